"""Fits that leave one pose out: what a pose looks like to the others, without the first-order formula.

The formula of linear regression subtracts a pose's part from the sum of squares. A pose that is wrong by several per
cent bends the fit so far that its part comes out larger than the whole, and the formula has nothing to say of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.lotters import ROWS_COLUMNS
from accelcal_cli.calibration.quality import design
from accelcal_cli.streams import Bool, Float, Int

STEPS, SETTLED = 12, 1e-6
"""Gauss-Newton steps at most, and the part of g below which a step is the last: the next would be its square."""

LEAST_ROOM = 1e-8
"""The trace of a matrix times that of its inverse is below 1 over this where the other poses determine a sensor."""

RIDGE = 1e-14
"""Part of the trace that is added to the diagonal, so that no matrix of a batch is singular to the last bit."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Poses seen by fits without them.

    Attributes:
        error: |f| - g of the pose left out, m/s^2, shape (S,).
        studentised: the same over its standard deviation, from the residuals of the others, shape (S,).
            Both NaN where the others do not determine the sensor, or where too few are left.
    """

    error: Float
    studentised: Float


def leave_out(force: Float, weights: Float, pose: Int, g: float, held: Bool | None = None) -> LeftOut:
    """Fit S sensors anew, each without one of its poses.

    Args:
        force: specific force by the fit with all poses, m/s^2, shape (S, J, 3).
        weights: of the poses, 0 for none, shape (S, J).
        pose: which one to leave out, shape (S,).
        g: local gravity, m/s^2.
        held: which of the nine parameters are not estimated, shape (9,).
    """
    free = np.arange(9) if held is None else np.flatnonzero(~held)
    sensors = np.arange(len(pose))
    kept = weights.copy()
    kept[sensors, pose] = 0.0
    with np.errstate(all="ignore"):
        for _ in range(STEPS):
            e, rows, cofactor = _linearised(force, kept, g, free)
            step = np.zeros((len(pose), 9))
            step[:, free] = -(cofactor @ (rows.swapaxes(1, 2) @ (kept * e)[..., None]))[..., 0]
            force = _moved(force, step, g)
            if not np.any(np.abs(step) > SETTLED * g):
                break
        e, rows, cofactor = _linearised(force, kept, g, free)
        freedom = np.count_nonzero(kept, axis=1) - len(free)
        variance = np.sum(kept * e * e, axis=1) / np.where(freedom > 0, freedom, np.nan)
        at = rows[sensors, pose]
        spread = 1.0 / weights[sensors, pose] + np.sum((cofactor @ at[..., None])[..., 0] * at, axis=1)
        error = np.linalg.norm(force[sensors, pose], axis=1) - g
        return LeftOut(error, -e[sensors, pose] / np.sqrt(variance * spread))


def _linearised(force: Float, weights: Float, g: float, free: Int) -> tuple[Float, Float, Float]:
    """Return e = (g^2 - |f|^2) / 2g, its derivatives by the changes of `_moved`, and the inverse of their products.

    Shapes (S, J), (S, J, p) and (S, p, p) for the p parameters at `free`; NaN where the weighted poses do not determine
    a sensor.
    """
    e = (g * g - np.sum(force * force, axis=2)) / (2.0 * g)
    rows = design(force / g)[..., free]
    normal = (rows * weights[..., None]).swapaxes(1, 2) @ rows
    size = np.einsum("spp->s", normal)
    finite = np.isfinite(size)[:, None, None]
    inverse = np.linalg.inv(
        np.where(finite, normal + RIDGE * size[:, None, None] * np.eye(len(free)), np.eye(len(free)))
    )
    spread = np.einsum("spp->s", inverse) * size
    known = (spread > 0) & (spread < 1.0 / LEAST_ROOM)
    return e, rows, np.where(known[:, None, None], inverse, np.nan)


def _moved(force: Float, step: Float, g: float) -> Float:
    """Return (I + E) f - b, with the lower triangle E (times g) and b from a step, m/s^2, shape (S, 9)."""
    E = np.zeros((len(step), 3, 3))
    for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
        E[:, i, j] = step[:, p] / g
    moved: Float = force + force @ E.swapaxes(1, 2) - step[:, None, 6:]
    return moved
