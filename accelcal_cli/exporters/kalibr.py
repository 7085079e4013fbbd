"""Kalibr's model of a reading is M a + b with a lower triangular M.

It is that of kalibr_imu_camera_calibration, IccScaledMisalignedImu. M is K_a in gauge `lower`, b is D_a. Kalibr itself
estimates b anew in every run; the key is for other readers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, DriverExporter

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

UNKNOWN = """\
  # PLACEHOLDERS: a static calibration does not know them. Take them from the data sheet or an Allan deviation.
  accelerometer_noise_density: null  # m/s^2/sqrt(Hz)
  accelerometer_random_walk: null  # m/s^3/sqrt(Hz)
  gyroscope_noise_density: null  # rad/s/sqrt(Hz)
  gyroscope_random_walk: null  # rad/s^2/sqrt(Hz)
  update_rate: null  # Hz
  rostopic: null
"""


@EXPORTERS.register("kalibr")
@dataclass(frozen=True)
class Kalibr(DriverExporter):
    """IMU file of Kalibr, model scale-misalignment."""

    suffix = ".yaml"

    def content(self, result: Calibration) -> bytes:
        """Return imuN with accelerometers.M and .b; noise, rate and topic are marked placeholders."""
        if self.driver_scale is not None or base.is_force(result):
            model, unit = self.in_metres(result).in_gauge("lower"), "m/s^2"
        else:
            model, unit = result.model.in_gauge("lower"), "unit of the readings"
        header = [
            *self.header(result),
            f"Kalibr: reading = M a + b; a in m/s^2, reading and b in {unit}, M lower triangular.",
            f"Axes of a: {base.BODY['lower']}, whatever the gauge of the result.",
        ]
        matrix = "".join(f"    - {row}\n" for row in base.rows(model.K))
        text = (
            f"{base.comment(header)}imu{self.instance or 0}:\n  model: scale-misalignment\n  accelerometers:\n    M:\n"
            f"{matrix}    b: {base.rows(model.D)[0]}\n{UNKNOWN}"
        )
        return text.encode()

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return what is left out, and that there are placeholders."""
        return (
            "noise densities, random walks, rate and topic are placeholders: fill them in",
            *super().warnings(result),
        )
