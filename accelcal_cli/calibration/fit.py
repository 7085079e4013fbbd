"""Residuals pose by pose: fit, leverage, leave-one-out error, outliers.

Fits that leave one pose out: what a pose looks like to the others, without the first-order formula.

The formula of linear regression subtracts a pose's part from the sum of squares. A pose that is wrong by several per
cent bends the fit so far that its part comes out larger than the whole, and the formula has nothing to say of it.

From the noise of a pose to the one-sigma of the parameters: where it holds, and what it is in each gauge.

The nine parameters are those of `quality`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import student_chance
from accelcal_cli.calibration.observability import BIAS, Observabilities, Verdict, design
from accelcal_cli.calibration.problem import ROWS_COLUMNS
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel

KEPT = 1000
"""Poses whose residuals a result keeps one by one; of more, the worst KEPT_WORST."""

KEPT_WORST = 20

NO_NOISE = 1e-12
"""Residuals, or their standard deviation, below this part of g are rounding."""

SUSPECT = 3.0
"""Studentised residuals beyond this may be outliers: those of Student's t with any freedom are as large at least."""

BENT = 0.01
"""A residual beyond this part of g bends the fit so far that no first-order formula holds."""

OUTLIER_LEVEL = 0.01
"""Chance of naming an outlier among all poses where there is none (Bonferroni over the poses)."""


@dataclass(frozen=True, eq=False)
class PoseResiduals:
    """Residuals of chosen poses.

    Attributes:
        pose: their numbers, from 0, shape (k,).
        error, before: |f| - g after and before calibration, m/s^2, shape (k,).
        force: calibrated specific force, gauge `lower`, m/s^2, shape (k, 3).
        leverage: part of the pose's own residual that the fit absorbs, shape (k,).
        studentised: residual over its standard deviation from the other poses, shape (k,).
        left_out: |f| - g, m/s^2, that a fit without the pose would show, shape (k,), to first order.
    """

    pose: Int
    error: Float
    before: Float
    force: Float
    leverage: Float
    studentised: Float
    left_out: Float


@dataclass(frozen=True)
class Fit:
    """Sums over all poses, and the poses that are kept.

    Attributes:
        rms, rms_before: of |f| - g after and before calibration, m/s^2.
        poses: the residuals that are kept, in the order of the poses.
    """

    rms: float
    rms_before: float
    poses: PoseResiduals


def modulus_errors(readings: Readings, model: ErrorModel, g: float) -> Iterator[tuple[int, Float, Float]]:
    """Yield (first pose, e, f) block by block: e = (g^2 - |f|^2) / 2g and f in m/s^2, shapes (B,) and (B, 3)."""
    for first, block in readings.blocks():
        f = model.specific_force(block)
        yield first, (g * g - np.einsum("ij,ij->j", f.T, f.T)) / (2.0 * g), f


def square_error(e: Float, g: float) -> float:
    """Return the sum of (|f| - g)^2 in (m/s^2)^2 from e, shape (B,)."""
    error = length_error(e, g)
    return float(np.sum(error * error))


def length_error(e: Float, g: float) -> Float:
    """Return |f| - g in m/s^2 from e = (g^2 - |f|^2) / 2g, both of shape (B,)."""
    error: Float = np.sqrt(np.maximum(g * g - 2.0 * g * e, 0.0)) - g
    return error


def examine(
    readings: Readings,
    model: ErrorModel,
    before: ErrorModel,
    g: float,
    cofactor: Float,
    weights: Float | None,
    robust: Callable[[Float], Float] | None = None,
    held: Bool | None = None,
) -> Fit:
    """Return the fit of a model in gauge `lower`, pose by pose.

    Args:
        readings: J poses.
        model: the calibrated sensor, gauge `lower`; before: what the readings were taken for without it.
        g: local gravity, m/s^2.
        cofactor: (J^T W J)^-1, shape (9, 9).
        weights: shape (J,) or None.
        robust: the weight that a robust fit gave a weighted residual, m/s^2; None after least squares.
        held: which of the nine parameters were not estimated, shape (9,).
    """
    after_sum, before_sum, weighted_sum = 0.0, 0.0, 0.0
    parts: list[tuple[Int, Float, Float, Float, Float]] = []
    uncalibrated = modulus_errors(readings, before, g)
    for (first, e, f), (_, e_before, _) in zip(modulus_errors(readings, model, g), uncalibrated, strict=True):
        w = np.ones(len(e)) if weights is None else weights[first : first + len(e)]
        if robust is not None:
            w = w * robust(np.sqrt(w) * e)
        after_sum += square_error(e, g)
        before_sum += square_error(e_before, g)
        scaled = np.sqrt(w) * e
        weighted_sum += float(np.sum(scaled * scaled))
        kept = _worst(scaled) if readings.poses > KEPT else np.arange(len(e))
        parts.append((first + kept, scaled[kept], w[kept], f[kept], e_before[kept]))
    pose, scaled, w, f, before_e = (np.concatenate(column) for column in zip(*parts, strict=True))
    if readings.poses > KEPT:
        kept = np.sort(_worst(scaled))
        pose, scaled, w, f, before_e = (column[kept] for column in (pose, scaled, w, f, before_e))
    residuals = _judge(pose, scaled, w, f, before_e, g, cofactor, weighted_sum, readings.poses, held)
    return Fit(
        float(np.sqrt(after_sum / readings.poses)), float(np.sqrt(before_sum / readings.poses)), residuals
    )


