"""`accelcal reproduce`: an experiment of a paper, beside the paper's own numbers."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.reproduce import Experiment
    from accelcal_cli.table import Table


def command(
    *,
    name: Annotated[
        str | None,
        typer.Argument(
            help="The experiment; without a name they are listed.",
            rich_help_panel="Input",
            autocompletion=options.one_of(partial(options.shipped, "studies")),
        ),
    ] = None,
    runs: Annotated[
        int | None,
        running.in_runs(help="Runs per optimizer.", show_default="the paper's", min=1, max=1_000_000),
    ] = None,
    seed: Annotated[
        int | None,
        running.in_runs(help="Seed of all random numbers.", show_default="the study's", min=0),
    ] = None,
    plot: running.Plot = None,
    format: options.Format = "table",
    study_options: running.StudyOptions,
) -> None:
    """Repeat an experiment of the papers, beside their numbers.

    The experiments are the files of configs/studies; what agrees and what does not is told in
    docs/explanation/reproduction.md.
    """
    from accelcal_cli.studies import reproduce

    if name is None:
        from accelcal_cli.views.experiments import catalogue_table

        _list(catalogue_table(), format, [study_options.raw, plot, study_options.cluster, runs, seed])
        return
    running.check_plot(plot)
    if name in reproduce.navigation_names():
        _voyage(name, runs, seed, study_options, plot, format)
    else:
        _experiment(reproduce.load(name).changed(runs, seed), study_options, plot, format)
    options.tell_written([study_options.raw, plot], study_options.quiet)


def _experiment(
    experiment: Experiment, study_options: running.StudyOptions, plot: str | None, format: str
) -> None:
    """Run an experiment on optimizers and print it beside the paper's numbers."""
    from accelcal_cli.output.console import show
    from accelcal_cli.studies.reproduce import curves
    from accelcal_cli.views.experiments import experiment_tables
    from accelcal_cli.views.studies import study_blocks

    records = study_options.run(experiment)
    results = experiment_tables(experiment, records)
    if format == "table":
        plotted = curves(experiment, records, shown=True)
        show(study_blocks(experiment.title, results, plotted, experiment.note))
    else:
        _print(experiment.name, experiment.title, results, format)
    sys.stdout.flush()
    if plot is not None:
        from accelcal_cli.output.plot import plot_convergence

        plot_convergence(experiment.title, curves(experiment, records), experiment.tolerance, plot)


def _voyage(
    name: str,
    runs: int | None,
    seed: int | None,
    study_options: running.StudyOptions,
    plot: str | None,
    format: str,
) -> None:
    """Run an experiment on navigation filters and print it beside the paper's numbers."""
    from accelcal_cli.navigation.study import Navigation, load_study
    from accelcal_cli.output.console import show
    from accelcal_cli.views.navigation import chart_of, curves, summary, with_paper

    settings = load_study(name, {"runs": runs, "seed": seed})
    study = Navigation(settings, settings.filters, (settings.ins,))
    records = study_options.run(study)
    table = with_paper(summary(study, records), settings)
    if format == "table":
        show([table])
    else:
        _print(name, settings.title, [table], format)
    sys.stdout.flush()
    if plot is not None:
        from accelcal_cli.output.plot import plot_voyage

        plot_voyage(chart_of(study, records, curves(study, records)), plot)


def _print(name: str, title: str, tables: Sequence[Table], format: str) -> None:
    """Print the tables of an experiment for other programs."""
    from accelcal_cli.output.machine import json_rows, json_text, write_csv

    if format == "json":
        parts = [{"title": table.title, "rows": json_rows([table])} for table in tables]
        sys.stdout.write(json_text({"name": name, "title": title, "tables": parts}))
        return
    for number, table in enumerate(tables):
        sys.stdout.write("\n" if number else "")
        write_csv(table, sys.stdout)


def _list(table: Table, format: str, stated: Sequence[object]) -> None:
    if any(value is not None for value in stated):
        raise UsageError('expected the name of an experiment; "accelcal reproduce" alone lists them')
    if not options.print_rows(format, table):
        from accelcal_cli.output.console import show

        show([table])
    sys.stdout.flush()
