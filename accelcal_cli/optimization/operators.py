"""Operators on whole populations that several optimizers share: choosing, selecting, clipping to the box."""

from __future__ import annotations

from functools import cache

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.optimization.problem import Bound, points


def gather(x: Float, index: Int) -> Float:
    """Return points of each run's population, x (R, P, D) at index (R, Q): shape (R, Q, D)."""
    flat = x.transpose(0, 2, 1)
    if len(flat) == 1:
        return np.asarray(flat.take(index[0], axis=2).transpose(0, 2, 1))
    out = np.empty((*flat.shape[:2], index.shape[1]))
    for source, columns, target in zip(flat, index, out, strict=True):
        source.take(columns, axis=1, out=target, mode="clip")  # "raise" would copy once more
    return out.transpose(0, 2, 1)


def clip(x: Float, low: Bound, high: Bound) -> None:
    """Clip x, shape (R, P, D), to low and high, in place."""
    if isinstance(low, float):
        x.clip(low, high, out=x)
    else:
        np.maximum(x, low, out=x)
        np.minimum(x, high, out=x)


def better_of(x: Float, fx: Float, new: Float, new_cost: Float) -> tuple[Float, Float]:
    """Return x and fx with every point replaced whose new one costs less; x, new (R, P, D), costs (R, P)."""
    better = new_cost < fx
    return np.where(better[..., None], new, x), np.minimum(new_cost, fx)


def best_of(x: Float, fx: Float) -> Float:
    """Return each run's best point, shape (R, D)."""
    return points(x, fx.argmin(axis=1))


def moved_to_best(leader: Float, cost: Float, x: Float, fx: Float) -> tuple[Float, Float]:
    """Return leader (R, 1, D) and its cost (R,), replaced by the best of x (R, P, D) where that costs less."""
    least = fx.min(axis=1)
    better = (least < cost)[:, None, None]
    return np.where(better, best_of(x, fx)[:, None], leader), np.minimum(least, cost)


def integers(u: Float, *below: int) -> Int:
    """Return integers, shape (..., C, P), from uniform numbers, shape (..., P, C); column c is in 0 .. below[c] - 1."""
    return np.asarray((u.swapaxes(-1, -2) * _column(below)).astype(np.intp))


@cache
def _column(values: tuple[int, ...]) -> Float:
    return np.array(values, dtype=float)[:, None]


def partners(picks: Int) -> tuple[Int, Int]:
    """Return two distinct partners, neither of them itself, for every individual.

    Args:
        picks: random integers below P - 1 and below P - 2, shape (..., 2, P), P >= 3; overwritten by the indices.

    Returns:
        Indices, twice (..., P). Drawn without rejection: the first is so many places further among
        the P - 1 others, the second among the P - 2 that remain.
    """
    first, second = picks[..., 0, :], picks[..., 1, :]
    second += second >= first
    size = picks.shape[-1]
    picks += np.arange(1, size + 1)
    picks -= size * (picks >= size)
    return first, second


def mutated_genes(u: Float, keep: float, gene: Int) -> Float:
    """Return 1 where a trial takes the mutant's gene, 0 where its parent's, shape (R, K, P, D), [dpso2014] eq. 5.

    Args:
        u: uniform numbers, one per gene, shape (R, K, P, D) of K iterations.
        keep: P_c, the probability to keep the parent's gene.
        gene: J_rand, the gene that always comes from the mutant, shape (R, K, P).
    """
    mutated = (u > keep).astype(float)
    runs, iterations, individuals = (np.arange(size) for size in gene.shape)
    mutated[runs[:, None, None], iterations[:, None], individuals, gene] = 1.0
    return mutated
