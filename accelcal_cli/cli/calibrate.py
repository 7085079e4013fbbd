"""`accelcal calibrate`: readings in, K matrix, bias, their sigma and a verdict out."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import options, process, wear
from accelcal_cli.errors import UsageError
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from collections.abc import Callable

    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.calibration.settings import Settings
    from accelcal_cli.views.blocks import Block, Table

ROBUST = ("none", "huber", "soft-l1")
ATTITUDES = ("unknown", "known")
PRESETS = ("printed", "tuned")

in_model, in_search = options.panel("Model"), options.panel("Search")


@frozen()
class ModelOptions:
    """What is estimated, and how much each pose counts; keys of the settings."""

    gauge: Annotated[
        str | None,
        in_model(
            help="Which of the equivalent matrices: {choices}.",
            show_default="lower",
            autocompletion=options.one_of(options.GAUGES),
        ),
    ] = None
    misalignment: Annotated[
        bool | None,
        in_model(
            help="Estimate misalignments; without, the axes are taken as perpendicular.",
            show_default="misalignment",
        ),
    ] = None
    temperature: Annotated[
        bool | None,
        in_model(
            help="Estimate temperature slopes, if a column determines them.", show_default="temperature"
        ),
    ] = None
    attitudes: Annotated[
        str | None,
        in_model(
            help="Attitudes of the poses: {choices} (from columns fx, fy, fz).",
            show_default="unknown",
            autocompletion=options.one_of(ATTITUDES),
        ),
    ] = None
    weights: Annotated[
        str | None,
        in_model(
            help="Weight of each pose: {choices}.",
            show_default="none; auto with --raw",
            autocompletion=options.one_of(options.WEIGHTS),
        ),
    ] = None
    robust: Annotated[
        str | None,
        in_model(help="Loss: {choices}.", show_default="none", autocompletion=options.one_of(ROBUST)),
    ] = None


@frozen()
class SearchOptions:
    """How the parameters are searched; keys of the settings, and parameters that most optimizers have."""

    optimizer: Annotated[
        str | None,
        in_search(
            help="Search method: {choices}.",
            show_default="de-pso",
            autocompletion=options.one_of(options.optimizers),
        ),
    ] = None
    preset: Annotated[
        str | None,
        in_search(
            help="Settings of the optimizer beneath those that are stated: {choices}.",
            show_default="its defaults",
            autocompletion=options.one_of(PRESETS),
        ),
    ] = None
    population: Annotated[int | None, in_search(help="Points of the search.")] = None
    iterations: Annotated[int | None, in_search(help="Iterations of the search.")] = None
    runs: Annotated[int | None, in_search(help="Independent searches (multi-start).")] = None
    seed: Annotated[int | None, in_search(help="Seed of all random numbers.", show_default="0")] = None
    polish: Annotated[
        bool | None, in_search(help="Finish by Levenberg-Marquardt.", show_default="polish")
    ] = None


def command(
    *,
    data: Annotated[
        str,
        typer.Argument(
            help="Static readings, or with --raw a log: text, Parquet, Arrow or native; - is standard input.",
            rich_help_panel="Input",
        ),
    ],
    columns: options.Columns = None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    config: Annotated[
        Path | None, options.in_input(help="YAML file: optimizer, its parameters, box, gauge, ...")
    ] = None,
    model: ModelOptions,
    search: SearchOptions,
    raw: Annotated[
        bool,
        options.in_log("--raw", help="The file is a raw log: find its static poses first, as detect does."),
    ] = False,
    worn: wear.Worn = False,
    log: options.DetectionOptions,
    tolerance: Annotated[
        float | None,
        options.in_output(
            help="Exit 1 when the rms of |f| - g is above this (m/s^2).", callback=options.check_tolerance
        ),
    ] = None,
    output: Annotated[
        str | None,
        options.in_output("--output", "-o", help="Result file: .yaml or .json; - is standard output."),
    ] = None,
    format: options.Format = "table",
    verbose: options.Verbose = False,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate an accelerometer from static readings.

    Prints a verdict, the K matrix and the bias with their 95 % intervals, and the fit; with --verbose also every pose,
    how well the poses determine each parameter, and the search. Exit code 1 means that the verdict is "suspect" or
    "undetermined", or that --tolerance was missed.
    """
    from accelcal_cli.calibration.calibrate import calibrate
    from accelcal_cli.io.readings import read_readings

    options.check_input(data)
    options.check_files([data, config], {"-o": output})
    _check_output(output, format)
    stated_g = gravity.stated()
    log.check_raw(raw)
    if worn:
        wear.check(raw, log)
    stated = options.stated(**vars(model), **vars(search), g=stated_g)
    stated["parameters"] = {name: stated.pop(name) for name in ("population", "iterations") if name in stated}
    settings = _settings(config, stated, raw)
    rest = None
    own_g = partial(local_g, settings, gravity, config)
    if worn:
        parts = {"misalignment": settings.misalignment, "slopes": settings.temperature}
        rest = wear.find(data, columns, log, own_g, form, **parts)
        readings = rest.readings()
    elif raw:
        readings = log.poses(data, columns, own_g, form, misalignment=settings.misalignment)
    else:
        readings = read_readings(
            data, options.split_columns(columns), stdin=sys.stdin.buffer, options=form.read_options()
        )
    settings = replace(settings, g=own_g(readings.form.unit))
    result = calibrate(readings, settings)
    if rest is not None:
        result = replace(result, worn=rest.figures(result))
    missed = tolerance is not None and not result.rms <= tolerance
    with process.even_if_unread():
        _show(result, format, output, verbose=verbose)
    with process.even_if_unread(sys.stderr):
        options.tell_written([output], quiet)
        if format != "table" or output == "-":  # the table shows them itself
            options.warn(data, result.warnings, quiet)
        options.tell_assumed_gravity(stated_g, settings.g, quiet, _units_of_g(result))
        if tolerance is not None and missed:
            options.tell([f"rms {result.rms:.6g} is above the tolerance {tolerance:.6g}"])
    if missed or result.verdict in options.BAD_VERDICTS:
        raise typer.Exit(options.BAD_VERDICT)


