"""`accelcal report`: results as one self-contained HTML page with pictures, or as a certificate."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.cli import meta as metadata
from accelcal_cli.cli import options, process
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

SUFFIXES = (".html", ".htm")
PAPERS = ("a4", "letter")
"""Names of `output.certificate`, stated again so that help need not import it; tests compare them."""


def command(
    *,
    results: Annotated[
        list[str],
        typer.Argument(
            help="Result file of accelcal calibrate; several stand side by side, a folder of them is a fleet; - is "
            "standard input.",
            rich_help_panel="Input",
        ),
    ],
    output: Annotated[str, options.in_output("--output", "-o", help="HTML file; - is standard output.")],
    certificate: Annotated[
        bool, options.in_output("--certificate", help="Write the two printed sides of a certificate.")
    ] = False,
    paper: Annotated[
        str | None,
        options.in_output(
            help="Paper of a certificate: {choices}.",
            show_default="a4",
            autocompletion=options.one_of(PAPERS),
        ),
    ] = None,
    title: Annotated[
        str | None, options.in_output(help="Heading of the page.", show_default="calibration of the readings")
    ] = None,
    meta: metadata.Meta = None,
    quiet: options.Quiet = False,
) -> None:
    """Write a report of a result: one HTML page with pictures.

    Verdict, parameters with 95 % intervals, residuals, poses, dilution, convergence, settings, origin. One file without
    links to others, readable light and dark, on a telephone and on paper. Two to four results stand side by side; more,
    or a folder that accelcal fleet wrote, are a fleet. --certificate prints on two sides of A4 or Letter; a result that
    is "undetermined" gets none. Exit code 1 means that a verdict is "suspect" or "undetermined"; the page is written
    all the same.
    """
    from accelcal_cli.output.document import check_packages
    from accelcal_cli.output.files import is_stream

    if output != "-" and not Path(output).is_dir() and not is_stream(output):
        options.check_suffix("-o", output, SUFFIXES)
    if paper is not None:
        options.check_choice("--paper", paper, PAPERS)
        if not certificate:
            raise UsageError("--paper is of a certificate: add --certificate")
    files = _files(results)
    options.check_files(files, {"-o": output})
    check_packages()
    kept = metadata.stated(meta) if meta else {}
    if len(files) > 1 and (certificate or kept):
        raise UsageError(
            f"{'--certificate' if certificate else '--meta'} is of one result: {len(files)} are stated"
        )
    loaded = {label: options.load_result(file) for label, file in _labels(files).items()}
    if kept:
        loaded = {label: _with(one, kept) for label, one in loaded.items()}
    text = _page(loaded, files, title, paper or PAPERS[0], certificate=certificate)
    with process.even_if_unread():
        from accelcal_cli.output.report import write

        write(text, output)
    with process.even_if_unread(sys.stderr):
        options.tell_written([output], quiet)
    if any(one.verdict in options.BAD_VERDICTS for one in loaded.values()):
        raise typer.Exit(options.BAD_VERDICT)


def _files(sources: Sequence[str]) -> list[str]:
    """Return the result files that are stated, those of folders in the order of their names.

    Raises:
        UsageError: a folder without any, or standard input beside others.
    """
    from accelcal_cli.calibration.result import RESULTS

    files: list[str] = []
    for source in sources:
        if source == "-" or not os.path.isdir(source):
            files.append(source)
            continue
        own = sorted(
            str(path) for path in Path(source).iterdir() if path.suffix in RESULTS and path.is_file()
        )
        if not own:
            raise UsageError(
                f"{source}: holds no result file; expected files that end in {', '.join(RESULTS)}"
            )
        files += own
    if "-" in files and len(files) > 1:
        raise UsageError("-: standard input is one result; expected it alone")
    return files


def _labels(files: Sequence[str]) -> dict[str, str]:
    """Return the files by what they are called on the page: their names, or whole paths where names are alike.

    Raises:
        UsageError: a file is stated twice.
    """
    twice = next((file for file in files if files.count(file) > 1), None) if len(files) < 1000 else None
    if twice is not None:
        raise UsageError(f"{twice}: is stated twice; expected each result once")
    stems = [Path(file).stem for file in files]
    return dict(zip(stems if len(set(stems)) == len(stems) else files, files, strict=True))


def _with(result: Calibration, stated: Mapping[str, str]) -> Calibration:
    """Return a result with what --meta adds to it; what it keeps already stands.

    Raises:
        UsageError: something else is kept under a key, or there are too many.
    """
    from accelcal_cli.calibration.provenance import check_meta

    for key, value in stated.items():
        if result.meta.get(key, value) != value:
            raise UsageError(
                f'--meta "{key}={value}": the result has {key} "{result.meta[key]}"; leave it out, or calibrate again'
            )
    return replace(result, meta=check_meta({**result.meta, **stated}, "--meta "))


def _page(
    loaded: Mapping[str, Calibration],
    files: Sequence[str],
    title: str | None,
    paper: str,
    *,
    certificate: bool,
) -> str:
    from accelcal_cli.output import report

    first, *others = loaded.values()
    if certificate:
        from accelcal_cli.output.certificate import page

        return page(first, files[0], title, paper)
    if not others:
        return report.page(first, title or f"Calibration of {report.source_name(first)}")
    if len(loaded) <= report.SIDE_BY_SIDE:
        return report.side_by_side(loaded, title or f"Calibrations {', '.join(loaded)}")
    return report.fleet_page(loaded, title or f"Fleet of {len(loaded):,} sensors")
