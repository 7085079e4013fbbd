"""Benchmarks: optimizers on test functions, many runs each.

Which optimizer ranks best over several functions, and whether that is more than chance.

Friedman's test on the ranks within each function, then Nemenyi's critical difference of two mean ranks: the
procedure of [demsar2006].
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.minimize import Stopping, minimize
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.study import Entry, Record, Study, Task, median_curve, records_of
from accelcal_cli.table import Column, Table


@dataclass(frozen=True)
class Benchmark(Study):
    """Every optimizer on every function that it suits; a cell is such a pair, function by function.

    Attributes:
        functions: names of test functions.
        entries: the optimizers.
        dimensions: D.
        repeats: runs of each cell; seed: of all of them.
        tolerance: a run succeeds when its cost is at or below this.
        evaluations: budget of a run; None leaves it to the iterations.
        stop: whether a run ends when it reaches the tolerance.
        shift, rotate: move the optimum, turn the coordinates.
    """

    functions: tuple[str, ...]
    entries: tuple[Entry, ...]
    dimensions: int = 12
    repeats: int = 20
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

    @property
    def runs(self) -> int:
        """Runs of each cell."""
        return self.repeats

    @property
    def title(self) -> str:
        """What is run, in one line."""
        runs = "1 run" if self.repeats == 1 else f"{self.repeats:,} runs"
        changes = ", shifted" * self.shift + ", rotated" * self.rotate
        return f"Benchmark: D = {self.dimensions}, {runs}, tolerance {self.tolerance:g}, seed {self.seed}{changes}"

    @cached_property
    def pairs(self) -> tuple[tuple[str, Entry], ...]:
        """Function name and optimizer of every cell."""
        return tuple(
            (f, e) for f in self.functions for e in self.entries if (f, e.label) not in self.unsuited
        )

    @cached_property
    def unsuited(self) -> tuple[tuple[str, str], ...]:
        """Function name and label where the function lacks what the optimizer needs."""
        built = [(entry.label, entry.build()) for entry in self.entries]
        return tuple(
            (name, label)
            for name in self.functions
            for label, optimizer in built
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
        return records_of(task, run, self.tolerance, time.thread_time() - start)

    def suiting(self, named: Sequence[str]) -> tuple[Benchmark, list[str]]:
        """Return the study without optimizers that suit no function, and a sentence for everything left out.

        Args:
            named: labels that were asked for by name, which may not be left out.

        Raises:
            ConfigError: a named optimizer does not suit a function, or no cell is left.
        """
        notes = []
        for entry in self.entries:
            on = [function for function, label in self.unsuited if label == entry.label]
            if not on:
                continue
            sentence = f"{entry.label} needs {_needs(entry)}, which {_listed(on)} {_lack(on)}"
            if entry.label in named:
                raise ConfigError(sentence)
            notes.append(f"{sentence}: left out there")
        used = {entry.label for _, entry in self.pairs}
        if not used:
            raise ConfigError("no optimizer suits any of the functions")
        return replace(self, entries=tuple(e for e in self.entries if e.label in used)), notes


def _needs(entry: Entry) -> str:
    words = {"residuals": "residuals (a sum of squares)", "closed_form": "a closed form"}
    return " and ".join(words.get(need, need) for need in entry.build().needs)


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _lack(names: Sequence[str]) -> str:
    return "does not have" if len(names) == 1 else "do not have"


def summary(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return one row a cell: statistics of the cost over the runs, success rate, evaluations, seconds."""
    rows = []
    for cell in range(study.cells):
        own = [record for record in records if record.cell == cell]
        if own:
            rows.append((*study.names(cell).values(), *_statistics(own)))
    return Table("Benchmark", COLUMNS, tuple(rows))


