"""`accelcal compare`: optimizers side by side on the same calibrations."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as running
from accelcal_cli.cli.simulate import LARGEST_NOISE
from accelcal_cli.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from accelcal_cli.studies.compare import Comparison
    from accelcal_cli.studies.scenarios import Recording, Simulation
    from accelcal_cli.studies.study import Record

UNKNOWNS = {"lower": 9, "full": 12}
DEFAULT = ("pso", "de", "de-pso", "levenberg-marquardt", "ellipsoid")
MOST_RUNS = 1_000_000
MOST_POSITIONS = 1_000_000


def command(
    data: Annotated[
        str | None,
        typer.Argument(
            help="Readings of one sensor to compare on instead of simulated ones; - is standard input."
        ),
    ] = None,
    columns: Annotated[
        str | None, typer.Option(help="The three output columns of DATA: names, or numbers from 1.")
    ] = None,
    sensor: Annotated[
        str | None,
        typer.Option(
            help="Type of the simulated sensors: dpso, mems, navigation, or a file.", show_default="mems"
        ),
    ] = None,
    fixed: Annotated[
        bool, typer.Option("--fixed", help="The configured sensor in every run, none drawn.")
    ] = False,
    positions: Annotated[
        int | None, typer.Option(help="Number of poses.", show_default="12", max=MOST_POSITIONS)
    ] = None,
    scheme: Annotated[
        str | None,
        typer.Option(help="faces-edges, edges, icosahedron, turns, fibonacci or random."),
    ] = None,
    noise: Annotated[
        float | None,
        typer.Option(help="Noise of one reading and axis, one sigma, m/s^2.", show_default="the sensor's"),
    ] = None,
    optimizer: Annotated[
        list[str] | None,
        typer.Option(
            "--optimizer",
            help='Optimizers: names with commas, repeated, or "all".',
            show_default=",".join(DEFAULT),
        ),
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file: optimizers and their parameters.")] = None,
    population: Annotated[
        int | None, typer.Option(help="Points of the search.", show_default="each optimizer's own", min=1)
    ] = None,
    iterations: Annotated[
        int | None, typer.Option(help="Iterations at most.", show_default="each optimizer's own", min=1)
    ] = None,
    runs: Annotated[int, typer.Option(help="Runs of each optimizer.", min=1, max=MOST_RUNS)] = 20,
    gauge: Annotated[str, typer.Option(help="What is searched: lower (9 unknowns) or full (12).")] = "lower",
    g: options.Gravity = None,
    polish: Annotated[
        bool,
        typer.Option(
            "--polish/--no-polish",
            help="Finish every search by Levenberg-Marquardt.",
            show_default="no-polish",
        ),
    ] = False,
    tolerance: Annotated[
        float, typer.Option(help="A run succeeds within this of the least cost, (m/s^2)^4, or within 1 %.")
    ] = 1e-10,
    seed: options.Seed = 0,
    raw: running.Raw = None,
    jobs: running.Jobs = 1,
    cluster: running.Cluster = None,
    resume: running.Resume = False,
    plot: running.Plot = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Compare optimizers on the same calibrations.

    Of simulated sensors, or of readings of a real one. Prints how many runs came to the least cost, what that took,
    and the errors of the parameters; with noise also how near the errors come to the Cramer-Rao bound.
    """
    from accelcal_cli.sensor.model import STANDARD_GRAVITY
    from accelcal_cli.studies.compare import Comparison
    from accelcal_cli.studies.scenarios import SearchSpace
    from accelcal_cli.studies.study import Budget, choose, words

    options.check_format(format)
    type_file = sensor if sensor is not None and Path(sensor).suffix else None
    options.check_apart([data, config, type_file], {"--raw": raw, "--plot": plot})
    running.check_plot(plot)
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected zero or more")
    space = SearchSpace(options.gravity(g, None, None) or STANDARD_GRAVITY, _unknowns(gauge))
    entries = choose(words(optimizer or ()), config, DEFAULT, Budget(population, iterations))
    if data is None:
        source: Simulation | Recording = _simulated(sensor, positions, scheme, noise, fixed, columns)
    else:
        stated = {
            "--sensor": sensor,
            "--fixed": fixed or None,
            "--positions": positions,
            "--scheme": scheme,
            "--noise": noise,
        }
        source = _recorded(
            data, columns, space.g, [option for option, value in stated.items() if value is not None]
        )
    study = Comparison(source, space, tuple(entries), runs, seed, tolerance, polish=polish)
    records = running.run(study, raw=raw, jobs=jobs, cluster=cluster, resume=resume, quiet=quiet)
    _show(study, records, format)
    if plot is not None:
        _plot(study, records, plot)
    if not quiet:
        for path in filter(None, (raw, plot)):
            typer.echo(f"accelcal: wrote {path}", err=True)


