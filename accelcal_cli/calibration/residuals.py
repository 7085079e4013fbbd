"""The residuals of a fit, pose by pose: leverage, studentised, as seen by the other poses, and which are outliers."""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import f_chance, student_chance
from accelcal_cli.calibration.observability import RIDGE, ROWS_COLUMNS, design, near_inverse, unit
from accelcal_cli.calibration.sample import NO_NOISE, Sample, length_error
from accelcal_cli.schema import frozen

KEPT = 1000
"""Poses whose residuals a fit keeps one by one; of more, the worst KEPT_WORST."""

KEPT_WORST = 20

OUTLIER_LEVEL = 0.002
"""Chance of naming an outlier among all poses where there is none (Bonferroni over the poses)."""

SUSPECT, SUSPECT_LEVEL = 3.0, 100.0 * OUTLIER_LEVEL
"""Studentised residuals beyond the first may be outliers: those of Student's t with any freedom are as large at least.
And so large by a chance below the second: of 12 poses, which leave two degrees of freedom, beyond 7.7."""

BENT = 0.002
"""A residual beyond this part of g bends the fit so far that no first-order formula holds."""

STEPS, SETTLED = 12, 1e-6
"""Gauss-Newton steps at most of a fit without a pose, and the part of g below which a step is the last: the next would
be its square."""

OPEN_DIRECTION = 1e-8
"""Part of the largest eigenvalue below which the poses do not tell a pattern from the parameters."""

LEAST_ROOM = 1e-8
"""The trace of a matrix times that of its inverse is below 1 over this where the other poses determine a sensor."""


@frozen(eq=False)
class PoseResiduals:
    """Residuals of k poses of each of R sensors.

    Attributes:
        pose: their numbers, from 0, shape (R, k); real: which are no repetitions, shape (R, k).
        weight: in the fit, that of a robust loss included, shape (R, k).
        error, before: |f| - g after and before calibration, m/s^2, shape (R, k).
        force: calibrated specific force, gauge `lower`, m/s^2, shape (R, k, 3).
        leverage: part of the pose's own residual that the fit absorbs, shape (R, k).
        studentised: residual over its standard deviation from the other poses, shape (R, k).
        left_out: |f| - g, m/s^2, that a fit without the pose would show, shape (R, k).
        outlier: whether the studentised residual is beyond chance, shape (R, k).
    """

    pose: Int
    real: Bool
    weight: Float
    error: Float
    before: Float
    force: Float
    leverage: Float
    studentised: Float
    left_out: Float
    outlier: Bool


def worst(columns: list[Float], sample: Sample) -> list[Float]:
    """Return the columns of the poses that are kept: all of few; of many those with the largest residuals, in order."""
    if int(sample.poses.max()) <= KEPT:
        return columns
    size = np.abs(columns[1])
    last = min(KEPT_WORST, size.shape[1]) - 1
    index = np.sort(np.argpartition(-size, last, axis=1)[:, :KEPT_WORST], axis=1)
    rows = np.arange(len(size))[:, None]
    return [column[rows, index] for column in columns]


def pose_residuals(
    total: Float,
    kept: list[Float],
    sample: Sample,
    cofactor: Float,
    freedom: Int,
    held: Bool | None,
    rejected: Bool | None,
    g: float,
) -> PoseResiduals:
    """Return the kept residuals with their leverage, studentised and with the pose left out, and the outliers."""
    order, scaled, w, f, e_raw = kept
    number = order.astype(np.intp)
    real, free = number < sample.poses[:, None], freedom[:, None]
    f = np.ascontiguousarray(f)
    size = np.linalg.norm(f, axis=2)
    leverage = leverages(design(f / np.where(size > 0, size, 1.0)[..., None]), w, cofactor)
    room = room_of(leverage)
    error, studentised = size - g, studentise(scaled, room, total[:, None], free)
    left_out = error / room
    may_be = is_suspect(studentised, error, sample.poses[:, None], free, g)
    sensor, pose = np.nonzero(may_be & real & (w > 0))
    if number.shape[1] < int(
        sample.poses.max()
    ):  # of so many poses none bends the fit, unless beyond all measure
        blown = np.isnan(studentised[sensor, pose])
        at = sensor[blown], pose[blown]
        studentised[at] = np.copysign(np.inf, error[at])
    elif len(sensor):
        at = sensor, pose
        studentised[at], left_out[at] = leave_out(f[sensor], w[sensor], pose, g, held)
    beyond = beyond_chance(np.abs(studentised), sample.poses[:, None], free)
    outlier = beyond & real & (np.abs(error) > NO_NOISE * g)
    if rejected is not None:
        _tell_rejected(
            rejected, order.astype(np.intp), (f, error, cofactor, total, free), studentised, left_out
        )
        outlier |= np.take_along_axis(rejected, number, axis=1)
    return PoseResiduals(
        number, real, w, error, length_error(e_raw, g), f, leverage, studentised, left_out, outlier
    )


