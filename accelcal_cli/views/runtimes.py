"""Running times of a benchmark as tables, and what its pictures are drawn from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.schema import frozen
from accelcal_cli.studies.benchmark import LEVEL, Benchmark, pairwise, statistics
from accelcal_cli.studies.runtimes import REDUCTIONS, data_profile, runtime_distribution
from accelcal_cli.studies.study import Curves, Record, quantile_curves, records_of_cell
from accelcal_cli.views.blocks import Block, Column, Paragraph, Table

BUDGETS = (1.0, 10.0, 100.0, 1e3, 1e4, 1e5)
"""Evaluations over D, or over D + 1, at which the tables read the distributions."""

GRID = 200
"""Points of a drawn distribution."""


def target_table(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return the expected running time of every function, dimension and optimizer to each target."""
    rows: dict[tuple[str, int, str], list[object]] = {}
    for row in statistics(study, records):
        key = row["function"], row["dimension"], row["optimizer"]
        cells = rows.setdefault(key, [])
        cells += [row["ert"], f"{round(row['success_rate'] * row['runs'])}/{row['runs']}"]
    columns = [Column("function"), Column("D", format="d", key="dimension"), Column("optimizer")]
    for target in study.goals:
        columns += [Column(f"{target:g}", format=",.0f"), Column("runs", key=f"runs {target:g}", beside=True)]
    note = "ERT: evaluations of all runs up to the target, or to their end, per run that reached it."
    table = Table(
        "Expected running time by target", tuple(columns), tuple((*k, *v) for k, v in rows.items()), (note,)
    )
    return (
        table if len(study.dimensions) > 1 else table.with_columns(i for i in range(len(columns)) if i != 1)
    )