def _worst(scaled: Float) -> Int:
    """Return the indices of the largest residuals, at most KEPT_WORST."""
    return np.argpartition(-np.abs(scaled), min(KEPT_WORST, len(scaled)) - 1)[:KEPT_WORST]


def _judge(
    pose: Int,
    scaled: Float,
    w: Float,
    f: Float,
    e_before: Float,
    g: float,
    cofactor: Float,
    weighted_sum: float,
    poses: int,
    held: Bool | None,
) -> PoseResiduals:
    """Return residuals with their leverage, studentised and with the pose left out.

    Studentised residuals need two degrees of freedom; `scaled` is sqrt(w) e, `weighted_sum` its squares over all poses.
    """
    freedom = poses - 9 + (0 if held is None else int(held.sum()))
    size = np.linalg.norm(f, axis=1)
    leverage = leverages(design(f / size[:, None]), w, cofactor)
    room = room_of(leverage)
    error, studentised = size - g, studentise(scaled, room, weighted_sum, freedom)
    left_out = error / room
    suspect = np.flatnonzero(is_suspect(studentised, error, freedom, g))
    if len(pose) < poses:  # of so many poses none bends the fit, unless it is beyond all measure
        blown = suspect[np.isnan(studentised[suspect])]
        studentised[blown] = np.copysign(np.inf, error[blown])
    elif len(suspect):
        alone = leave_out(
            np.broadcast_to(f, (len(suspect), *f.shape)), np.tile(w, (len(suspect), 1)), suspect, g, held
        )
        studentised[suspect], left_out[suspect] = alone.studentised, alone.error
    return PoseResiduals(pose, error, length_error(e_before, g), f, leverage, studentised, left_out)


def is_suspect(studentised: Float, error: Float, freedom: Int | int, g: float) -> Bool:
    """Return which poses may be outliers, or bend the fit too far for the first-order formula, shape (..., J).

    Args:
        studentised: by that formula, NaN where it has nothing to say; error: |f| - g, m/s^2.
        freedom: J - 9, a scalar or of shape (..., 1).
    """
    large = ~(np.abs(studentised) <= SUSPECT) & (np.abs(error) > NO_NOISE * g)
    return np.asarray((large | (np.abs(error) > BENT * g)) & (np.asarray(freedom) >= 2))


def leverages(rows: Float, w: Float, cofactor: Float) -> Float:
    """Return the part of each pose's own residual that the fit absorbs, shape (..., J).

    Args:
        rows: their design, shape (..., J, 9); w: their weights, shape (..., J).
        cofactor: (J^T W J)^-1, shape (..., 9, 9).
    """
    leverage: Float = np.minimum(w * np.sum((rows @ cofactor) * rows, axis=-1), 1.0)
    return leverage


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
    found: Float = -scaled / deviation
    return found


def outliers(residuals: PoseResiduals, poses: int, freedom: int) -> Int:
    """Return the pose numbers whose studentised residual is beyond chance (Student t, Bonferroni)."""
    if freedom < 2:
        return residuals.pose[:0]
    size = np.abs(residuals.studentised)
    beyond = beyond_chance(size, np.full(size.shape, poses), np.full(size.shape, freedom))
    named: Int = residuals.pose[beyond]
    return named


def beyond_chance(size: Float, poses: Int, freedom: Int) -> Bool:
    """Return which studentised residuals are so large that none of a sensor's would be by chance, same shape.

    Args:
        size: absolute values, NaN for none; poses, freedom: of their sensor, same shape.
    """
    found: Bool = np.asarray(size > SUSPECT)
    suspect = np.flatnonzero(found & (freedom >= 2))
    chance = poses.flat[suspect] * student_chance(size.flat[suspect], freedom.flat[suspect] - 1)
    found[...] = False
    found.flat[suspect[chance < OUTLIER_LEVEL]] = True
    return found


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


