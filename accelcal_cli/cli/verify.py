"""`accelcal verify`: an old result against new readings."""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import Annotated

import typer

from accelcal_cli.cli import options, process
from accelcal_cli.errors import UsageError

in_test = options.panel("Test")


def command(
    *,
    result: options.ResultFile,
    data: Annotated[
        str,
        typer.Argument(
            help="New static readings of the sensor; - is standard input.", rich_help_panel="Input"
        ),
    ],
    columns: options.Columns = None,
    form: options.TextOptions,
    raw: Annotated[
        bool,
        options.in_log("--raw", help="The file is a raw log: find its static poses first, as detect does."),
    ] = False,
    log: options.DetectionOptions,
    g: Annotated[
        float | None,
        options.in_input(help="Local gravity; must be that of the result.", show_default="the result's"),
    ] = None,
    level: Annotated[float, in_test(help="Chance of calling an unchanged sensor changed.")] = 0.05,
    tolerance: Annotated[
        float | None,
        in_test(
            help="Exit 1 when the rms of |f| - g under the old result is above this (m/s^2).",
            callback=options.check_tolerance,
        ),
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
    from accelcal_cli.views.verification import blocks, differences

    options.check_input(data)
    log.check_raw(raw)
    if not 0 < level < 1:
        raise UsageError(f"--level {level:g}: expected a chance between 0 and 1")
    old = options.load_result(result, data)
    if g is not None and not math.isclose(options.GravityOptions(g).stated() or 0.0, old.g, rel_tol=1e-9):
        raise UsageError(
            f"--g {g:g}: {result} was calibrated with g = {old.g:.9g}; leave out --g, or calibrate anew"
        )
    if raw:
        readings = log.poses(data, columns, lambda _: old.g, form, misalignment=not old.held.any())
    else:
        readings = read_readings(
            data, options.split_columns(columns), stdin=sys.stdin.buffer, options=form.read_options()
        )
    verification = verify(old, readings, level, tolerance)
    with process.even_if_unread():
        options.print_result(
            format, partial(differences, verification), partial(blocks, verification), verification.record
        )
    with process.even_if_unread(sys.stderr):
        options.warn(result, old.warnings, quiet)
        if format != "table":  # the table shows them itself
            options.warn(readings.source, verification.warnings, quiet)
        if not verification.within:
            options.tell([f"rms {verification.rms:.6g} is above the tolerance {tolerance:.6g}"], quiet)
    if not verification.passed:
        raise typer.Exit(options.BAD_VERDICT)
