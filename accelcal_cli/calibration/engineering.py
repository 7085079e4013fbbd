"""A sensor as an engineer states it: sensitivity of each axis, angles between the axes, bias as force along an axis.

None of these nine depends on the gauge. They follow from the nine parameters of `observability`, whose K_A changes by
(I + E / g) K_A and K_a with it by -K_a E / g, with k_i the rows of K_a, s_i their lengths and r_i = k_i / s_i:

    d s_i / s_i = -r_i E r_i / g
    d (r_i r_j) = -r_i (E + E^T) r_j / g - r_i r_j (d s_i / s_i + d s_j / s_j)
    d (D_i / s_i) = d D_i / s_i - D_i / s_i (d s_i / s_i)
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import ROWS_COLUMNS
from accelcal_cli.sensor.model import AXIS_PAIRS, bias_force, misalignment, sensitivity


def quantities(K: Float, D: Float) -> Float:
    """Return sensitivities, misalignments (rad) and biases as force, shape (..., 9), in the order of PARAMETERS.

    Args:
        K: K_a in any gauge, shape (..., 3, 3); D: bias, less its nominal value where there is one, shape (..., 3).
    """
    return np.concatenate([sensitivity(K), misalignment(K), bias_force(K, D)], axis=-1)


def chain(lower: Float, D: Float, g: float) -> Float:
    """Return d quantities / d parameters, shape (..., 9, 9); sensitivities as a part of themselves.

    Args:
        lower: K_a in gauge `lower`, shape (..., 3, 3); D: as of `quantities`, shape (..., 3).
        g: local gravity, m/s^2: the first six parameters are g times the entries of E.
    """
    s = sensitivity(lower)
    rows = lower / s[..., None]
    change = np.zeros((*lower.shape[:-2], 9, 9))
    for p, (a, b) in enumerate(ROWS_COLUMNS[:6]):
        scale = -rows[..., a] * rows[..., b] / g
        change[..., :3, p] = scale
        for q, (i, j) in enumerate(AXIS_PAIRS):
            cosine = np.sum(rows[..., i, :] * rows[..., j, :], axis=-1)
            turn = -(rows[..., i, a] * rows[..., j, b] + rows[..., i, b] * rows[..., j, a]) / g
            turn -= cosine * (scale[..., i] + scale[..., j])
            change[..., 3 + q, p] = turn / np.sqrt(1.0 - cosine**2)
        change[..., 6:, p] = -D / s * scale
    for i in range(3):
        change[..., 6 + i, 6 + i] = lower[..., i, i] / s[..., i]
    return change


def propagated(change: Float, covariance: Float) -> Float:
    """Return the standard deviations that a covariance, shape (..., 9, 9), gives the quantities of a `chain`.

    NaN for a quantity that a parameter without a variance moves: shape (..., 9).
    """
    lost = np.isnan(np.einsum("...pp->...p", covariance))
    square = np.einsum("...ip,...pq,...iq->...i", change, np.nan_to_num(covariance), change)
    size = np.abs(change)
    moved = size > NEGLIGIBLE * size.max(axis=(-1, -2), keepdims=True)
    touched = (moved & lost[..., None, :]).any(axis=-1)
    return np.where(touched, np.nan, np.sqrt(np.maximum(square, 0.0)))


NEGLIGIBLE = 1e-9
"""A derivative below this part of the largest is rounding."""
