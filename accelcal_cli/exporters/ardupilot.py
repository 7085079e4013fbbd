"""ArduPilot corrects a reading in m/s^2, in the axes of the log, as (reading - ACCOFFS) * ACCSCAL, axis by axis.

It does so after the driver's own rotation, and turns the board afterwards
(AP_InertialSensor_Backend::_rotate_and_correct_accel). Its own calibration stores the
same sign: AccelCalibrator fits diag * (reading + offset) and saves minus its offset. Before ACCOFFS it takes a cubic
polynomial of temperature from the reading, held within TMIN and TMAX: P(T - 35) - P(CALTEMP - 35), coefficients in
1e-6 m/s^2 (AP_InertialSensor_tempcal.cpp); its scales know no temperature.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, INSTANCE, DiagonalExporter
from accelcal_cli.schema import setting

if TYPE_CHECKING:
    from accelcal_cli.arrays import Float
    from accelcal_cli.calibration.result import Calibration, Temperature

PER_COEFFICIENT = 1e6
"""Coefficients of INS_TCAL for 1 m/s^2 per degree (SCALE_FACTOR of AP_InertialSensor_tempcal.cpp)."""

LARGEST_OFFSET, SCALES = 3.5, (0.8, 1.2)
"""What ArduPilot's parameters may be, m/s^2 and 1: beyond, it refuses to arm."""


@EXPORTERS.register("ardupilot")
@dataclass(frozen=True)
class ArduPilot(DiagonalExporter):
    """ArduPilot parameters, in the file format of Mission Planner and MAVProxy.

    INS_ACCOFFS_X, ..., INS_ACCSCAL_X, ...: offset D_a in m/s^2, scale of the sensor's own axis; INS_TCALn_ACC1_X, ...:
    slopes of the offset with temperature, where there are any.
    """

    orientation = "AHRS_ORIENTATION"

    suffix = ".param"

    instance: int | None = setting(None, INSTANCE, low=0, high=2)

    def content(self, result: Calibration) -> bytes:
        """Return the parameters, one per line."""
        from accelcal_cli.sensor.poses import AXES

        offset, triad = self.triad(result)
        slopes, instance, correction = self.bias_slopes(result), self.number(result), self.correction(result)
        number = "" if instance == 0 else str(instance + 1)
        header = [
            *self.header(result),
            "ArduPilot: corrected = (reading - ACCOFFS) * ACCSCAL, m/s^2, in the axes of the log.",
            *self.notes(result),
        ]
        device = None if correction is None else correction.device_id
        values: dict[str, float] = {} if device is None else {f"INS_ACC{number}_ID": device}
        for key, numbers in (("OFFS", offset), ("SCAL", triad.scale)):
            values |= {
                f"INS_ACC{number}{key}_{axis.upper()}": float(v)
                for axis, v in zip(AXES, numbers, strict=True)
            }
        if slopes is not None and result.temperature is not None:
            header += self._thermal_notes(instance + 1)
            values |= self._thermal(instance + 1, slopes, result.temperature)
        lines = "".join(
            f"{key},{value}\n" if isinstance(value, int) else f"{key},{value:.9g}\n"
            for key, value in values.items()
        )
        return (base.comment(header) + lines).encode()

    @staticmethod
    def _thermal(number: int, slopes: Float, drift: Temperature) -> dict[str, float]:
        """Return the parameters of the temperature calibration, whose polynomials are linear."""
        from accelcal_cli.sensor.poses import AXES

        name, nothing = f"INS_TCAL{number}", 0.0 * slopes
        powers = enumerate((slopes * PER_COEFFICIENT, nothing, nothing), start=1)
        return {
            f"{name}_ENABLE": 1,
            f"{name}_TMIN": drift.low,
            f"{name}_TMAX": drift.high,
            **{
                f"{name}_ACC{p}_{axis.upper()}": float(v)
                for p, row in powers
                for axis, v in zip(AXES, row, strict=True)
            },
            f"INS_ACC{number}_CALTEMP": drift.reference,
        }

    @staticmethod
    def _thermal_notes(number: int) -> list[str]:
        name = f"INS_TCAL{number}"
        return [
            "ArduPilot subtracts 1e-6 ACC1 (T - CALTEMP) before ACCOFFS, T in degrees Celsius, held within "
            f"{name}_TMIN and TMAX.",
            f"{name}_ENABLE = 1 enables the gyroscope's polynomials, {name}_GYR, as well. The others of {name} appear "
            "once it is set: refresh the parameters and load the file again.",
        ]

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
