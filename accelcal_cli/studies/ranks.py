"""Which optimizer ranks best over several functions, and whether that is more than chance.

Friedman's test on the ranks within each function, then Nemenyi's critical difference of two mean ranks: the
procedure of [demsar2006].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.streams import Float
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.study import Record
from accelcal_cli.table import Column, Table

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
