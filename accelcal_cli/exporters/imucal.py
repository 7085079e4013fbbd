"""imucal corrects a reading as R_a^-1 K_a^-1 (acc - b_a) (FerrarisCalibrationInfo).

Its K_a holds the lengths of the rows alone, R_a rows of length 1 (ferraris_calibration.py).
The gyroscope is left as it is.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration

FORMAT = "2.0.0"


@EXPORTERS.register("imucal")
@dataclass(frozen=True)
class Imucal(Exporter):
    """Calibration info of the Python package imucal.

    A Ferraris calibration: K_a the sensitivity of each axis, R_a the directions of the axes in the body, b_a the bias.
    """

    suffix = ".json"

    def content(self, result: Calibration) -> bytes:
        """Return the record as JSON."""
        import numpy as np

        from accelcal_cli.sensor.model import sensitivity

        scale = sensitivity(result.K_a)
        record = {
            "cal_type": "Ferraris",
            "_format_version": FORMAT,
            "acc_unit": result.unit,
            "gyr_unit": "deg/s",
            "from_acc_unit": result.unit if base.is_force(result) else "a.u.",
            "from_gyr_unit": "deg/s",
            "comment": "; ".join(
                [*self.header(result), base.frame(result), "gyroscope not calibrated: identity"]
            ),
            "K_a": base.rows(np.diag(scale)),
            "R_a": base.rows(result.K_a / scale[:, None]),
            "b_a": base.rows(result.D_a)[0],
            "K_g": base.rows(np.eye(3)),
            "R_g": base.rows(np.eye(3)),
            "K_ga": base.rows(np.zeros((3, 3))),
            "b_g": [0.0, 0.0, 0.0],
        }
        return (json.dumps(record, indent=4) + "\n").encode()

    def warnings(self, result: Calibration) -> tuple[str, ...]:
        """Return what is left out, and that the gyroscope is not calibrated."""
        return (
            "the gyroscope part is the identity: accelcal calibrates accelerometers",
            *super().warnings(result),
        )
