"""Residuals pose by pose: fit, leverage, leave-one-out error, outliers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.chances import student_chance
from accelcal_cli.calibration.left_out import leave_out
from accelcal_cli.calibration.quality import design
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Bool, Float, Int

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
