"""`accelcal report`: a result as one self-contained HTML page with pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from accelcal_cli.cli import options, process

SUFFIXES = (".html", ".htm")


def command(
    result: options.ResultFile,
    output: Annotated[str, options.in_output("--output", "-o", help="HTML file; - is standard output.")],
    title: Annotated[
        str | None, options.in_output(help="Heading of the page.", show_default="calibration of the readings")
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Write a report of a result: one HTML page with pictures.

    Verdict, parameters with sigma, residuals, poses, dilution, convergence, settings, origin. One file without
    links to others, readable light and dark, on a telephone and on paper. Exit code 1 means that the verdict is
    "suspect" or "undetermined"; the report is written all the same.
    """
    from accelcal_cli.output.files import is_stream
    from accelcal_cli.output.report import check_packages, report

    if output != "-" and not Path(output).is_dir() and not is_stream(output):
        options.check_suffix("-o", output, SUFFIXES)
    options.check_files([result], {"-o": output})
    check_packages()
    calibration = options.load_result(result)
    with process.even_if_unread():
        report(calibration, output, title=title)
    with process.even_if_unread(sys.stderr):
        options.tell_written([output], quiet)
    if calibration.verdict in options.BAD_VERDICTS:
        raise typer.Exit(options.BAD_VERDICT)
