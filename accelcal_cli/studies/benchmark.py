"""Benchmarks: optimizers on test functions, many runs each, their statistics and their ranks.

Which optimizer ranks best over several functions, and whether that is more than chance: Friedman's test on the ranks
within each function, then Nemenyi's critical difference of two mean ranks, the procedure of [demsar2006].
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.minimize import Stopping, minimize
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.studies.functions import TestFunction
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
        dimensions: D.
        runs: of each cell; seed: of all of them.
        tolerance: a run succeeds when its cost is at or below this.
        evaluations: budget per run; None leaves it to the iterations.
        stop: whether a run ends when it reaches the tolerance.
        shift, rotate: move the optimum, rotate the coordinates.
    """

    functions: tuple[str, ...]
    entries: tuple[Entry, ...]
    dimensions: int = 12
    runs: int = 20
    seed: int = 0
    tolerance: float = 1e-8
    evaluations: int | None = None
    stop: bool = False
    shift: bool = False
    rotate: bool = False

    @property
    def cells(self) -> int:
        """Pairs of a function and an optimizer that suits it."""
        return len(self.pairs)

    @cached_property
    def pairs(self) -> tuple[tuple[str, Entry], ...]:
        """Function name and optimizer of every cell."""
        return tuple(
            (f, e) for f in self.functions for e in self.entries if (f, e.label) not in self.unsuited
        )

    @cached_property
    def unsuited(self) -> tuple[tuple[str, str], ...]:
        """Function name and label where the function lacks what the optimizer needs."""
        optimizers = [(entry.label, entry.build()) for entry in self.entries]
        return tuple(
            (name, label)
            for name in self.functions
            for label, optimizer in optimizers
            if not optimizer.suits(self.problem(name))
        )

    def problem(self, name: str) -> TestFunction:
        """Return a test function of this study."""
        return TestFunction(name, self.dimensions, shift=self.shift, rotate=self.rotate, seed=self.seed)

    def names(self, cell: int) -> dict[str, str]:
        """Return function and optimizer of a cell; see `Study.names`."""
        function, entry = self.pairs[cell]
        return {"function": function, "optimizer": entry.label}

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        name, entry = self.pairs[task.cell]
        problem, optimizer = self.problem(name), entry.build()
        stopping = Stopping(self.tolerance if self.stop else None, self.evaluations)
        runs = range(task.first, task.last)
        start = time.thread_time()
        run = minimize(problem, optimizer, runs=runs, seed=self.seed, stopping=stopping)
        records = records_of(task, run, self.tolerance, time.thread_time() - start)
        return [replace(r, point=tuple(x)) for r, x in zip(records, run.x.tolist(), strict=True)]

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
            needs = " and ".join(NEEDS.get(need, need) for need in entry.build().needs)
            do = "does" if len(lacking) == 1 else "do"
            sentence = f"{entry.label} needs {needs}, which {_listed(lacking)} {do} not have"
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
    """Return one row per cell: statistics of the cost over the runs, success rate, evaluations, seconds.

    Definition:
        evaluations, seconds: medians; evaluations_to_tolerance: median of the runs that reached the tolerance.
        min, max, mean, variance, median, quartiles: of the cost; a run without any finite cost counts as infinite.
        failures: number of runs with a numerical failure.
    """
    by_cell = [(study.names(cell), records_of_cell(records, cell)) for cell in range(study.cells)]
    return [{**names, **_statistics(own)} for names, own in by_cell if own]


def _statistics(records: Sequence[Record]) -> Row:
    cost = np.array([r.cost for r in records])
    hits = [r.hit for r in records if r.hit is not None]
    several = len(cost) > 1 and bool(np.isfinite(cost).all())
    return {
        "runs": len(records),
        "evaluations": int(np.median([r.evaluations for r in records])),
        **spread(cost),
        "mean": float(cost.mean()),
        "variance": float(cost.var(ddof=1)) if several else None,
        "success_rate": len(hits) / len(records),
        "evaluations_to_tolerance": int(np.median(hits)) if hits else None,
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
    """Rank the optimizers that ran on all functions by median cost; None below two of either."""
    labels = [e.label for e in study.entries if all(label != e.label for _, label in study.unsuited)]
    if len(labels) < 2 or len(study.functions) < 2:
        return None
    medians = {(r["function"], r["optimizer"]): r["median"] for r in statistics(study, records)}
    return ranking(labels, np.array([[medians[f, label] for label in labels] for f in study.functions]))


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