def _tell_rejected(
    rejected: Bool,
    number: Int,
    fit: tuple[Float, Float, Float, Float, Int],
    studentised: Float,
    left_out: Float,
) -> None:
    """Fill in how far off the poses are that the fit was made without.

    Args:
        rejected: which of all poses, shape (R, J); number: of those that are kept, shape (R, k).
        fit: their specific force and |f| - g, the cofactor, the sum of squares and the degrees of freedom.
        studentised, left_out: to fill in, shape (R, k).
    """
    f, error, cofactor, total, freedom = fit
    rows = design(unit(f))
    spread = 1.0 + np.sum((rows @ cofactor) * rows, axis=2)
    deviation = np.sqrt(total[:, None] / np.maximum(freedom, 1) * spread)
    out = np.take_along_axis(rejected, number, axis=1)
    studentised[out], left_out[out] = (error / deviation)[out], error[out]


def is_suspect(studentised: Float, error: Float, poses: Int, freedom: Int, g: float) -> Bool:
    """Return which poses may be outliers, or bend the fit too far for the first-order formula, shape (R, J).

    Args:
        studentised: by that formula, NaN where it has nothing to say; error: |f| - g, m/s^2.
        poses: J, shape (R, 1); freedom: J - 9, shape (R, 1).
    """
    size = np.abs(studentised)
    large = np.isnan(size) | beyond_chance(size, poses, freedom, SUSPECT_LEVEL)
    large &= np.abs(error) > NO_NOISE * g
    return np.asarray((large | (np.abs(error) > BENT * g)) & (freedom >= 2))


def leverages(rows: Float, w: Float, cofactor: Float) -> Float:
    """Return the part of each pose's own residual that the fit absorbs, shape (..., J).

    Args:
        rows: their design, shape (..., J, 9); w: their weights, shape (..., J).
        cofactor: (J^T W J)^-1, shape (..., 9, 9).
    """
    return np.asarray(np.minimum(w * np.sum((rows @ cofactor) * rows, axis=-1), 1.0))


def room_of(leverage: Float) -> Float:
    """Return 1 - leverage; NaN for a pose that the fit follows completely: it has no error to judge it by."""
    return np.where(leverage < 1.0 - 1e-9, 1.0 - leverage, np.nan)


def studentise(scaled: Float, room: Float, total: Float | float, freedom: Int | int) -> Float:
    """Return residuals over their standard deviation from the other poses, shape (..., J), NaN below 2 of freedom.

    Args:
        scaled: sqrt(w) e, m/s^2, and `room`, both of shape (..., J).
        total: the sum of all their squares; freedom: J - 9; both scalars or of shape (..., 1).
    """
    others = np.maximum(total - scaled**2 / room, 0.0) / np.maximum(freedom - 1, 1)
    deviation = np.sqrt(np.where((others > 0) & (np.asarray(freedom) >= 2), others, np.nan) * room)
    return np.asarray(-scaled / deviation)


