"""From the noise of a pose to the one-sigma of the parameters: where it holds, and what it is in each gauge.

The nine parameters are those of `quality`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accelcal_cli.calibration.lotters import ROWS_COLUMNS
from accelcal_cli.calibration.quality import BIAS, Observabilities, Verdict
from accelcal_cli.streams import Bool, Float


def covariance(seen: Observabilities, variance: Float, walled: Bool, g: float) -> Float:
    """Return the covariance of the nine parameters, (m/s^2)^2, shape (R, 9, 9); NaN where it does not hold.

    Args:
        seen: what the poses of R sensors say.
        variance: of one pose's modulus, (m/s^2)^2, shape (R,).
        walled: whose search stopped at a wall of its box, shape (R,): that is not the least-squares answer.
        g: local gravity, m/s^2.
    """
    held = firm(seen.dop, seen.verdicts, np.sqrt(variance), g) & ~walled[:, None]
    return np.where(held[:, :, None] & held[:, None], variance[:, None, None] * seen.cofactor, np.nan)


def firm(dop: Float, verdict: Sequence[Verdict], s: Float, g: float) -> Bool:
    """Return which of the nine parameters of R sensors the linear covariance holds for, shape (R, 9).

    Poses that leave a direction open leave a valley of almost equal cost, and the valley bends: an error d along
    it moves every other parameter by about d^2 / 2g. Where that is more than their own error, or d is without
    bound, the covariance tells less than what chance decides.

    Args:
        dop: dilution of precision, shape (R, 9); verdict: on the poses, R of them.
        s: standard deviation of one pose's modulus, m/s^2, shape (R,); g: local gravity, m/s^2.
    """
    bounded = np.isfinite(dop).all(axis=1, keepdims=True)
    error = s[:, None] * np.where(bounded, dop, 0.0)
    bend = error.max(axis=1, keepdims=True) ** 2 / (2.0 * g)
    poor = np.array([word == "undetermined" for word in verdict], dtype=bool)
    return np.where(poor[:, None], bounded & (error >= bend), True)


def propagate(K: Float, K_lower: Float, covariance: Float, gauge: str, g: float) -> tuple[Float, Float]:
    """Return one-sigma of K_a in a gauge, shape (..., 3, 3), and of D_a, shape (..., 3).

    Args:
        K: K_a in `gauge`, shape (..., 3, 3); K_lower: the same sensors in gauge `lower`.
        covariance: of the nine parameters, (m/s^2)^2, shape (..., 9, 9).
        gauge: `lower`, `upper` or `symmetric`; in `full` the free rotation moves every entry of K_a, the diagonal to
            second order, and they come out as NaN.
        g: local gravity, m/s^2.
    """
    variance = np.einsum("...pp->...p", covariance)
    sigma_D = np.sqrt(variance[..., BIAS]) * np.einsum("...ii->...i", K_lower)
    if gauge == "full":
        return np.full(K.shape, np.nan), sigma_D
    chain = gauge_chain(K, K_lower, gauge, g)
    lost = np.isnan(variance[..., :6])
    square = np.einsum("...ip,...pq,...iq->...i", chain, np.nan_to_num(covariance[..., :6, :6]), chain)
    size = np.abs(chain)
    felt = size > 1e-9 * size.max(axis=(-1, -2), keepdims=True)
    touched = (felt & lost[..., None, :]).any(axis=-1)
    sigma_K = np.where(touched, np.nan, np.sqrt(np.maximum(square, 0.0))).reshape(K.shape)
    exact = {"lower": np.triu(np.ones((3, 3)), 1), "upper": np.tril(np.ones((3, 3)), -1)}
    # A zero of the gauge has no error.
    return np.where(exact.get(gauge, np.zeros((3, 3))), 0.0, sigma_K), sigma_D


def gauge_chain(K: Float, K_lower: Float, gauge: str, g: float) -> Float:
    """Return d K / d parameters, shape (..., 9, 6): entries of K_a in a gauge by the first six of the nine parameters.

    A change E of the inverse matrix in gauge `lower` moves K by -K (R E R^T - W), R = K^-1 K_lower, where the
    small rotation W (skew) is the one that keeps K in its gauge: three linear conditions. In `full`, which has none,
    W leaves the body frame unturned.
    """
    R = np.linalg.solve(K, K_lower)
    turned = [K @ _skew(axis) for axis in np.eye(3)]
    turns = np.stack([_conditions(change, gauge) for change in turned], axis=-1)
    columns = []
    for i, j in ROWS_COLUMNS[:6]:
        moved = R[..., :, i, None] * R[..., None, :, j] / g  # R E R^T
        change = -0.5 * K @ (moved + moved.swapaxes(-1, -2))
        if gauge != "full":
            angle = np.linalg.solve(turns, -_conditions(change, gauge)[..., None])
            for k, turn in enumerate(turned):
                change = change + angle[..., k, :, None] * turn
        columns.append(change.reshape(*K.shape[:-2], 9))
    return np.stack(columns, axis=-1)


def _conditions(change: Float, gauge: str) -> Float:
    """Return what must vanish for a change of K to stay in the gauge, shape (..., 3)."""
    above, below = change[..., [0, 0, 1], [1, 2, 2]], change[..., [1, 2, 2], [0, 0, 1]]
    return {"lower": above, "upper": below}.get(gauge, above - below)


def _skew(axis: Float) -> Float:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
