"""`accelcal detect`: a raw log in, static poses out."""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import options as detecting
from accelcal_cli.cli import options as running
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.detection.detect import Detection

PLOT = "Draw the log with its poses to a .png or .svg file."


def command(
    data: Annotated[str, typer.Argument(help="CSV, text or Parquet file of a raw log; - is standard input.")],
    columns: detecting.Columns = None,
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
    g: options.Gravity = None,
    latitude: options.Latitude = None,
    height: options.Height = None,
    output: Annotated[
        str | None, typer.Option("--output", "-o", help="CSV file of the poses; - is standard output.")
    ] = None,
    plot: Annotated[str | None, typer.Option("--plot", help=PLOT, metavar="FILE")] = None,
    format: options.Format = "table",
    quiet: options.Quiet = False,
) -> None:
    """Find the static poses in a raw log.

    Prints the poses, and with -o writes them as the CSV file that `calibrate` reads. Several thresholds are tried,
    and the one is kept whose poses calibrate best. `calibrate --raw` does both in one.
    """
    from accelcal_cli.detection.detect import TooFewPosesError
    from accelcal_cli.output.files import check_target
    from accelcal_cli.sensor.model import STANDARD_GRAVITY

    options.check_format(format)
    if output == "-" and format != "table":
        raise UsageError(f"-o - prints the poses as CSV; leave out --format {format}")
    if output is not None and output == plot:
        raise UsageError(f'--plot "{plot}": expected another file than --output')
    options.check_apart([data], {"-o": output, "--plot": plot})
    if output is not None:
        check_target(output)
    running.check_plot(plot)
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
    local_g = options.gravity(g, latitude, height) or STANDARD_GRAVITY
    try:
        found = detecting.find_poses(data, columns, chosen, local_g, picture=plot is not None)
    except TooFewPosesError as failure:
        _draw(failure.found, plot, quiet)
        raise
    _show(found, format, output, plot, quiet)


def _draw(found: Detection, plot: str | None, quiet: bool) -> None:
    """Draw the log where a picture is asked for."""
    if plot is None:
        return
    from accelcal_cli.output.plot import plot_log

    plot_log(found, plot)
    if not quiet:
        typer.echo(f"accelcal: wrote {plot}", err=True)


def _show(found: Detection, format: str, output: str | None, plot: str | None, quiet: bool) -> None:
    """Write the poses and the picture, then print in the chosen form."""
    from accelcal_cli.output.files import whole_file
    from accelcal_cli.output.machine import json_text, write_csv
    from accelcal_cli.views.detection import poses_table, record

    if output is not None:
        with whole_file(output) as file:
            write_csv(poses_table(found), file)
    if format == "json":
        sys.stdout.write(json_text(record(found)))
    elif format == "csv":
        write_csv(poses_table(found), sys.stdout)
    elif output != "-":
        from accelcal_cli.output.console import show
        from accelcal_cli.views.detection import blocks

        show(blocks(found))
    sys.stdout.flush()
    if output not in (None, "-") and not quiet:
        typer.echo(f"accelcal: wrote {output}", err=True)
    _draw(found, plot, quiet)
