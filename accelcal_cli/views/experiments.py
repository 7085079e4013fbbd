"""Comparisons and the experiments of the papers as tables, beside the numbers that the papers print."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from accelcal_cli.studies import compare, reproduce
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.compare import Comparison, Estimates
from accelcal_cli.studies.reproduce import Experiment, PaperTable, Part
from accelcal_cli.studies.scenarios import WITHIN, Recording
from accelcal_cli.studies.study import Curves, Record, Row, median_curves
from accelcal_cli.views.blocks import Column, Table
from accelcal_cli.views.studies import benchmark_table, table_of

COMPARISON = (
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("success", format=".0%", key="success_rate"),
    Column("time", "s", ".3f", key="seconds"),
    Column("evaluations", format=",d"),
    Column("to success", format=",d", key="evaluations_to_success"),
    Column("cost", "(m/s^2)^4", ".3g"),
    Column("excess", format=".2g"),
    Column("bias error", "micro-g", ".3g", key="bias_error"),
    Column("scale error", "ppm", ".3g", key="scale_error"),
    Column("misalignment", "arcsec", ".3g", key="misalignment_error"),
    Column("efficiency", format=".3g"),
    Column("min", format=".3g"),
    Column("lower quartile", format=".3g", key="lower_quartile"),
    Column("upper quartile", format=".3g", key="upper_quartile"),
    Column("max", format=".3g"),
)

SPREAD = ("optimizer", "min", "lower_quartile", "cost", "upper_quartile", "max")
"""Columns of the table of the costs' spread, which people see beside the rest of a comparison."""


ERROR_PARTS = (
    Column("estimate"),
    Column("off-diagonals", format=".2g", key="off_diagonals"),
    Column("rotation", format=".2g"),
    Column("misalignments", format=".2g"),
    Column("scale factors", format=".2g", key="scale_factors"),
    Column("bias", format=".2g"),
    Column("cost", "(m/s^2)^4", ".2g"),
)


ERROR_PARTS_NOTE = (
    "Errors, rms in output units. Rotation: the antisymmetric part of the off-diagonals, which no readings without "
    "known attitudes can show. Misalignments and scale factors: in gauge lower, where no rotation is left."
)


PARAMETERS = ("K_11", "K_12", "K_13", "K_21", "K_22", "K_23", "K_31", "K_32", "K_33", "D_1", "D_2", "D_3")


FUNCTION_COLUMNS = (
    "function", "optimizer", "min", "lower_quartile", "median", "upper_quartile", "max", "mean", "variance",
    "success_rate", "evaluations_to_tolerance", "ert", "runs", "evaluations", "failures", "seconds",
)  # fmt: skip
"""Columns of a paper's test functions, in order."""

KEYS = ("function", "optimizer")
"""Columns that identify the row of ours to which a row of the paper belongs."""


def comparison_subject(study: Comparison) -> str:
    """Return whose readings a comparison is on."""
    source = study.source
    if isinstance(source, Recording):
        return source.source
    return f"{'Sensors drawn from' if source.drawn else 'Always the same'} {source.sensor.name}"


def comparison_conditions(study: Comparison) -> str:
    """Return what a comparison runs, in one line."""
    source, space = study.source, study.space
    search = f"g = {space.g:g}, {space.unknowns} unknowns, {study.runs} runs, seed {study.seed}"
    if isinstance(source, Recording):
        return f"{source.poses} poses, {search}"
    return f"{source.positions} poses, noise {source.noise:g} m/s^2, {search}"


def comparison_table(study: Comparison, records: Sequence[Record]) -> Table:
    """Return one row per optimizer, with notes on what success is and who missed it."""
    rows = compare.statistics(study, records)
    return table_of("Comparison", COMPARISON, rows, (*_comparison_notes(study), *_misses(rows)))


def _comparison_notes(study: Comparison) -> tuple[str, ...]:
    success = f"Success: within {study.tolerance:g} (m/s^2)^4 or 1 % of the least cost of the readings."
    if isinstance(study.source, Recording):
        return (success, "Errors: distance from the Levenberg-Marquardt solution of the same readings.")
    efficiency = "Efficiency: error over the Cramer-Rao bound; 1 is as good as the noise allows."
    return (success, efficiency) if study.source.noise > 0 else (success,)


def _misses(rows: Sequence[Row]) -> list[str]:
    """Return a sentence for each optimizer that did not always reach the least cost of noisy readings."""
    sentences = []
    for row in rows:
        excess, rate = row["excess"], row["success_rate"]
        if excess is not None and rate < 1.0:
            cost = "within 1 %" if excess <= WITHIN else f"{1.0 + excess:.3g} times as high"
            sentences.append(
                f"{row['optimizer']} came within 1 % of the least cost in {rate:.0%} of its runs; "
                f"its median run is {cost}."
            )
    return sentences


def split_spread(table: Table) -> tuple[Table, Table]:
    """Return a comparison without the spread of the costs, and their spread: least, quartiles and largest."""
    keys = [column.label for column in table.columns]
    rest = table.with_columns(i for i, key in enumerate(keys) if key == "cost" or key not in SPREAD[1:])
    own = table.with_columns(i for i, key in enumerate(keys) if key in SPREAD)
    order = sorted(range(len(own.columns)), key=lambda i: SPREAD.index(own.columns[i].label))
    named = own.with_columns(order)
    median = tuple(replace(c, name="median", unit="") if c.label == "cost" else c for c in named.columns)
    return rest, replace(named, title="Cost over the runs", columns=median, notes=())


