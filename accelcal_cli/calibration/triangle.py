"""Readings compressed to an 11 x 11 triangle whose cost is theirs, exactly, and the ellipsoid that it holds.

With x = (N - c) / s and h = (x, 1), |f|^2 / g^2 = h^T Q h is linear in the ten entries of Q. Stacking the rows
[phi(x_j), 1] and taking the R of their QR keeps sum_j (1 - phi_j . q)^2 = |R [q; -1]|^2 for every Q. QR of stacked
blocks composes (TSQR), so readings of any number pass through in blocks; a weight multiplies its row.

The closed form: readings lie on an ellipsoid, and a linear fit finds it.

x^T A x + 2 m^T x + d = 0 with trace(A) = 3, nine unknowns by linear least squares. A free constant term instead
of the trace condition would admit the trivial minimum. The centre is the bias, A's Cholesky factor the matrix.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float, Int

PIECE = 512
"""Rows of one small QR; LAPACK's panel of 512 x 11 stays in the first-level cache."""


@dataclass(frozen=True, eq=False)
class Triangle:
    """The compressed readings of R sensors.

    Attributes:
        R: upper triangles, shape (R, 11, 11), of the rows [phi(x), 1].
        centre: c, shape (R, 3), output units.
        scale: s, shape (R,), output units.
        poses: J, the number of readings of each sensor, shape (R,).
    """

    R: Float
    centre: Float
    scale: Float
    poses: Int

    def take(self, index: Int) -> Triangle:
        """Return the triangles of the sensors at `index`."""
        return Triangle(self.R[index], self.centre[index], self.scale[index], self.poses[index])


def rows(x: Float) -> Float:
    """Return [phi(x), 1], shape (..., J, 11), for normalised readings x, shape (..., J, 3).

    Written column by column into memory of shape (..., 11, J): products of contiguous columns.
    """
    h = np.ascontiguousarray(x.swapaxes(-1, -2))
    out = np.empty((*x.shape[:-2], 11, x.shape[-2]))
    for k in range(3):
        np.multiply(h[..., k, :], h[..., k, :], out=out[..., k, :])
        np.multiply(h[..., k, :], 2.0, out=out[..., 6 + k, :])
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        np.multiply(out[..., 6 + i, :], h[..., j, :], out=out[..., 3 + k, :])
    out[..., 9:, :] = 1.0
    return out.swapaxes(-1, -2)


def compress(
    blocks: Iterable[tuple[Float, Float | None]], centre: Float, scale: Float, poses: Int
) -> Triangle:
    """Compress the readings of R sensors, block by block.

    Args:
        blocks: pairs of readings, shape (R, B, 3) in output units, and their weights, shape (R, B), or None; a weight
            of 0 leaves a reading out.
        centre: c, shape (R, 3); scale: s, shape (R,). Any values serve; near the middle and the radius of the readings
            they keep the arithmetic free of cancellation.
        poses: J of each sensor, shape (R,).
    """
    R: Float = np.zeros((len(scale), 11, 11))
    for block, weight in blocks:
        table = rows((block - centre[:, None]) / scale[:, None, None])
        if weight is not None:
            table *= np.sqrt(weight)[..., None]
        R = _triangle(np.concatenate([R, _pieces(table)], axis=1))
    return Triangle(R, centre, scale, poses)


def compress_each(readings: Float, weights: Float | None = None) -> Triangle:
    """Compress the readings of R sensors, shape (R, J, 3), with weights, shape (R, J), or None, all at once."""
    low, high = readings.min(axis=1), readings.max(axis=1)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low).max(axis=1)
    table = rows((readings - centre[:, None]) / scale[:, None, None])
    if weights is not None:
        table *= np.sqrt(weights)[..., None]
    if table.shape[1] < 11:
        table = np.concatenate([table, np.zeros((len(table), 11 - table.shape[1], 11))], axis=1)
    return Triangle(_triangle(table), centre, scale, np.full(len(readings), readings.shape[1]))


def _pieces(table: Float) -> Float:
    """Return rows with the same R as `table`, shape (R, J, 11), fewer by a factor PIECE / 11 where there are many."""
    whole = table.shape[1] // PIECE * PIECE
    if whole <= PIECE:
        return table
    small = _triangle(table[:, :whole].reshape(-1, PIECE, 11)).reshape(len(table), -1, 11)
    return np.concatenate([_pieces(small), table[:, whole:]], axis=1)


def _triangle(table: Float) -> Float:
    """Return R of the QR of (..., rows >= 11, 11), shape (..., 11, 11)."""
    R: Float = np.linalg.qr(table, mode="r")  # type: ignore[assignment]  # numpy types mode "r" as "reduced"
    return R


LARGEST_CONDITION = 4.0
"""No accelerometer's axes differ by this factor once each has unit extent, or stand as oblique: beyond it the fit
describes the noise, not the sensor."""