def _settings(config: Path | None, stated: dict[str, Any], raw: bool) -> Settings:
    """Return the settings; poses of a raw log are weighted unless the file says otherwise."""
    from accelcal_cli.calibration.settings import load_settings, weights_of_log
    from accelcal_cli.config import load_mapping

    if raw:
        keys = {} if config is None else load_mapping(config)
        if "weights" not in keys:
            stated.setdefault("weights", weights_of_log({**keys, **stated}))
    return load_settings(config, stated)


def local_g(
    settings: Settings, gravity: options.GravityOptions, config: Path | None, unit: str | None
) -> float:
    """Return local gravity in the unit of the readings; what the settings file states is taken as it is."""
    from accelcal_cli.config import load_mapping

    filed = config is not None and "g" in load_mapping(config) and gravity.stated() is None
    own = None if filed else gravity.in_unit(unit)
    return settings.g if own is None else own


def _units_of_g(result: Calibration) -> str:
    """Return what to say of readings that are 1 long and not 9.8: they were compared with m/s^2."""
    looks = 0.8 < float(result.nominal_scale.mean()) * result.g < 1.25
    return "; these readings seem to be in units of g: add --g 1" if looks else ""


def _check_output(output: str | None, format: str) -> None:
    if output == "-" and format != "table":
        raise UsageError(f"-o - prints the result file; leave out --format {format}")
    if output in (None, "-"):
        return
    from accelcal_cli.calibration.result import RESULTS
    from accelcal_cli.output.files import is_stream

    if Path(output).suffix not in RESULTS and not is_stream(output) and not Path(output).is_dir():
        raise UsageError(f'-o "{output}": expected a name that ends in {", ".join(RESULTS)}')


def _show(result: Calibration, format: str, output: str | None, *, verbose: bool) -> None:
    """Write the result file, then print the result in the chosen form."""
    if output is not None:
        result.save(output)
        if output == "-":
            return

    def table() -> Table:
        from accelcal_cli.views.calibration import values

        return values(result)

    shown: Callable[[], list[Block]]
    if verbose:
        from accelcal_cli.views.calibration import blocks

        shown = partial(blocks, result)
    elif result.worn is None:
        from accelcal_cli.views.quoted import screen

        shown = partial(screen, result)
    else:
        from accelcal_cli.views.calibration import worn
        from accelcal_cli.views.quoted import screen

        shown = partial(screen, result, worn(result.worn))
    options.print_result(format, table, shown, result.record)
