"""`accelcal plan`: which poses to take next, and the sigma to expect."""

from __future__ import annotations

import io
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import process as pipes
from accelcal_cli.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.planning.plan import Plan

MOST_POSES = 200
FROM_NOTHING, NEXT = 12, 6
BAD_VERDICT = 1
RESULTS = (".yaml", ".yml", ".json")
"""Endings of a result file; anything else holds readings."""


def command(
    data: Annotated[
        str | None,
        typer.Argument(
            help="The poses so far: readings, or a result file (.yaml, .json); - is standard input.",
            show_default="none",
        ),
    ] = None,
    poses: Annotated[
        int | None,
        typer.Option(
            help="Poses in the end, those so far included.",
            show_default="12 from nothing",
            min=1,
            max=1_000_000_000,
        ),
    ] = None,
    add: Annotated[
        int | None,
        typer.Option(
            help="Poses to add, instead of --poses.", show_default="6 to readings", min=1, max=MOST_POSES
        ),
    ] = None,
    fixture: Annotated[
        str, typer.Option(help="What the sensor can be held against: faces, edges, corners or any.")
    ] = "corners",
    noise: Annotated[
        float | None,
        typer.Option(help="Noise of one pose, one sigma, m/s^2.", show_default="s of the poses so far"),
    ] = None,
    columns: options.Columns = None,
    g: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Plan the next poses: those that shrink the worst sigma.

    Prints them in words and as vectors, and the sigma to expect after each. Exit code 1 means that not even all
    these poses determine the parameters.
    """
    from accelcal_cli.planning.design import FIXTURES

    options.check_format(format)
    if fixture not in FIXTURES:
        raise UsageError(
            f'--fixture "{fixture}": unknown{did_you_mean(fixture, FIXTURES)}; expected one of {", ".join(FIXTURES)}'
        )
    if noise is not None and not (math.isfinite(noise) and noise > 0):
        raise UsageError(f"--noise {noise:g}: expected a positive number in m/s^2")
    if poses is not None and add is not None:
        raise UsageError("--poses and --add: expected one of them, not both")
    stated_g = options.gravity(g, latitude, height)
    so_far = _so_far(data, columns, stated_g) if data is not None else None
    found = _plan(so_far, poses, add, fixture, noise, stated_g)
    with pipes.even_if_unread():
        _show(found, format)
    with pipes.even_if_unread(sys.stderr):
        if so_far is not None and format != "table":  # the table shows them itself
            options.caution(str(data), so_far.cautions, quiet)
    if found.verdict == "undetermined":
        raise typer.Exit(BAD_VERDICT)


def _so_far(data: str, columns: str | None, g: float | None) -> Calibration:
    """Return the calibration of the poses so far."""
    from accelcal_cli.calibration.calibrate import calibrate
    from accelcal_cli.calibration.result import is_result, load_result
    from accelcal_cli.calibration.settings import load_settings
    from accelcal_cli.io.readings import read_readings

    options.check_input(data)
    stdin = io.BufferedReader(cast("Any", sys.stdin.buffer)) if data == "-" else None
    if Path(data).suffix in RESULTS or (stdin is not None and is_result(_head(stdin))):
        if columns is not None or g is not None:
            raise UsageError(
                f"{data}: a result file has its own columns and g; leave out --columns, --g and --latitude"
            )
        return load_result(data if stdin is None else "<stdin>", stdin)
    settings = load_settings(None, {"optimizer": "levenberg-marquardt", **({} if g is None else {"g": g})})
    readings = read_readings(data, options.split_columns(columns), stdin=stdin)
    return calibrate(readings, settings)


def _head(stdin: io.BufferedReader) -> bytes:
    """Return how standard input begins; nothing where it cannot be read, which the reader of it will say."""
    try:
        return stdin.peek()
    except OSError:
        return b""


def _plan(
    so_far: Calibration | None,
    poses: int | None,
    add: int | None,
    fixture: str,
    noise: float | None,
    g: float | None,
) -> Plan:
    import numpy as np

    from accelcal_cli.planning.plan import plan
    from accelcal_cli.sensor.model import STANDARD_GRAVITY

    taken = 0 if so_far is None else so_far.poses
    count = add or ((poses or FROM_NOTHING) - taken if poses or so_far is None else NEXT)
    if count < 1:
        raise UsageError(f"--poses {poses}: {taken} poses are there already; expected more, or --add")
    if count > MOST_POSES:
        raise UsageError(f"--poses {poses}: {count} poses to plan; expected at most {MOST_POSES}")
    local_g = g or STANDARD_GRAVITY
    if so_far is None:
        return plan(np.zeros((9, 9)), 0, count, fixture, None if noise is None else noise / local_g)
    known = so_far.s if so_far.freedom > 0 and so_far.s > 0 else None
    sigma = noise or known
    part = None if sigma is None else sigma / so_far.g
    return plan(so_far.information, taken, count, fixture, part, so_far)


def _show(found: Plan, format: str) -> None:
    from accelcal_cli.output.machine import json_text, write_csv
    from accelcal_cli.views.plan import blocks, pose_table, record

    if format == "json":
        sys.stdout.write(json_text(record(found)))
    elif format == "csv":
        write_csv(pose_table(found), sys.stdout)
    else:
        from accelcal_cli.output.console import show

        show(blocks(found))
