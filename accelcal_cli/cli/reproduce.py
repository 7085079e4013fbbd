"""`accelcal reproduce`: an experiment of a paper, beside the paper's own numbers."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.studies.reproduce import Experiment
    from accelcal_cli.views.blocks import Block, Table


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
    from accelcal_cli.views.experiments import experiment_catalogue

    if name is None:
        if any(value is not None for value in (study_options.raw, plot, study_options.cluster, runs, seed)):
            raise UsageError('expected the name of an experiment; "accelcal reproduce" alone lists them')
        options.print_result(format, experiment_catalogue, lambda: [experiment_catalogue()])
        return
    options.check_files([], {"--raw": study_options.raw, "--plot": plot})
    options.check_plot(plot)
    if name in reproduce.navigation_names():
        _voyage(name, runs, seed, study_options, plot, format)
    else:
        _experiment(reproduce.load(name).changed(runs, seed), study_options, plot, format)
    options.tell_written([study_options.raw, plot], study_options.quiet)


def _experiment(
    experiment: Experiment, study_options: running.StudyOptions, plot: str | None, format: str
) -> None:
    """Run an experiment on optimizers and print it beside the paper's numbers."""
    from accelcal_cli.studies.reproduce import curves
    from accelcal_cli.views.experiments import experiment_tables
    from accelcal_cli.views.studies import study_blocks

    records = study_options.run(experiment)
    results = experiment_tables(experiment, records)
    shown = study_blocks(experiment.title, results, curves(experiment, records, shown=True), experiment.note)
    _print(experiment.name, experiment.title, results, shown, format)
    running.draw_convergence(plot, experiment.title, curves(experiment, records), experiment.tolerance)


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
    from accelcal_cli.views.navigation import chart_of, curves, shown, summary, with_paper

    settings = load_study(name, {"runs": runs, "seed": seed})
    study = Navigation(settings, settings.filters, (settings.ins,))
    records = study_options.run(study)
    table = with_paper(summary(study, records), settings)
    _print(name, settings.title, [table], [shown(table)], format)
    if plot is not None:
        from accelcal_cli.output.plot import plot_voyage

        plot_voyage(chart_of(study, records, curves(study, records)), plot)


def _print(name: str, title: str, tables: Sequence[Table], blocks: Iterable[Block], format: str) -> None:
    """Print the tables of an experiment for other programs, or what it shows to people."""
    from accelcal_cli.output.console import show
    from accelcal_cli.output.machine import json_rows, json_text, write_csv

    if format == "table":
        show(blocks)
    elif format == "json":
        parts = [{"title": table.title, "rows": json_rows([table])} for table in tables]
        sys.stdout.write(json_text({"name": name, "title": title, "tables": parts}))
    else:
        for number, table in enumerate(tables):
            sys.stdout.write("\n" if number else "")
            write_csv(table, sys.stdout)
    sys.stdout.flush()
