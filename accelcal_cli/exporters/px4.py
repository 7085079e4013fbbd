"""PX4 parameters, in the file format of QGroundControl.

PX4 corrects a reading of the driver, in m/s^2 and in the axes of the sensor, as (reading - OFF) * SCALE, axis by axis,
and turns the board afterwards (PX4-Autopilot, src/lib/sensor_calibration/Accelerometer.hpp).
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target
from accelcal_cli.sensor.poses import AXES

SENSORS = 4
REAL32 = 9  # MAV_PARAM_TYPE_REAL32


def export(result: Calibration, target: Target) -> Export:
    """Return CAL_ACCn_XOFF, ..., CAL_ACCn_XSCALE, ...: offset D_a in m/s^2, scale 1 / K_ii."""
    if target.instance >= SENSORS:
        raise UsageError(f"--instance {target.instance}: PX4 has accelerometers 0 to {SENSORS - 1}")
    model = base.in_metres(result, target, "px4")
    warnings = (*base.dropped(model, result), *base.without_temperature(result))
    name = f"CAL_ACC{target.instance}"
    said = [
        *base.origin(result),
        "PX4: corrected = (reading - OFF) * SCALE, m/s^2, in the axes of the sensor.",
        f"{name}_ID has to be the device that the readings came from.",
        *(f"Warning: {warning}." for warning in warnings),
        "Vehicle-Id Component-Id Name Value Type",
    ]
    values = [(f"{axis.upper()}OFF", model.D[i]) for i, axis in enumerate(AXES)]
    values += [(f"{axis.upper()}SCALE", 1.0 / np.diagonal(model.K)[i]) for i, axis in enumerate(AXES)]
    lines = "".join(f"1\t1\t{name}_{key}\t{value:.9g}\t{REAL32}\n" for key, value in values)
    return Export((base.comment(said) + lines).encode(), warnings)
