"""The IMU file of Kalibr, model scale-misalignment.

Kalibr's model of a reading is M a + b with a lower triangular M (kalibr_imu_camera_calibration,
IccScaledMisalignedImu):
M is K_a in gauge `lower`, b is D_a. Kalibr itself estimates b anew in every run; the key is for other readers.
"""

from __future__ import annotations

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target

UNKNOWN = """\
  # PLACEHOLDERS: a static calibration does not know them. Take them from the data sheet or an Allan deviation.
  accelerometer_noise_density: null  # m/s^2/sqrt(Hz)
  accelerometer_random_walk: null  # m/s^3/sqrt(Hz)
  gyroscope_noise_density: null  # rad/s/sqrt(Hz)
  gyroscope_random_walk: null  # rad/s^2/sqrt(Hz)
  update_rate: null  # Hz
  rostopic: null
"""


def export(result: Calibration, target: Target) -> Export:
    """Return imuN with accelerometers.M and .b; noise, rate and topic are marked placeholders."""
    if target.driver_scale is not None or base.force_already(result):
        model, unit = base.in_metres(result, target, "kalibr").in_gauge("lower"), "m/s^2"
    else:
        model, unit = result.model.in_gauge("lower"), "unit of the readings"
    said = [
        *base.origin(result),
        f"Kalibr: reading = M a + b; a in m/s^2, reading and b in {unit}, M lower triangular (gauge lower).",
    ]
    matrix = "".join(f"    - {row}\n" for row in base.rows(model.K))
    text = (
        f"{base.comment(said)}imu{target.instance}:\n  model: scale-misalignment\n  accelerometers:\n    M:\n{matrix}"
        f"    b: {base.rows(model.D)[0]}\n{UNKNOWN}"
    )
    warning = "noise densities, random walks, rate and topic are placeholders: fill them in"
    return Export(text.encode(), (warning, *base.without_temperature(result)))
