"""The closed form: readings lie on an ellipsoid, and a linear fit finds it.

x^T A x + 2 m^T x + d = 0 with trace(A) = 3, nine unknowns by linear least squares. A free constant term instead
of the trace condition would admit the trivial minimum. The centre is the bias, A's Cholesky factor the matrix.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.compress import Triangle
from accelcal_cli.streams import Float

LARGEST_CONDITION = 4.0
"""No accelerometer's axes differ by this factor: beyond it the fit describes the noise, not the sensor."""

SMALLEST_PIVOT = 1e-9
"""A pivot of the triangle below this part of the largest means a direction the poses say nothing of."""


def fit_ellipsoid(triangle: Triangle) -> tuple[Float, Float]:
    """Return K g / s in gauge `lower`, shape (R, 3, 3), and (D - c) / s, shape (R, 3).

    NaN for a sensor whose readings do not determine an ellipsoid: fewer than nine poses, poses on a common other
    quadric, or noise that makes the fitted quadric no ellipsoid.
    """
    phi = triangle.R[..., :10]
    # trace(A) = 3 eliminates A_33 = 3 - A_11 - A_22.
    left = np.concatenate([phi[..., :2] - phi[..., 2:3], phi[..., 3:]], axis=-1)
    right = -3.0 * phi[..., 2]
    q, r = np.linalg.qr(left)
    pivots = np.abs(np.einsum("...ii->...i", r))
    solvable = pivots.min(axis=-1) > SMALLEST_PIVOT * pivots.max(axis=-1)
    r = np.where(solvable[:, None, None], r, np.eye(9))
    z = np.linalg.solve(r, q.swapaxes(-1, -2) @ right[..., None])[..., 0]
    A = np.empty((len(z), 3, 3))
    A[:, 0, 0], A[:, 1, 1], A[:, 2, 2] = z[:, 0], z[:, 1], 3.0 - z[:, 0] - z[:, 1]
    A[:, 0, 1] = A[:, 1, 0] = z[:, 2]
    A[:, 0, 2] = A[:, 2, 0] = z[:, 3]
    A[:, 1, 2] = A[:, 2, 1] = z[:, 4]
    m, d = z[:, 5:8], z[:, 8]
    values = np.linalg.eigvalsh(A)
    solvable &= (values[:, 0] > 0) & (values[:, 2] < LARGEST_CONDITION**2 * values[:, 0])
    A = np.where(solvable[:, None, None], A, np.eye(3))
    centre = -np.linalg.solve(A, m[..., None])[..., 0]
    level = -np.einsum("ri,ri->r", m, centre) - d  # c^T A c - d
    solvable &= level > 0
    shape = np.linalg.inv(A) * np.where(solvable, level, 1.0)[:, None, None]
    K = np.linalg.cholesky(0.5 * (shape + shape.swapaxes(-1, -2)))
    return np.where(solvable[:, None, None], K, np.nan), np.where(solvable[:, None], centre, np.nan)