def _unknowns(gauge: str) -> int:
    if gauge not in UNKNOWNS:
        raise UsageError(
            f'--gauge "{gauge}": unknown{did_you_mean(gauge, UNKNOWNS)}; expected lower or full '
            "(errors are always those of gauge lower)"
        )
    return UNKNOWNS[gauge]


def _simulated(
    sensor: str | None,
    positions: int | None,
    scheme: str | None,
    noise: float | None,
    fixed: bool,
    columns: str | None,
) -> Simulation:
    from accelcal_cli.sensor.poses import directions
    from accelcal_cli.sensor.simulation import load_sensor
    from accelcal_cli.studies.scenarios import FEWEST, Simulation

    if columns is not None:
        raise UsageError("--columns: needs a file of readings")
    if noise is not None and not 0 <= noise <= LARGEST_NOISE:
        raise UsageError(f"--noise {noise:g}: expected 0 to {LARGEST_NOISE:g} m/s^2")
    count = 12 if positions is None else positions
    if count < FEWEST:
        raise UsageError(f"--positions {count}: nine parameters need at least {FEWEST} poses")
    import numpy as np

    directions(count, scheme, np.ones((count, 3)))  # refuses a scheme that does not fit
    device = load_sensor(sensor or "mems")
    return Simulation(device, not fixed, count, scheme, device.noise if noise is None else noise)


def _recorded(data: str, columns: str | None, g: float, simulation: Sequence[str]) -> Recording:
    from accelcal_cli.io.readings import read_readings
    from accelcal_cli.studies.scenarios import Recording

    if simulation:
        raise UsageError(f"{', '.join(simulation)}: not with a file of readings, which are not simulated")
    options.check_input(data)
    chosen = None if columns is None else [part.strip() for part in columns.split(",")]
    return Recording.of(read_readings(data, chosen, stdin=sys.stdin.buffer), g)


def _show(study: Comparison, records: Sequence[Record], format: str) -> None:
    from accelcal_cli.output.machine import json_rows, json_text, write_csv
    from accelcal_cli.studies.study import median_curves
    from accelcal_cli.views.experiments import comparison_conditions, comparison_subject, comparison_table

    rows = comparison_table(study, records)
    if format == "json":
        sys.stdout.write(json_text(json_rows([rows])))
    elif format == "csv":
        write_csv(rows, sys.stdout)
    else:
        from accelcal_cli.output.console import show
        from accelcal_cli.views.studies import study_blocks

        panels = median_curves(study, records)
        plotted = {"Convergence": panels[""]} if panels[""] else {}
        title, note = comparison_subject(study), comparison_conditions(study)
        show(study_blocks(title, [replace(rows.filled(), title="")], plotted, note))
    sys.stdout.flush()


def _plot(study: Comparison, records: Sequence[Record], path: str) -> None:
    from accelcal_cli.output.plot import plot_convergence
    from accelcal_cli.studies.study import median_curves
    from accelcal_cli.views.experiments import comparison_conditions, comparison_subject

    tolerance = 0.0 if study.noisy else study.tolerance
    panels = {comparison_conditions(study): median_curves(study, records)[""]}
    plot_convergence(comparison_subject(study), panels, tolerance, path)
