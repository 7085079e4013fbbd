"""Benchmarks: optimizers on test functions, many runs each, their statistics and their ranks.

Which optimizer ranks best over several functions, and whether that is more than chance: Friedman's test on the ranks
within each function, then Nemenyi's critical difference of two mean ranks, the procedure of [demsar2006].
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.minimize import Stopping
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.runtimes import REDUCTIONS, Targeted, expected_running_time, hits_of
from accelcal_cli.studies.study import (
    Entry,
    Record,
    Row,
    Study,
    Task,
    records_of,
    records_of_cell,
    spread,
)

NEEDS = {"residuals": "residuals (a sum of squares)", "closed_form": "a closed form"}


@dataclass(frozen=True)
class Benchmark(Study):
    """Every optimizer on every function that it suits; a cell is such a pair, function by function.

    Attributes:
        functions: names of test functions.
        entries: the optimizers.
        dimensions: D, one or several.
        runs: of each cell; seed: of all of them.
        tolerance: a run succeeds when its cost is at or below this.
        evaluations: budget per run; None leaves it to the iterations.
        stop: whether a run ends when it reaches the tolerance.
        shift, rotate: move the optimum, rotate the coordinates.
        instances: so many places and rotations, run by run in turn; 0 is the plain function, or the one that `shift`
            and `rotate` say.
        targets: costs whose running time is told; none is the tolerance.
    """

    functions: tuple[str, ...]
    entries: tuple[Entry, ...]
    dimensions: tuple[int, ...] = (12,)
    runs: int = 20
    seed: int = 0
    tolerance: float = 1e-8
    evaluations: int | None = None
    stop: bool = False
    shift: bool = False
    rotate: bool = False
    instances: int = 0
    targets: tuple[float, ...] = ()

    @property
    def cells(self) -> int:
        """Functions in their dimensions, each with every optimizer that suits it."""
        return len(self.problems)

    @cached_property
    def pairs(self) -> tuple[tuple[str, Entry], ...]:
        """Function name and optimizer of every cell of one dimension."""
        return tuple(
            (f, e) for f in self.functions for e in self.entries if (f, e.label) not in self.unsuited
        )

    @cached_property
    def problems(self) -> tuple[tuple[str, int, Entry], ...]:
        """Function name, dimension and optimizer of every cell, function by function."""
        return tuple(
            (f, D, e) for f in self.functions for D in self.dimensions for g, e in self.pairs if g == f
        )

    @property
    def goals(self) -> tuple[float, ...]:
        """The targets, which are the tolerance where none is stated."""
        return self.targets or (self.tolerance,)

    @cached_property
    def unsuited(self) -> tuple[tuple[str, str], ...]:
        """Function name and label where the function lacks what the optimizer needs."""
        return tuple(
            (name, entry.label)
            for name in self.functions
            for entry in self.entries
            if not entry.suits(self.problem(name, self.dimensions[0]))
        )

    def problem(self, name: str, dimensions: int, runs: Sequence[int] = (0,)) -> Problem:
        """Return a test function of this study as the runs of these numbers have it."""
        changes = {"shift": self.shift or self.instances > 0, "rotate": self.rotate or self.instances > 0}
        own = [self.instance(run) for run in runs] if self.instances else [0]
        return TestFunction(name, dimensions, seed=self.seed, instances=own, **changes)

    def instance(self, run: int) -> int:
        """Return the number of a run's place and rotation, from 1; 0 without instances."""
        return 1 + run % self.instances if self.instances else 0

    def budget(self, dimensions: int) -> int | None:  # noqa: ARG002
        """Return the evaluations that every optimizer has in these dimensions; None when each has its own."""
        return self.evaluations

    def names(self, cell: int) -> dict[str, str]:
        """Return function and optimizer of a cell; see `Study.names`."""
        function, _, entry = self.problems[cell]
        return {"function": function, "optimizer": entry.label}

    def panel(self, cell: int) -> str:
        """Return the function, and its dimension where there are several."""
        function, D, _ = self.problems[cell]
        return function if len(self.dimensions) == 1 else f"{function}, D = {D}"

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        name, D, entry = self.problems[task.cell]
        runs = range(task.first, task.last)
        return self.timed(task, self.problem(name, D, runs), entry, self.evaluations)

    def timed(self, task: Task, problem: Problem, entry: Entry, evaluations: int | None) -> list[Record]:
        """Return the records of a task's runs on a problem, with what they reached when."""
        runs = range(task.first, task.last)
        watched = Targeted(problem, len(runs), (self.tolerance, *self.goals), REDUCTIONS)
        stopping = Stopping(self.tolerance if self.stop else None, evaluations)
        start = time.thread_time()
        run = entry.run(watched, runs, seed=self.seed, stopping=stopping)
        seconds = time.thread_time() - start
        hit, hits, reductions = (
            hits_of(watched, *part)
            for part in ((0, 1), (1, 1 + len(self.goals)), (1 + len(self.goals), None))
        )
        further = zip(
            records_of(task, run, self.tolerance, seconds), run.x.tolist(), hit, hits, reductions, strict=True
        )
        return [
            replace(r, hit=h[0], point=tuple(x), hits=t, reductions=q, instance=self.instance(r.run))
            for r, x, h, t, q in further
        ]

    def suiting(self, named: Sequence[str]) -> tuple[Benchmark, list[str]]:
        """Return the study without optimizers that suit no function, and a sentence for everything left out.

        Args:
            named: labels that were asked for by name, which may not be left out.

        Raises:
            ConfigError: a named optimizer does not suit a function, or no cell is left.
        """
        notes = []
        for entry in self.entries:
            lacking = [function for function, label in self.unsuited if label == entry.label]
            if not lacking:
                continue
            wanted = " and ".join(NEEDS.get(need, need) for need in entry.needs)
            do = "does" if len(lacking) == 1 else "do"
            sentence = f"{entry.label} needs {wanted}, which {_listed(lacking)} {do} not have"
            if entry.label in named:
                raise ConfigError(sentence)
            notes.append(f"{sentence}: left out there")
        used = {entry.label for _, entry in self.pairs}
        if not used:
            raise ConfigError("no optimizer suits any of the functions")
        return replace(self, entries=tuple(e for e in self.entries if e.label in used)), notes


