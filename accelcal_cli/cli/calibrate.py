"""`accelcal calibrate`: readings in, K matrix, bias, their sigma and a verdict out."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as detecting
from accelcal_cli.cli import process as pipes
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

BAD_VERDICT = 1
FACES = 6
"""Poses at least of a log without --min-poses when no misalignment is asked for."""
SUFFIXES = (".yaml", ".yml", ".json")
"""Endings of a result file; they choose its form."""


def command(
    data: Annotated[
        str,
        typer.Argument(
            help="CSV, text or Parquet file of static readings, or with --raw of a log; - is standard input."
        ),
    ],
    columns: options.Columns = None,
    g: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    optimizer: Annotated[str | None, typer.Option(help="Search method.", show_default="de-pso")] = None,
    config: Annotated[
        Path | None, typer.Option(help="YAML file: optimizer, its parameters, box, gauge, ...")
    ] = None,
    population: Annotated[int | None, typer.Option(help="Points of the search.")] = None,
    iterations: Annotated[int | None, typer.Option(help="Iterations of the search.")] = None,
    runs: Annotated[int | None, typer.Option(help="Independent searches (multi-start).")] = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.", show_default="0")] = None,
    gauge: Annotated[
        str | None, typer.Option(help="lower, upper, symmetric or full.", show_default="lower")
    ] = None,
    robust: Annotated[
        str | None, typer.Option(help="Loss: none, huber or soft-l1.", show_default="none")
    ] = None,
    weights: Annotated[
        str | None,
        typer.Option(help="Weight of a pose: none, n, sd or auto.", show_default="none; auto with --raw"),
    ] = None,
    attitudes: Annotated[
        str | None,
        typer.Option(help="unknown, or known: from columns fx, fy, fz.", show_default="unknown"),
    ] = None,
    misalignment: Annotated[
        bool | None,
        typer.Option(
            help="Estimate misalignments; without, the axes are taken as perpendicular.",
            show_default="misalignment",
        ),
    ] = None,
    temperature: Annotated[
        bool | None,
        typer.Option(
            help="Slopes with temperature, if a column determines them.", show_default="temperature"
        ),
    ] = None,
    polish: Annotated[
        bool | None, typer.Option(help="Finish by Levenberg-Marquardt.", show_default="polish")
    ] = None,
    raw: Annotated[
        bool, typer.Option("--raw", help="The file is a raw log: find its static poses first, see detect.")
    ] = False,
    gyro: detecting.Gyro = None,
    time: detecting.Time = None,
    rate: detecting.Rate = None,
    window: detecting.Window = None,
    still: detecting.Still = None,
    multiplier: detecting.Multiplier = None,
    min_length: detecting.MinLength = None,
    trim: detecting.Trim = None,
    merge: detecting.Merge = None,
    thin: detecting.Thin = None,
    min_poses: detecting.MinPoses = None,
    tolerance: Annotated[
        float | None, typer.Option(help="Exit 1 when the rms of |f| - g is above this (m/s^2).")
    ] = None,
    output: Annotated[
        str | None, typer.Option("--output", "-o", help="Result file: .yaml or .json; - is standard output.")
    ] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Calibrate an accelerometer from static readings.

    Prints the K matrix and the bias with their uncertainty, how well the poses determine them, and a verdict.
    Exit code 1 means that the verdict is "undetermined" or that --tolerance was missed.
    """
    from accelcal_cli.calibration.calibrate import calibrate
    from accelcal_cli.calibration.settings import load_settings
    from accelcal_cli.config import load_mapping
    from accelcal_cli.io.readings import read_readings
    from accelcal_cli.sensor.model import STANDARD_GRAVITY

    options.check_format(format)
    options.check_input(data)
    options.check_apart([data, config], {"-o": output})
    _check_output(output, format)
    options.check_tolerance(tolerance)
    stated_g = options.gravity(g, latitude, height)
    overrides: dict[str, Any] = {
        "optimizer": optimizer,
        "g": stated_g,
        "runs": runs,
        "seed": seed,
        "gauge": gauge,
        "robust": robust,
        "weights": weights,
        "polish": polish,
        "attitudes": attitudes,
        "misalignment": misalignment,
        "temperature": temperature,
    }
    parameters = {"population": population, "iterations": iterations}
    stated = {k: v for k, v in overrides.items() if v is not None}
    chosen = detecting.stated(
        gyro=gyro,
        time=time,
        rate=rate,
        window=window,
        still=still,
        multiplier=multiplier,
        min_length=min_length,
        trim=trim,
        merge=merge,
        thin=thin,
        min_poses=min_poses,
    )
    if not raw and chosen:
        raise UsageError(f"--{next(iter(chosen)).replace('_', '-')}: goes with --raw only")
    if raw:
        keys = {} if config is None else load_mapping(config)
        aligned = {**keys, **stated}.get("misalignment") is False
        if "weights" not in keys:
            stated.setdefault("weights", "n" if aligned else "auto")
        if aligned:
            chosen.setdefault("min_poses", FACES)
    stated["parameters"] = {k: v for k, v in parameters.items() if v is not None}
    settings = load_settings(config, stated)
    if raw:
        readings = detecting.find_poses(data, columns, chosen, settings.g).readings()
    else:
        readings = read_readings(data, options.split_columns(columns), stdin=sys.stdin.buffer)
    result = calibrate(readings, settings)
    missed = tolerance is not None and not result.rms <= tolerance
    with pipes.even_if_unread():
        _show(result, format, output)
    with pipes.even_if_unread(sys.stderr):
        if output not in (None, "-") and not quiet:
            typer.echo(f"accelcal: wrote {output}", err=True)
        if format != "table" or output == "-":  # the table shows them itself
            options.caution(data, result.cautions, quiet)
        if not quiet and stated_g is None and settings.g == STANDARD_GRAVITY:
            typer.echo(
                f"accelcal: g = {settings.g} assumed; state yours with --g or --latitude and --height "
                f"(scale factors are proportional to it){_units_of_g(result)}",
                err=True,
            )
        if tolerance is not None and missed:
            typer.echo(f"accelcal: rms {result.rms:.6g} is above the tolerance {tolerance:.6g}", err=True)
    if missed or result.verdict == "undetermined":
        raise typer.Exit(BAD_VERDICT)


