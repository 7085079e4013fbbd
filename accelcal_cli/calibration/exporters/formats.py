"""The formats by name."""

from __future__ import annotations

from accelcal_cli.calibration.exporters import ardupilot, c_header, imucal, kalibr, npz, px4, ros
from accelcal_cli.calibration.exporters.base import Export, Exporter, Target
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError, did_you_mean

FORMATS: dict[str, Exporter] = {
    "px4": px4.export,
    "ardupilot": ardupilot.export,
    "kalibr": kalibr.export,
    "imucal": imucal.export,
    "ros": ros.export,
    "c-header": c_header.export,
    "numpy": npz.export,
}


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
