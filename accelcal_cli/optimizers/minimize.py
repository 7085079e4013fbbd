"""The one loop that runs every optimizer.

It owns what no algorithm should: the initial sample, the count of evaluations, the best point so far, the
trace, stopping, and the status of each run. A numerical failure is the status of that run, not an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.optimizers.base import CONVERGED, FAILED, Optimizer, take
from accelcal_cli.problem import Counted, Problem
from accelcal_cli.streams import Float, Int, Streams

BLOCK_BYTES = 48 * 1024
"""Runs go through the loop in blocks whose population fits this many bytes: a dozen temporaries of that size
stay in the processor's second-level cache, which makes twenty runs of 100 x 12 about twice as fast."""


class Status(Enum):
    """How a run ended."""

    ITERATIONS = "all iterations used"
    EVALUATIONS = "evaluation budget used"
    TOLERANCE = "cost reached the tolerance"
    CONVERGED = "converged"
    FAILED = "numerical failure"


@dataclass(frozen=True)
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


def minimize(
    problem: Problem,
    optimizer: Optimizer,
    *,
    runs: int | Sequence[int] = 1,
    seed: int = 0,
    stopping: Stopping = Stopping(),
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
    size = max(1, BLOCK_BYTES // (8 * optimizer.population * problem.dimensions))
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

    def run(self, numbers: NDArray[np.int64], seed: int, x: Float | None) -> Run:
        runs = len(numbers)
        rng = Streams(seed, numbers.tolist())
        counted = Counted(self.problem, runs)
        if x is None:
            lower, upper = self.problem.start or (self.problem.lower, self.problem.upper)
            x = lower + (upper - lower) * rng.uniform(self.optimizer.population, lower.size)
        state = self.optimizer.init(counted, x, rng)
        alive: Int = np.arange(runs)
        self.status = [Status.ITERATIONS] * runs
        self.steps = np.zeros(runs, dtype=np.int64)
        self.best_x, self.best_cost = counted.best_x.copy(), counted.best_cost.copy()
        self.evaluations = counted.evaluations.copy()
        costs, counts = [self.best_cost.copy()], [self.evaluations.copy()]
        for k in range(self.optimizer.iterations):
            ended = self._ended(counted, state, alive)
            if ended.any():
                keep = np.flatnonzero(~ended)
                alive, counted, state, rng = (
                    alive[keep],
                    counted.take(keep),
                    take(state, keep),
                    rng.take(keep),
                )
                if not len(alive):
                    break
            state = self.optimizer.step(counted, state, rng)
            self.steps[alive] = k + 1
            self.best_cost[alive], self.evaluations[alive] = counted.best_cost, counted.evaluations
            self.best_x[alive] = counted.best_x
            if self.trace:
                costs.append(self.best_cost.copy())
                counts.append(self.evaluations.copy())
        else:
            self._ended(counted, state, alive)
        return self._outcome(numbers, costs, counts)

    def _ended(self, counted: Counted, state: object, alive: Int) -> NDArray[np.bool_]:
        """Return which of the runs still alive have ended, and note how."""
        ended = np.zeros(len(alive), dtype=bool)
        status = getattr(state, "status", None)
        checks: list[tuple[Status, NDArray[np.bool_]]] = []
        if self.stopping.evaluations is not None:
            checks.append((Status.EVALUATIONS, counted.evaluations >= self.stopping.evaluations))
        if status is not None:
            checks.append((Status.FAILED, status == FAILED))
            checks.append((Status.CONVERGED, status == CONVERGED))
        if self.stopping.tolerance is not None:
            checks.append((Status.TOLERANCE, counted.best_cost <= self.stopping.tolerance))
        for name, which in checks:
            for i in np.flatnonzero(which):
                self.status[alive[i]] = name
            ended |= which
        return ended

    def _outcome(
        self, numbers: NDArray[np.int64], costs: list[Float], counts: list[NDArray[np.int64]]
    ) -> Run:
        status = tuple(
            s if np.isfinite(c) else Status.FAILED for s, c in zip(self.status, self.best_cost, strict=True)
        )
        return Run(
            numbers,
            self.best_x,
            self.best_cost,
            self.evaluations,
            self.steps,
            status,
            np.array(costs).T if self.trace else None,
            np.array(counts).T if self.trace else None,
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