def _units_of_g(result: Calibration) -> str:
    """Return what to say of readings that are 1 long and not 9.8: they were compared with m/s^2."""
    looks = 0.8 < float(result.nominal_scale.mean()) * result.g < 1.25
    return "; readings in units of g, as these seem to be, go with --g 1" if looks else ""


def _check_output(output: str | None, format: str) -> None:
    if output is None:
        return
    if output == "-":
        if format != "table":
            raise UsageError(f"-o - prints the result file; leave out --format {format}")
        return
    from accelcal_cli.output.files import check_target, is_stream

    if Path(output).suffix not in SUFFIXES and not is_stream(output) and not Path(output).is_dir():
        raise UsageError(f'-o "{output}": expected a name that ends in {", ".join(SUFFIXES)}')
    check_target(output)


def _show(result: Calibration, format: str, output: str | None) -> None:
    """Write the result file, then print the result in the chosen form."""
    from accelcal_cli.output.machine import json_text, write_csv

    if output is not None:
        from accelcal_cli.config import dump
        from accelcal_cli.output.files import whole_file

        text = json_text(result.record()) if output.endswith(".json") else dump(result.record())
        with whole_file(output, binary=True) as file:  # read back as UTF-8, whatever the terminal takes
            file.write(text.encode())
        if output == "-":
            return
    if format == "json":
        sys.stdout.write(json_text(result.record()))
    elif format == "csv":
        from accelcal_cli.views.calibration import values

        write_csv(values(result), sys.stdout)
    else:
        from accelcal_cli.output.console import show
        from accelcal_cli.views.calibration import blocks

        show(blocks(result))
