"""Options that `detect` and `calibrate --raw` share, and what they come to."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any

import typer

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.calibration.detection import Detection, DetectSettings

LARGEST_MULTIPLIER = 1e6
LARGEST_RATE = 1e6
LARGEST_MERGE, LARGEST_THIN = 5.0, 90.0
"""Degrees: the mean of poses that differ more is shorter than gravity by over a thousandth of it."""

Columns = Annotated[
    str | None, typer.Option(help="The three accelerometer columns: names, or numbers from 1, with commas.")
]
Gyro = Annotated[
    str | None,
    typer.Option(
        help="The three gyroscope columns, or none.", show_default="found by name", metavar="COLUMNS"
    ),
]
Time = Annotated[
    str | None,
    typer.Option(help="The time column, or none.", show_default="found by name", metavar="COLUMN"),
]
Rate = Annotated[
    float | None, typer.Option(help="Rows a second.", show_default="from the time column", metavar="HZ")
]
Window = Annotated[
    str | None,
    typer.Option(
        help="Window of the variance: seconds, or rows as in 101rows.",
        show_default="1 s; 101 rows without time",
        metavar="SPAN",
    ),
]
Still = Annotated[
    str | None,
    typer.Option(
        help="Still period at the beginning that sets the threshold: seconds, or rows.",
        show_default="the quietest windows set it",
        metavar="SPAN",
    ),
]
Multiplier = Annotated[
    str | None,
    typer.Option(
        help="Threshold as a multiple of the still variance; of several, with commas, the best is kept.",
        show_default="2 to 100",
        metavar="NUMBERS",
    ),
]
MinLength = Annotated[
    str | None,
    typer.Option(
        help="Least length of an interval after trimming: seconds, or rows.",
        show_default="1 s; 100 rows without time",
        metavar="SPAN",
    ),
]
Trim = Annotated[
    str | None,
    typer.Option(
        help="Cut off both ends of an interval: seconds, or rows.",
        show_default="half a window",
        metavar="SPAN",
    ),
]
Merge = Annotated[float | None, typer.Option(help="Join poses within this many degrees.", metavar="DEGREES")]
Thin = Annotated[
    float | None,
    typer.Option(help="Of poses within this many degrees keep only the longest.", metavar="DEGREES"),
]
MinPoses = Annotated[
    int | None,
    typer.Option(help="Attitudes, 5 degrees apart, that must be found.", show_default="12", min=2),
]


def stated(**values: Any) -> dict[str, Any]:
    """Return the options that were stated."""
    return {name: value for name, value in values.items() if value is not None}


def find_poses(
    data: str, columns: str | None, chosen: Mapping[str, Any], g: float, picture: bool = False
) -> Detection:
    """Find the static poses of a raw log as the stated options say.

    Args:
        data: file, or - for standard input.
        columns: option --columns.
        chosen: the other options of this module that were stated, by name.
        g: local gravity, m/s^2.
        picture: keep what a picture of the log needs.
    """
    from accelcal_cli.calibration.detection import detect
    from accelcal_cli.sensor.rawlog import open_raw_log

    options.check_input(data)
    settings = _settings(chosen, g)
    log = open_raw_log(
        data, _split(columns), _split(chosen.get("gyro")), chosen.get("time"), stdin=sys.stdin.buffer
    )
    try:
        return detect(log, settings, picture)
    finally:
        log.close()


def _settings(chosen: Mapping[str, Any], g: float) -> DetectSettings:
    from accelcal_cli.calibration.detection import MULTIPLIERS, DetectSettings
    from accelcal_cli.sensor.spans import Spans, parse_span

    if "merge" in chosen and "thin" in chosen:
        raise UsageError("--merge and --thin: expected one of them, not both")
    names = ("window", "still", "min_length", "trim")
    spans = [parse_span(chosen.get(name), f"--{name.replace('_', '-')}") for name in names]
    multipliers = chosen.get("multiplier")
    return DetectSettings(
        spans=Spans(*spans),
        rate=_between("--rate", chosen.get("rate"), LARGEST_RATE, "rows a second"),
        multipliers=MULTIPLIERS if multipliers is None else _multipliers(multipliers),
        merge=_between("--merge", chosen.get("merge"), LARGEST_MERGE, "degrees"),
        thin=_between("--thin", chosen.get("thin"), LARGEST_THIN, "degrees"),
        least_poses=chosen.get("min_poses", DetectSettings.least_poses),
        g=g,
    )


def _split(text: str | None) -> Sequence[str] | None:
    return None if text is None else [part.strip() for part in text.split(",")]


def _between(option: str, value: float | None, most: float, unit: str) -> float | None:
    if value is not None and not 0 < value <= most:
        raise UsageError(f"{option} {value:g}: expected more than 0 and at most {most:g} {unit}")
    return value


def _multipliers(text: str) -> tuple[float, ...]:
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = [math.nan]
    if not all(1 < value <= LARGEST_MULTIPLIER for value in values):
        raise UsageError(
            f'--multiplier "{text}": expected numbers above 1, at most {LARGEST_MULTIPLIER:g}, with commas'
        )
    return tuple(sorted(set(values)))