def parameter_table(estimates: Estimates) -> Table:
    """Return every parameter of every estimate."""
    columns = (Column("parameter"), *(Column(name, format=".8g") for name in estimates))
    rows = []
    for name in PARAMETERS:
        index = tuple(int(digit) - 1 for digit in name[2:])
        if name[0] == "K" and all(K[index] == 0 for K, _ in estimates.values()):
            continue  # of gauge lower
        rows.append((name, *(float((K if name[0] == "K" else D)[index]) for K, D in estimates.values())))
    return Table("estimates", columns, tuple(rows))


def error_parts_table(study: Comparison, estimates: Estimates) -> Table:
    """Return the parts of the error of each estimate, and its cost on the readings."""
    rows = compare.error_parts(study, estimates)
    return table_of("what of the error the readings show", ERROR_PARTS, rows, [ERROR_PARTS_NOTE])


def experiment_catalogue() -> Table:
    """Return the experiments and what they repeat."""
    columns = Column("name"), Column("title"), Column("source")
    return Table("Experiments", columns, tuple(reproduce.catalogue()))


def experiment_tables(experiment: Experiment, records: Sequence[Record]) -> list[Table]:
    """Return what is to be printed of an experiment's records, part by part."""
    return [
        *(
            replace(table, title=f"{part.title}: {table.title}" if table.title else part.title).filled()
            for number, part in enumerate(experiment.parts)
            for table in _part_tables(part, experiment.records_of(number, records))
        ),
        *_sensitivity_tables(experiment, records),
    ]


SENSITIVITY = (
    Column("function"),
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("success", format=".0%", key="success_rate"),
    *(Column(name, format=".2g") for name in ("min",)),
    Column("lower quartile", format=".2g", key="lower_quartile"),
    Column("median", format=".2g"),
    Column("upper quartile", format=".2g", key="upper_quartile"),
    Column("max", format=".2g"),
    Column("mean", format=".2g"),
    Column("log10 ratio of means", format=".1f", key="ratio"),
    Column("of medians", format=".1f", key="median_ratio"),
)


def _sensitivity_tables(experiment: Experiment, records: Sequence[Record]) -> list[Table]:
    """Return one table for each thing that varies, its values in the first column."""
    tables = []
    for title, rows in reproduce.sensitivity(experiment, records).items():
        part = next(part for part in experiment.parts if part.title == title)
        columns = (Column(part.varies, key="varies"), *SENSITIVITY)
        notes = [f"Log10 ratio: cost of {part.ratio[1]} over that of {part.ratio[0]}."] if part.ratio else []
        tables.append(table_of(title, columns, rows, notes).filled())
    return tables


def _coordinate_table(study: Benchmark, records: Sequence[Record]) -> Table:
    rows = reproduce.coordinates(study, records)
    columns = (
        *(Column(name) for name in (*KEYS, "quantity")),
        *(Column(key, format=".3g") for key in list(rows[0])[3:]),
    )
    return table_of("best points over the runs", columns, rows)


def _part_tables(part: Part, records: Sequence[Record]) -> list[Table]:
    study = part.study()
    tables = []
    for show in part.show:
        if show == "summary":
            ours = (
                benchmark_table(study, records)
                if isinstance(study, Benchmark)
                else comparison_table(study, records)
            )
            further = []
            if isinstance(study, Benchmark):
                keys = [column.label for column in ours.columns]
                ours = ours.with_columns(keys.index(key) for key in FUNCTION_COLUMNS)
            if isinstance(study, Comparison):
                ours, costs = split_spread(ours)
                further = [costs]
            tables += [with_paper_rows(replace(ours, title=""), part.paper), *further]
        elif show == "curves":
            tables.append(checkpoint_table(median_curves(study, records)))
        elif show == "successful" and isinstance(study, Comparison):
            rows = compare.statistics(study, records, only_successful=True)
            tables.append(split_spread(table_of("successful runs alone", COMPARISON, rows))[0])
        elif show == "coordinates" and isinstance(study, Benchmark):
            tables.append(_coordinate_table(study, records))
        elif show in ("parameters", "mean parameters") and isinstance(study, Comparison):
            mean = show == "mean parameters"
            estimates = compare.estimates(study, records, part.printed, mean=mean)
            whose = "mean of the successful runs" if mean else "median run"
            own = [parameter_table(estimates), error_parts_table(study, estimates)]
            tables += [replace(table, title=f"{table.title}, {whose}") for table in own]
    return tables


def with_paper_rows(ours: Table, paper: PaperTable | None) -> Table:
    """Return our table with the paper's rows, each under ours of the same function and optimizer.

    A column `from` tells the rows apart; what the paper does not print is empty.
    """
    if paper is None:
        return ours
    keys = [column.key or column.name for column in ours.columns]
    own = [key for key in KEYS if key in keys]
    split = len(own)
    printed = [dict(zip(paper.columns, row, strict=True)) for row in paper.rows]
    rows: list[Sequence[Any]] = []
    for row in ours.rows:
        rows.append((*row[:split], "here", *row[split:]))
        for theirs in printed:
            if [theirs.get(key) for key in own] == list(row[:split]):
                values = [theirs.get(key) for key in keys]
                rows.append((*values[:split], "paper", *values[split:]))
    columns = (*ours.columns[:split], Column("from"), *ours.columns[split:])
    return replace(ours, columns=columns, rows=tuple(rows))


def checkpoint_table(curves: Curves) -> Table:
    """Return the median cost of each optimizer at some parts of the evaluations."""
    evaluations, rows = reproduce.checkpoints(curves)
    columns = (
        *(Column(name) for name in KEYS),
        *(Column(f"{count:,.0f}", format=".2g") for count in evaluations),
    )
    table = tuple((function, label, *costs) for function, label, costs in rows)
    return Table("median cost after so many evaluations", columns, table).filled()
