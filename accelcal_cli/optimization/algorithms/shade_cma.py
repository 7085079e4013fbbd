"""SHADE-CMA: L-SHADE, then CMA-ES from where it has gathered.

Phase one is success-history adaptive differential evolution with linear population size reduction [tanabe2014]:
current-to-pbest/1 with an archive, F and CR drawn around remembered successes. Phase two is the covariance matrix
adaptation evolution strategy [hansen2016], started at the best point with the shape of the last population. The first
finds the right valley among many, the second follows it to rounding.

The size of the population is a schedule over the evaluations and thus common to all runs of a batch; the archive has
one capacity and a count of its own for each run.

Equation numbers are those of the tutorial, arXiv 1604.00772, with its default constants but one thing: its negative
weights of the worse half (active CMA) are left out, so that the weights are positive and sum to 1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.optimization.operators import best_of, gather, integers
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State, Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

TERMINAL = np.nan
"""Value of M_CR that is never left: CR is 0 from then on, one gene at a time [tanabe2014]."""

SMALLEST_SIGMA = 1e-300
"""Step size below which phase two has converged: close to the smallest double."""


@dataclass(frozen=True, eq=False)
class ShadeState(State):
    """Phase one: the population with its memories and archive."""

    weights: Float  # M_F, (R, H)
    rates: Float  # M_CR, TERMINAL once CR = 0 alone succeeded, (R, H)
    position: Int  # next memory entry to write, (R,)
    archive: Float  # (R, A, D)
    archived: Int  # entries in use, (R,)
    used: int  # evaluations so far


@dataclass(frozen=True, eq=False)
class CmaState(State):
    """Phase two: a search distribution for each run; x and fx are its last samples."""

    mean: Float  # (R, D)
    sigma: Float  # (R,)
    C: Float  # (R, D, D)
    axes: Float  # B, eigenvectors of C, (R, D, D)
    lengths: Float  # square roots of its eigenvalues, (R, D)
    path_sigma: Float  # (R, D)
    path_c: Float  # (R, D)
    generation: int
    used: int  # evaluations so far


@OPTIMIZERS.register("shade-cma")
@dataclass(frozen=True)
class ShadeCma(Optimizer[ShadeState | CmaState]):
    """L-SHADE followed by CMA-ES on one budget of evaluations."""

    family = "evolution"
    paper = "tanabe2014"

    population: int = setting(200, "starting population of phase one", low=8, high=100_000)
    iterations: int = setting(
        1_000_000, "steps at most; the evaluations end it first", low=1, high=100_000_000
    )
    evaluations: int = setting(50_000, "budget of both phases", low=500, high=1_000_000_000)
    phase_one: float = setting(0.65, "part of the budget for phase one", above=0, high=0.95)
    smallest: int = setting(
        12, "population at the end of phase one, and lambda of phase two", low=4, high=1000
    )
    memory: int = setting(6, "entries of the success history (H)", low=1, high=1000)
    greed: float = setting(0.2, "part of the population that may lead (p)", above=0, high=1)
    archive: float = setting(1.4, "archive size, part of the population", low=0, high=10)
    samples: int | None = setting(None, "lambda of phase two, where it is not `smallest`", low=4, high=1000)

    @property
    def points_per_run(self) -> int:
        """A quarter of the starting population: it shrinks fast, and phase two lives on many runs at once."""
        return max(1, self.population // 4)

    def init(self, problem: Problem, x: Float, rng: Streams) -> ShadeState:
        """Start with every memory entry at 0.5 and an empty archive."""
        runs, population, dimensions = x.shape
        half = np.full((runs, self.memory), 0.5)
        store = np.zeros((runs, dimensions, int(self.archive * population))).swapaxes(1, 2)
        zeros = np.zeros(runs, dtype=np.intp)
        return ShadeState(x, problem.cost(x), half, half, zeros, store, zeros, used=population)

    def step(self, problem: Problem, state: ShadeState | CmaState, rng: Streams) -> ShadeState | CmaState:
        """Make one generation of the phase that the evaluations are in."""
        if isinstance(state, CmaState):
            return _cma_step(problem, state, rng, self.evaluations)
        if state.used + state.x.shape[1] > self.phase_one * self.evaluations:
            first = _cma_start(state.x, state.fx, self.samples or self.smallest, state.used)
            return _cma_step(problem, first, rng, self.evaluations)
        return self._generation(problem, state, rng)

    def _generation(self, problem: Problem, state: ShadeState, rng: Streams) -> ShadeState:
        x, fx = state.x, state.fx
        population, dimensions = x.shape[1:]
        u = rng.uniform(population, dimensions + 6)
        F, CR = self._draw(state, u[..., 0], u[..., 1], rng)
        trial = self._mutants(state, F, u[..., 2:5])
        # A coordinate outside the box goes halfway between its parent and the wall.
        low, high = problem.limits
        np.copyto(trial, 0.5 * (x + low), where=trial < low)
        np.copyto(trial, 0.5 * (x + high), where=trial > high)
        keep = u[..., 6:] > CR[..., None]
        gene = integers(u[..., 5:6], dimensions)[:, 0]
        keep[np.arange(len(x))[:, None], np.arange(population), gene] = False
        np.copyto(trial, x, where=keep)
        trial_cost = problem.cost(trial)
        better = trial_cost < fx
        gain = np.where(better, fx - trial_cost, 0.0)
        state = self._learn(state, F, CR, gain)
        state = self._archive(state, better, rng.uniform(population, 1)[..., 0])
        # A tie moves the individual too, and teaches nothing: on a plateau the population drifts.
        moves = trial_cost <= fx
        x, fx = np.where(moves[..., None], trial, x), np.where(moves, trial_cost, fx)
        return self._reduce(replace(state, x=x, fx=fx, used=state.used + population))

    def _draw(self, state: ShadeState, u: Float, v: Float, rng: Streams) -> tuple[Float, Float]:
        """Return F, Cauchy around a remembered value and positive, and CR, normal and cut to [0, 1].

        Redrawing F while it is not positive is drawing from the part of the distribution above zero.
        """
        entry = (u * self.memory).astype(np.intp)
        centre = np.take_along_axis(state.weights, entry, axis=1)
        least = 0.5 + np.arctan(-centre / 0.1) / np.pi
        F = centre + 0.1 * np.tan(np.pi * (least + (1.0 - least) * v - 0.5))
        CR = np.take_along_axis(state.rates, entry, axis=1) + 0.1 * rng.normal(state.x.shape[1], 1)[..., 0]
        return np.clip(F, 1e-12, 1.0), np.where(np.isnan(CR), 0.0, np.clip(CR, 0.0, 1.0))

    def _mutants(self, state: ShadeState, F: Float, u: Float) -> Float:
        """Return x + F (x_pbest - x) + F (x_r1 - x_r2), r2 from population and archive."""
        x, population = state.x, state.x.shape[1]
        order = np.argsort(state.fx, axis=1, kind="stable")
        leaders = max(2, round(self.greed * population))
        leader = gather(x, np.take_along_axis(order, (u[..., 0] * leaders).astype(np.intp), axis=1))
        own = np.arange(population)
        first = (u[..., 1] * (population - 1)).astype(np.intp)
        first += first >= own
        pool = population + state.archived[:, None]
        second = (u[..., 2] * (pool - 2)).astype(np.intp)
        second += second >= np.minimum(first, own)
        second += second >= np.maximum(first, own)
        both = np.concatenate((x, state.archive), axis=1)
        mutant = gather(x, first)
        mutant -= gather(both, second)
        mutant += leader
        mutant -= x
        mutant *= F[..., None]
        mutant += x
        return mutant

    def _learn(self, state: ShadeState, F: Float, CR: Float, gain: Float) -> ShadeState:
        """Write the weighted Lehmer means of the successful F and CR into the next memory entry.

        M_CR becomes TERMINAL when every successful CR is 0, and stays so.
        """
        total = gain.sum(axis=1)
        useful = (total > 0) & np.isfinite(total)
        w = gain / np.where(useful, total, 1.0)[:, None]
        rows = np.flatnonzero(useful)
        weights, rates = state.weights.copy(), state.rates.copy()
        entry = state.position[rows]
        weights[rows, entry] = _lehmer(w[rows], F[rows])
        ended = np.isnan(rates[rows, entry]) | ~(CR[rows] * (gain[rows] > 0)).any(axis=1)
        rates[rows, entry] = np.where(ended, TERMINAL, _lehmer(w[rows], CR[rows]))
        position = np.where(useful, (state.position + 1) % self.memory, state.position)
        return replace(state, weights=weights, rates=rates, position=position)

    def _archive(self, state: ShadeState, better: Bool, u: Float) -> ShadeState:
        """Put the parents that lost into the archive, in place of random entries once it is full."""
        capacity = state.archive.shape[1]
        if not capacity:
            return state
        archive, limit = state.archive.copy(order="K"), int(self.archive * state.x.shape[1])
        run, loser = np.nonzero(better)
        count = np.cumsum(better, axis=1)
        slot = state.archived[run] + count[run, loser] - 1
        slot = np.where(slot < limit, slot, (u[run, loser] * limit).astype(np.intp))
        archive[run, slot] = state.x[run, loser]
        return replace(state, archive=archive, archived=np.minimum(limit, state.archived + count[:, -1]))

    def _reduce(self, state: ShadeState) -> ShadeState:
        """Drop the worst individuals down to the size that the evaluations used allow."""
        part = state.used / (self.phase_one * self.evaluations)
        size = max(self.smallest, round(self.population + (self.smallest - self.population) * part))
        if size >= state.x.shape[1]:
            return state
        keep = np.argsort(state.fx, axis=1, kind="stable")[:, :size]
        return replace(
            state,
            x=gather(state.x, keep),
            fx=np.take_along_axis(state.fx, keep, axis=1),
            archived=np.minimum(state.archived, int(self.archive * size)),
        )


def _lehmer(w: Float, values: Float) -> Float:
    """Return the weighted Lehmer mean, shape (k,), of values (k, P) with weights w (k, P); 0 when all are 0."""
    below = np.add.reduce(w * values, axis=1)
    return np.asarray(np.add.reduce(w * values**2, axis=1) / np.where(below > 0, below, 1.0))


@dataclass(frozen=True)
class _Constants:
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
    def of(cls, samples: int, D: int) -> _Constants:
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


def _cma_start(x: Float, fx: Float, samples: int, used: int) -> CmaState:
    """Return the search distribution of a population x, shape (R, P, D): its best point, half its covariance.

    The covariance is normalised to unit mean variance and mixed half and half with the identity; sigma is the square
    root of that mean variance.
    """
    runs, _, D = x.shape
    best = best_of(x, fx)
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


def _cma_step(problem: Problem, state: CmaState, rng: Streams, budget: int) -> CmaState:
    """Sample, rank, and adapt mean, paths, covariance and step size."""
    samples, D = state.x.shape[1:]
    k = _Constants.of(samples, D)
    x, y = _sample(problem, state, rng)
    fx = problem.cost(x)
    rows, order = np.arange(len(fx))[:, None], np.argsort(fx, axis=1, kind="stable")
    ranked, steps = fx[rows, order], y[rows, order[:, : len(k.weights)]]
    step = np.add.reduce(k.weights[:, None] * steps, axis=1)  # eq. 41
    mean = state.mean + state.sigma[:, None] * step  # eq. 42
    decay, push = 1 - k.c_sigma, math.sqrt(k.c_sigma * (2 - k.c_sigma) * k.mu_eff)
    path_sigma = decay * state.path_sigma + push * _whiten(state, step)  # eq. 43
    length = np.sqrt(np.add.reduce(path_sigma**2, axis=1))
    sigma = _step_size(problem, state.sigma, length, ranked, k)
    bound = (1.4 + 2 / (D + 1)) * k.chi * math.sqrt(1 - decay ** (2 * (state.generation + 1)))
    short = (length < bound)[:, None]  # h_sigma
    path_c = (1 - k.c_c) * state.path_c + short * math.sqrt(k.c_c * (2 - k.c_c) * k.mu_eff) * step  # eq. 45
    C = _adapt(state.C, path_c, steps, short, k)
    values, axes = np.linalg.eigh(C)
    lengths = np.sqrt(np.maximum(values, 0.0))
    used = state.used + samples
    done = (sigma * lengths[:, -1] < SMALLEST_SIGMA) | (ranked[:, 0] == 0) | (used + samples > budget)
    status = np.where(done, Status.CONVERGED, Status.RUNNING).astype(np.int8)
    return CmaState(
        x, fx, mean, sigma, C, axes, lengths, path_sigma, path_c, state.generation + 1, used, status=status
    )


def _sample(problem: Problem, state: CmaState, rng: Streams) -> tuple[Float, Float]:
    """Return new points, clipped to the box, and their steps from the mean over sigma, shapes (R, P, D)."""
    y = (rng.normal(*state.x.shape[1:]) * state.lengths[:, None]) @ state.axes.swapaxes(1, 2)  # eq. 39
    mean, sigma = state.mean[:, None], state.sigma[:, None, None]
    sample = mean + sigma * y  # eq. 40
    x = np.clip(sample, *problem.limits)
    clipped = x != sample
    if clipped.any():
        # The other steps stay as drawn, not as rounded: rounded to the spacing of doubles around the mean they shrink
        # to nothing, and sigma with them, one step of that spacing before the minimum.
        y = np.where(clipped, (x - mean) / sigma, y)
    return x, y


def _step_size(problem: Problem, sigma: Float, length: Float, ranked: Float, k: _Constants) -> Float:
    """Return the new sigma, eq. 44, from the length of its path and the costs in order, at most the box."""
    sigma = sigma * np.exp(k.c_sigma / k.d_sigma * (length / k.chi - 1))
    # The best 70 % of samples cost the same: no direction to go, so the step has to grow.
    flat = ranked[:, 0] == ranked[:, math.ceil(0.7 * ranked.shape[1]) - 1]
    sigma = np.where(flat, sigma * math.exp(0.2 + k.c_sigma / k.d_sigma), sigma)
    return np.asarray(np.minimum(sigma, (problem.upper - problem.lower).max()))


def _whiten(state: CmaState, y: Float) -> Float:
    """Return C^(-1/2) y, shape (R, D)."""
    turned = np.einsum("rij,ri->rj", state.axes, y) / np.maximum(state.lengths, SMALLEST_SIGMA)
    return np.asarray(np.einsum("rij,rj->ri", state.axes, turned))


def _adapt(C: Float, path: Float, steps: Float, short: Float, k: _Constants) -> Float:
    """Return the new covariance, eq. 47: rank-one update by the path, rank-mu update by the best samples."""
    loss = (1 - short) * k.c_c * (2 - k.c_c)
    decay = 1 - k.c_1 - k.c_mu + k.c_1 * loss[..., None]
    rank_one = path[:, :, None] * path[:, None, :]
    rank_mu = (steps * k.weights[:, None]).swapaxes(1, 2) @ steps
    C = decay * C + k.c_1 * rank_one + k.c_mu * rank_mu
    return np.asarray(0.5 * (C + C.swapaxes(1, 2)))