def covariance(seen: Observabilities, variance: Float, walled: Bool, g: float) -> Float:
    """Return the covariance of the nine parameters, (m/s^2)^2, shape (R, 9, 9); NaN where it does not hold.

    Args:
        seen: what the poses of R sensors say.
        variance: of one pose's modulus, (m/s^2)^2, shape (R,).
        walled: whose search stopped at a wall of its box, shape (R,): that is not the least-squares answer.
        g: local gravity, m/s^2.
    """
    held = firm(seen.dop, seen.verdicts, np.sqrt(variance), g) & ~walled[:, None]
    return np.where(held[:, :, None] & held[:, None], variance[:, None, None] * seen.cofactor, np.nan)


def firm(dop: Float, verdict: Sequence[Verdict], s: Float, g: float) -> Bool:
    """Return which of the nine parameters of R sensors the linear covariance holds for, shape (R, 9).

    Poses that leave a direction open leave a valley of almost equal cost, and the valley bends: an error d along
    it moves every other parameter by about d^2 / 2g. Where that is more than their own error, or d is without
    bound, the covariance tells less than what chance decides.

    Args:
        dop: dilution of precision, shape (R, 9); verdict: on the poses, R of them.
        s: standard deviation of one pose's modulus, m/s^2, shape (R,); g: local gravity, m/s^2.
    """
    bounded = np.isfinite(dop).all(axis=1, keepdims=True)
    error = s[:, None] * np.where(bounded, dop, 0.0)
    bend = error.max(axis=1, keepdims=True) ** 2 / (2.0 * g)
    poor = np.array([word == "undetermined" for word in verdict], dtype=bool)
    return np.where(poor[:, None], bounded & (error >= bend), True)


def propagate(K: Float, K_lower: Float, covariance: Float, gauge: str, g: float) -> tuple[Float, Float]:
    """Return one-sigma of K_a in a gauge, shape (..., 3, 3), and of D_a, shape (..., 3).

    Args:
        K: K_a in `gauge`, shape (..., 3, 3); K_lower: the same sensors in gauge `lower`.
        covariance: of the nine parameters, (m/s^2)^2, shape (..., 9, 9).
        gauge: `lower`, `upper` or `symmetric`; in `full` the free rotation moves every entry of K_a, the diagonal to
            second order, and they come out as NaN.
        g: local gravity, m/s^2.
    """
    variance = np.einsum("...pp->...p", covariance)
    sigma_D = np.sqrt(variance[..., BIAS]) * np.einsum("...ii->...i", K_lower)
    if gauge == "full":
        return np.full(K.shape, np.nan), sigma_D
    chain = gauge_chain(K, K_lower, gauge, g)
    lost = np.isnan(variance[..., :6])
    square = np.einsum("...ip,...pq,...iq->...i", chain, np.nan_to_num(covariance[..., :6, :6]), chain)
    size = np.abs(chain)
    felt = size > 1e-9 * size.max(axis=(-1, -2), keepdims=True)
    touched = (felt & lost[..., None, :]).any(axis=-1)
    sigma_K = np.where(touched, np.nan, np.sqrt(np.maximum(square, 0.0))).reshape(K.shape)
    exact = {"lower": np.triu(np.ones((3, 3)), 1), "upper": np.tril(np.ones((3, 3)), -1)}
    # A zero of the gauge has no error.
    return np.where(exact.get(gauge, np.zeros((3, 3))), 0.0, sigma_K), sigma_D


def gauge_chain(K: Float, K_lower: Float, gauge: str, g: float) -> Float:
    """Return d K / d parameters, shape (..., 9, 6): entries of K_a in a gauge by the first six of the nine parameters.

    A change E of the inverse matrix in gauge `lower` moves K by -K (R E R^T - W), R = K^-1 K_lower, where the
    small rotation W (skew) is the one that keeps K in its gauge: three linear conditions. In `full`, which has none,
    W leaves the body frame unturned.
    """
    R = np.linalg.solve(K, K_lower)
    turned = [K @ _skew(axis) for axis in np.eye(3)]
    turns = np.stack([_conditions(change, gauge) for change in turned], axis=-1)
    columns = []
    for i, j in ROWS_COLUMNS[:6]:
        moved = R[..., :, i, None] * R[..., None, :, j] / g  # R E R^T
        change = -0.5 * K @ (moved + moved.swapaxes(-1, -2))
        if gauge != "full":
            angle = np.linalg.solve(turns, -_conditions(change, gauge)[..., None])
            for k, turn in enumerate(turned):
                change = change + angle[..., k, :, None] * turn
        columns.append(change.reshape(*K.shape[:-2], 9))
    return np.stack(columns, axis=-1)


def _conditions(change: Float, gauge: str) -> Float:
    """Return what must vanish for a change of K to stay in the gauge, shape (..., 3)."""
    above, below = change[..., [0, 0, 1], [1, 2, 2]], change[..., [1, 2, 2], [0, 0, 1]]
    return {"lower": above, "upper": below}.get(gauge, above - below)


def _skew(axis: Float) -> Float:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
