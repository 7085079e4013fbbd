"""`accelcal compare`: optimizers side by side on the same calibrations."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, running
from accelcal_cli.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from accelcal_cli.studies.scenarios import Recording, Simulation
    from accelcal_cli.views.blocks import Table

UNKNOWNS = {"lower": 9, "full": 12}
DEFAULT = ("pso", "de", "de-pso", "levenberg-marquardt", "ellipsoid")
MOST_RUNS = 1_000_000
MOST_POSITIONS = 1_000_000


in_simulation, in_search = options.panel("Simulated sensors"), options.panel("Search")


@dataclass(frozen=True)
class SimulationOptions:
    """The sensors that are simulated when no readings are given."""

    sensor: Annotated[
        str | None,
        in_simulation(
            help="Type of the sensors: {choices}, or a YAML file.",
            show_default="mems",
            autocompletion=options.one_of(partial(options.shipped, "sensors")),
        ),
    ] = None
    fixed: Annotated[
        bool, in_simulation("--fixed", help="The configured sensor in every run, none drawn.")
    ] = False
    positions: Annotated[
        int | None, in_simulation(help="Number of poses.", show_default="12", max=MOST_POSITIONS)
    ] = None
    scheme: Annotated[
        str | None,
        in_simulation(
            help="Where the poses point: {choices}.", autocompletion=options.one_of(options.SCHEMES[1:])
        ),
    ] = None
    noise: Annotated[
        float | None,
        in_simulation(
            help="Noise of one reading and axis, one sigma, m/s^2.",
            show_default="the sensor's",
            callback=options.check_noise,
        ),
    ] = None

    def scenario(self) -> Simulation:
        """Return what is simulated.

        Raises:
            UsageError: too few poses, or a scheme that does not fit their number.
            ConfigError: no such type of sensor.
        """
        import numpy as np

        from accelcal_cli.sensor.poses import directions
        from accelcal_cli.sensor.simulation import load_sensor
        from accelcal_cli.studies.scenarios import FEWEST, Simulation

        count = 12 if self.positions is None else self.positions
        if count < FEWEST:
            raise UsageError(f"--positions {count}: nine parameters need at least {FEWEST} poses")
        directions(count, self.scheme, np.ones((count, 3)))  # refuses a scheme that does not fit
        device = load_sensor(self.sensor or "mems")
        noise = device.noise if self.noise is None else self.noise
        return Simulation(device, not self.fixed, count, self.scheme, noise)


def command(
    *,
    data: Annotated[
        str | None,
        typer.Argument(
            help="Readings of one sensor to compare on instead of simulated ones; - is standard input.",
            rich_help_panel="Input",
        ),
    ] = None,
    columns: options.Columns = None,
    form: options.TextOptions,
    g: Annotated[
        float | None,
        options.in_input(
            "--g", help="Local gravity in m/s^2 (1 for readings in units of g).", show_default="9.80665"
        ),
    ] = None,
    simulation: SimulationOptions,
    optimizer: Annotated[
        list[str] | None,
        in_search(
            "--optimizer",
            help="Optimizers, separated by commas or repeated: {choices}.",
            show_default=",".join(DEFAULT),
            metavar="NAMES",
            autocompletion=options.several_of(options.optimizers_or_all),
        ),
    ] = None,
    preset: running.Preset = None,
    peer: running.Peers = None,
    evaluations: Annotated[
        int | None,
        in_search(
            help="Evaluations per run; the generation under way is finished.",
            show_default="none; 50,000 with --peer",
            min=1,
            max=1_000_000_000,
        ),
    ] = None,
    config: Annotated[Path | None, in_search(help="YAML file: optimizers and their parameters.")] = None,
    population: Annotated[
        int | None, in_search(help="Points of the search.", show_default="each optimizer's own", min=1)
    ] = None,
    iterations: Annotated[
        int | None, in_search(help="Iterations at most.", show_default="each optimizer's own", min=1)
    ] = None,
    gauge: Annotated[
        str,
        in_search(
            help="What is searched: {choices} (9 or 12 unknowns).", autocompletion=options.one_of(UNKNOWNS)
        ),
    ] = "lower",
    polish: Annotated[
        bool,
        in_search(
            "--polish/--no-polish",
            help="Finish every search by Levenberg-Marquardt.",
            show_default="no-polish",
        ),
    ] = False,
    tolerance: Annotated[
        float, in_search(help="A run succeeds within this of the least cost, (m/s^2)^4, or within 1 %.")
    ] = 1e-10,
    runs: Annotated[int, running.in_runs(help="Runs per optimizer.", min=1, max=MOST_RUNS)] = 20,
    seed: running.Seed = 0,
    plot: running.Plot = None,
    format: options.Format = "table",
    study_options: running.StudyOptions,
) -> None:
    """Compare optimizers on the same calibrations.

    Of simulated sensors, or of readings of a real one. Prints how many runs came to the least cost, what that took,
    and the errors of the parameters; with noise also how near the errors come to the Cramer-Rao bound.
    """
    from accelcal_cli.sensor.model import STANDARD_GRAVITY
    from accelcal_cli.studies.compare import Comparison
    from accelcal_cli.studies.scenarios import SearchSpace
    from accelcal_cli.studies.study import Budget, choose, median_curves, words
    from accelcal_cli.views import experiments
    from accelcal_cli.views.studies import study_blocks

    sensor = simulation.sensor
    type_file = sensor if sensor is not None and Path(sensor).suffix else None
    options.check_files([data, config, type_file], {"--raw": study_options.raw, "--plot": plot})
    options.check_plot(plot)
    if not (math.isfinite(tolerance) and tolerance >= 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected zero or more")
    if gauge not in UNKNOWNS:
        raise UsageError(
            f'--gauge "{gauge}": unknown{did_you_mean(gauge, UNKNOWNS)}; expected lower or full '
            "(errors are always those of gauge lower)"
        )
    space = SearchSpace(options.GravityOptions(g).stated() or STANDARD_GRAVITY, UNKNOWNS[gauge])
    peers, evaluations = running.peer_entries(peer), running.peer_budget(peer, evaluations)
    budget = Budget(population, iterations, evaluations)
    entries = choose(words(optimizer or ()), config, DEFAULT, budget, preset) + peers
    source: Simulation | Recording
    if data is not None:
        source = _recorded(data, columns, form, space.g, simulation)
    elif needless := options.stated(columns=columns, **vars(form)):
        raise UsageError(f"--{next(iter(needless)).replace('_', '-')} needs a file of readings")
    else:
        source = simulation.scenario()
    study = Comparison(
        source, space, tuple(entries), runs, seed, tolerance, polish=polish, evaluations=evaluations
    )
    records = study_options.run(study)
    title, conditions = experiments.comparison_subject(study), experiments.comparison_conditions(study)
    rows, curves = experiments.comparison_table(study, records), median_curves(study, records)[""]
    shown = {"Convergence": curves} if curves else {}
    options.print_result(
        format,
        rows,
        lambda: study_blocks(title, _shown(rows), shown, conditions),
    )
    running.draw_convergence(plot, title, {conditions: curves}, 0.0 if study.noisy else study.tolerance)
    options.tell_written([study_options.raw, plot], study_options.quiet)


def _shown(rows: Table) -> list[Table]:
    """Return what people see of a comparison: its table without empty columns, and the spread of the costs."""
    from accelcal_cli.views.experiments import split_spread

    rest, costs = split_spread(rows)
    return [replace(rest.filled(), title=""), costs]


def _recorded(
    data: str, columns: str | None, form: options.TextOptions, g: float, simulation: SimulationOptions
) -> Recording:
    from accelcal_cli.io.readings import read_readings
    from accelcal_cli.studies.scenarios import Recording

    stated = [f"--{name}" for name, value in options.stated(**vars(simulation)).items() if value is not False]
    if stated:
        raise UsageError(f"{', '.join(stated)}: not with a file of readings, which are not simulated")
    options.check_input(data)
    return Recording.of(
        read_readings(
            data, options.split_columns(columns), stdin=sys.stdin.buffer, options=form.read_options()
        ),
        g,
    )
