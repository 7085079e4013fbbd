"""`accelcal reproduce`: an experiment of a paper, beside the paper's own numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.reproduce import Experiment
    from accelcal_cli.studies.study import Record
    from accelcal_cli.table import Table


def command(
    name: Annotated[
        str | None, typer.Argument(help="The experiment; without a name they are listed.")
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option(help="Runs of each optimizer.", show_default="the paper's", min=1, max=1_000_000),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(help="Seed of all random numbers.", show_default="the study's", min=0)
    ] = None,
    raw: running.Raw = None,
    jobs: running.Jobs = 1,
    cluster: running.Cluster = None,
    resume: running.Resume = False,
    plot: running.Plot = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Repeat an experiment of the papers, beside their numbers.

    The experiments are the files of configs/studies; what agrees and what does not is told in
    docs/explanation/reproduction.md.
    """
    from accelcal_cli.studies import reproduce

    options.check_format(format)
    if name is None:
        from accelcal_cli.views.experiments import catalogue_table

        _list(catalogue_table(), format, [raw, plot, cluster, runs, seed])
        return
    running.check_plot(plot)
    if name in reproduce.navigation_names():
        from accelcal_cli.cli import navigate

        navigate.reproduce(name, runs, seed, raw, jobs, cluster, resume, plot, format, quiet)
        return
    experiment = reproduce.load(name).changed(runs, seed)
    records = running.run(experiment, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
    _show(experiment, records, format)
    if plot is not None:
        from accelcal_cli.output.plot import plot_convergence

        plot_convergence(experiment.title, reproduce.curves(experiment, records), experiment.tolerance, plot)
    if not quiet:
        for path in filter(None, (raw, plot)):
            typer.echo(f"accelcal: wrote {path}", err=True)


def _list(table: Table, format: str, stated: Sequence[object]) -> None:
    from accelcal_cli.output.machine import json_rows, json_text, write_csv

    if any(value is not None for value in stated):
        raise UsageError('expected the name of an experiment; "accelcal reproduce" alone lists them')
    if format == "json":
        sys.stdout.write(json_text(json_rows([table])))
    elif format == "csv":
        write_csv(table, sys.stdout)
    else:
        from accelcal_cli.output.console import show

        show([table])
    sys.stdout.flush()


def _show(experiment: Experiment, records: Sequence[Record], format: str) -> None:
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.studies.reproduce import curves
    from accelcal_cli.views.experiments import experiment_tables

    shown = experiment_tables(experiment, records)
    if format == "json":
        parts = [{"title": table.title, "rows": json_rows([table])} for table in shown]
        sys.stdout.write(json_text({"name": experiment.name, "title": experiment.title, "tables": parts}))
    elif format == "csv":
        for number, table in enumerate(shown):
            sys.stdout.write("\n" if number else "")
            write_csv(table, sys.stdout)
    else:
        from accelcal_cli.output.console import show
        from accelcal_cli.views.studies import study_blocks

        show(study_blocks(experiment.title, shown, curves(experiment, records, shown=True), experiment.note))
    sys.stdout.flush()
