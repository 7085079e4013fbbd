"""Weights of poses that share an error of their own beside the noise of their readings.

The variance of a pose is m^2 + v_j: v_j from the scatter of its readings and their number, m^2 what the fit leaves
beyond that (a table that gives, a sensor that is not linear), the same for all poses. Weights 1 / (m^2 + v_j) follow
the number of readings while noise rules, and level off where it does not. m^2 is the value for which the weighted
squares have their expectation J - 9 [paule1982].

Robust losses by iterative reweighting, and the weights of unequal poses.

What the scatter of the readings within each pose says of the noise of its mean.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.distributions import chi_square_chance
from accelcal_cli.calibration.fit import modulus_errors
from accelcal_cli.calibration.settings import Robust, Weights
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel

HUBER = 1.345
"""Huber's k: 95 % of the efficiency of least squares under normal noise (Huber 1964)."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SAMPLE = 100_000
"""At most about this many residuals decide the scale."""


def loss_weight(z: Float, loss: Robust) -> Float:
    """Return the weight psi(z) / z of residuals z in units of the noise, same shape."""
    if loss == "huber":
        return HUBER / np.maximum(np.abs(z), HUBER)
    return 1.0 / np.sqrt(1.0 + z * z)  # soft-L1: rho = 2 (sqrt(1 + z^2) - 1)


def loss_slope(z: Float, loss: Robust) -> Float:
    """Return psi'(z), same shape."""
    if loss == "huber":
        return (np.abs(z) <= HUBER).astype(float)
    return (1.0 + z * z) ** -1.5


def noise_scale(readings: Readings, model: ErrorModel, g: float) -> float:
    """Return a robust standard deviation of e, m/s^2: its median absolute value times 1.4826."""
    stride = max(1, readings.poses // SAMPLE)
    sizes = [np.abs(e)[(-first) % stride :: stride] for first, e, _ in modulus_errors(readings, model, g)]
    # Nine parameters follow the smallest residuals: the factor gives the scale back what they took.
    freedom = max(1.0, readings.poses - 9.0) / readings.poses
    return NORMAL_MAD * float(np.median(np.concatenate(sizes))) / float(np.sqrt(freedom))


def robust_blocks(
    readings: Readings, model: ErrorModel, g: float, scale: float, loss: Robust, weights: Float | None
) -> Iterator[tuple[Float, Float]]:
    """Yield readings with their robust weights, block by block."""
    errors = modulus_errors(readings, model, g)
    for (first, block), (_, e, _) in zip(readings.blocks(), errors, strict=True):
        own = 1.0 if weights is None else weights[first : first + len(e)]
        yield block, own * loss_weight(np.sqrt(own) * e / scale, loss)


def robust_variance(
    readings: Readings, model: ErrorModel, g: float, scale: float, loss: Robust, weights: Float | None
) -> float:
    """Return the factor of (J^T W J)^-1 in the covariance of the M-estimate, (m/s^2)^2 [huber1981].

    Definition: sum psi^2 / (J - 9) / (mean psi')^2, in units of m/s^2 squared. W are the weights of the poses, without
    those of the loss.
    """
    square, slope = 0.0, 0.0
    for first, e, _ in modulus_errors(readings, model, g):
        own = np.ones(len(e)) if weights is None else weights[first : first + len(e)]
        z = np.sqrt(own) * e / scale
        square += float(np.sum((loss_weight(z, loss) * z * scale) ** 2))
        slope += float(np.sum(loss_slope(z, loss)))
    return square / max(1, readings.poses - 9) / (slope / readings.poses) ** 2


def pose_weights(readings: Readings, choice: Weights) -> Float | None:
    """Return the weights of the poses, mean 1, shape (J,), or None when all count alike.

    Raises:
        DataError: the readings carry no count or scatter to weigh by.
    """
    if choice == "none":
        return None
    if readings.count is None:
        raise DataError(
            f'{readings.source}: --weights {choice} needs a column "n" or repeated readings of a pose'
        )
    weights = readings.count.astype(float)
    if choice == "sd":
        if readings.scatter is None or not (readings.scatter > 0).any(axis=1).all():
            raise DataError(
                f"{readings.source}: --weights sd needs standard deviations above zero (columns sx, sy, sz) "
                "or at least two readings of every pose"
            )
        weights = weights / np.mean(readings.scatter**2, axis=1)
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        raise DataError(f"{readings.source}: --weights {choice}: every weight has to be a positive number")
    scaled: Float = weights / weights.mean()
    return scaled


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
