"""Residuals pose by pose: fit, leverage, leave-one-out error, outliers; and the robust weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.quality import design
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float, Int

KEPT = 1000
"""Poses whose residuals a result keeps one by one; of more, the worst KEPT_WORST."""

KEPT_WORST = 20

OUTLIER_LEVEL = 0.01
"""Chance of naming an outlier among all poses where there is none (Bonferroni over the poses)."""


@dataclass(frozen=True)
class PoseResiduals:
    """Residuals of chosen poses.

    Attributes:
        pose: their numbers, from 0, shape (k,).
        error: |f| - g, m/s^2, shape (k,).
        leverage: part of the pose's own residual that the fit absorbs, shape (k,).
        studentised: residual over its standard deviation from the other poses, shape (k,).
        left_out: |f| - g, m/s^2, that a fit without the pose would show, shape (k,), to first order.
    """

    pose: Int
    error: Float
    leverage: Float
    studentised: Float
    left_out: Float


@dataclass(frozen=True)
class Fit:
    """Sums over all poses.

    Attributes:
        rms: of |f| - g, m/s^2.
        poses: the residuals that are kept, in the order of the poses.
    """

    rms: float
    poses: PoseResiduals


def rms_error(readings: Readings, model: ErrorModel, g: float) -> float:
    """Return the rms of |f| - g over all poses, m/s^2."""
    total = 0.0
    for _, block in readings.blocks():
        total += float(np.sum((np.linalg.norm(model.specific_force(block), axis=1) - g) ** 2))
    return float(np.sqrt(total / readings.poses))


def modulus_errors(readings: Readings, model: ErrorModel, g: float) -> Iterator[tuple[int, Float, Float]]:
    """Yield (first pose, e, u) block by block: e = (g^2 - |f|^2) / 2g, m/s^2, and u = f / |f|, shape (B, 3)."""
    for first, block in readings.blocks():
        f = model.specific_force(block)
        square = np.einsum("ji,ji->j", f, f)
        yield first, (g * g - square) / (2.0 * g), f / np.sqrt(square)[:, None]


def examine(
    readings: Readings,
    model: ErrorModel,
    g: float,
    cofactor: Float,
    weights: Float | None,
    freedom: int,
    robust: Callable[[Float], Float] | None = None,
) -> Fit:
    """Return the fit of a model in gauge `lower`, pose by pose.

    Args:
        readings: J poses.
        model: the calibrated sensor, gauge `lower`.
        g: local gravity, m/s^2.
        cofactor: (J^T W J)^-1, shape (9, 9).
        weights: shape (J,) or None.
        freedom: J - 9; studentised residuals need at least 2.
        robust: the weight that a robust fit gave a weighted residual, m/s^2; None after least squares.
    """
    square_sum, weighted_sum = 0.0, 0.0
    parts: list[tuple[Int, Float, Float, Float]] = []
    for first, e, u in modulus_errors(readings, model, g):
        w = np.ones(len(e)) if weights is None else weights[first : first + len(e)]
        if robust is not None:
            w = w * robust(np.sqrt(w) * e)
        rows = design(u)
        leverage = np.minimum(w * np.einsum("jp,pq,jq->j", rows, cofactor, rows), 1.0)
        error = np.sqrt(np.maximum(g * g - 2.0 * g * e, 0.0)) - g
        square_sum += float(np.sum(error**2))
        weighted_sum += float(np.sum(w * e**2))
        parts.append(_keep(np.arange(first, first + len(e)), error, leverage, np.sqrt(w) * e, readings.poses))
    pose, error, leverage, scaled = (np.concatenate(column) for column in zip(*parts, strict=True))
    if readings.poses > KEPT:
        worst = np.sort(np.argsort(-np.abs(scaled), kind="stable")[:KEPT_WORST])
        pose, error, leverage, scaled = pose[worst], error[worst], leverage[worst], scaled[worst]
    room = 1.0 - leverage
    # A pose that the fit follows completely (leverage 1) has no error of its own to judge it by.
    own = np.where(room > 1e-9, room, np.nan)
    if freedom >= 2:
        others = np.maximum(weighted_sum - scaled**2 / own, 0.0) / (freedom - 1)
        studentised = scaled / np.sqrt(np.where(others > 0, others, np.nan) * own)
    else:
        studentised = np.full(len(pose), np.nan)
    return Fit(
        float(np.sqrt(square_sum / readings.poses)),
        PoseResiduals(pose, error, leverage, -studentised, error / own),
    )


def outliers(residuals: PoseResiduals, poses: int, freedom: int) -> Int:
    """Return the pose numbers whose studentised residual is beyond chance (Student t, Bonferroni)."""
    if freedom < 2:
        return residuals.pose[:0]
    size = np.abs(residuals.studentised)
    # Student's t has heavier tails than any bound of 3, so most fits need no quantile and no scipy.
    suspect = size > 3.0
    if not suspect.any():
        return residuals.pose[:0]
    from scipy.special import stdtr

    chance = 2.0 * poses * stdtr(freedom - 1, -size)
    named: Int = residuals.pose[suspect & (chance < OUTLIER_LEVEL)]
    return named


def _keep(
    pose: Int, error: Float, leverage: Float, scaled: Float, poses: int
) -> tuple[Int, Float, Float, Float]:
    if poses > KEPT and len(pose) > KEPT_WORST:
        worst = np.argpartition(-np.abs(scaled), KEPT_WORST)[:KEPT_WORST]
        return pose[worst], error[worst], leverage[worst], scaled[worst]
    return pose, error, leverage, scaled
