"""What the scatter of the readings within each pose says of the noise of its mean."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.chances import chi_square_chance
from accelcal_cli.streams import Float


def explained(u: Float, scatter: Float, behind: Float, scale: Float) -> Float:
    """Return the variance of each pose's modulus that its scatter explains, (m/s^2)^2, shape (..., J).

    Args:
        u: directions of the specific force, shape (..., J, 3).
        scatter: standard deviation of one raw reading, output units, same shape; behind: how many, shape (..., J).
        scale: scale factors, output units per m/s^2, shape (..., 3).
    """
    force = scatter / scale[..., None, :]
    variance: Float = np.sum((u * force) ** 2, axis=-1) / behind
    return variance


def beyond_scatter(s: float, variance: float, freedom: int) -> tuple[float | None, float | None]:
    """Return s over the noise of a mean variance `explained`, and the chance of so large a ratio; None without any."""
    if freedom < 1 or not s > 0 or not variance > 0:
        return None, None
    ratio = s / float(np.sqrt(variance))
    chance = chi_square_chance(np.array([freedom * ratio**2]), np.array([freedom]))
    return ratio, float(chance[0])
