"""The formats by name."""

from __future__ import annotations

from collections.abc import Iterable

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError, did_you_mean
from accelcal_cli.exporters import ardupilot, c_header, imucal, kalibr, npz, px4, ros
from accelcal_cli.exporters.base import Export, Exporter, Target

FORMATS: dict[str, Exporter] = {
    "px4": px4.export,
    "ardupilot": ardupilot.export,
    "kalibr": kalibr.export,
    "imucal": imucal.export,
    "ros": ros.export,
    "c-header": c_header.export,
    "numpy": npz.export,
}


TARGETED = ("px4", "ardupilot", "kalibr")
"""Formats that depend on the target: on its driver and the number of the sensor there."""


def check_options(name: str, given: Iterable[str]) -> None:
    """Refuse options on the target that a format has no use for.

    Args:
        name: one of FORMATS; given: the options that were stated, as `--driver-scale`.

    Raises:
        UsageError: the format does not depend on them.
    """
    for option in given:
        if name not in TARGETED:
            raise UsageError(
                f"{option}: --to {name} has no use for it; the formats that take it are {', '.join(TARGETED)}"
            )


def check_name(name: str) -> str:
    """Return the name of a format.

    Raises:
        UsageError: there is none of this name.
    """
    if name not in FORMATS:
        raise UsageError(
            f'--to "{name}": unknown{did_you_mean(name, FORMATS)}; expected one of {", ".join(FORMATS)}'
        )
    return name


def export(result: Calibration, name: str, target: Target) -> Export:
    """Return a result in a format.

    Args:
        result: the calibration; its verdict is the caller's concern.
        name: one of FORMATS.
        target: what the format has to know of the target.

    Raises:
        UsageError: no such format, or one that cannot hold these units.
    """
    return FORMATS[check_name(name)](result, target)
