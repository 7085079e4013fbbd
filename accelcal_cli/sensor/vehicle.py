"""What a vehicle makes of its readings before it logs them, and how a calibration of those is one of the sensor itself.

PX4 and ArduPilot log N = R S (r - o) of a reading r of the driver: o an offset, S a scale for each axis, R the turn of
the board (PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.hpp; ArduPilot,
AP_InertialSensor_Backend::_rotate_and_correct_accel). With N = K f + D the driver's reading is

    r = o + S^-1 R' N = K_r f + D_r,   K_r = S^-1 R' K,   D_r = o + S^-1 R' D.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.triad import ORIENTATIONS, rotation

NONE = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))

SYSTEMS = {"px4": ("PX4", "CAL_ACC{}"), "ardupilot": ("ArduPilot", "INS_ACC{}")}
"""Systems by name: as they are called, and their parameters of an accelerometer by its number."""

Vector3 = tuple[float, float, float]


@frozen()
class VehicleCorrection:
    """What a vehicle had done to the readings that it logged.

    Attributes:
        system: ``px4`` or ``ardupilot``, whose parameters these are.
        instance: number of the accelerometer by the names of the parameters, from 0.
        device_id: as the vehicle has it, None if unknown.
        offset: o, m/s^2; scale: S, of the sensor's own axes; turn: R, rows.
        thermal: whether the vehicle compensated temperature, too, before all this.
        doubt: why offset, scale and turn are not known; empty where they are.
    """

    system: str
    instance: int = 0
    device_id: int | None = None
    offset: Vector3 = (0.0, 0.0, 0.0)
    scale: Vector3 = (1.0, 1.0, 1.0)
    turn: tuple[Vector3, Vector3, Vector3] = NONE
    thermal: bool = False
    doubt: str = ""

    @property
    def is_none(self) -> bool:
        """Whether the readings are the driver's own."""
        return not self.doubt and (self.offset, self.scale, self.turn) == ((0.0,) * 3, (1.0,) * 3, NONE)

    def in_words(self) -> str:
        """Return a sentence for the user."""
        name, parameters = SYSTEMS[self.system]
        named = parameters.format("" if not self.instance and self.system == "ardupilot" else self._number())
        device = "" if self.device_id is None else f", device {self.device_id}"
        if self.is_none:
            return f"{name} logs these readings before it corrects them ({named}{device})"
        if self.doubt:
            return (
                f"{name} corrected the readings, by parameters that are not known: {self.doubt}; an export is a "
                "correction of readings that the vehicle has corrected already"
            )
        return (
            f"{name} corrected the readings by its {named}{device}: a result of calibrate --raw holds these numbers, "
            f"and --to {self.system} replaces them"
        )

    def _number(self) -> int:
        return self.instance + (self.system == "ardupilot")

    def of_driver(self, matrix: Float, offset: Float) -> tuple[Float, Float]:
        """Return K_r and D_r of the driver's readings, m/s^2, by K, shape (3, 3), and D, shape (3,), of the log."""
        return self.undone(matrix), np.array(self.offset) + self.undone(offset)

    def undone(self, values: Float) -> Float:
        """Return S^-1 R' times a vector, shape (3,), or a matrix, shape (3, 3)."""
        back = np.array(self.turn).T / np.array(self.scale)[:, None]
        return np.asarray(back @ values)

    @classmethod
    def from_record(cls, record: Mapping[str, Any] | None) -> VehicleCorrection | None:
        """Return the correction of a record, None where there is none or it is no such record."""
        try:
            return cls(**{**record, **_tuples(record)}) if record and record["system"] in SYSTEMS else None
        except (TypeError, ValueError, KeyError):
            return None


def _tuples(record: Mapping[str, Any]) -> dict[str, Any]:
    offset, scale = (tuple(float(v) for v in record[key]) for key in ("offset", "scale"))
    turn = tuple(tuple(float(v) for v in row) for row in record["turn"])
    if [len(offset), len(scale), *map(len, turn)] != [3] * 5:
        raise ValueError("offset, scale, turn")
    return {"offset": offset, "scale": scale, "turn": turn}


def board_turn(number: int) -> Float | None:
    """Return R by its number, of MAV_SENSOR_ROTATION, shape (3, 3); None for a number that is not known."""
    return rotation(*ORIENTATIONS[number]) if 0 <= number < len(ORIENTATIONS) else None


def as_rows(matrix: Float) -> tuple[Vector3, Vector3, Vector3]:
    """Return a matrix, shape (3, 3), as rows of plain numbers."""
    x, y, z = (np.round(matrix, 15) + 0.0).tolist()
    return (x[0], x[1], x[2]), (y[0], y[1], y[2]), (z[0], z[1], z[2])
