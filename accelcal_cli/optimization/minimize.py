"""The one loop that runs every optimizer.

It owns what no algorithm should: the initial sample, the count of evaluations, the best point so far, the
trace, stopping, and the status of each run. A numerical failure is the status of that run, not an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.optimization.optimizer import Optimizer, S, Status, take
from accelcal_cli.optimization.problem import Counted, Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import frozen

N = TypeVar("N", bound=np.generic)

BLOCK_BYTES = 192 * 1024
"""Runs go through the loop in blocks whose population fits this many bytes, twenty runs of 100 x 12: enough to
hide the interpreter, and a handful of temporaries of that size still fits the second-level cache."""


@frozen(eq=False)
class Run:
    """The outcome of R runs.

    Attributes:
        runs: their numbers, shape (R,).
        x: best point of each, shape (R, D).
        cost: its cost, shape (R,).
        evaluations: evaluations used, shape (R,).
        iterations: steps made, shape (R,).
        status: how each ended; `Status.message` says it in words.
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


@frozen()
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
    optimizer: Optimizer[S],
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
    size = max(1, BLOCK_BYTES // (8 * optimizer.points_per_run * problem.dimensions))
    # Freed at once: from now on glibc keeps smaller blocks instead of faulting them in anew.
    np.empty(1 << 20)
    parts = []
    for first in range(0, len(numbers), size):
        block = np.arange(first, min(first + size, len(numbers)))
        loop = _Loop(problem.take(block) if size < len(numbers) else problem, optimizer, stopping, trace)
        with np.errstate(all="ignore"):
            parts.append(loop.run(numbers[block], seed, None if start is None else start[block]))
        if progress:
            progress(int(block[-1]) + 1, len(numbers))
    return parts[0] if len(parts) == 1 else _join(parts)


def polish(problem: Problem, x: Float) -> Run:
    """Return Levenberg-Marquardt runs from points x, shape (R, D), inside the box of a problem with residuals."""
    from accelcal_cli.optimization.algorithms.levenberg_marquardt import LevenbergMarquardt

    return minimize(problem, LevenbergMarquardt(), runs=len(x), start=x[:, None, :], trace=False)


class _Loop(Generic[S]):
    """One block of runs; those that end leave the batch, the others go on."""

    def __init__(self, problem: Problem, optimizer: Optimizer[S], stopping: Stopping, trace: bool) -> None:
        self.problem, self.optimizer, self.stopping, self.trace = problem, optimizer, stopping, trace
        self.endless = stopping == NEVER

    def run(self, numbers: NDArray[np.int64], seed: int, x: Float | None) -> Run:
        """Return the outcome of the runs of these numbers, from the population x or a sampled one."""
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
        state = self._record(self.optimizer.init(self.counted, x, self.rng))
        for k in range(self.optimizer.iterations):
            state = self._retire(state, k)
            if not len(self.alive):
                break
            state = self._record(self.optimizer.step(self.counted, state, self.rng))
        else:
            self._retire(state, self.optimizer.iterations)
            self._leave(np.arange(len(self.alive)), self.optimizer.iterations)
        return self._outcome(numbers)

    def _record(self, state: S) -> S:
        """Enter the best costs in the trace, and return the state."""
        if self.trace:
            # Counted replaces this array when a run improves and never writes into it: no copy is needed.
            self.costs.append((self.alive, self.counted.best_cost))
            self.counts.append(self.counted.spent)
        return state

    def _retire(self, state: S, k: int) -> S:
        """Return the state without the runs that have ended after k steps."""
        if state.status is None and self.endless:
            return state
        reasons = self._reasons(state.status)
        over = np.logical_or.reduce([ended for _, ended in reasons])
        if not over.any():
            return state
        for status, ended in reasons:
            for run in self.alive[ended].tolist():
                self.status[run] = status
        self._leave(np.flatnonzero(over), k)
        rest = np.flatnonzero(~over)
        self.alive, self.counted, self.rng = self.alive[rest], self.counted.take(rest), self.rng.take(rest)
        return take(state, rest)

    def _reasons(self, status: NDArray[np.int8] | None) -> list[tuple[Status, Bool]]:
        """Return each reason to end and the runs it holds for, the weightiest reason last."""
        reasons: list[tuple[Status, Bool]] = []
        if self.stopping.evaluations is not None:
            reasons.append((Status.EVALUATIONS, self.counted.evaluations >= self.stopping.evaluations))
        if status is not None:
            reasons += [(reason, status == reason) for reason in (Status.FAILED, Status.CONVERGED)]
        if self.stopping.tolerance is not None:
            reasons.append((Status.TOLERANCE, self.counted.best_cost <= self.stopping.tolerance))
        return reasons

    def _leave(self, index: Int, k: int) -> None:
        """Enter the results of the runs at `index` of those alive, which have made k steps."""
        runs, counted = self.alive[index], self.counted
        self.best_x[runs], self.best_cost[runs] = counted.best_x[index], counted.best_cost[index]
        self.steps[runs], self.evaluations[runs] = k, counted.spent

    def _outcome(self, numbers: NDArray[np.int64]) -> Run:
        """Return the results of all runs; one without a finite cost has failed."""
        for failed in np.flatnonzero(~np.isfinite(self.best_cost)).tolist():
            self.status[failed] = Status.FAILED
        run = Run(numbers, self.best_x, self.best_cost, self.evaluations, self.steps, tuple(self.status))
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
    """Return the outcome of the runs of all parts, their traces as long as the longest."""
    return Run(
        np.concatenate([part.runs for part in parts]),
        np.concatenate([part.x for part in parts]),
        np.concatenate([part.cost for part in parts]),
        np.concatenate([part.evaluations for part in parts]),
        np.concatenate([part.iterations for part in parts]),
        tuple(status for part in parts for status in part.status),
        _stacked([part.trace for part in parts if part.trace is not None]),
        _stacked([part.trace_evaluations for part in parts if part.trace_evaluations is not None]),
    )


def _stacked(traces: list[NDArray[N]]) -> NDArray[N] | None:
    """Return the rows of all traces, each with its last value repeated up to the longest; None without traces."""
    longest = max((trace.shape[1] for trace in traces), default=0)
    padded = [np.pad(trace, ((0, 0), (0, longest - trace.shape[1])), mode="edge") for trace in traces]
    return np.concatenate(padded) if padded else None
