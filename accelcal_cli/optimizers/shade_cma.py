"""SHADE-CMA: L-SHADE, then CMA-ES from where it has gathered.

Phase one is success-history adaptive differential evolution with linear population size reduction [tanabe2014]:
current-to-pbest/1 with an archive, F and CR drawn around remembered successes. Phase two is the covariance matrix
adaptation evolution strategy with the default constants of the tutorial [hansen2016], started at the best point with
the shape of the last population. The first finds the right valley among many, the second follows it to rounding.

The size of the population is a schedule over the evaluations and thus common to all runs of a batch; the archive has
one capacity and a count of its own for each run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.optimizers import cma
from accelcal_cli.optimizers.base import OPTIMIZERS, Optimizer, State, gather, integers
from accelcal_cli.problem import Problem
from accelcal_cli.registry import setting
from accelcal_cli.streams import Bool, Float, Int, Streams

TERMINAL = np.nan
"""Value of M_CR that is never left: CR is 0 from then on, one gene at a time [tanabe2014]."""


@dataclass(frozen=True, eq=False)
class ShadeState(State):
    """Phase one: the population with its memories and archive."""

    weights: Float  # M_F, (R, H)
    rates: Float  # M_CR, TERMINAL once CR = 0 alone succeeded, (R, H)
    position: Int  # next memory entry to write, (R,)
    archive: Float  # (R, A, D)
    archived: Int  # entries in use, (R,)
    used: int  # evaluations so far


@OPTIMIZERS.register("shade-cma")
@dataclass(frozen=True)
class ShadeCma(Optimizer):
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

    @property
    def crowd(self) -> int:
        """A quarter of the starting population: it shrinks fast, and phase two lives on many runs at once."""
        return max(1, self.population // 4)

    def init(self, problem: Problem, x: Float, rng: Streams) -> ShadeState:
        """Start with every memory entry at 0.5 and an empty archive."""
        runs, population, dimensions = x.shape
        half = np.full((runs, self.memory), 0.5)
        store = np.zeros((runs, dimensions, int(self.archive * population))).swapaxes(1, 2)
        zeros = np.zeros(runs, dtype=np.intp)
        return ShadeState(x, problem.cost(x), half, half, zeros, store, zeros, used=population)

    def step(self, problem: Problem, state: ShadeState | cma.CmaState, rng: Streams) -> State:
        """Make one generation of the phase that the evaluations are in."""
        if isinstance(state, cma.CmaState):
            return cma.step(problem, state, rng, self.evaluations)
        if state.used + state.x.shape[1] > self.phase_one * self.evaluations:
            start = cma.start(state.x, state.fx, self.smallest, state.used)
            return cma.step(problem, start, rng, self.evaluations)
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
        learned = (total > 0) & np.isfinite(total)
        w = gain / np.where(learned, total, 1.0)[:, None]
        rows = np.flatnonzero(learned)
        weights, rates = state.weights.copy(), state.rates.copy()
        entry = state.position[rows]
        weights[rows, entry] = _lehmer(w[rows], F[rows])
        ended = np.isnan(rates[rows, entry]) | ~(CR[rows] * (gain[rows] > 0)).any(axis=1)
        rates[rows, entry] = np.where(ended, TERMINAL, _lehmer(w[rows], CR[rows]))
        position = np.where(learned, (state.position + 1) % self.memory, state.position)
        return replace(state, weights=weights, rates=rates, position=position)

    def _archive(self, state: ShadeState, better: Bool, u: Float) -> ShadeState:
        """Put the parents that lost into the archive, in place of random entries once it is full."""
        capacity = state.archive.shape[1]
        if not capacity:
            return state
        archive, limit = state.archive.copy(order="K"), int(self.archive * state.x.shape[1])
        run, lost = np.nonzero(better)
        count = np.cumsum(better, axis=1)
        slot = state.archived[run] + count[run, lost] - 1
        slot = np.where(slot < limit, slot, (u[run, lost] * limit).astype(np.intp))
        archive[run, slot] = state.x[run, lost]
        return replace(state, archive=archive, archived=np.minimum(limit, state.archived + count[:, -1]))

    def _reduce(self, state: ShadeState) -> ShadeState:
        """Drop the worst individuals down to the size that the evaluations used allow."""
        part = state.used / (self.phase_one * self.evaluations)
        size = max(self.smallest, round(self.population + (self.smallest - self.population) * part))
        if size >= state.x.shape[1]:
            return state
        keep = np.argsort(state.fx, axis=1, kind="stable")[:, :size]
        limit = int(self.archive * size)
        return replace(
            state,
            x=gather(state.x, keep),
            fx=np.take_along_axis(state.fx, keep, axis=1),
            archived=np.minimum(state.archived, limit),
        )


def _lehmer(w: Float, values: Float) -> Float:
    """Return the weighted Lehmer mean, shape (k,), of values (k, P) with weights w (k, P); 0 when all are 0."""
    below = np.add.reduce(w * values, axis=1)
    mean: Float = np.add.reduce(w * values**2, axis=1) / np.where(below > 0, below, 1.0)
    return mean