def beyond_chance(size: Float, poses: Int, freedom: Int, level: float = OUTLIER_LEVEL) -> Bool:
    """Return which studentised residuals are so large that none of a sensor's would be by chance (Student's t).

    Args:
        size: absolute values, shape (..., J), NaN for none; poses, freedom: of their sensor, broadcast to that shape.
        level: chance of one such residual among all poses.
    """
    beyond: Bool = np.zeros(size.shape, dtype=bool)
    suspect = np.nonzero((size > SUSPECT) & (freedom >= 2))
    poses, freedom = (np.broadcast_to(a, size.shape)[suspect] for a in (poses, freedom))
    beyond[suspect] = poses * student_chance(size[suspect], freedom - 1) < level
    return beyond


FEWEST_SPARE = 3
"""Degrees of freedom that a test for a pattern leaves to the noise at least."""


def bend_and_drift(residuals: PoseResiduals, poses: Int, g: float) -> tuple[Float, Float]:
    """Return the p-values of residuals that bend with the direction, and that drift from pose to pose, shape (R,) each.

    A quadratic or a cubic term of each axis, or both; a bias that changes evenly from the first pose to the last.

    Args:
        residuals: of all poses; poses: J of each sensor, shape (R,); g: m/s^2.
    """
    spare = np.count_nonzero(residuals.weight, axis=1) - 9 - 3
    if spare.max() < FEWEST_SPARE:
        return np.full(len(spare), np.nan), np.full(len(spare), np.nan)
    f, w = residuals.force, residuals.weight
    # Unit directions in the nine as in the patterns: with the length of f in one of them alone, noise is a pattern.
    u, e = unit(f), (g * g - np.sum(f * f, axis=2)) / (2.0 * g)
    rows = design(u)
    cofactor = _cofactor((rows * w[..., None]).swapaxes(1, 2) @ rows)
    time = (residuals.pose / np.maximum(poses[:, None] - 1, 1))[..., None]
    kinds = (u**3, u**4, np.concatenate([u**3, u**4], axis=2), time * u)
    *bends, drift = (pattern_chance(e, rows, w, cofactor, columns, g) for columns in kinds)
    return np.minimum(len(bends) * np.fmin.reduce(bends), 1.0), drift  # Bonferroni


def pattern_chance(e: Float, rows: Float, w: Float, cofactor: Float, columns: Float, g: float) -> Float:
    """Return the p-values of a pattern in the residuals, shape (R,), NaN where the poses cannot tell.

    The F test of a fit with q columns more, B: those of an error that the linear, constant model does not have. Its
    normal matrix is that of B less what the nine take of it, B^T W B - B^T W A C A^T W B.

    Args:
        e: residuals, m/s^2, w: weights, shape (R, J); rows: A, shape (R, J, 9); cofactor: C, shape (R, 9, 9), NaN
            where the poses do not determine the sensor.
        columns: B, shape (R, J, q); g: m/s^2.
    """
    q = columns.shape[2]
    chance, spare = np.full(len(e), np.nan), np.count_nonzero(w, axis=1) - 9 - q
    total = np.sum(w * e * e, axis=1)
    at = np.flatnonzero(
        (spare >= FEWEST_SPARE) & (total > (NO_NOISE * g) ** 2) & ~np.isnan(cofactor[:, 0, 0])
    )
    if not len(at):
        return chance
    A, B, C, e, w = rows[at], columns[at] * np.sqrt(w[at])[..., None], cofactor[at], e[at], w[at]
    A, e = A * np.sqrt(w)[..., None], e * np.sqrt(w)
    taken = C @ (A.swapaxes(1, 2) @ np.concatenate([B, e[..., None]], axis=2))
    left = np.concatenate([B, e[..., None]], axis=2) - A @ taken  # of B and e, what the nine do not explain
    whole = np.sum(B * B, axis=(1, 2))
    normal = left[..., :q].swapaxes(1, 2) @ left[..., :q]
    inverse = np.linalg.inv(normal + RIDGE * whole[:, None, None] * np.eye(q))
    open_to = np.einsum("rqq->r", inverse) * whole
    known = (open_to > 0) & (open_to < 1.0 / OPEN_DIRECTION)
    part = left[..., :q].swapaxes(1, 2) @ left[..., q:]
    gain = np.sum(part * (inverse @ part), axis=(1, 2))
    noise = np.maximum(np.sum(left[..., q] ** 2, axis=1) - gain, 1e-300) / spare[at]
    ratio = np.clip(gain / q / noise, 1e-12, 1e12)
    told = at[known]
    chance[told] = f_chance(ratio[known], np.full(len(told), float(q)), spare[told].astype(float))
    return chance


