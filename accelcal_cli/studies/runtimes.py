"""How many evaluations a target takes: hits, expected running time, their distribution, data profiles [hansen2021].

A hit is the number of evaluations up to and with the first point at or below a target; points of one
generation count in the order of the population.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.studies.study import Record

REDUCTIONS = (1e-1, 1e-3, 1e-5, 1e-7)
"""Parts tau of the first cost whose hits the data profiles count [more2009]."""


class Targeted(Problem):
    """A problem that notes when each run first reached each target.

    Args:
        problem: what is minimised; its least cost is 0.
        runs: R.
        targets: costs, in any order; parts: of the cost of a run's first point, the other targets.
    """

    def __init__(
        self, problem: Problem, runs: int, targets: Sequence[float], parts: Sequence[float] = ()
    ) -> None:
        """Start with no hits."""
        self.problem, self.parts = problem, np.array(parts)
        self.name, self.lower, self.upper, self.start = (
            problem.name,
            problem.lower,
            problem.upper,
            problem.start,
        )
        self.minimum, self.has_residuals = problem.minimum, problem.has_residuals
        self.limits_of = np.full((runs, len(targets) + len(parts)), np.nan)
        self.limits_of[:, : len(targets)] = targets
        self.hits: Int = np.zeros(
            self.limits_of.shape, dtype=np.int64
        )  # 0: not yet; shared by all parts of the runs
        self.rows, self.spent = np.arange(runs), 0

    def cost(self, x: Float) -> Float:
        """Return the cost, and note what it reaches."""
        fx = self.problem.cost(x)
        self._note(fx)
        return fx

    def residuals(self, x: Float) -> Float:
        """Return the residuals, and note what their squares reach."""
        r = self.problem.residuals(x)
        self._note(np.einsum("rpm,rpm->rp", r, r))
        return r

    def jacobian(self, x: Float) -> Float:
        """Return the Jacobian: one evaluation per point, as the count of the loop has it."""
        self.spent += x.shape[1]
        return self.problem.jacobian(x)

    def take(self, index: Int) -> Targeted:
        """Return the problem of the runs at `index`, which goes on noting into the same hits."""
        part = copy.copy(self)
        part.problem, part.rows = self.problem.take(index), self.rows[index]
        return part

    def _note(self, fx: Float) -> None:
        if not self.spent and len(self.parts):
            self.limits_of[self.rows, -len(self.parts) :] = self.parts * fx[:, :1]
        for row, costs in zip(self.rows, fx, strict=True):
            open_targets = np.flatnonzero(
                (self.hits[row] == 0) & (self.limits_of[row] >= np.fmin.reduce(costs))
            )
            for target in open_targets:
                first = int(np.argmax(costs <= self.limits_of[row, target]))
                self.hits[row, target] = self.spent + first + 1
        self.spent += fx.shape[1]


def hits_of(problem: Targeted, first: int, last: int | None) -> list[tuple[int | None, ...]]:
    """Return the hits of columns first to last - 1 of every run; None where a target was not reached."""
    return [tuple(int(n) if n else None for n in row[first:last]) for row in problem.hits]


def expected_running_time(hits: Sequence[int | None], evaluations: Sequence[int]) -> float | None:
    """Return ERT: the evaluations of all runs, up to the target or to their end, per run that reached it [hansen2021].

    None when no run did.
    """
    successes = sum(hit is not None for hit in hits)
    spent = sum(n if hit is None else hit for hit, n in zip(hits, evaluations, strict=True))
    return spent / successes if successes else None


def runtime_distribution(
    records: Sequence[Record], unit: Sequence[float], budgets: Sequence[float]
) -> list[float]:
    """Return the share of pairs of a run and a target that are solved within budgets, in units of evaluations.

    Args:
        records: runs with their hits.
        unit: evaluations that count as one, of each run: its dimensions, say.
        budgets: in these units.
    """
    runtimes = [
        hit / size if hit is not None else np.inf
        for r, size in zip(records, unit, strict=True)
        for hit in r.hits
    ]
    return _shares(runtimes, budgets)


def data_profile(
    records: Sequence[Record], dimensions: Sequence[int], budgets: Sequence[float], tau: float
) -> list[float]:
    """Return the share of runs whose cost fell to tau times the first within budgets of D + 1 evaluations [more2009].

    Args:
        records: runs with their reductions; dimensions: D of each; budgets: in simplex gradients, D + 1 evaluations.
        tau: one of REDUCTIONS.
    """
    column = REDUCTIONS.index(tau)
    needed = [
        np.inf if (n := r.reductions[column]) is None else n / (D + 1)
        for r, D in zip(records, dimensions, strict=True)
    ]
    return _shares(needed, budgets)


def _shares(needed: Sequence[float], budgets: Sequence[float]) -> list[float]:
    values = np.array(needed)
    return [float(np.mean(values <= budget)) for budget in budgets]
