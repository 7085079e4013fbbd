"""Weights of unequal poses, and the weights that a robust loss gives residuals.

The weights of the poses come from what stands beside the readings: how many raw readings a pose is the mean of, and
how much they scatter. `auto` adds what the fit leaves beyond that (calibration.search).
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.settings import Robust, Weights

HUBER = 1.345
"""Huber's k: 95 % of the efficiency of least squares under normal noise (Huber 1964)."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

NEEDS = {
    "n": 'a column "n" or repeated readings per pose',
    "sd": "standard deviations above zero (columns sx, sy, sz) or at least two readings per pose",
    "auto": "the number of readings and their standard deviation (columns n, sx, sy, sz), or at least two readings "
    "per pose",
}
"""What weights need to stand beside the readings, in words."""


def pose_weights(sample: Sample, choice: Weights) -> Float | None:
    """Return the weights of the poses, mean 1 per sensor, 0 for repetitions, shape (R, J); None when all count alike.

    A sensor whose readings do not give them (see `without_weights`) has weights without meaning.
    """
    real = sample.real(0, int(sample.poses.max()))
    if choice == "none" or sample.count is None:
        return None if real.all() else real.astype(float)
    weights = sample.count.astype(float)
    if choice == "sd" and sample.scatter is not None:
        square = np.mean(sample.scatter**2, axis=2)
        weights = np.divide(weights, square, out=np.full(weights.shape, np.nan), where=square > 0)
    weights = np.where(real, weights, 0.0)
    mean: Float = weights.sum(axis=1, keepdims=True) / sample.poses[:, None]
    return weights / mean


def without_weights(sample: Sample, choice: Weights) -> Bool:
    """Return which sensors have readings that do not give the weights, shape (R,)."""
    if choice == "none":
        return np.zeros(len(sample), dtype=bool)
    count, scatter = sample.count, sample.scatter
    if count is None or (choice != "n" and scatter is None):
        return np.ones(len(sample), dtype=bool)
    usable: Bool = np.isfinite(count) & (count > 0)
    if scatter is not None and choice != "n":
        usable &= ~np.isnan(scatter).any(axis=2)
        usable &= (choice == "auto") | (scatter > 0).any(axis=2)
    return np.asarray((~usable & sample.real(0, count.shape[1])).any(axis=1))


def explained(u: Float, scatter: Float, count: Float, scale: Float) -> Float:
    """Return the variance of each pose's modulus that its scatter explains, (m/s^2)^2, shape (..., J).

    Args:
        u: directions of the specific force, shape (..., J, 3).
        scatter: standard deviation of one raw reading, output units, same shape; count: how many, shape (..., J).
        scale: scale factors, output units per m/s^2, shape (..., 3).
    """
    force = scatter / scale[..., None, :]
    variance: Float = np.sum((u * force) ** 2, axis=-1) / count
    return variance


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
