"""The closed form: readings lie on an ellipsoid, and a linear fit finds it.

x^T A x + 2 m^T x + d = 0 with trace(A) = 3, nine unknowns by linear least squares. A free constant term instead
of the trace condition would admit the trivial minimum. The centre is the bias, A's Cholesky factor the matrix.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.compress import Triangle, rows
from accelcal_cli.streams import Float

LARGEST_CONDITION = 4.0
"""No accelerometer's axes differ by this factor: beyond it the fit describes the noise, not the sensor."""

SMALLEST_PIVOT = 1e-9
"""A pivot of the triangle below this part of the largest means a direction the poses say nothing of."""

ROUNDS = 3
"""Rounds towards the least cost: noise of 1e-3 g leaves a part of 1e-6 in each."""


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


def least_squares(triangle: Triangle) -> tuple[Float, Float]:
    """Return K g / s in gauge `lower`, shape (R, 3, 3), and (D - c) / s, shape (R, 3), at the least cost.

    The rows' last two columns are both ones. With y the quadric x^T A x + 2 m^T x = 1 (A as it comes, not scaled to
    the trace) the cost is L = F / (1 + e)^2, F = |T y - t|^2 + rho^2 and e = m^T A^-1 m, where T, t and rho are
    the triangle's first nine columns, the tenth above its diagonal, and its diagonal there. Where its gradient
    vanishes,

        y = T^-1 t - F / (1 + e) (T^T T)^-1 phi(d),   d = -A^-1 m,

    phi(d) the row of a reading at the centre d. F is the noise squared, so each round gains as many digits. NaN for
    a sensor whose readings determine no ellipsoid; after much noise the rounds end before the last digits.
    """
    T, t, rho = triangle.R[:, :9, :9], triangle.R[:, :9, 9], triangle.R[:, 9, 9]
    pivots = np.abs(np.einsum("rii->ri", T))
    solvable = pivots.min(axis=1) > SMALLEST_PIVOT * pivots.max(axis=1)
    inverse = np.linalg.inv(np.where(solvable[:, None, None], T, np.eye(9)))
    first = _times(inverse, t)
    y = first
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            d, e = _centre(y)
            F = rho**2 + np.sum(_times(T, y - first) ** 2, axis=1)
            back = _times(inverse.swapaxes(1, 2), rows(d[:, None])[:, 0, :9])
            y = first - (F / (1.0 + e))[:, None] * _times(inverse, back)
        d, e = _centre(y)
        A = _matrix(y) / (1.0 + e)[:, None, None]
        values = np.linalg.eigvalsh(np.where(np.isfinite(A), A, 0.0))
        solvable &= (
            np.isfinite(A).all(axis=(1, 2)) & np.isfinite(d).all(axis=1) & (values[:, 0] > SMALLEST_PIVOT)
        )
    shape = np.linalg.inv(np.where(solvable[:, None, None], A, np.eye(3)))
    K = np.linalg.cholesky(0.5 * (shape + shape.swapaxes(1, 2)))
    return np.where(solvable[:, None, None], K, np.nan), np.where(solvable[:, None], d, np.nan)


def _times(matrix: Float, vector: Float) -> Float:
    product: Float = (matrix @ vector[..., None])[..., 0]
    return product


def _matrix(y: Float) -> Float:
    """Return A, shape (R, 3, 3), of the quadrics y, shape (R, 9)."""
    return y[:, [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def _centre(y: Float) -> tuple[Float, Float]:
    """Return d = -A^-1 m, shape (R, 3), and m^T A^-1 m, shape (R,), by cofactors: a singular A gives inf or NaN."""
    A, m = _matrix(y), y[:, 6:]
    cofactors = np.stack([np.cross(A[:, k - 2], A[:, k - 1]) for k in range(3)], axis=2)
    d: Float = -_times(cofactors, m) / np.sum(A[:, 0] * cofactors[..., 0], axis=1)[:, None]
    return d, -np.sum(m * d, axis=1)
