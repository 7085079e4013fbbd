"""CMA-ES, the covariance matrix adaptation evolution strategy, batched over runs [hansen2016].

Equation numbers are those of the tutorial, arXiv 1604.00772, with its default constants but one thing: its negative
weights of the worse half (active CMA) are left out, so that the weights are positive and sum to 1. Phase two of
SHADE-CMA.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np

from accelcal_cli.optimizers.base import CONVERGED, RUNNING, State
from accelcal_cli.problem import Problem
from accelcal_cli.streams import Float, Streams

SMALLEST_SIGMA = 1e-300


@dataclass(frozen=True)
class Constants:
    """Default strategy parameters for lambda samples in D dimensions, tutorial table 1."""

    weights: Float  # (mu,)
    mu_eff: float
    c_sigma: float
    d_sigma: float
    c_c: float
    c_1: float
    c_mu: float
    chi: float  # E |N(0, I)|

    @classmethod
    @cache
    def of(cls, samples: int, D: int) -> Constants:
        """Return the default constants."""
        raw = math.log((samples + 1) / 2) - np.log(np.arange(1, samples // 2 + 1))
        w = raw / raw.sum()
        mu = 1.0 / float((w**2).sum())
        c_sigma = (mu + 2) / (D + mu + 5)
        c_1 = 2 / ((D + 1.3) ** 2 + mu)
        return cls(
            w,
            mu,
            c_sigma,
            1 + 2 * max(0.0, math.sqrt((mu - 1) / (D + 1)) - 1) + c_sigma,
            (4 + mu / D) / (D + 4 + 2 * mu / D),
            c_1,
            min(1 - c_1, 2 * (mu - 2 + 1 / mu) / ((D + 2) ** 2 + mu)),
            math.sqrt(D) * (1 - 1 / (4 * D) + 1 / (21 * D * D)),
        )


@dataclass(frozen=True, eq=False)
class CmaState(State):
    """A search distribution for each run; x and fx are its last samples."""

    mean: Float  # (R, D)
    sigma: Float  # (R,)
    C: Float  # (R, D, D)
    axes: Float  # B, eigenvectors of C, (R, D, D)
    lengths: Float  # square roots of its eigenvalues, (R, D)
    path_sigma: Float  # (R, D)
    path_c: Float  # (R, D)
    generation: int
    used: int  # evaluations so far


def start(x: Float, fx: Float, samples: int, used: int) -> CmaState:
    """Return the search distribution of a population x, shape (R, P, D): its best point, half its covariance.

    The covariance is normalised to unit mean variance and mixed half and half with the identity; sigma is the square
    root of that mean variance.
    """
    runs, _, D = x.shape
    best = x[np.arange(runs), fx.argmin(axis=1)]
    centred = x - x.mean(axis=1, keepdims=True)
    covariance = centred.swapaxes(1, 2) @ centred / x.shape[1]
    variance = np.maximum(np.einsum("rdd->r", covariance) / D, SMALLEST_SIGMA)
    C = 0.5 * covariance / variance[:, None, None] + 0.5 * np.eye(D)
    values, axes = np.linalg.eigh(C)
    zeros = np.zeros((runs, D))
    first = np.broadcast_to(best[:, None], (runs, samples, D))
    return CmaState(
        first,
        np.broadcast_to(fx.min(axis=1)[:, None], (runs, samples)),
        best,
        np.sqrt(variance),
        C,
        axes,
        np.sqrt(np.maximum(values, 0.0)),
        zeros,
        zeros,
        generation=0,
        used=used,
    )


def step(problem: Problem, state: CmaState, rng: Streams, budget: int) -> CmaState:
    """Sample, rank, and adapt mean, paths, covariance and step size."""
    samples, D = state.x.shape[1:]
    k = Constants.of(samples, D)
    x, y = _sample(problem, state, rng)
    fx = problem.cost(x)
    rows, order = np.arange(len(fx))[:, None], np.argsort(fx, axis=1, kind="stable")
    ranked, chosen = fx[rows, order], y[rows, order[:, : len(k.weights)]]
    moved = np.add.reduce(k.weights[:, None] * chosen, axis=1)  # eq. 41
    mean = state.mean + state.sigma[:, None] * moved  # eq. 42
    kept, push = 1 - k.c_sigma, math.sqrt(k.c_sigma * (2 - k.c_sigma) * k.mu_eff)
    path_sigma = kept * state.path_sigma + push * _whiten(state, moved)  # eq. 43
    length = np.sqrt(np.add.reduce(path_sigma**2, axis=1))
    sigma = _step_size(problem, state.sigma, length, ranked, k)
    bound = (1.4 + 2 / (D + 1)) * k.chi * math.sqrt(1 - kept ** (2 * (state.generation + 1)))
    short = (length < bound)[:, None]  # h_sigma
    path_c = (1 - k.c_c) * state.path_c + short * math.sqrt(k.c_c * (2 - k.c_c) * k.mu_eff) * moved  # eq. 45
    C = _adapt(state.C, path_c, chosen, short, k)
    values, axes = np.linalg.eigh(C)
    lengths = np.sqrt(np.maximum(values, 0.0))
    used = state.used + samples
    done = (sigma * lengths[:, -1] < SMALLEST_SIGMA) | (ranked[:, 0] == 0) | (used + samples > budget)
    status = np.where(done, CONVERGED, RUNNING).astype(np.int8)
    return CmaState(
        x, fx, mean, sigma, C, axes, lengths, path_sigma, path_c, state.generation + 1, used, status=status
    )


def _sample(problem: Problem, state: CmaState, rng: Streams) -> tuple[Float, Float]:
    """Return new points, pressed into the box, and their steps from the mean over sigma, shapes (R, P, D)."""
    z = rng.normal(*state.x.shape[1:])
    y = (z * state.lengths[:, None]) @ state.axes.swapaxes(1, 2)  # eq. 39
    mean, sigma = state.mean[:, None], state.sigma[:, None, None]
    drawn = mean + sigma * y  # eq. 40
    x = np.clip(drawn, *problem.limits)
    pressed = x != drawn
    if pressed.any():
        # The other steps stay as drawn, not as rounded: rounded to the spacing of doubles around the mean they shrink
        # to nothing, and sigma with them, one step of that spacing before the minimum.
        y = np.where(pressed, (x - mean) / sigma, y)
    return x, y


def _step_size(problem: Problem, sigma: Float, length: Float, ranked: Float, k: Constants) -> Float:
    """Return the new sigma, eq. 44, from the length of its path and the costs in order, at most the box."""
    sigma = sigma * np.exp(k.c_sigma / k.d_sigma * (length / k.chi - 1))
    # The best 70 % of samples cost the same: no direction to go, so the step has to grow.
    flat = ranked[:, 0] == ranked[:, math.ceil(0.7 * ranked.shape[1]) - 1]
    sigma = np.where(flat, sigma * math.exp(0.2 + k.c_sigma / k.d_sigma), sigma)
    least: Float = np.minimum(sigma, (problem.upper - problem.lower).max())
    return least


def _whiten(state: CmaState, y: Float) -> Float:
    """Return C^(-1/2) y, shape (R, D)."""
    turned = np.einsum("rij,ri->rj", state.axes, y) / np.maximum(state.lengths, SMALLEST_SIGMA)
    white: Float = np.einsum("rij,rj->ri", state.axes, turned)
    return white


def _adapt(C: Float, path: Float, chosen: Float, short: Float, k: Constants) -> Float:
    """Return the new covariance, eq. 47: rank-one update by the path, rank-mu update by the best samples."""
    lost = (1 - short) * k.c_c * (2 - k.c_c)
    kept = 1 - k.c_1 - k.c_mu + k.c_1 * lost[..., None]
    rank_one = path[:, :, None] * path[:, None, :]
    rank_mu = (chosen * k.weights[:, None]).swapaxes(1, 2) @ chosen
    C = kept * C + k.c_1 * rank_one + k.c_mu * rank_mu
    symmetric: Float = 0.5 * (C + C.swapaxes(1, 2))
    return symmetric
