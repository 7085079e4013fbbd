"""`accelcal plan`: which poses to take next, and the sigma to expect."""

from __future__ import annotations

import io
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from accelcal_cli.cli import options, process
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration
    from accelcal_cli.io.readings import Readings

MOST_POSES = 200
"""As in `planning`; a test compares them."""

in_plan = options.panel("Plan")


def command(
    *,
    data: Annotated[
        str | None,
        typer.Argument(
            help="The poses so far: readings, with --raw a log, or a result file (.yaml, .json); - is standard input.",
            show_default="none",
            rich_help_panel="Input",
        ),
    ] = None,
    columns: options.Columns = None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    poses: Annotated[
        int | None,
        in_plan(
            help="Poses in the end, those so far included.",
            show_default="12 from nothing",
            min=1,
            max=1_000_000_000,
        ),
    ] = None,
    add: Annotated[
        int | None,
        in_plan(
            help="Poses to add, instead of --poses.", show_default="6 to readings", min=1, max=MOST_POSES
        ),
    ] = None,
    fixture: Annotated[
        str,
        in_plan(
            help="What the sensor can be held against: {choices}.",
            autocompletion=options.one_of(options.FIXTURES),
        ),
    ] = "corners",
    raw: Annotated[
        bool,
        options.in_log("--raw", help="The file is a raw log: find its static poses first, as detect does."),
    ] = False,
    log: options.DetectionOptions,
    noise: Annotated[
        float | None,
        in_plan(help="Noise of one pose, one sigma, m/s^2.", show_default="s of the poses so far"),
    ] = None,
    format: options.Format = "table",
    verbose: options.Verbose = False,
    quiet: options.Quiet = False,
) -> None:
    """Plan the next poses: those that shrink the worst sigma.

    Prints them in words, and the sigma to expect after each; with --verbose also as vectors. Exit code 1 means that
    not even all these poses determine the parameters.
    """
    from accelcal_cli.planning import plan
    from accelcal_cli.views import plan as views

    options.check_choice("--fixture", fixture, options.FIXTURES)
    options.check_positive("--noise", noise, " in m/s^2")
    log.check_raw(raw)
    if raw and data is None:
        raise UsageError("--raw needs the name of a log")
    stated_g = gravity.stated()
    so_far = _so_far(data, columns, form, gravity, log if raw else None) if data is not None else None
    proposal = plan(so_far, poses=poses, add=add, fixture=fixture, noise=noise, g=stated_g)
    with process.even_if_unread():
        options.print_result(
            format,
            partial(views.pose_table, proposal),
            partial(views.blocks, proposal, verbose),
            partial(views.record, proposal),
        )
    with process.even_if_unread(sys.stderr):
        if so_far is not None and format != "table":  # the table shows them itself
            options.warn(str(data), so_far.warnings, quiet)
    if proposal.verdict == "undetermined":
        raise typer.Exit(options.BAD_VERDICT)


def _so_far(
    data: str,
    columns: str | None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    log: options.DetectionOptions | None,
) -> Calibration:
    """Return the calibration of the poses so far; those of a raw log are found as `log` says."""
    from accelcal_cli.calibration.calibrate import calibrate
    from accelcal_cli.calibration.result import RESULTS, is_result, load_result
    from accelcal_cli.calibration.settings import load_settings
    from accelcal_cli.io.readings import read_readings

    options.check_input(data)
    stated = {"optimizer": "levenberg-marquardt"}
    if log is not None:
        if Path(data).suffix in RESULTS:
            raise UsageError(f"{data}: a result file is no log; leave out --raw")
        readings = _still_poses(log, data, columns, form, gravity)
        stated["weights"] = "auto"
    else:
        stdin = io.BufferedReader(cast("Any", sys.stdin.buffer)) if data == "-" else None
        if Path(data).suffix in RESULTS or (stdin is not None and is_result(_head(stdin))):
            if columns is not None or form.where or gravity.stated() is not None:
                raise UsageError(
                    f"{data}: a result file has its own columns and g; leave out --columns, --where, --g and --latitude"
                )
            return load_result(data if stdin is None else "<stdin>", stdin)
        readings = read_readings(
            data, options.split_columns(columns), stdin=stdin, options=form.read_options()
        )
    g = gravity.in_unit(readings.form.unit)
    return calibrate(readings, load_settings(None, {**stated, **({} if g is None else {"g": g})}))


def _still_poses(
    log: options.DetectionOptions,
    data: str,
    columns: str | None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
) -> Readings:
    """Return the static poses of a log; where they are fewer than a calibration needs, those that there are."""
    from accelcal_cli.detection.detect import TooFewPosesError
    from accelcal_cli.sensor.model import STANDARD_GRAVITY

    def local_g(unit: str | None) -> float:
        own = gravity.in_unit(unit)
        return STANDARD_GRAVITY if own is None else own

    try:
        return log.poses(data, columns, local_g, form, misalignment=True)
    except TooFewPosesError as error:
        if log.min_poses is not None or len(error.detection.intervals) < 2:
            raise
        return error.detection.readings()


def _head(stdin: io.BufferedReader) -> bytes:
    """Return how standard input begins; nothing where it cannot be read, which the reader of it will say."""
    try:
        return stdin.peek()
    except OSError:
        return b""