def _listed(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))


def statistics(study: Benchmark, records: Sequence[Record]) -> list[Row]:
    """Return one row per cell and target: statistics of the cost over the runs, success rate, evaluations, seconds.

    Definition:
        evaluations, seconds: medians; evaluations_to_tolerance: median of the runs that reached the target.
        ert: evaluations of all runs up to the target, or to their end, per run that reached it; None when none did.
        success_rate: part of the runs that reached the target. instance: numbers of the instances, "0" is none.
        min, max, mean, variance, median, quartiles: of the cost; a run without any finite cost counts as infinite.
        failures: number of runs with a numerical failure.
    """
    instances = f"1-{min(study.instances, study.runs)}" if study.instances else "0"
    rows: list[Row] = []
    for cell in range(study.cells):
        own = records_of_cell(records, cell)
        common = {"dimension": study.problems[cell][1], "instance": instances}
        for number, target in enumerate(study.goals) if own else ():
            hits = [r.hits[number] if r.hits else r.hit for r in own]
            rows.append({**study.names(cell), **_statistics(own, hits), "target": target, **common})
    return rows


def _statistics(records: Sequence[Record], reached: Sequence[int | None]) -> Row:
    cost = np.array([r.cost for r in records])
    hits = [hit for hit in reached if hit is not None]
    several = len(cost) > 1 and bool(np.isfinite(cost).all())
    return {
        "runs": len(records),
        "evaluations": int(np.median([r.evaluations for r in records])),
        **spread(cost),
        "mean": float(cost.mean()),
        "variance": float(cost.var(ddof=1)) if several else None,
        "success_rate": len(hits) / len(records),
        "evaluations_to_tolerance": int(np.median(hits)) if hits else None,
        "ert": expected_running_time(reached, [r.evaluations for r in records]),
        "failures": sum(r.status == Status.FAILED.name.lower() for r in records),
        "seconds": float(np.median([r.seconds for r in records])),
    }


LEVEL = 0.05
"""Significance level of the tests."""


@dataclass(frozen=True)
class Ranking:
    """Mean ranks of k optimizers over N functions.

    Attributes:
        labels: the optimizers, best first.
        functions: N.
        ranks: mean rank of each, 1 is best.
        p: of Nemenyi's test against the first, for each; 1 for the first itself.
        chi_squared, p_friedman: Friedman's statistic and its p; None with two optimizers, as the test needs three.
        critical: difference of two mean ranks that is significant at LEVEL.
    """

    labels: tuple[str, ...]
    functions: int
    ranks: tuple[float, ...]
    p: tuple[float, ...]
    chi_squared: float | None
    p_friedman: float | None
    critical: float


def rank(study: Benchmark, records: Sequence[Record]) -> Ranking | None:
    """Rank the optimizers that ran on all functions by median cost; None below two of either.

    A function counts once for every dimension.
    """
    labels = [e.label for e in study.entries if all(label != e.label for _, label in study.unsuited)]
    places = [(f, D) for f in study.functions for D in study.dimensions]
    if len(labels) < 2 or len(places) < 2:
        return None
    medians = {
        (r["function"], r["dimension"], r["optimizer"]): r["median"] for r in statistics(study, records)
    }
    return ranking(labels, np.array([[medians[*place, label] for label in labels] for place in places]))


