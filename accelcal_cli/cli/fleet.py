"""`accelcal fleet`: readings of thousands of sensors in, a row or a result file for each out."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options, process
from accelcal_cli.errors import ConfigError, UsageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from accelcal_cli.arrays import Bool
    from accelcal_cli.calibration.fleet import Fleet
    from accelcal_cli.calibration.settings import Settings
    from accelcal_cli.io.fleet import FleetReadings

SUFFIXES = (".csv", ".parquet", ".json")
NAMED = 5
"""Sensors that a line on standard error names."""


in_model = options.panel("Model")


def command(
    *,
    data: Annotated[
        list[str],
        typer.Argument(
            help="Table of static readings with a column that labels the sensor, or one file per sensor; CSV, text or "
            "Parquet; - is standard input.",
            rich_help_panel="Input",
        ),
    ],
    sensor_column: Annotated[
        str | None,
        options.in_input(
            help="Column that labels the sensor: name, or number from 1.", show_default="found by name"
        ),
    ] = None,
    columns: options.Columns = None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    config: Annotated[
        Path | None, options.in_input(help="YAML file: box, nominal, gauge, weights, g.")
    ] = None,
    gauge: Annotated[
        str | None,
        in_model(
            help="Which of the equivalent matrices: {choices}.",
            show_default="lower",
            autocompletion=options.one_of(options.GAUGES[:-1]),
        ),
    ] = None,
    weights: Annotated[
        str | None,
        in_model(
            help="Weight of each pose: {choices}.",
            show_default="none",
            autocompletion=options.one_of(options.WEIGHTS[:-1]),
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        options.in_output(
            help="Exit 1 when the rms of |f| - g of a sensor is above this (m/s^2).",
            callback=options.check_tolerance,
        ),
    ] = None,
    output: Annotated[
        str | None,
        options.in_output(
            "--output",
            "-o",
            help="Table of all sensors, .csv, .parquet or .json; or a folder, ending in /, for a result file of each.",
        ),
    ] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Calibrate thousands of sensors at once.

    Every sensor as `calibrate --optimizer levenberg-marquardt` would by itself. Prints how the fleet spreads, which
    sensors fit worst, which stand out and which are not determined; --format csv or json prints a row for each.
    Exit code 1 means that a sensor is suspect, undetermined or failed, or missed the --tolerance.
    """
    from accelcal_cli.calibration.fleet import calibrate_fleet, check_settings
    from accelcal_cli.calibration.settings import load_settings
    from accelcal_cli.config import load_mapping
    from accelcal_cli.io.fleet import read_fleet
    from accelcal_cli.output.files import whole_folder
    from accelcal_cli.output.machine import write_result

    for source in data:
        options.check_input(source)
    options.check_apart([*data, config], {"-o": output})
    folder = output is not None and _check_output(output)
    stated_g = gravity.stated()
    stated = options.stated(g=stated_g, gauge=gauge, weights=weights)
    filed = {} if config is None else load_mapping(config)
    if "optimizer" not in filed:
        stated["optimizer"] = "levenberg-marquardt"
    settings = load_settings(config, stated)
    if filed.get("temperature") is True:  # the default asks for nothing, a file does
        raise ConfigError(
            f"{config}: temperature: true: a fleet goes without slopes; calibrate this sensor by itself"
        )
    check_settings(settings)
    readings = read_fleet(
        data,
        options.split_columns(columns),
        sensor_column,
        stdin=sys.stdin.buffer,
        options=form.read_options(),
    )
    own = gravity.in_unit(readings.unit)
    if own is not None and (stated_g is not None or "g" not in filed):
        settings = replace(settings, g=own)
    if folder and output is not None:
        with whole_folder(output) as results:
            fleet = calibrate_fleet(
                readings, settings, lambda number, one: write_result(results, readings.sensors[number], one)
            )
    else:
        fleet = calibrate_fleet(readings, settings)
    with process.even_if_unread():
        _show(fleet, readings, settings, format, None if folder else output)
    bad = _bad(fleet, tolerance)
    with process.even_if_unread(sys.stderr):
        options.tell(dict.fromkeys(note for origin in readings.origins for note in origin.notes), quiet)
        options.tell_assumed_gravity(stated_g, settings.g, quiet)
        options.tell_written([output], quiet)
        _name(bad, readings.sensors)
    if any(which.any() for which in bad.values()):
        raise typer.Exit(options.BAD_VERDICT)


def _check_output(output: str) -> bool:
    """Refuse an output that could not be written; return whether it is a folder."""
    from accelcal_cli.output.files import check_folder, check_target

    if output.endswith("/") or Path(output).is_dir():
        check_folder(output)
        return True
    if Path(output).suffix not in SUFFIXES:
        raise UsageError(
            f'-o "{output}": expected a name that ends in {", ".join(SUFFIXES)}, or a folder, ending in /'
        )
    check_target(output)
    return False


def _show(fleet: Fleet, readings: FleetReadings, settings: Settings, format: str, output: str | None) -> None:
    """Write the table of all sensors, then print the fleet in the chosen form."""
    from accelcal_cli.calibration.fleet import standouts
    from accelcal_cli.output.machine import write_table
    from accelcal_cli.views import fleet as fleet_tables

    outlying = standouts(fleet, settings.g)
    rows = cache(partial(fleet_tables.sensors, fleet, readings.sensors, outlying))  # made when asked for
    if output is not None:
        write_table(rows(), output)
    options.print_result(
        format, rows, partial(fleet_tables.blocks, fleet, readings.sensors, outlying, settings.g)
    )


def _bad(fleet: Fleet, tolerance: float | None) -> dict[str, Bool]:
    """Return which sensors are suspect, not determined or too far off, shape (R,) each, by what they are."""
    kinds = {"undetermined or failed": ~fleet.determined, "suspect": fleet.verdict == "suspect"}
    if tolerance is not None:  # A sensor that failed has no rms; it is named already.
        kinds[f"with an rms above the tolerance {tolerance:.6g}"] = fleet.rms > tolerance
    return kinds


def _name(bad: Mapping[str, Bool], labels: Sequence[str]) -> None:
    """Name the sensors that are bad on standard error."""
    for what, which in bad.items():
        names = [labels[r] for r in which.nonzero()[0].tolist()]
        if names:
            more = f" and {len(names) - NAMED:,} more" if len(names) > NAMED else ""
            count = f"{len(names):,} of {len(labels):,} sensors"
            options.tell([f"{count} {what}: {', '.join(names[:NAMED])}{more}"])
