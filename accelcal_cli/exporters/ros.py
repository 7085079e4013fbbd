"""The node apply_calib of the ROS package imu_calib corrects a reading as SM * reading - bias (AccelCalib::applyCalib).

SM is K_A, row by row, and bias is f_0, in m/s^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration


@EXPORTERS.register("ros")
@dataclass(frozen=True)
class Ros(Exporter):
    """Calibration file of the ROS package imu_calib.

    SM, nine numbers, and bias, three; the corrected force is in m/s^2.
    """

    suffix = ".yaml"

    def content(self, result: Calibration) -> bytes:
        """Return SM and bias as YAML."""
        metres = base.metres_per_unit(result)
        header = [
            *self.header(result),
            "imu_calib: corrected = SM * reading - bias, m/s^2; the reading is in the unit of the calibrated readings.",
            base.frame(result),
        ]
        matrix = [value for row in base.rows(result.model.K_A * metres) for value in row]
        bias = base.rows(result.model.f_0 * metres)[0]
        return f"{base.comment(header)}SM: {matrix}\nbias: {bias}\n".encode()
