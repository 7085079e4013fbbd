"""Options that several commands share, and the checks on them."""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from accelcal_cli.errors import UsageError, did_you_mean

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from accelcal_cli.calibration.result import Calibration

FORMATS = ("table", "json", "csv")

Format = Annotated[str, typer.Option("--format", help="What to print: table, json or csv.", metavar="FORMAT")]
Seed = Annotated[int, typer.Option("--seed", help="Seed of all random numbers.", min=0)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print nothing on standard error but errors.")]
Gravity = Annotated[
    float | None,
    typer.Option(
        "--g", help="Local gravity in m/s^2 (1 for readings in units of g).", show_default="9.80665"
    ),
]
Latitude = Annotated[
    float | None, typer.Option("--latitude", help="Degrees; gravity from WGS84 instead of --g.")
]
Height = Annotated[
    float | None, typer.Option("--height", help="Metres above the ellipsoid, with --latitude.")
]
Columns = Annotated[
    str | None,
    typer.Option("--columns", help="The three output columns: names, or numbers from 1, with commas."),
]


def check_format(choice: str) -> str:
    """Return a known output format or raise UsageError."""
    if choice not in FORMATS:
        raise UsageError(
            f'--format "{choice}": unknown{did_you_mean(choice, FORMATS)}; expected one of {", ".join(FORMATS)}'
        )
    return choice


def check_input(source: str) -> None:
    """Raise UsageError when readings are to come from a terminal, where nobody types them."""
    if source == "-" and sys.stdin.isatty():
        raise UsageError("-: standard input is a terminal; expected the name of a file, or a pipe")


def check_apart(inputs: Iterable[str | Path | None], outputs: Mapping[str, str | None]) -> None:
    """Raise UsageError when an output would take the place of a file that is read.

    Args:
        inputs: files that are read, - for standard input, None for one that was not stated.
        outputs: files to write by the option that names them.
    """
    read = [_identity(source) for source in inputs if source is not None]
    for option, output in outputs.items():
        if output in (None, "-") or not os.path.isfile(output):  # a pipe or a device holds nothing to lose
            continue
        written = os.stat(output)
        if any(source is not None and os.path.samestat(source, written) for source in read):
            raise UsageError(f'{option} "{output}": is the input itself; expected another name')


def _identity(source: str | Path) -> os.stat_result | None:
    """Return what tells one file from another, whatever it is called; None where there is no file."""
    try:
        return os.fstat(sys.stdin.fileno()) if source == "-" else os.stat(source)
    except (OSError, ValueError):  # it does not exist, or standard input is no file
        return None


def load_result(source: str, data: str | None = None) -> Calibration:
    """Return the calibration of a result file, or of standard input for `-`.

    Raises:
        UsageError: standard input is a terminal, or `data` is to come from it, too.
        ConfigError, DataError: no result file.
    """
    from accelcal_cli import config

    if source != "-":
        return config.load_result(source)
    if data == "-":
        raise UsageError(
            "- -: standard input is one file; expected the name of the result file or of the readings"
        )
    check_input(source)
    return config.load_result("<stdin>", sys.stdin.buffer)


def gravity(g: float | None, latitude: float | None, height: float | None) -> float | None:
    """Return the stated local gravity in m/s^2, or None when nothing was stated.

    Raises:
        UsageError: out of range, stated twice, or a height without a latitude.
    """
    from accelcal_cli.sensor.gravity import check_gravity, normal_gravity

    if g is not None and latitude is not None:
        raise UsageError("--g and --latitude: expected one of them, not both")
    if height is not None and latitude is None:
        raise UsageError("--height: needs --latitude")
    if g is not None:
        return check_gravity(g)
    return None if latitude is None else normal_gravity(latitude, height or 0.0)


def caution(source: str, cautions: Iterable[str], quiet: bool) -> None:
    """Say on standard error, unless quiet, what speaks against trusting a file."""
    for text in () if quiet else cautions:
        typer.echo(f"accelcal: {source}: caution: {text}", err=True)


def check_tolerance(tolerance: float | None) -> None:
    """Raise UsageError when a stated tolerance is not a positive number."""
    if tolerance is not None and not (math.isfinite(tolerance) and tolerance > 0):
        raise UsageError(f"--tolerance {tolerance:g}: expected a positive number in m/s^2")


def split_columns(text: str | None) -> list[str] | None:
    """Return the columns named with commas, or None when none were named."""
    return None if text is None else [part.strip() for part in text.split(",")]


def check_positive(option: str, value: float) -> None:
    """Raise UsageError when the value of an option is not a positive number."""
    if not (math.isfinite(value) and value > 0):
        raise UsageError(f"{option} {value:g}: expected a positive number")
