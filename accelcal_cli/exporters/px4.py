"""PX4 corrects a reading of the driver, in m/s^2 and in the axes of the log, as (reading - OFF) * SCALE.

It does so axis by axis, after the driver's own rotation, and turns the board afterwards
(PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.hpp). Before OFF it subtracts a cubic polynomial in T - TREF,
T held within TMIN and TMAX (TemperatureCompensation::calc_thermal_offsets_3D); its scales know no temperature.
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

INT32, REAL32 = 6, 9  # MAV_PARAM_TYPE_INT32, MAV_PARAM_TYPE_REAL32


@EXPORTERS.register("px4")
@dataclass(frozen=True)
class Px4(DiagonalExporter):
    """PX4 parameters, in the file format of QGroundControl.

    CAL_ACCn_XOFF, ..., CAL_ACCn_XSCALE, ...: offset D_a in m/s^2, scale of the sensor's own axis; TC_An_X1_0, ...:
    slopes of the offset with temperature, where there are any.
    """

    orientation = "SENS_BOARD_ROT"

    suffix = ".params"

    instance: int | None = setting(None, INSTANCE, low=0, high=3)

    device_id: int | None = setting(
        None,
        "device id of the accelerometer in the target, as its CAL_ACCn_ID says; without it that of the log",
        low=1,
        high=2**31 - 1,
    )

    def content(self, result: Calibration) -> bytes:
        """Return the parameters, one per line."""
        from accelcal_cli.sensor.poses import AXES

        offset, triad = self.triad(result)
        name, slopes, device = f"CAL_ACC{self.number(result)}", self.bias_slopes(result), self.device(result)
        header = [
            *self.header(result),
            "PX4: corrected = (reading - OFF) * SCALE, m/s^2, in the axes of the log.",
            *([] if device else [f"{name}_ID has to be the device that the readings came from."]),
            *self.notes(result),
        ]
        values: dict[str, float] = {} if device is None else {f"{name}_ID": device}
        for key, numbers in (("OFF", offset), ("SCALE", triad.scale)):
            values |= {f"{name}_{axis.upper()}{key}": float(v) for axis, v in zip(AXES, numbers, strict=True)}
        if slopes is not None and result.temperature is not None:
            thermal = f"TC_A{self.number(result)}"
            header += self._thermal_notes(thermal, device)
            values |= self._thermal(thermal, device, slopes, result.temperature)
        header.append("Vehicle-Id Component-Id Name Value Type")
        lines = "".join(
            f"1\t1\t{key}\t{v}\t{INT32}\n" if isinstance(v, int) else f"1\t1\t{key}\t{v:.9g}\t{REAL32}\n"
            for key, v in values.items()
        )
        return (base.comment(header) + lines).encode()

    def device(self, result: Calibration) -> int | None:
        """Return the device id: as stated, or that of the log; None where neither says it."""
        correction = self.correction(result)
        return self.device_id or (correction.device_id if correction else None)

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return what is left out, and that PX4 needs the device of a thermal calibration."""
        nameless = self.bias_slopes(result) is not None and self.device(result) is None
        number = self.number(result)
        told = f"PX4 applies temperature slopes to the device TC_A{number}_ID only: state it with --device-id"
        return (*super().warnings(result), *((told,) if nameless else ()))

    @staticmethod
    def _thermal(name: str, device: int | None, slopes: Float, drift: Temperature) -> dict[str, float]:
        """Return the parameters of the thermal compensation: the offset is linear, and none at TREF."""
        powers = (0.0 * slopes, slopes, 0.0 * slopes, 0.0 * slopes)
        return {
            "TC_A_ENABLE": 1,
            **({} if device is None else {f"{name}_ID": device}),
            f"{name}_TREF": drift.reference,
            f"{name}_TMIN": drift.low,
            f"{name}_TMAX": drift.high,
            **{f"{name}_X{p}_{i}": float(v) for p, row in enumerate(powers) for i, v in enumerate(row)},
        }

    @staticmethod
    def _thermal_notes(name: str, device: int | None) -> list[str]:
        own = "" if device else f"{name}_ID has to be the device, as CAL_ACC{name[-1]}_ID. "
        return [
            f"PX4 subtracts X1 (T - TREF) before OFF, T in degrees Celsius, held within {name}_TMIN and TMAX.",
            f"{own}The others of {name} appear once TC_A_ENABLE is 1: restart PX4 and load the file again.",
        ]
