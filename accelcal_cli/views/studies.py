"""Tables of studies: the raw results of any study, and the statistics and ranks of a benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from accelcal_cli.studies.benchmark import LEVEL, Benchmark, Ranking, statistics
from accelcal_cli.studies.study import Record, Row, Study
from accelcal_cli.table import Column, Table

FEW = 5
"""Below this many functions the chi-squared distribution is a coarse approximation and the power is small."""


def table_of(title: str, columns: Sequence[Column], rows: Iterable[Row], notes: Iterable[str] = ()) -> Table:
    """Return a table of rows of statistics, each cell found by the key of its column."""
    keys = [column.key or column.name for column in columns]
    return Table(title, tuple(columns), tuple([row[key] for key in keys] for row in rows), tuple(notes))


def raw_table(study: Study, records: Sequence[Record]) -> Table:
    """Return one row per run: everything that does not depend on how fast or where it ran.

    Costs and values that are not finite are left for the writer to leave empty.
    """
    further = list(dict.fromkeys(name for record in records for name in record.values))
    columns = (
        *(Column(label) for label in study.names(0)),
        Column("run", format="d"),
        Column("cost", format=".6g"),
        Column("evaluations", format="d"),
        Column("iterations", format="d"),
        Column("status"),
        Column("hit", format="d"),
        *(Column(name, format=".6g") for name in further),
    )
    rows = [
        (
            *study.names(r.cell).values(),
            *(r.run, r.cost, r.evaluations, r.iterations, r.status, r.hit),
            *(r.values.get(name) for name in further),
        )
        for r in records
    ]
    return Table("Raw results", columns, tuple(rows))


BENCHMARK = (
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


def benchmark_title(study: Benchmark) -> str:
    """Return what a benchmark runs, in one line."""
    runs = "1 run" if study.runs == 1 else f"{study.runs:,} runs"
    changes = ", shifted" * study.shift + ", rotated" * study.rotate
    return f"Benchmark: D = {study.dimensions}, {runs}, tolerance {study.tolerance:g}, seed {study.seed}{changes}"


def benchmark_table(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return one row per cell: statistics of the cost over the runs, success rate, evaluations, seconds."""
    return table_of("Benchmark", BENCHMARK, statistics(study, records))


def ranking_table(ranking: Ranking) -> Table:
    """Return the ranking as a table whose notes say what was tested."""
    columns = (
        Column("optimizer"),
        Column("mean rank", format=".2f", key="mean_rank"),
        Column("p against the best", format=".2g", key="p"),
    )
    rows = zip(ranking.labels, ranking.ranks, (None, *ranking.p[1:]), strict=True)
    return Table(f"Ranks over {ranking.functions} functions", columns, tuple(rows), _ranking_notes(ranking))


def _ranking_notes(ranking: Ranking) -> tuple[str, ...]:
    notes = ["Mean rank by the median cost on each function; 1 is best, ties share."]
    if ranking.p_friedman is not None:
        verdict = "differ" if ranking.p_friedman < LEVEL else "are not shown to differ"
        notes.append(
            f"Friedman test, null hypothesis that all rank alike: chi-squared {ranking.chi_squared:.3g}, "
            f"p = {ranking.p_friedman:.2g}; at the {LEVEL:.0%} level the optimizers {verdict}."
        )
    notes.append(
        f"Nemenyi test of pairs: mean ranks less than {ranking.critical:.2f} apart do not differ "
        f"significantly at the {LEVEL:.0%} level."
    )
    if ranking.functions < FEW:
        notes.append(
            f"{ranking.functions} functions are few: with so few the tests detect only large differences."
        )
    return tuple(notes)
