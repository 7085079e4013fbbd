"""NumPy arrays in one .npz file: f = K_A N - f_0 = K_A (N - D_a)."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.calibration.result import Calibration


@EXPORTERS.register("numpy")
@dataclass(frozen=True)
class NumPy(Exporter):
    """NumPy arrays for code of your own.

    K_A, f_0, K_a, D_a, their covariance, g and the unit of f, and text on the origin.
    """

    suffix = ".npz"
    binary = True

    def content(self, result: Calibration) -> bytes:
        """Return the arrays; `numpy.load` reads them."""
        import numpy as np

        file = io.BytesIO()
        np.savez(
            file,
            K_A=result.model.K_A,
            f_0=result.model.f_0,
            K_a=result.K_a,
            D_a=result.D_a,
            covariance=result.covariance,
            g=np.array(result.g),
            unit=np.array(result.unit),
            origin=np.array("; ".join([*base.origin(result), base.frame(result)])),
        )
        return file.getvalue()
