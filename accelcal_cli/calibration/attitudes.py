"""Attitudes, not rows: how many different directions the poses of a sensor have, and what those determine.

The dilution of precision falls with the root of the number of rows, so that noise seems to determine what the attitudes
cannot. The geometry of a set of poses is therefore judged by its distinct attitudes, each counted once, and as if they
were twelve: more attitudes make an estimate better, which sigma says, and not the geometry.

An attitude is a label, else a cluster of directions within `APART` degrees around the most frequent one. Many rows go
through the cells of a cube first, so that memory stays constant and the order of the rows does not matter. Clusters
serve counting alone: readings are never averaged over them, for the mean over a cap of 5 degrees is 1900 ppm too short.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import Observability, design

APART = 5.0
"""Degrees from the middle of an attitude within which directions belong to it."""

STANDARD = 12
"""Attitudes that the thresholds of the dilution of precision are made for."""

CELLS = 64
"""Cells along the edge of a face of the cube: 1.4 degrees, well below APART."""

NEAR = float(np.cos(np.radians(APART)))


@dataclass(frozen=True, eq=False)
class Geometry:
    """What the distinct attitudes of R sensors determine.

    Attributes:
        attitudes: how many there are, shape (R,).
        observability: of the attitudes, each counted once and all together as `STANDARD`.
        information: J^T J of the attitudes, each counted once, shape (R, 9, 9).
    """

    attitudes: Int
    observability: Observability
    information: Float

    @classmethod
    def of(cls, information: Float, attitudes: Int, held: Bool | None) -> Geometry:
        """Return the geometry of so many attitudes, shape (R,), with their J^T J, shape (R, 9, 9).

        `held` parameters, shape (9,), are not estimated.
        """
        # More than twelve attitudes count as twelve of the same kind.
        excess = np.maximum(attitudes / STANDARD, 1.0)[:, None, None]
        return cls(attitudes, Observability.of(information / excess, attitudes, held), information)


def distinct(u: Float, real: Bool, labelled: Bool) -> tuple[Int, Float]:
    """Return how many attitudes poses have, shape (R,), and J^T J of one direction of each, shape (R, 9, 9).

    The direction with the most neighbours within `APART` degrees takes them all, until none is left.

    Args:
        u: unit directions of the specific force, shape (R, J, 3), J at most some thousand; real: which poses count.
        labelled: sensors whose poses are attitudes of their own, shape (R,).
    """
    rows = design(u) * real[..., None]
    information = rows.swapaxes(1, 2) @ rows
    count = real.sum(axis=1)
    near = (u @ u.swapaxes(1, 2) >= NEAR) & real[:, :, None] & real[:, None]
    for sensor in np.flatnonzero((near.sum(axis=(1, 2)) > count) & ~labelled).tolist():
        middles = _greedy(near[sensor], real[sensor])
        count[sensor] = len(middles)
        own = rows[sensor, middles]
        information[sensor] = own.T @ own
    return count, information


def _greedy(near: Bool, real: Bool) -> list[int]:
    """Return the middles of the attitudes among directions whose neighbours are marked in shape (J, J)."""
    left, middles = real.copy(), []
    while left.any():
        neighbours = near[:, left].sum(axis=1) * left
        middle = int(np.argmax(neighbours))
        middles.append(middle)
        left &= ~near[middle]
    return middles


@dataclass(eq=False)
class CellCount:
    """The directions of one sensor's rows by cells of a cube, in constant memory.

    Attributes:
        sums: of the directions in each cell, shape (6 CELLS^2, 3); count: how many there are, shape (6 CELLS^2,).
    """

    sums: Float = field(default_factory=lambda: np.zeros((6 * CELLS**2, 3)))
    count: Float = field(default_factory=lambda: np.zeros(6 * CELLS**2))

    def add(self, u: Float) -> None:
        """Add unit directions, shape (B, 3)."""
        cell = _cell(u)
        size = len(self.count)
        self.count += np.bincount(cell, minlength=size)
        for k in range(3):
            self.sums[:, k] += np.bincount(cell, weights=u[:, k], minlength=size)

    def distinct(self) -> tuple[int, Float]:
        """Return how many attitudes there are, and J^T J of one direction of each, shape (9, 9)."""
        used = np.flatnonzero(self.count)
        used = used[np.argsort(-self.count[used], kind="stable")]
        u = self.sums[used]
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        left, middles = np.ones(len(u), dtype=bool), []
        for k in range(len(u)):
            if left[k]:
                middles.append(k)
                left &= u @ u[k] < NEAR
                left[k] = False
        rows = design(u[middles])
        return len(middles), rows.T @ rows


def _cell(u: Float) -> Int:
    """Return the number of the cell of each direction, shape (B,)."""
    size = np.abs(u)
    axis = np.argmax(size, axis=1)
    at = np.arange(len(u))
    face = 2 * axis + (u[at, axis] < 0)
    largest = size[at, axis]
    first, second = (
        np.minimum(((u[at, (axis + k) % 3] / largest + 1.0) * (0.5 * CELLS)).astype(np.intp), CELLS - 1)
        for k in (1, 2)
    )
    return np.asarray((face * CELLS + first) * CELLS + second)
