"""PX4 corrects a reading of the driver, in m/s^2 and in the axes of the log, as (reading - OFF) * SCALE.

It does so axis by axis, after the driver's own rotation, and turns the board afterwards
(PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.hpp).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, INSTANCE, DiagonalExporter
from accelcal_cli.schema import setting

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

REAL32 = 9  # MAV_PARAM_TYPE_REAL32


@EXPORTERS.register("px4")
@dataclass(frozen=True)
class Px4(DiagonalExporter):
    """PX4 parameters, in the file format of QGroundControl.

    CAL_ACCn_XOFF, ..., CAL_ACCn_XSCALE, ...: offset D_a in m/s^2, scale of the sensor's own axis.
    """

    orientation = "SENS_BOARD_ROT"

    suffix = ".params"

    instance: int = setting(0, INSTANCE, low=0, high=3)

    def content(self, result: Calibration) -> bytes:
        """Return the parameters, one per line."""
        from accelcal_cli.sensor.poses import AXES

        offset, triad = self.triad(result)
        name = f"CAL_ACC{self.instance}"
        header = [
            *base.origin(result),
            "PX4: corrected = (reading - OFF) * SCALE, m/s^2, in the axes of the log.",
            f"{name}_ID has to be the device that the readings came from.",
            *self.notes(result),
            "Vehicle-Id Component-Id Name Value Type",
        ]
        lines = "".join(
            f"1\t1\t{name}_{axis.upper()}{key}\t{value:.9g}\t{REAL32}\n"
            for key, values in (("OFF", offset), ("SCALE", triad.scale))
            for axis, value in zip(AXES, values, strict=True)
        )
        return (base.comment(header) + lines).encode()
