"""Optimizers and studies of them: the catalogue and settings, raw results, benchmarks and ranks."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from accelcal_cli.config import load_mapping
from accelcal_cli.optimization.optimizer import OPTIMIZERS, optimizer_file, shipped_parameters
from accelcal_cli.studies.benchmark import LEVEL, Benchmark, Ranking, statistics
from accelcal_cli.studies.study import Curves, Record, Row, Study
from accelcal_cli.views.blocks import BLANK, Block, Column, Paragraph, Table, convergence

FEW = 5
"""Below this many functions the chi-squared distribution is a coarse approximation and the power is small."""


def table_of(title: str, columns: Sequence[Column], rows: Iterable[Row], notes: Iterable[str] = ()) -> Table:
    """Return a table of rows of statistics, each cell found by the key of its column."""
    keys = [column.label for column in columns]
    return Table(title, tuple(columns), tuple([row[key] for key in keys] for row in rows), tuple(notes))


def raw_table(study: Study, records: Sequence[Record]) -> Table:
    """Return one row per run: everything that does not depend on how fast or where it ran.

    Costs and values that are not finite are left for the writer to leave empty.
    """
    further = list(dict.fromkeys(name for record in records for name in record.values))
    own = study if isinstance(study, Benchmark) else None
    columns = (
        *(Column(label) for label in study.names(0)),
        Column("run", format="d"),
        Column("cost", format=".6g"),
        Column("evaluations", format="d"),
        Column("iterations", format="d"),
        Column("status"),
        Column("hit", format="d"),
        *(Column(name, format=".6g") for name in further),
        *(_points_of(own) if own else ()),
    )
    rows = [
        (
            *study.names(r.cell).values(),
            *(r.run, r.cost, r.evaluations, r.iterations, r.status, r.hit),
            *(r.values.get(name) for name in further),
            *(_run_of(own, r) if own else ()),
        )
        for r in records
    ]
    return Table("Raw results", columns, tuple(rows))


def _points_of(study: Benchmark) -> list[Column]:
    """Return the columns of runs on test functions: where, hits of the targets, trace and best point."""
    counts = ["dimension", "instance", *(f"hit_{target:g}" for target in study.targets)]
    return [
        *(Column(name, format="d") for name in counts),
        *(Column("trace_evaluations"), Column("trace_cost")),
        *(Column(f"x_{i + 1}", format=".6g") for i in range(max(study.dimensions))),
    ]


def _run_of(study: Benchmark, r: Record) -> list[Any]:
    """Return the cells of `_points_of` of one run: a trace is numbers with spaces between."""
    D = study.problems[r.cell][1]
    trace = [" ".join(map(str, column)) for column in zip(*r.curve, strict=True)] or ["", ""]
    point = [*r.point, *[None] * (max(study.dimensions) - len(r.point))]
    return [D, r.instance, *(r.hits if study.targets else ()), *trace, *point]


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
    Column("lower quartile", format=".3g", key="lower_quartile"),
    Column("upper quartile", format=".3g", key="upper_quartile"),
    Column("ERT", format=",.0f", key="ert"),
    Column("target", format="g"),
    Column("D", format="d", key="dimension"),
    Column("instance"),
)

SHOWN = (
    "optimizer", "evaluations", "min", "lower_quartile", "median", "upper_quartile", "max", "mean", "success_rate",
    "evaluations_to_tolerance", "ert", "failures", "seconds",
)  # fmt: skip
"""Columns that people see of each function, in order; the others are for programs."""


def benchmark_title(study: Benchmark) -> str:
    """Return what a benchmark runs, in one line."""
    runs = "1 run" if study.runs == 1 else f"{study.runs:,} runs"
    changes = ", shifted" * study.shift + ", rotated" * study.rotate
    if study.instances:
        changes = f", {study.instances} instances"
    budgets = [budget for D in study.dimensions if (budget := study.budget(D)) is not None]
    if budgets:
        counts = " and ".join(dict.fromkeys(f"{budget:,}" for budget in budgets))
        changes += f", {counts} evaluations (the last generation is finished)"
    sizes = ", ".join(map(str, study.dimensions))
    return f"Benchmark: D = {sizes}, {runs}, tolerance {study.tolerance:g}, seed {study.seed}{changes}"


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


def study_blocks(title: str, tables: Iterable[Table], curves: Curves, note: str = "") -> list[Block]:
    """Return what a study shows.

    Args:
        title: what was run; note: what to know when reading it.
        tables: its tables, each with its title and notes.
        curves: evaluations and median cost, by what they belong to and optimizer.
    """
    remark: list[Block] = [Paragraph(note.strip())] if note else []
    plots = [convergence(name, panel) for name, panel in curves.items()]
    return [Paragraph(heading=title), *remark, BLANK, *tables, *plots]


BELOW = 1e-4
"""Part of the tolerance where the plots of a benchmark have their floor."""


def benchmark_blocks(
    title: str, summary: Table, curves: Curves, tolerance: float, further: Iterable[Block]
) -> list[Block]:
    """Return what a benchmark shows: table and curves of each function, then tables of all.

    Args:
        title: what was run.
        summary: its first column is the function.
        curves: evaluations and median cost by function and optimizer.
        tolerance: costs far below it are not told apart in the plots.
        further: tables that follow, such as ranks.
    """
    blocks: list[Block] = [Paragraph(heading=title), BLANK]
    for function, panel in curves.items():
        blocks.append(_of_panel(summary, function))
        if panel:
            blocks.append(convergence(function, panel, tolerance * BELOW))
    return [*blocks, *further]


def shown_columns(summary: Table) -> Table:
    """Return the rows of a benchmark with the columns that people see, and function, dimension and target."""
    keys = [column.label for column in summary.columns]
    wanted = ("function", "dimension", *SHOWN[:-2], "target")
    return summary.with_columns(keys.index(key) for key in wanted)


def _of_panel(summary: Table, function: str) -> Table:
    """Return the rows of one function and dimension, without what the heading says, nor failures where there are none.

    Of several targets the first has a row here; `target_table` has all.
    """
    keys = [column.label for column in summary.columns]
    name, target = (keys.index(key) for key in ("dimension", "target"))
    own = [row for row in summary.rows if function in (row[0], f"{row[0]}, D = {row[name]}")]
    rows = tuple(row for row in own if row[target] == own[0][target])
    failed = any(row[keys.index("failures")] for row in rows)
    shown = [key for key in SHOWN if key != "failures" or failed]
    return Table(function, summary.columns, rows).with_columns(keys.index(key) for key in shown)


def _parameters(name: str) -> dict[str, Any]:
    """Return the settings of an optimizer as `calibrate` and `benchmark` use them."""
    defaults = {field.name: field.default for field in dataclasses.fields(OPTIMIZERS.get(name))}
    return {**defaults, **shipped_parameters(name)}


def optimizer_catalogue() -> Table:
    """Return all optimizers: name, family, what it needs, paper, one sentence, parameters with defaults."""
    rows = []
    for name in OPTIMIZERS.names():
        cls = OPTIMIZERS.get(name)
        needs = ", ".join(need.replace("_", " ") for need in cls.needs)
        rows.append((name, cls.family, needs, cls.paper, _sentence(cls), _parameters(name)))
    names = ("name", "family", "needs", "paper", "summary", "parameters")
    return Table("Optimizers", tuple(Column(n) for n in names), tuple(rows))


def optimizer_settings(name: str) -> Table:
    """Return the settings of one optimizer: name, default, range, meaning.

    Raises:
        ConfigError: no such optimizer.
    """
    cls = OPTIMIZERS.get(name)
    values, hints = _parameters(name), typing.get_type_hints(cls)
    rows = [
        (
            field.name,
            values[field.name],
            _range(field.metadata, hints[field.name]),
            field.metadata.get("doc", ""),
        )
        for field in dataclasses.fields(cls)
    ]
    columns = (Column("parameter"), Column("default"), Column("range"), Column("meaning"))
    title = f"{name}: {cls.family}, [{cls.paper}]. {_sentence(cls)}"
    return Table(title, columns, tuple(rows), tuple(_presets(name)))


def _presets(name: str) -> list[str]:
    """Return a sentence for each preset of an optimizer: what it sets; none where the file has none."""
    path = optimizer_file(name)
    presets = load_mapping(path).get("presets", {}) if path else {}
    return [
        f"--preset {key}: {assignments(values) if values else 'the defaults'}"
        for key, values in presets.items()
    ]


def _sentence(cls: type) -> str:
    return (cls.__doc__ or "").strip().splitlines()[0]


def _range(limits: Any, hint: Any) -> str:
    """Return the values that a setting may have, in words."""
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(str, typing.get_args(hint)))
    low, above, high = (limits.get(key) for key in ("low", "above", "high"))
    parts = [f"> {above:,}"] if above is not None else [f">= {low:,}"] if low is not None else []
    if high is not None:
        parts.append(f"<= {high:,}")
    return ", ".join(parts)


def optimizer_catalogue_blocks(table: Table) -> list[Block]:
    """Return what the catalogue shows: one paragraph per optimizer, with its settings."""
    blocks: list[Block] = []
    for record in table.records():
        needs = f" Needs {record['needs']}." if record["needs"] else ""
        blocks += [
            Paragraph(f" - {record['family']}, [{record['paper']}]", heading=record["name"]),
            Paragraph(record["summary"] + needs, indent=2),
            Paragraph(assignments(record["parameters"]), indent=2),
        ]
    closing = "The settings of one: accelcal optimizers NAME. The papers: docs/bibliography.md."
    return [*blocks, BLANK, Paragraph(closing)]


def optimizer_settings_blocks(table: Table) -> list[Block]:
    """Return what the settings of one optimizer show, each with its default, its range and its meaning."""
    blocks: list[Block] = [Paragraph(heading=table.title)]
    for name, default, values, meaning in table.rows:
        limits = f"  ({values})" if values else ""
        blocks += [Paragraph(f" = {plain(default)}{limits}", heading=name), Paragraph(meaning, indent=2)]
    return [*blocks, *([BLANK] if table.notes else []), *map(Paragraph, table.notes)]


def assignments(parameters: Mapping[str, Any]) -> str:
    """Return settings as `name=value` with spaces between."""
    return " ".join(f"{name}={plain(value)}" for name, value in parameters.items())


def plain(value: Any) -> str:
    """Return a setting as YAML has it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def flat_text(table: Table) -> Table:
    """Return the table with every cell as text that fits into CSV."""
    rows = tuple(
        tuple(
            assignments(cell) if isinstance(cell, Mapping) else "" if cell == "" else plain(cell)
            for cell in row
        )
        for row in table.rows
    )
    return dataclasses.replace(table, rows=rows)
