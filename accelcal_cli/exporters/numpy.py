"""NumPy arrays in one .npz file: f = K_A N - f_0 = K_A (N - D_a).

With slopes f = K_A ((N - D_a - bias_slope t) / (1 + scale_slope t)), t = T - temperature_reference.
"""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration


@EXPORTERS.register("numpy")
@dataclass(frozen=True)
class NumPy(Exporter):
    """NumPy arrays for code of your own.

    K_A, f_0, K_a, D_a, their covariance, g and the unit of f, and text on the origin; where there are any,
    temperature slopes.
    """

    suffix = ".npz"
    binary = True
    slopes = "all"

    def content(self, result: Calibration) -> bytes:
        """Return the arrays; `numpy.load` reads them."""
        import numpy as np

        file, drift = io.BytesIO(), result.temperature
        slopes: dict[str, Any] = (
            {}
            if drift is None
            else {
                "temperature_reference": np.array(drift.reference),
                "temperature_range": np.array([drift.low, drift.high]),
                "scale_slope": drift.scale,
                "bias_slope": drift.bias,
                "slope_covariance": drift.covariance,
            }
        )
        np.savez(
            file,
            K_A=result.model.K_A,
            f_0=result.model.f_0,
            K_a=result.K_a,
            D_a=result.D_a,
            covariance=result.covariance,
            g=np.array(result.g),
            unit=np.array(result.unit),
            origin=np.array("; ".join([*self.header(result), base.frame(result)])),
            **slopes,
        )
        return file.getvalue()
