"""imucal corrects a reading as R_a^-1 K_a^-1 (acc - b_a) (FerrarisCalibrationInfo).

Its K_a holds the scale factors alone, R_a the rest. The gyroscope is left as it is.
"""

from __future__ import annotations

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

    A Ferraris calibration: K_a diagonal, R_a = K_a^-1 times the whole matrix, b_a the bias. In gauge `full` the axes
    may lie anywhere in the body, and the length of a row is the scale factor.
    """

    suffix = ".json"

    def content(self, result: Calibration) -> bytes:
        """Return the record as JSON."""
        import json

        import numpy as np

        scale = np.linalg.norm(result.K_a, axis=1) if result.gauge == "full" else result.K_a.diagonal()
        record = {
            "cal_type": "Ferraris",
            "_format_version": FORMAT,
            "acc_unit": result.unit,
            "gyr_unit": "deg/s",
            "from_acc_unit": result.unit if base.is_force(result) else "a.u.",
            "from_gyr_unit": "deg/s",
            "comment": "; ".join([*base.origin(result), "gyroscope not calibrated: identity"]),
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