def _statistics(records: Sequence[Record]) -> tuple[Any, ...]:
    """Return the numbers of one row; a run without any finite cost counts as infinite."""
    cost = np.array([r.cost for r in records])
    hits = [r.hit for r in records if r.hit is not None]
    several = len(cost) > 1 and bool(np.isfinite(cost).all())
    return (
        len(records),
        int(np.median([r.evaluations for r in records])),
        float(cost.min()),
        float(cost.max()),
        float(cost.mean()),
        float(cost.var(ddof=1)) if several else None,
        float(np.median(cost)),
        len(hits) / len(records),
        int(np.median(hits)) if hits else None,
        sum(r.status == Status.FAILED.name.lower() for r in records),
        float(np.median([r.seconds for r in records])),
    )


COLUMNS = (
    Column("function"),
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("evaluations", format=",d"),
    Column("min", format=".3g"),
    Column("max", format=".3g"),
    Column("mean", format=".3g"),
    Column("variance", format=".3g"),
    Column("median", format=".3g"),
    Column("success", format=".0%", key="success_rate"),
    Column("to tolerance", format=",d", key="evaluations_to_tolerance"),
    Column("failed", format="d", key="failures"),
    Column("time", "s", ".3f", key="seconds"),
)


def curves(study: Benchmark, records: Sequence[Record]) -> Mapping[str, Mapping[str, tuple[Float, Float]]]:
    """Return the median convergence (evaluations, cost) by function and optimizer."""
    found: dict[str, dict[str, tuple[Float, Float]]] = {name: {} for name in study.functions}
    for cell, (name, entry) in enumerate(study.pairs):
        curve = median_curve([record for record in records if record.cell == cell])
        if curve is not None:
            found[name][entry.label] = curve
    return found


LEVEL = 0.05
FEW = 5
"""Below this many functions the chi-squared distribution is a coarse approximation and the power is small."""


@dataclass(frozen=True)
class Ranking:
    """Mean ranks of k optimizers over N functions.

    Attributes:
        labels: the optimizers, best first.
        functions: N.
        ranks: mean rank of each, 1 is best.
        p: of Nemenyi's test against the first, for each; 1 for the first itself.
        chi_squared, p_friedman: Friedman's statistic and its p; None with two optimizers, which it needs more of.
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
    costs: dict[tuple[str, str], list[float]] = {}
    for record in records:
        function, optimizer = study.names(record.cell).values()
        costs.setdefault((function, optimizer), []).append(record.cost)
    medians = np.array([[np.median(costs[f, label]) for label in labels] for f in study.functions])
    return ranking(labels, medians)


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
        return 0.0, 1.0  # every function is a tie of all
    result = friedmanchisquare(*ranks.T)
    return float(result.statistic), float(result.pvalue)


def table(result: Ranking) -> Table:
    """Return the ranking as a table whose notes say what was tested."""
    columns = (
        Column("optimizer"),
        Column("mean rank", format=".2f", key="mean_rank"),
        Column("p against the best", format=".2g", key="p"),
    )
    p = (None, *result.p[1:])
    return Table(
        f"Ranks over {result.functions} functions",
        columns,
        tuple(zip(result.labels, result.ranks, p, strict=True)),
        _notes(result),
    )


def _notes(result: Ranking) -> tuple[str, ...]:
    notes = ["Mean rank by the median cost on each function; 1 is best, ties share."]
    if result.p_friedman is not None:
        verdict = "differ" if result.p_friedman < LEVEL else "are not shown to differ"
        notes.append(
            f"Friedman test, null hypothesis that all rank alike: chi-squared {result.chi_squared:.3g}, "
            f"p = {result.p_friedman:.2g}; at the {LEVEL:.0%} level the optimizers {verdict}."
        )
    notes.append(
        f"Nemenyi test of pairs: mean ranks less than {result.critical:.2f} apart do not differ "
        f"significantly at the {LEVEL:.0%} level."
    )
    if result.functions < FEW:
        notes.append(f"{result.functions} functions are few: such tests then find only large differences.")
    return tuple(notes)
