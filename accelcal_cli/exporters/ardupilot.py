"""ArduPilot corrects a reading in m/s^2, in the axes of the log, as (reading - ACCOFFS) * ACCSCAL, axis by axis.

It does so after the driver's own rotation, and turns the board afterwards
(AP_InertialSensor_Backend::_rotate_and_correct_accel). Its own calibration stores the
same sign: AccelCalibrator fits diag * (reading + offset) and saves minus its offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, INSTANCE, DiagonalExporter
from accelcal_cli.schema import setting

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

LARGEST_OFFSET, SCALES = 3.5, (0.8, 1.2)
"""What ArduPilot's parameters may be, m/s^2 and 1: beyond, it refuses to arm."""


@EXPORTERS.register("ardupilot")
@dataclass(frozen=True)
class ArduPilot(DiagonalExporter):
    """ArduPilot parameters, in the file format of Mission Planner and MAVProxy.

    INS_ACCOFFS_X, ..., INS_ACCSCAL_X, ...: offset D_a in m/s^2, scale of the sensor's own axis.
    """

    orientation = "AHRS_ORIENTATION"

    suffix = ".param"

    instance: int = setting(0, INSTANCE, low=0, high=2)

    def content(self, result: Calibration) -> bytes:
        """Return the parameters, one per line."""
        from accelcal_cli.sensor.poses import AXES

        offset, triad = self.triad(result)
        header = [
            *base.origin(result),
            "ArduPilot: corrected = (reading - ACCOFFS) * ACCSCAL, m/s^2, in the axes of the log.",
            *self.notes(result),
        ]
        number = "" if self.instance == 0 else str(self.instance + 1)
        lines = "".join(
            f"INS_ACC{number}{key}_{axis.upper()},{value:.9g}\n"
            for key, values in (("OFFS", offset), ("SCAL", triad.scale))
            for axis, value in zip(AXES, values, strict=True)
        )
        return (base.comment(header) + lines).encode()

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return what is left out, and whether ArduPilot would refuse the parameters."""
        offset, triad = self.triad(result)
        scale = triad.scale
        usual = abs(offset).max() <= LARGEST_OFFSET and SCALES[0] <= scale.min() <= scale.max() <= SCALES[1]
        refused = (
            f"ArduPilot expects offsets up to {LARGEST_OFFSET:g} m/s^2 and "
            f"scales of {SCALES[0]:g} to {SCALES[1]:g}"
        )
        return (*super().warnings(result), *(() if usual else (refused,)))
