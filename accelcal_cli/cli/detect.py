"""`accelcal detect`: a raw log in, static poses out."""

from __future__ import annotations

import sys
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.detection.detect import Detection


def command(
    *,
    data: Annotated[
        str,
        typer.Argument(
            help="Raw log: text, Parquet, Arrow or native; - is standard input.", rich_help_panel="Input"
        ),
    ],
    columns: options.Columns = None,
    form: options.TextOptions,
    gravity: options.GravityOptions,
    log: options.DetectionOptions,
    output: Annotated[
        str | None,
        options.in_output("--output", "-o", help="CSV file of the poses; - is standard output."),
    ] = None,
    plot: Annotated[
        str | None,
        options.in_output(
            "--plot", help="Draw the log with its poses to a .png or .svg file.", metavar="FILE"
        ),
    ] = None,
    format: options.Format = "table",
    verbose: options.Verbose = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the static poses in a raw log.

    Prints the poses, and with -o writes them as the CSV file that `calibrate` reads. Several thresholds are tried,
    and the one whose poses calibrate best is kept; --verbose shows them. `calibrate --raw` does both in one.
    """
    from accelcal_cli.detection.detect import TooFewPosesError
    from accelcal_cli.output.files import whole_file
    from accelcal_cli.output.machine import write_csv
    from accelcal_cli.sensor.model import STANDARD_GRAVITY
    from accelcal_cli.views import detection as views

    if output == "-" and format != "table":
        raise UsageError(f"-o - prints the poses as CSV; leave out --format {format}")
    if output is not None and output == plot:
        raise UsageError(f'--plot "{plot}": expected another file than --output')
    options.check_files([data], {"-o": output, "--plot": plot})
    options.check_plot(plot)
    gravity.stated()  # refuses what is wrong before the file is read
    try:
        detection = log.detect(
            data,
            columns,
            lambda unit: gravity.in_unit(unit) or STANDARD_GRAVITY,
            form,
            picture=plot is not None,
        )
    except TooFewPosesError as failure:
        _draw(failure.detection, plot, quiet)
        raise
    poses = views.poses_table(detection)
    if output is not None:
        with whole_file(output) as file:
            write_csv(poses, file)
    if output != "-":
        options.print_result(
            format, poses, partial(views.blocks, detection, verbose), partial(views.record, detection)
        )
    sys.stdout.flush()
    options.warn(data, detection.warnings, quiet)
    options.tell_written([output], quiet)
    _draw(detection, plot, quiet)


def _draw(detection: Detection, plot: str | None, quiet: bool) -> None:
    """Draw the log where a picture is asked for."""
    if plot is None:
        return
    from accelcal_cli.output.plot import plot_log

    plot_log(detection, plot)
    options.tell_written([plot], quiet)
