"""`accelcal benchmark`: optimizers on test functions."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.benchmark import Benchmark
    from accelcal_cli.studies.study import Record

MOST = 1_000_000_000


def command(
    func: Annotated[
        list[str] | None,
        typer.Option(
            "--func",
            help='Test functions: names with commas, repeated, or "all".',
            show_default="the four of the DE-PSO paper",
        ),
    ] = None,
    optimizer: Annotated[
        list[str] | None,
        typer.Option(
            "--optimizer",
            help='Optimizers: likewise; see "accelcal optimizers".',
            show_default="pso,de,de-pso,shade-cma",
        ),
    ] = None,
    dim: Annotated[int, typer.Option(help="Dimensions of the functions.", min=2, max=1000)] = 12,
    runs: Annotated[int, typer.Option(help="Runs of each pair.", min=1, max=1_000_000)] = 20,
    population: Annotated[
        int | None, typer.Option(help="Points of the search.", show_default="each optimizer's own", min=1)
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Iterations at most.", show_default="each optimizer's own", min=1)
    ] = None,
    evaluations: Annotated[
        int | None,
        typer.Option(
            help="Budget of each run; iterations follow from it.", show_default="none", min=1, max=MOST
        ),
    ] = None,
    seed: options.Seed = 0,
    tolerance: Annotated[float, typer.Option(help="A run succeeds with a cost at or below this.")] = 1e-8,
    stop: Annotated[bool, typer.Option("--stop", help="End a run that reaches the tolerance.")] = False,
    shift: Annotated[bool, typer.Option("--shift", help="Move the optimum off the centre.")] = False,
    rotate: Annotated[bool, typer.Option("--rotate", help="Turn the coordinates.")] = False,
    config: Annotated[Path | None, typer.Option(help="YAML file: optimizers and their parameters.")] = None,
    raw: running.Raw = None,
    jobs: running.Jobs = 1,
    cluster: running.Cluster = None,
    resume: running.Resume = False,
    plot: running.Plot = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Run optimizers on test functions with known minima.

    All minima are 0. Prints the spread of the cost over the runs, how many reached the tolerance and after how many
    evaluations, and ranks with a significance test when several optimizers run on several functions.
    """
    from accelcal_cli.studies.benchmark import Benchmark
    from accelcal_cli.studies.functions import select
    from accelcal_cli.studies.study import ALL, Budget, choose, words

    options.check_format(format)
    options.check_apart([config], {"--raw": raw, "--plot": plot})
    running.check_plot(plot)
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected zero or more")
    named = words(optimizer or ())
    budget = Budget(population, iterations, evaluations)
    entries = choose(named, config, ("pso", "de", "de-pso", "shade-cma"), budget)
    study = Benchmark(
        select(words(func or ())),
        tuple(entries), dim, runs, seed, tolerance, evaluations, stop, shift, rotate,
    )  # fmt: skip
    study, notes = study.suiting([] if ALL in named else [entry.label for entry in entries])
    if not quiet:
        for note in notes:
            typer.echo(f"accelcal: {note}", err=True)
    records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
    _show(study, records, format)
    if plot is not None:
        _plot(study, records, plot)
    if not quiet:
        for path in filter(None, (raw, plot)):
            typer.echo(f"accelcal: wrote {path}", err=True)


def _show(study: Benchmark, records: Sequence[Record], format: str) -> None:
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.studies.benchmark import rank
    from accelcal_cli.studies.study import median_curves
    from accelcal_cli.views.studies import benchmark_blocks, benchmark_table, benchmark_title, ranking_table

    rows = benchmark_table(study, records)
    if format == "json":
        sys.stdout.write(json_text(json_rows([rows])))
    elif format == "csv":
        write_csv(rows, sys.stdout)
    else:
        from accelcal_cli.output.console import show

        ranking = rank(study, records)
        further = [ranking_table(ranking)] if ranking else []
        curves = median_curves(study, records)
        show(benchmark_blocks(benchmark_title(study), rows, curves, study.tolerance, further))
    sys.stdout.flush()


def _plot(study: Benchmark, records: Sequence[Record], path: str) -> None:
    from accelcal_cli.output.plot import plot_convergence
    from accelcal_cli.studies.study import median_curves
    from accelcal_cli.views.studies import benchmark_title

    plot_convergence(benchmark_title(study), median_curves(study, records), study.tolerance, path)
