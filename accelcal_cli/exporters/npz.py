"""NumPy arrays in one .npz file: f = K_A N - f_0 = K_A (N - D_a)."""

from __future__ import annotations

import io

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target


def export(result: Calibration, target: Target) -> Export:  # noqa: ARG001  # one signature for all
    """Return K_A, f_0, K_a, D_a, their covariance, g and the unit of f, and text on the origin."""
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
        origin=np.array("; ".join(base.origin(result))),
    )
    return Export(file.getvalue(), base.without_temperature(result))
