"""`--worn`: rest in days of wear, for the commands that calibrate raw logs."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from accelcal_cli.cli import options
from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from accelcal_cli.detection.worn import Wear, WornSettings

APPLY = ("time", "gyro", "rate", "min_poses")
"""Options of a raw log that go with --worn."""

Worn = Annotated[
    bool,
    options.in_log(
        "--worn",
        help="The log is of days of wear: rest is 10 s in which no axis scatters by more than 13 mg.",
    ),
]


def check(raw: bool, log: options.DetectionOptions) -> None:
    """Refuse --worn without --raw, and options that do not go with it: raise UsageError."""
    if not raw:
        raise UsageError("--worn needs --raw")
    for name in options.stated(**vars(log)):
        if name not in APPLY:
            raise UsageError(f"--{name.replace('_', '-')} does not apply to --worn")


def find(
    data: str,
    columns: str | None,
    log: options.DetectionOptions,
    gravity: Callable[[str | None], float],
    form: options.TextOptions,
    *,
    misalignment: bool,
    slopes: bool,
) -> Wear:
    """Find where a worn sensor rests; see `options.DetectionOptions.poses`, and `WornSettings` for `slopes`."""
    from accelcal_cli.detection.rawlog import open_raw_log
    from accelcal_cli.detection.worn import find_wear

    options.check_input(data)
    own = settings(log, misalignment=misalignment, slopes=slopes)
    raw = open_raw_log(
        data,
        options.split_columns(columns),
        options.split_columns(log.gyro),
        log.time,
        stdin=sys.stdin.buffer,
        options=form.read_options(),
    )
    try:
        return find_wear(raw, replace(own, g=gravity(raw.columns.unit)))
    finally:
        raw.close()


def settings(log: options.DetectionOptions, *, misalignment: bool, slopes: bool) -> WornSettings:
    """Return the options of a raw log as the library takes them for days of wear; g is to be set."""
    from accelcal_cli.detection.worn import WornSettings

    few = WornSettings.least_poses if misalignment else options.FACES
    rate = options.check_positive("--rate", log.rate, " of rows per second")
    return WornSettings(rate, log.min_poses or few, slopes=slopes and misalignment)