FILLED = 1.5
"""Largest factor between the extent of an axis and that of the ellipsoid fitted to it, where axes differ by more than
LARGEST_CONDITION: readings all over the ellipsoid have as much of it in every axis."""

SURELY_FILLED = 0.1
"""Largest standard deviation of the squared extents of such an ellipsoid, as a part of them: noise in an axis that does
not answer fits ellipsoids as flat as it likes, and none so surely."""

MOST_UNLIKE = 2000.0
"""Largest factor between the extents of two axes: g beside mg is 1000, and beyond that a column is no axis."""

LEAST_SPREAD = 0.25
"""Least eigenvalue of the correlation of such readings: 1 for a sphere all over, 0 where they lie in a plane."""

SMALLEST_PIVOT = 1e-9
"""A pivot of the triangle below this part of the largest means a direction the poses say nothing of."""

ROUNDS = 3
"""Rounds towards the least cost: noise of 1e-3 g leaves a part of 1e-6 in each."""


def fit_ellipsoid(triangle: Triangle) -> tuple[Float, Float]:
    """Return K g / s in gauge `lower`, shape (R, 3, 3), and (D - c) / s, shape (R, 3).

    NaN for a sensor whose readings do not determine an ellipsoid: fewer than nine poses, poses on a common other
    quadric, or noise that makes the fitted quadric no ellipsoid. Where the axes of the ellipsoid differ too much to be
    those of a sensor, it is fitted anew with every axis brought to unit extent.
    """
    K, centre, _ = _ellipsoid(triangle.R[..., :10])
    refused = np.flatnonzero(np.isnan(K[:, 0, 0]))
    if len(refused):
        K[refused], centre[refused] = _of_unit_extent(triangle.take(refused))
    return K, centre


def _of_unit_extent(triangle: Triangle) -> tuple[Float, Float]:
    """Return what `fit_ellipsoid` does where the axes are of very different scale, NaN elsewhere."""
    covariance = _moments(triangle)
    variance = np.einsum("rii->ri", covariance)
    usable = (variance > 0).all(axis=1) & (triangle.poses > 9)
    extent = np.sqrt(3.0 * np.where(usable[:, None], variance, 1.0))  # of a sphere all over
    usable &= extent.max(axis=1) < MOST_UNLIKE * extent.min(axis=1)
    correlation = 3.0 * covariance / (extent[:, :, None] * extent[:, None, :])
    usable &= np.linalg.eigvalsh(np.where(usable[:, None, None], correlation, 0.0))[:, 0] > LEAST_SPREAD
    factor = rows(1.0 / extent[:, None])[:, 0, :9]
    factor[:, 3:] *= 0.5  # the rows hold 2 x_i x_j and 2 x_i
    phi = np.concatenate([triangle.R[..., :9] * factor[:, None], triangle.R[..., 9:10]], axis=2)
    K, centre, uncertain = _ellipsoid(phi, triangle.poses)
    size = np.sqrt(np.sum(K**2, axis=2))
    with np.errstate(invalid="ignore"):
        usable &= (
            (size.max(axis=1) < FILLED) & (size.min(axis=1) > 1.0 / FILLED) & (uncertain < SURELY_FILLED)
        )
    return (
        np.where(usable[:, None, None], K * extent[:, :, None], np.nan),
        np.where(usable[:, None], centre * extent, np.nan),
    )


def _moments(triangle: Triangle) -> Float:
    """Return the covariance of the normalised readings, shape (R, 3, 3): products of the columns of the triangle."""
    sums = np.einsum("rki,rk->ri", triangle.R[..., :9], triangle.R[..., 9])
    sums /= np.sum(triangle.R[..., 9] ** 2, axis=1)[:, None]
    sums[:, 3:] *= 0.5
    mean = sums[:, 6:]
    return np.asarray(_matrix(sums) - mean[:, :, None] * mean[:, None, :])


def _ellipsoid(phi: Float, poses: Int | None = None) -> tuple[Float, Float, Float]:
    """Return K in gauge `lower`, centre, and how uncertain the diagonal of A is, as a part of it, shape (R,).

    Args:
        phi: the first ten columns of triangles, shape (R, 11, 10).
        poses: J, shape (R,); without it nothing is uncertain.
    """
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
    uncertain = np.zeros(len(z))
    if poses is not None:
        square = np.sum((right - _times(left, z)) ** 2, axis=1) / np.maximum(poses - 9, 1)
        inverse = np.linalg.inv(r)[:, :2]
        inverse = np.concatenate([inverse, inverse.sum(axis=1, keepdims=True)], axis=1)
        own = np.sqrt(square[:, None] * np.sum(inverse**2, axis=2))
        uncertain = np.max(own / np.einsum("rii->ri", A), axis=1)
    return (
        np.where(solvable[:, None, None], K, np.nan),
        np.where(solvable[:, None], centre, np.nan),
        uncertain,
    )


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
