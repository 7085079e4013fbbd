"""The calibration file of the ROS package imu_calib, YAML.

Its node apply_calib corrects a reading as SM * reading - bias (AccelCalib::applyCalib): SM is K_A, row by row, and bias
is f_0, in m/s^2.
"""

from __future__ import annotations

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target
from accelcal_cli.sensor.model import STANDARD_GRAVITY


def export(result: Calibration, target: Target) -> Export:  # noqa: ARG001  # one signature for all
    """Return SM, nine numbers, and bias, three; the corrected force is in m/s^2."""
    metres = STANDARD_GRAVITY if result.unit == "g" else 1.0
    said = [
        *base.origin(result),
        "imu_calib: corrected = SM * reading - bias, m/s^2; the reading is in the unit of the calibrated readings.",
    ]
    matrix = [value for row in base.rows(result.model.K_A * metres) for value in row]
    text = f"{base.comment(said)}SM: {matrix}\nbias: {base.rows(result.model.f_0 * metres)[0]}\n"
    return Export(text.encode(), base.without_temperature(result))
