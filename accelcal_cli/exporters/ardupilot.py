"""ArduPilot parameters, in the file format of Mission Planner and MAVProxy.

ArduPilot corrects a reading in m/s^2, in the axes of the sensor, as (reading - ACCOFFS) * ACCSCAL, axis by axis, and
turns the board afterwards (AP_InertialSensor_Backend::_rotate_and_correct_accel). Its own calibration stores the same
sign: AccelCalibrator fits diag * (reading + offset) and saves minus its offset.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target
from accelcal_cli.sensor.poses import AXES

SENSORS = 3
LARGEST_OFFSET, SCALES = 3.5, (0.8, 1.2)
"""What ArduPilot's parameters may be, m/s^2 and 1: beyond, it refuses to arm."""


def export(result: Calibration, target: Target) -> Export:
    """Return INS_ACCOFFS_X, ..., INS_ACCSCAL_X, ...: offset D_a in m/s^2, scale 1 / K_ii."""
    if target.instance >= SENSORS:
        raise UsageError(
            f"--instance {target.instance}: ArduPilot has accelerometers 0 to {SENSORS - 1} here"
        )
    model = base.in_metres(result, target, "ardupilot")
    scale = 1.0 / np.diagonal(model.K)
    warnings = [*base.dropped(model, result), *base.without_temperature(result)]
    if np.abs(model.D).max() > LARGEST_OFFSET or scale.min() < SCALES[0] or scale.max() > SCALES[1]:
        warnings.append(
            f"ArduPilot expects offsets up to {LARGEST_OFFSET:g} m/s^2 and scales of {SCALES[0]:g} to {SCALES[1]:g}"
        )
    number = "" if target.instance == 0 else str(target.instance + 1)
    said = [
        *base.origin(result),
        "ArduPilot: corrected = (reading - ACCOFFS) * ACCSCAL, m/s^2, in the axes of the sensor.",
        *(f"Warning: {warning}." for warning in warnings),
    ]
    values = [(f"OFFS_{axis.upper()}", model.D[i]) for i, axis in enumerate(AXES)]
    values += [(f"SCAL_{axis.upper()}", scale[i]) for i, axis in enumerate(AXES)]
    lines = "".join(f"INS_ACC{number}{key},{value:.9g}\n" for key, value in values)
    return Export((base.comment(said) + lines).encode(), tuple(warnings))
