"""`accelcal benchmark`: optimizers on test functions."""

from __future__ import annotations

import math
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from accelcal_cli.cli import options, running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.views.blocks import Block

MOST = 1_000_000_000

in_problem, in_search = options.panel("Problem"), options.panel("Search")


FUNCTIONS = (
    "sphere",
    "rosenbrock",
    "rastrigin",
    "griewank",
    "modified-rosenbrock",
    "ackley",
    "schwefel",
    "levy",
    "zakharov",
    "elliptic",
    "styblinski-tang",
)
"""Names of studies.functions, stated again so that help need not import it; tests compare them."""


FORMATS = (*options.FORMATS, "latex")
MOST_DIMENSIONS = 1000


def _check_format(choice: str) -> str:
    return options.check_choice("--format", choice, FORMATS)


def command(
    *,
    func: Annotated[
        list[str] | None,
        in_problem(
            "--func",
            help="Test functions, separated by commas or repeated: {choices}.",
            show_default="the four of the DE-PSO paper",
            metavar="NAMES",
            autocompletion=options.several_of((*FUNCTIONS, "all", "bbob")),
        ),
    ] = None,
    dim: Annotated[
        str | None,
        in_problem(
            help="Dimensions of the functions, one or several separated by commas.",
            show_default="12; 5 for bbob",
            metavar="NUMBERS",
        ),
    ] = None,
    instances: Annotated[
        int | None,
        in_problem(
            help="Places and rotations of the functions, run by run in turn; 0: the plain functions.",
            show_default="0; 15 for bbob",
            min=0,
            max=1_000_000,
        ),
    ] = None,
    shift: Annotated[bool, in_problem("--shift", help="Move the optimum off the centre.")] = False,
    rotate: Annotated[bool, in_problem("--rotate", help="Rotate the coordinates.")] = False,
    tolerance: Annotated[float, in_problem(help="A run succeeds with a cost at or below this.")] = 1e-8,
    target: Annotated[
        list[str] | None,
        in_problem(
            "--target",
            help="Costs whose expected running time is told, separated by commas or repeated.",
            show_default="the tolerance",
            metavar="NUMBERS",
        ),
    ] = None,
    optimizer: Annotated[
        list[str] | None,
        in_search(
            "--optimizer",
            help="Optimizers, separated by commas or repeated: {choices}.",
            show_default="pso,de,de-pso,shade-cma",
            metavar="NAMES",
            autocompletion=options.several_of(options.optimizers_or_all),
        ),
    ] = None,
    preset: running.Preset = None,
    peer: running.Peers = None,
    config: Annotated[Path | None, in_search(help="YAML file: optimizers and their parameters.")] = None,
    population: Annotated[
        int | None, in_search(help="Points of the search.", show_default="each optimizer's own", min=1)
    ] = None,
    iterations: Annotated[
        int | None, in_search(help="Iterations at most.", show_default="each optimizer's own", min=1)
    ] = None,
    evaluations: Annotated[
        int | None,
        in_search(
            help="Evaluations per run; the generation under way is finished.",
            show_default="none; 1,000 D for bbob",
            min=1,
            max=MOST,
        ),
    ] = None,
    stop: Annotated[bool, in_search("--stop", help="End a run that reaches the tolerance.")] = False,
    runs: Annotated[
        int | None,
        running.in_runs(
            help="Runs per pair.", show_default="20; one per instance for bbob", min=1, max=1_000_000
        ),
    ] = None,
    seed: running.Seed = 0,
    plot: running.Plot = None,
    coco: Annotated[
        str | None,
        options.in_output(help="Folder for the data of bbob that cocopp reads.", metavar="FOLDER"),
    ] = None,
    profile: Annotated[
        str | None,
        options.in_output(
            help="Draw running times, data profiles and boxes to a .png or .svg file.", metavar="FILE"
        ),
    ] = None,
    format: Annotated[
        str,
        options.in_output(
            "--format",
            help="What to print: {choices}.",
            metavar="FORMAT",
            autocompletion=options.one_of(FORMATS),
            callback=_check_format,
        ),
    ] = "table",
    study_options: running.StudyOptions,
) -> None:
    """Run optimizers on test functions with known minima.

    All minima are 0. Prints the spread of the cost over the runs, how many reached the tolerance and after how many
    evaluations, and ranks with a significance test when several optimizers run on several functions.
    """
    from accelcal_cli.studies.benchmark import Benchmark, rank, unequal_budgets
    from accelcal_cli.studies.functions import select
    from accelcal_cli.studies.study import ALL, Budget, choose, median_curves, words
    from accelcal_cli.views.blocks import BLANK, Paragraph
    from accelcal_cli.views.runtimes import bands, difference_block, profiles, running_time_tables
    from accelcal_cli.views.studies import (
        benchmark_blocks,
        benchmark_table,
        benchmark_title,
        ranking_table,
        shown_columns,
    )

    options.check_files([config], {"--raw": study_options.raw, "--plot": plot, "--profile": profile})
    options.check_plot(plot)
    options.check_plot(profile)
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected zero or more")
    named, peers = words(optimizer or ()), running.peer_entries(peer)
    if not (wanted := words(func or ())) or not wanted[0].startswith("bbob"):
        evaluations = running.peer_budget(peer, evaluations)
    budget = Budget(population, iterations, evaluations)
    entries = choose(named, config, ("pso", "de", "de-pso", "shade-cma"), budget, preset) + peers
    study: Benchmark
    if any(name.startswith("bbob") for name in wanted):
        from accelcal_cli.studies import bbob

        bbob.cocoex()
        if shift or rotate or instances == 0:
            raise UsageError("--shift, --rotate, --instances 0: not with bbob, whose instances do it")
        if coco is not None and (study_options.jobs > 1 or study_options.cluster or study_options.resume):
            raise UsageError("--coco: not with --jobs, --cluster or --resume; its data are written in one go")
        count = instances or bbob.INSTANCES
        study = bbob.Bbob(
            bbob.select(wanted), tuple(entries), _dimensions(dim or "5"), runs or count, seed, tolerance, evaluations,
            stop, instances=count, targets=_targets(target), folder=coco or "",
        )  # fmt: skip
    elif coco is not None:
        raise UsageError("--coco needs --func bbob")
    else:
        study = Benchmark(
            select(wanted),
            tuple(entries), _dimensions(dim or "12"), runs or 20, seed, tolerance, evaluations, stop, shift, rotate,
            instances or 0, _targets(target),
        )  # fmt: skip
    study, notes = study.suiting([] if ALL in named else [entry.label for entry in entries])
    options.tell(notes, study_options.quiet)
    records = study_options.run(study)
    title, rows, curves = (
        benchmark_title(study),
        benchmark_table(study, records),
        median_curves(study, records),
    )

    unequal = unequal_budgets(study, records)

    def blocks() -> list[Block]:
        ranking = None if unequal else rank(study, records)
        further: list[Block] = [*running_time_tables(study, records)]
        if not unequal and (differences := difference_block(study, records)):
            further += [differences, BLANK] if isinstance(differences, Paragraph) else [differences]
        further += [ranking_table(ranking)] if ranking else []
        return benchmark_blocks(title, rows, curves, tolerance, further)

    if format == "latex":
        from accelcal_cli.output.machine import latex_text

        sys.stdout.write(latex_text(shown_columns(rows)))
    else:
        options.print_result(format, rows, blocks)
    if unequal and format == "table":
        options.tell([unequal], study_options.quiet)
    running.draw_convergence(plot, title, curves, tolerance, partial(bands, study, records))
    if profile is not None:
        from accelcal_cli.output.profiles import plot_profiles

        plot_profiles(title, profiles(study, records), profile)
    options.tell_written([study_options.raw, plot, profile], study_options.quiet)


def _dimensions(text: str) -> tuple[int, ...]:
    try:
        numbers = [int(part) for part in text.split(",")]
    except ValueError:
        numbers = [0]
    if not all(2 <= number <= MOST_DIMENSIONS for number in numbers):
        raise UsageError(
            f'--dim "{text}": expected whole numbers from 2 to {MOST_DIMENSIONS}, separated by commas'
        )
    return tuple(dict.fromkeys(numbers))


def _targets(stated: list[str] | None) -> tuple[float, ...]:
    from accelcal_cli.studies.study import words

    try:
        numbers = [float(part) for part in words(stated or ())]
    except ValueError:
        numbers = [math.nan]
    if not all(math.isfinite(number) and number >= 0 for number in numbers):
        raise UsageError(f'--target "{",".join(stated or ())}": expected numbers from 0, separated by commas')
    return tuple(dict.fromkeys(numbers))
