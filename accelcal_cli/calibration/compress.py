"""Readings compressed to an 11 x 11 triangle whose cost is theirs, exactly.

With x = (N - c) / s and h = (x, 1), |f|^2 / g^2 = h^T Q h is linear in the ten entries of Q. Stacking the rows
[phi(x_j), 1] and taking the R of their QR keeps sum_j (1 - phi_j . q)^2 = |R [q; -1]|^2 for every Q. QR of stacked
blocks composes (TSQR), so readings of any number pass through in blocks; a weight multiplies its row.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.streams import Float, Int

PAIRS = (np.array([0, 1, 2, 0, 0, 1, 0, 1, 2, 3]), np.array([0, 1, 2, 1, 2, 2, 3, 3, 3, 3]))
"""Which entries of the symmetric 4 x 4 matrix Q the vector q holds."""

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


def compress(blocks: Iterable[tuple[Float, Float | None]], centre: Float, scale: float) -> Triangle:
    """Compress one sensor's readings.

    Args:
        blocks: pairs of readings, shape (B, 3) in output units, and their weights, shape (B,), or None.
        centre: c, shape (3,); scale: s. Any values serve; near the middle and the radius of the readings they
            keep the arithmetic free of cancellation.
    """
    R: Float = np.zeros((11, 11))
    poses = 0
    for block, weight in blocks:
        poses += len(block)
        table = rows((block - centre) / scale)
        if weight is not None:
            table *= np.sqrt(weight)[:, None]
        R = _triangle(np.concatenate([R, _pieces(table)]))
    return Triangle(R[None], np.asarray(centre)[None], np.array([scale]), np.array([poses]))


def compress_each(readings: Float, weights: Float | None = None, poses: Int | None = None) -> Triangle:
    """Compress the readings of R sensors with J poses each, shape (R, J, 3), weights (R, J) or None.

    Sensors with fewer poses repeat one of them with weight zero; `poses`, shape (R,), says how many there are.
    """
    low, high = readings.min(axis=1), readings.max(axis=1)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low).max(axis=1)
    table = rows((readings - centre[:, None]) / scale[:, None, None])
    if weights is not None:
        table *= np.sqrt(weights)[..., None]
    if table.shape[1] < 11:
        table = np.concatenate([table, np.zeros((len(table), 11 - table.shape[1], 11))], axis=1)
    each = np.full(len(readings), readings.shape[1]) if poses is None else poses
    return Triangle(_triangle(table), centre, scale, each)


def _pieces(table: Float) -> Float:
    """Return rows with the same R as `table`, fewer by a factor PIECE / 11 when there are many."""
    whole = len(table) // PIECE * PIECE
    if whole <= PIECE:
        return table
    small = _triangle(table[:whole].reshape(-1, PIECE, 11)).reshape(-1, 11)
    return np.concatenate([_pieces(small), table[whole:]])


def _triangle(table: Float) -> Float:
    """Return R of the QR of (..., rows >= 11, 11), shape (..., 11, 11)."""
    R: Float = np.linalg.qr(table, mode="r")  # type: ignore[assignment]  # numpy types mode "r" as "reduced"
    return R
