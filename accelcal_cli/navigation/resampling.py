"""Weights and resampling as pure functions; weights are logarithms until they are needed.

All are batched over runs: weights of shape (R, N), draws u that the caller took from each run's own stream.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.streams import Float, Int


def normalised(log_weights: Float) -> Float:
    """Return weights that sum to 1, shape (R, N); equal ones where no particle has any likelihood."""
    weights: Float = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def effective_size(weights: Float) -> Float:
    """Return N_eff = 1 / sum w^2, shape (R,). [depf2015] eq. 2."""
    size: Float = 1.0 / np.square(weights).sum(axis=1)
    return size


def systematic(weights: Float, u: Float) -> Int:
    """Return the chosen particles, shape (R, N): one draw and N equal strides [kitagawa1996].

    Args:
        weights: shape (R, N), summing to 1.
        u: U[0, 1), shape (R,).
    """
    count = weights.shape[1]
    cumulative = np.cumsum(weights, axis=1)
    cumulative /= cumulative[:, -1:]
    before = np.ceil(count * cumulative - u[:, None]).astype(np.intp)
    return _repeated(np.diff(np.clip(before, 0, count), axis=1, prepend=0))


def residual(weights: Float, u: Float) -> Int:
    """Return the chosen particles, shape (R, N): the whole parts of N w, and the rest systematically [liu1998].

    Args:
        weights: shape (R, N), summing to 1.
        u: U[0, 1), shape (R,).
    """
    count = weights.shape[1]
    copies = np.floor(count * weights + 1e-12)
    rest = count * weights - copies
    left = count - copies.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(np.maximum(rest, 0.0), axis=1)
    total = np.where(cumulative[:, -1:] > 0, cumulative[:, -1:], 1.0)
    before = np.ceil(left * cumulative / total - u[:, None]).astype(np.intp)
    before = np.clip(before, 0, left.astype(np.intp))
    before[:, -1:] = left.astype(np.intp)
    return _repeated(copies.astype(np.intp) + np.diff(before, axis=1, prepend=0))


def _repeated(copies: Int) -> Int:
    """Return each particle's number as often as it is copied, shape (R, N); every row of copies sums to N."""
    runs, count = copies.shape
    return np.repeat(np.tile(np.arange(count), runs), copies.ravel()).reshape(runs, count)


SCHEMES = {"systematic": systematic, "residual": residual}


def moments(weights: Float, x: Float) -> tuple[Float, Float]:
    """Return mean, shape (R, D), and covariance, shape (R, D, D), of weighted particles x, shape (R, N, D)."""
    mean = (weights[:, :, None] * x).sum(axis=1)
    away = (x - mean[:, None]).swapaxes(1, 2)
    return mean, (weights[:, None] * away) @ away.swapaxes(1, 2)
