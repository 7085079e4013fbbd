"""What keeps a verification from telling: noise that hides a change, and readings that are doubtful themselves."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.cautions import is_large, large_residuals, not_fitting
from accelcal_cli.calibration.chances import Pair
from accelcal_cli.calibration.quality import design
from accelcal_cli.calibration.residuals import (
    beyond_chance,
    leverages,
    modulus_errors,
    room_of,
    studentise,
)
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.shift import Shift
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float

NOISIER, SURELY = 3.0, 1e-4
"""New readings of so many times the noise of the old, and by chance this rarely, hide what the result would show. The
chance is so small that sensors read with equal noise keep their verdict. Where noise hides changes, only one that is
as certain is called a change: the level does not hold between noises that differ much."""

FEW, USUAL = 0.25, 2.0
"""Poses off the result are wrong themselves when they are at most this part of all, and half of all are within so many
sigma of it; else it is rather the sensor, or the noise of all."""


def doubts(old: Calibration, pair: Pair, readings: Readings) -> tuple[str, ...]:
    """Return why new readings that show no change do not show that there is none, in sentences."""
    lines = []
    if readings.cautions:
        lines.append(
            "The new readings are doubtful themselves, as the cautions say: what they differ by says little of the "
            "sensor."
        )
    if is_large(old.s, old.g, old.freedom):
        lines.append(
            f"One pose of the result itself errs by {old.s / old.g:.2%} of g, which hides any ordinary change: "
            "calibrate anew first."
        )
    variance, freedom = pair.b.variance, pair.b.freedom
    noisier = variance > NOISIER**2 * pair.a.variance and pair.noise_chance() < SURELY
    if freedom > 0 and (noisier or is_large(float(np.sqrt(variance)), old.g, freedom)):
        lines.append(
            "A change that the result would show is hidden in the noise of the new readings: measure again with the "
            "care of the calibration, each pose at rest and averaged."
        )
    return tuple(lines)


def cautions(old: Calibration, found: Shift, pair: Pair, readings: Readings, verdict: str) -> tuple[str, ...]:
    """Return what speaks against the new readings, in sentences, as `calibrate` would say it of them.

    Few poses hide the one among them that is wrong: where the verdict is inconclusive the result helps to find it.
    """
    s = float(np.sqrt(pair.b.variance)) if pair.b.freedom > 0 else float("nan")
    off = _outlying(found, pair, readings, old.g)
    if verdict == "inconclusive":
        off = sorted({*off, *_few_off(old, readings)})
    return (
        *readings.cautions,
        *large_residuals(s, old.g, pair.b.freedom),
        *not_fitting([readings.where(j) for j in off], pair.b.freedom),
    )


def _outlying(found: Shift, pair: Pair, readings: Readings, g: float) -> list[int]:
    """Return the numbers of the poses that do not fit what the others say, by Student's t as in a calibration."""
    freedom = pair.b.freedom
    if freedom < 2:
        return []
    numbers: list[int] = []
    for first, e, f in modulus_errors(readings, found.model, g):
        room = room_of(leverages(_rows(f), np.ones(len(e)), found.cofactor))
        left = e + design(f / g) @ found.step
        numbers += _beyond(
            first, studentise(left, room, freedom * pair.b.variance, freedom), readings, freedom
        )
    return numbers


def _few_off(old: Calibration, readings: Readings) -> list[int]:
    """Return the numbers of the poses beyond chance off the result, if the others, most of them, are not."""
    cofactor = old.covariance / old.s**2
    parts = []
    for _, e, f in modulus_errors(readings, old.model.in_gauge("lower"), old.g):
        rows = _rows(f)
        parts.append(e / (old.s * np.sqrt(1.0 + np.sum((rows @ cofactor) * rows, axis=1))))
    t = np.concatenate(parts)
    if np.median(np.abs(t)) > USUAL:
        return []
    numbers = _beyond(0, t, readings, old.freedom + 1)
    return numbers if len(numbers) <= FEW * readings.poses else []


def _rows(f: Float) -> Float:
    """Return the design of poses by the directions of their force, shape (B, 9)."""
    return design(f / np.linalg.norm(f, axis=1, keepdims=True))


def _beyond(first: int, t: Float, readings: Readings, freedom: int) -> list[int]:
    """Return the numbers of the poses of a block whose studentised residual, shape (B,), is beyond chance."""
    beyond = beyond_chance(np.abs(t), np.full(len(t), readings.poses), np.full(len(t), freedom))
    found: list[int] = (first + np.flatnonzero(beyond)).tolist()
    return found
