"""`accelcal report`: a result as one self-contained HTML page with pictures."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from accelcal_cli.cli import options
from accelcal_cli.cli import process as pipes
from accelcal_cli.errors import UsageError

SUFFIXES = (".html", ".htm")
BAD_VERDICT = 1


def command(
    result: Annotated[str, typer.Argument(help="Result file of accelcal calibrate; - is standard input.")],
    output: Annotated[str, typer.Option("--output", "-o", help="HTML file; - is standard output.")],
    title: Annotated[
        str | None, typer.Option(help="Heading of the page.", show_default="calibration of the readings")
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Write a report of a result: one HTML page with pictures.

    Verdict, parameters with sigma, residuals, poses, dilution, convergence, settings, origin. One file without
    links to others, readable light and dark, on a telephone and on paper. Exit code 1 means that the verdict is
    "undetermined"; the report is written all the same.
    """
    from accelcal_cli.output.files import check_target, is_stream, whole_file
    from accelcal_cli.output.report.page import check_packages, page

    named = Path(output).suffix in SUFFIXES or Path(output).is_dir()
    if output != "-" and not named and not is_stream(output):
        raise UsageError(f'-o "{output}": expected a name that ends in {" or ".join(SUFFIXES)}')
    options.check_apart([result], {"-o": output})
    check_target(output)
    check_packages()
    found = options.load_result(result)
    source = Path(str(found.data.get("source", result))).name
    text = page(found, title or f"Calibration of {source}")
    with pipes.even_if_unread(), whole_file(output, binary=True) as file:
        file.write(text.encode())  # the page says that it is UTF-8, whatever the terminal takes
    with pipes.even_if_unread(sys.stderr):
        if not quiet and output != "-":
            typer.echo(f"accelcal: wrote {output}", err=True)
    if found.verdict == "undetermined":
        raise typer.Exit(BAD_VERDICT)