SHORT = 0.95
"""An optimizer that was cut off below this part of the evaluations that another used had not the same budget."""

CUT_OFF = ("iterations", "evaluations")
"""How runs end that used what they were given; others had enough."""


def unequal_budgets(study: Benchmark, records: Sequence[Record]) -> str | None:
    """Return a sentence when the optimizers had different budgets, so that their costs say nothing of their ranks."""
    for D in study.dimensions:
        if study.budget(D) is not None:
            continue
        used: dict[str, int] = {}
        given: dict[str, int] = {}
        for r in records:
            _, own, entry = study.problems[r.cell]
            if own == D:
                used[entry.label] = max(used.get(entry.label, 0), r.evaluations)
                if r.status in CUT_OFF:
                    given[entry.label] = max(given.get(entry.label, 0), r.evaluations)
        most = max(used, key=used.__getitem__)
        least = min(given, key=given.__getitem__, default=most)
        if given.get(least, used[most]) < SHORT * used[most]:
            return (
                f"not ranked: {most} used {used[most]:,} evaluations and {least} was cut off after {given[least]:,}; "
                f"--evaluations N gives all the same budget"
            )
    return None


@dataclass(frozen=True)
class PairDifference:
    """Two optimizers that differ on one function: the better, the worse, and the p of Holm."""

    function: str
    dimension: int
    better: str
    worse: str
    p: float


def pairwise(study: Benchmark, records: Sequence[Record]) -> tuple[list[PairDifference], int]:
    """Return the pairs of optimizers that differ at LEVEL on a function, and how many pairs were tested.

    Wilcoxon's rank sum test of the costs of the runs, two-sided, corrected by [holm1979] for all pairs on the function.
    """
    from scipy.stats import mannwhitneyu

    found, tested = [], 0
    for function in study.functions:
        for D in study.dimensions:
            cells = [c for c, (f, d, _) in enumerate(study.problems) if (f, d) == (function, D)]
            costs = {
                study.names(c)["optimizer"]: [r.cost for r in records_of_cell(records, c)] for c in cells
            }
            pairs = list(combinations(costs, 2))
            tested += len(pairs)
            p = [_p_of(mannwhitneyu, costs[a], costs[b]) for a, b in pairs]
            for (a, b), corrected in zip(pairs, holm(p), strict=True):
                if corrected < LEVEL:
                    better, worse = (a, b) if _ranked_below(costs[a], costs[b]) else (b, a)
                    found.append(PairDifference(function, D, better, worse, corrected))
    return found, tested


def _p_of(test: Callable[..., Any], a: Sequence[float], b: Sequence[float]) -> float:
    return 1.0 if len({*a, *b}) == 1 else float(test(a, b).pvalue)


def _ranked_below(a: Sequence[float], b: Sequence[float]) -> bool:
    """Return whether the costs a come before those of b in the ranks of both together."""
    from scipy.stats import rankdata

    ranks = rankdata([*a, *b])
    return float(ranks[: len(a)].mean()) < float(ranks[len(a) :].mean())


def holm(p: Sequence[float]) -> list[float]:
    """Return p-values corrected for their number, step down [holm1979]; in their order, at most 1."""
    corrected, largest = [1.0] * len(p), 0.0
    for place, number in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, (len(p) - place) * p[number]))
        corrected[number] = largest
    return corrected


def ranking(labels: Sequence[str], medians: Float) -> Ranking:
    """Return the ranking by medians, shape (N functions, k optimizers)."""
    from scipy.stats import rankdata, studentized_range

    N, k = medians.shape
    ranks = rankdata(medians, axis=1)
    mean = ranks.mean(axis=0)
    order = np.argsort(mean, kind="stable")
    # [demsar2006] section 3.2.2: q / sqrt 2 times this is the critical difference
    unit = math.sqrt(k * (k + 1) / (6.0 * N))
    distance = (mean - mean[order[0]]) * math.sqrt(2.0) / unit
    p = studentized_range.sf(distance, k, np.inf)
    chi_squared, p_friedman = _friedman(ranks) if k > 2 else (None, None)
    return Ranking(
        tuple(labels[i] for i in order),
        N,
        tuple(float(mean[i]) for i in order),
        (1.0, *(float(np.clip(p[i], 0.0, 1.0)) for i in order[1:])),
        chi_squared,
        p_friedman,
        float(studentized_range.ppf(1.0 - LEVEL, k, np.inf)) / math.sqrt(2.0) * unit,
    )


def _friedman(ranks: Float) -> tuple[float, float]:
    """Return Friedman's chi-squared, corrected for ties, and its p."""
    from scipy.stats import friedmanchisquare

    if (ranks == ranks[:, :1]).all():
        return 0.0, 1.0  # all optimizers tie on every function
    result = friedmanchisquare(*ranks.T)
    return float(result.statistic), float(result.pvalue)