def leave_out(
    force: Float, weights: Float, pose: Int, g: float, held: Bool | None = None
) -> tuple[Float, Float]:
    """Fit S sensors anew, each without one of its poses: what a pose looks like to the others.

    The formula of linear regression subtracts a pose's part from the sum of squares. A pose that is wrong by several
    per cent bends the fit so far that its part comes out larger than the whole, and the formula has nothing to say.

    Args:
        force: specific force by the fit with all poses, m/s^2, shape (S, J, 3).
        weights: of the poses, 0 for none, shape (S, J).
        pose: which one to leave out, shape (S,).
        g: local gravity, m/s^2.
        held: which of the nine parameters are not estimated, shape (9,).

    Returns:
        |f| - g of the pose left out over its standard deviation, from the residuals of the others, and |f| - g itself,
        m/s^2, shape (S,) both; NaN where the others do not determine the sensor, or where too few are left.
    """
    free = np.arange(9) if held is None else np.flatnonzero(~held)
    sensors = np.arange(len(pose))
    kept = weights.copy()
    kept[sensors, pose] = 0.0
    with np.errstate(all="ignore"):
        going = np.ones((len(pose), 1), dtype=bool)
        for _ in range(STEPS):
            e, rows, cofactor = _linearised(force, kept, g, free)
            step = np.zeros((len(pose), 9))
            step[:, free] = -(cofactor @ (rows.swapaxes(1, 2) @ (kept * e)[..., None]))[..., 0]
            force = _moved(
                force, np.where(going, step, 0.0), g
            )  # each comes to the same point in any company
            going &= (np.abs(step) > SETTLED * g).any(axis=1, keepdims=True)
            if not going.any():
                break
        e, rows, cofactor = _linearised(force, kept, g, free)
        freedom = np.count_nonzero(kept, axis=1) - len(free)
        variance = np.sum(kept * e * e, axis=1) / np.where(freedom > 0, freedom, np.nan)
        at = rows[sensors, pose]
        spread = 1.0 / weights[sensors, pose] + np.sum((cofactor @ at[..., None])[..., 0] * at, axis=1)
        error = np.linalg.norm(force[sensors, pose], axis=1) - g
        return -e[sensors, pose] / np.sqrt(variance * spread), error


def _linearised(force: Float, weights: Float, g: float, free: Int) -> tuple[Float, Float, Float]:
    """Return e = (g^2 - |f|^2) / 2g, its derivatives by the changes of `_moved`, and the inverse of their products.

    Shapes (S, J), (S, J, p) and (S, p, p) for the p parameters at `free`; NaN where the weighted poses do not determine
    a sensor.
    """
    e = (g * g - np.sum(force * force, axis=2)) / (2.0 * g)
    rows = design(force / g)[..., free]
    return e, rows, _cofactor((rows * weights[..., None]).swapaxes(1, 2) @ rows)


def _cofactor(normal: Float) -> Float:
    """Return the inverses of normal matrices, shape (S, p, p), NaN where they are singular."""
    size = np.einsum("spp->s", normal)
    inverse = near_inverse(np.where(np.isfinite(size)[:, None, None], normal, np.eye(normal.shape[1])))
    spread = np.einsum("spp->s", inverse) * size
    known = (spread > 0) & (spread < 1.0 / LEAST_ROOM)
    return np.where(known[:, None, None], inverse, np.nan)


def _moved(force: Float, step: Float, g: float) -> Float:
    """Return (I + E) f - b, with the lower triangle E (times g) and b from a step, m/s^2, shape (S, 9)."""
    E = np.zeros((len(step), 3, 3))
    for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
        E[:, i, j] = step[:, p] / g
    return np.asarray(force + force @ E.swapaxes(1, 2) - step[:, None, 6:])
