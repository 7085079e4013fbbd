"""The one loop that runs every optimizer.

It owns what no algorithm should: the initial sample, the count of evaluations, the best point so far, the
trace, stopping, and the status of each run. A numerical failure is the status of that run, not an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float, Int
from accelcal_cli.optimization.optimizer import CONVERGED, FAILED, Optimizer, take
from accelcal_cli.optimization.problem import Counted, Problem
from accelcal_cli.rng import Streams

BLOCK_BYTES = 192 * 1024
"""Runs go through the loop in blocks whose population fits this many bytes, twenty runs of 100 x 12: enough to
hide the interpreter, and a handful of temporaries of that size still fits the second-level cache."""


class Status(Enum):
    """How a run ended."""

    ITERATIONS = "all iterations used"
    EVALUATIONS = "evaluation budget used"
    TOLERANCE = "cost reached the tolerance"
    CONVERGED = "converged"
    FAILED = "numerical failure"


@dataclass(frozen=True, eq=False)
class Run:
    """The outcome of R runs.

    Attributes:
        runs: their numbers, shape (R,).
        x: best point of each, shape (R, D).
        cost: its cost, shape (R,).
        evaluations: evaluations used, shape (R,).
        iterations: steps made, shape (R,).
        status: how each ended.
        trace: best cost so far after every step, shape (R, K + 1), the last value repeated after a run's end;
            None when no trace was asked for.
        trace_evaluations: evaluations after every step, same shape.
    """

    runs: NDArray[np.int64]
    x: Float
    cost: Float
    evaluations: NDArray[np.int64]
    iterations: NDArray[np.int64]
    status: tuple[Status, ...]
    trace: Float | None = None
    trace_evaluations: NDArray[np.int64] | None = None


@dataclass(frozen=True)
class Stopping:
    """When to stop before the iterations run out.

    Attributes:
        tolerance: stop a run whose cost is at or below this; None never does.
        evaluations: start no step at or beyond this many evaluations of a run; None has no such limit.
    """

    tolerance: float | None = None
    evaluations: int | None = None


NEVER = Stopping()


def minimize(
    problem: Problem,
    optimizer: Optimizer,
    *,
    runs: int | Sequence[int] = 1,
    seed: int = 0,
    stopping: Stopping = NEVER,
    start: Float | None = None,
    trace: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Run:
    """Minimise `problem` with `optimizer`, R independent runs at once.

    Args:
        problem: what to minimise. One that differs from run to run has its runs in the order of `runs`.
        optimizer: the algorithm and its settings.
        runs: how many runs, or their numbers; run r gives the same bits in any company.
        seed: with the run's number, the source of all its random numbers.
        stopping: tolerance and evaluation budget.
        start: starting population, shape (R, P, D); sampled uniformly over the box when not given.
        trace: whether to keep the best cost after every step.
        progress: called with (steps done, steps at most) of all runs together, now and then.
    """
    numbers = np.arange(runs) if isinstance(runs, int) else np.asarray(runs, dtype=np.int64)
    size = max(1, BLOCK_BYTES // (8 * optimizer.crowd * problem.dimensions))
    # Freed at once: from now on glibc keeps smaller blocks instead of faulting them in anew.
    np.empty(1 << 20)
    parts = []
    for first in range(0, len(numbers), size):
        block = np.arange(first, min(first + size, len(numbers)))
        x = None if start is None else start[block]
        loop = _Loop(problem.take(block) if size < len(numbers) else problem, optimizer, stopping, trace)
        with np.errstate(all="ignore"):
            parts.append(loop.run(numbers[block], seed, x))
        if progress:
            progress(int(block[-1]) + 1, len(numbers))
    return parts[0] if len(parts) == 1 else _join(parts)


class _Loop:
    """One block of runs; those that end leave the batch, the others go on."""

    def __init__(self, problem: Problem, optimizer: Optimizer, stopping: Stopping, trace: bool) -> None:
        self.problem, self.optimizer, self.stopping, self.trace = problem, optimizer, stopping, trace
        self.endless = stopping == NEVER

    def run(self, numbers: NDArray[np.int64], seed: int, x: Float | None) -> Run:
        runs = len(numbers)
        self.alive: Int = np.arange(runs)
        self.rng, self.counted = Streams(seed, numbers.tolist()), Counted(self.problem, runs)
        self.status = [Status.ITERATIONS] * runs
        self.best_x, self.best_cost = np.empty((runs, self.problem.dimensions)), np.empty(runs)
        self.steps, self.evaluations = np.zeros(runs, np.int64), np.zeros(runs, np.int64)
        self.costs: list[tuple[Int, Float]] = []
        self.counts: list[int] = []
        if x is None:
            lower, upper = self.problem.start or (self.problem.lower, self.problem.upper)
            x = lower + (upper - lower) * self.rng.uniform(self.optimizer.population, lower.size)
        state = self._noted(self.optimizer.init(self.counted, x, self.rng))
        for k in range(self.optimizer.iterations):
            state = self._retired(state, k)
            if not len(self.alive):
                break
            state = self._noted(self.optimizer.step(self.counted, state, self.rng))
        else:
            self._retired(state, self.optimizer.iterations)
            self._leave(np.arange(len(self.alive)), self.optimizer.iterations)
        return self._outcome(numbers)

    def _noted(self, state: Any) -> Any:
        """Return the state, its best costs entered in the trace."""
        if self.trace:
            # Counted replaces this array when a run improves and never writes into it: no copy is needed.
            self.costs.append((self.alive, self.counted.best_cost))
            self.counts.append(self.counted.spent)
        return state

    def _retired(self, state: Any, k: int) -> Any:
        """Return the state without the runs that have ended after k steps."""
        if state.status is None and self.endless:
            return state
        checks = self._checks(state)
        if not any(which.any() for _, which in checks):
            return state
        for status, which in checks:
            for i in np.flatnonzero(which):
                self.status[self.alive[i]] = status
        ended = np.logical_or.reduce([which for _, which in checks])
        self._leave(np.flatnonzero(ended), k)
        keep = np.flatnonzero(~ended)
        self.alive, self.counted, self.rng = self.alive[keep], self.counted.take(keep), self.rng.take(keep)
        return take(state, keep)

    def _checks(self, state: Any) -> list[tuple[Status, NDArray[np.bool_]]]:
        """Return each reason to end and the runs it holds for, the weightiest reason last."""
        checks = []
        if self.stopping.evaluations is not None:
            checks.append((Status.EVALUATIONS, self.counted.evaluations >= self.stopping.evaluations))
        if state.status is not None:
            checks.append((Status.FAILED, state.status == FAILED))
            checks.append((Status.CONVERGED, state.status == CONVERGED))
        if self.stopping.tolerance is not None:
            checks.append((Status.TOLERANCE, self.counted.best_cost <= self.stopping.tolerance))
        return checks

    def _leave(self, index: Int, k: int) -> None:
        """Enter the results of the runs at `index` of those alive, which have made k steps."""
        runs, counted = self.alive[index], self.counted
        self.best_x[runs], self.best_cost[runs] = counted.best_x[index], counted.best_cost[index]
        self.steps[runs], self.evaluations[runs] = k, counted.spent

    def _outcome(self, numbers: NDArray[np.int64]) -> Run:
        status = tuple(
            s if np.isfinite(c) else Status.FAILED for s, c in zip(self.status, self.best_cost, strict=True)
        )
        run = Run(numbers, self.best_x, self.best_cost, self.evaluations, self.steps, status)
        if not self.trace:
            return run
        costs = np.empty((len(self.costs), len(numbers)))
        for row, (alive, best) in zip(costs, self.costs, strict=True):
            row[alive] = best
        # A run that ended early keeps its last value.
        last = np.minimum(np.arange(len(costs)), self.steps[:, None])
        return replace(
            run,
            trace=np.take_along_axis(costs.T, last, axis=1),
            trace_evaluations=np.array(self.counts)[last],
        )


def _join(parts: list[Run]) -> Run:
    def stack(name: str) -> NDArray[np.float64]:
        return np.concatenate([getattr(part, name) for part in parts])

    def pad(name: str) -> NDArray[np.float64] | None:
        if getattr(parts[0], name) is None:
            return None
        longest = max(getattr(part, name).shape[1] for part in parts)
        rows = [getattr(part, name) for part in parts]
        return np.concatenate([np.pad(r, ((0, 0), (0, longest - r.shape[1])), mode="edge") for r in rows])

    return Run(
        stack("runs").astype(np.int64),
        stack("x"),
        stack("cost"),
        stack("evaluations").astype(np.int64),
        stack("iterations").astype(np.int64),
        tuple(s for part in parts for s in part.status),
        pad("trace"),
        pad("trace_evaluations"),  # type: ignore[arg-type]
    )
