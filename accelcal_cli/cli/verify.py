"""`accelcal verify`: an old result against new readings."""

from __future__ import annotations

import math
import sys
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import process as pipes
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.verification.verify import Verification

FAILED = 1


def command(
    result: Annotated[str, typer.Argument(help="Result file of accelcal calibrate; - is standard input.")],
    data: Annotated[str, typer.Argument(help="New static readings of the sensor; - is standard input.")],
    columns: options.Columns = None,
    g: Annotated[
        float | None,
        typer.Option(help="Local gravity; has to be that of the result.", show_default="the result's"),
    ] = None,
    level: Annotated[float, typer.Option(help="Chance of calling an unchanged sensor changed.")] = 0.05,
    tolerance: Annotated[
        float | None,
        typer.Option(help="Exit 1 when the rms of |f| - g under the old result is above this (m/s^2)."),
    ] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Say whether a sensor has changed since it was calibrated.

    Compares the result with new readings: a chi-square test of all nine parameters, each of them alone, and the rms
    of |f| - g against a tolerance. Exit code 1 means that the sensor has changed, that these readings cannot tell, or
    that --tolerance was missed.
    """
    from accelcal_cli.io.readings import read_readings
    from accelcal_cli.verification.verify import verify

    options.check_format(format)
    options.check_input(data)
    options.check_tolerance(tolerance)
    if not 0 < level < 1:
        raise UsageError(f"--level {level:g}: expected a chance between 0 and 1")
    old = options.load_result(result, data)
    _check_gravity(g, old, result)
    readings = read_readings(data, options.split_columns(columns), stdin=sys.stdin.buffer)
    found = verify(old, readings, level, tolerance)
    with pipes.even_if_unread():
        _show(found, format)
    with pipes.even_if_unread(sys.stderr):
        options.caution(result, old.cautions, quiet)
        if format != "table":  # the table shows them itself
            options.caution(readings.source, found.cautions, quiet)
        if not found.within and not quiet:
            typer.echo(f"accelcal: rms {found.rms:.6g} is above the tolerance {tolerance:.6g}", err=True)
    if not found.passed:
        raise typer.Exit(FAILED)


def _check_gravity(g: float | None, old: Calibration, name: str) -> None:
    stated = options.gravity(g, None, None)
    if stated is not None and not math.isclose(stated, old.g, rel_tol=1e-9):
        raise UsageError(
            f"--g {stated:g}: {name} was calibrated with g = {old.g:.9g}; leave out --g, or calibrate anew"
        )


def _show(found: Verification, format: str) -> None:
    from accelcal_cli.output.machine import json_text, write_csv

    if format == "json":
        sys.stdout.write(json_text(found.record()))
    elif format == "csv":
        from accelcal_cli.views.verification import differences

        write_csv(differences(found), sys.stdout)
    else:
        from accelcal_cli.output.console import show
        from accelcal_cli.views.verification import blocks

        show(blocks(found))