def dimension_table(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return the expected running time to the hardest target over the dimensions, in evaluations over D."""
    target = min(study.goals)
    rows: dict[tuple[str, str], list[float | None]] = {}
    for row in statistics(study, records):
        if row["target"] == target:
            ert = None if row["ert"] is None else row["ert"] / row["dimension"]
            rows.setdefault((row["function"], row["optimizer"]), []).append(ert)
    columns = (
        *(Column("function"), Column("optimizer")),
        *(Column(f"D = {D}", format=",.0f") for D in study.dimensions),
    )
    title = f"Expected running time over D to {target:g}"
    return Table(title, columns, tuple((*names, *values) for names, values in rows.items()))


def distribution_table(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return the share of pairs of run and target that each optimizer solves within budgets over D."""
    own = _by_optimizer(study, records)
    rows = [(label, *runtime_distribution(runs, sizes, BUDGETS)) for label, (runs, sizes) in own.items()]
    columns = (Column("optimizer"), *(Column(f"{b:g} D", format=".0%") for b in BUDGETS))
    note = f"Share of runs and targets ({', '.join(f'{t:g}' for t in study.goals)}) solved within so many evaluations."
    return Table("Distribution of running times (ECDF)", columns, tuple(rows), (note,))


def profile_table(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return the data profiles of each optimizer: share of runs solved within budgets of D + 1 evaluations."""
    own = _by_optimizer(study, records)
    rows = [
        (f"{tau:g}", label, *data_profile(runs, sizes, BUDGETS, tau))
        for tau in REDUCTIONS
        for label, (runs, sizes) in own.items()
    ]
    columns = (Column("tau"), Column("optimizer"), *(Column(f"{b:g} (D + 1)", format=".0%") for b in BUDGETS))
    note = "Share of the runs whose cost fell to tau times that of their first point; one unit is D + 1 evaluations."
    return Table("Data profiles", columns, tuple(rows), (note,))


def difference_block(study: Benchmark, records: Sequence[Record]) -> Block | None:
    """Return which optimizers differ on which function, or a sentence that none do; None where there is no pair."""
    found, tested = pairwise(study, records)
    if not tested:
        return None
    note = (
        "Wilcoxon's rank sum test of the costs of the runs; p for all pairs on a function by Holm's method: "
        f"{tested - len(found)} of {tested} pairs do not differ at the {LEVEL:.0%} level."
    )
    if not found:
        return Paragraph(note)
    columns = [Column("function"), Column("D", format="d", key="dimension")]
    columns += [Column("better"), Column("worse"), Column("p", format=".2g")]
    rows = tuple((d.function, d.dimension, d.better, d.worse, d.p) for d in found)
    table = Table("Optimizers that differ", tuple(columns), rows, (note,))
    return (
        table if len(study.dimensions) > 1 else table.with_columns(i for i in range(len(columns)) if i != 1)
    )


def _by_optimizer(study: Benchmark, records: Sequence[Record]) -> dict[str, tuple[list[Record], list[int]]]:
    """Return the runs of each optimizer, and the dimensions of each run."""
    found: dict[str, tuple[list[Record], list[int]]] = {}
    for r in records:
        _, D, entry = study.problems[r.cell]
        runs, sizes = found.setdefault(entry.label, ([], []))
        runs.append(r)
        sizes.append(D)
    return found


@frozen(eq=False)
class Profiles:
    """What the picture of a benchmark shows, by optimizer.

    Attributes:
        distribution, profile: budgets and shares, both of shape (GRID,); the budgets are evaluations over D, or D + 1.
        costs: best costs of the runs by panel (function and dimension).
        scaling: dimensions and expected running time over D to the hardest target by function.
        tau: part of the first cost that the data profiles are of; target: the hardest.
    """

    distribution: dict[str, tuple[Float, Float]]
    profile: dict[str, tuple[Float, Float]]
    costs: dict[str, dict[str, list[float]]]
    scaling: dict[str, dict[str, tuple[list[int], list[float]]]]
    tau: float
    target: float


def profiles(study: Benchmark, records: Sequence[Record], tau: float = 1e-3) -> Profiles:
    """Return what the picture of a benchmark shows."""
    most = max(r.evaluations / study.problems[r.cell][1] for r in records)
    grid = np.geomspace(1.0, max(most, 10.0), GRID)
    own = _by_optimizer(study, records)
    costs: dict[str, dict[str, list[float]]] = {}
    for cell in range(study.cells):
        panel = costs.setdefault(study.panel(cell), {})
        panel[study.names(cell)["optimizer"]] = [r.cost for r in records_of_cell(records, cell)]
    scaling: dict[str, dict[str, tuple[list[int], list[float]]]] = {}
    for row in statistics(study, records):
        if row["target"] == min(study.goals) and row["ert"] is not None:
            line = scaling.setdefault(row["function"], {}).setdefault(row["optimizer"], ([], []))
            line[0].append(row["dimension"])
            line[1].append(row["ert"] / row["dimension"])
    return Profiles(
        {
            k: (grid, np.array(runtime_distribution(runs, sizes, grid.tolist())))
            for k, (runs, sizes) in own.items()
        },
        {
            k: (grid, np.array(data_profile(runs, sizes, grid.tolist(), tau)))
            for k, (runs, sizes) in own.items()
        },
        costs,
        scaling if len(study.dimensions) > 1 else {},
        tau,
        min(study.goals),
    )


def bands(study: Benchmark, records: Sequence[Record]) -> tuple[Curves, Curves]:
    """Return the lower and upper quartile of the best costs as convergence curves."""
    return quantile_curves(study, records, 0.25), quantile_curves(study, records, 0.75)


def running_time_tables(study: Benchmark, records: Sequence[Record]) -> list[Table]:
    """Return the tables of a benchmark with stated targets, and of one over several dimensions."""
    tables = [dimension_table(study, records)] if len(study.dimensions) > 1 else []
    if study.targets:
        further = (target_table, distribution_table, profile_table)
        tables += [table(study, records) for table in further]
    return [replace(table, rows=tuple(table.rows)) for table in tables]
