"""`accelcal benchmark`: optimizers on test functions."""

from __future__ import annotations

import math
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


def command(
    *,
    func: Annotated[
        list[str] | None,
        in_problem(
            "--func",
            help="Test functions, separated by commas or repeated: {choices}.",
            show_default="the four of the DE-PSO paper",
            metavar="NAMES",
            autocompletion=options.several_of((*FUNCTIONS, "all")),
        ),
    ] = None,
    dim: Annotated[int, in_problem(help="Dimensions of the functions.", min=2, max=1000)] = 12,
    shift: Annotated[bool, in_problem("--shift", help="Move the optimum off the centre.")] = False,
    rotate: Annotated[bool, in_problem("--rotate", help="Rotate the coordinates.")] = False,
    tolerance: Annotated[float, in_problem(help="A run succeeds with a cost at or below this.")] = 1e-8,
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
            help="Evaluations per run; iterations follow from them.", show_default="none", min=1, max=MOST
        ),
    ] = None,
    stop: Annotated[bool, in_search("--stop", help="End a run that reaches the tolerance.")] = False,
    runs: Annotated[int, running.in_runs(help="Runs per pair.", min=1, max=1_000_000)] = 20,
    seed: running.Seed = 0,
    plot: running.Plot = None,
    format: options.Format = "table",
    study_options: running.StudyOptions,
) -> None:
    """Run optimizers on test functions with known minima.

    All minima are 0. Prints the spread of the cost over the runs, how many reached the tolerance and after how many
    evaluations, and ranks with a significance test when several optimizers run on several functions.
    """
    from accelcal_cli.studies.benchmark import Benchmark, rank
    from accelcal_cli.studies.functions import select
    from accelcal_cli.studies.study import ALL, Budget, choose, median_curves, words
    from accelcal_cli.views.studies import benchmark_blocks, benchmark_table, benchmark_title, ranking_table

    options.check_files([config], {"--raw": study_options.raw, "--plot": plot})
    options.check_plot(plot)
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected zero or more")
    named = words(optimizer or ())
    budget = Budget(population, iterations, evaluations)
    entries = choose(named, config, ("pso", "de", "de-pso", "shade-cma"), budget, preset)
    study = Benchmark(
        select(words(func or ())),
        tuple(entries), dim, runs, seed, tolerance, evaluations, stop, shift, rotate,
    )  # fmt: skip
    study, notes = study.suiting([] if ALL in named else [entry.label for entry in entries])
    options.tell(notes, study_options.quiet)
    records = study_options.run(study)
    title, rows, curves = (
        benchmark_title(study),
        benchmark_table(study, records),
        median_curves(study, records),
    )

    def blocks() -> list[Block]:
        ranking = rank(study, records)
        further = [ranking_table(ranking)] if ranking else []
        return benchmark_blocks(title, rows, curves, tolerance, further)

    options.print_result(format, rows, blocks)
    running.draw_convergence(plot, title, curves, tolerance)
    options.tell_written([study_options.raw, plot], study_options.quiet)
