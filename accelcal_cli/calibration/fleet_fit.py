"""Weights, residuals and reasons of a batch of sensors, pose by pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration import quality
from accelcal_cli.calibration.left_out import leave_out
from accelcal_cli.calibration.lotters import Loetters
from accelcal_cli.calibration.nominal import Start, taken_for
from accelcal_cli.calibration.quality import Observabilities
from accelcal_cli.calibration.residuals import (
    KEPT,
    KEPT_WORST,
    beyond_chance,
    is_suspect,
    leverages,
    room_of,
    studentise,
)
from accelcal_cli.calibration.scatter import explained
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.verdict import edge_names, reasons_of
from accelcal_cli.errors import DataError
from accelcal_cli.optimizers.minimize import Run
from accelcal_cli.sensor.fleet import Batch, FleetReadings
from accelcal_cli.streams import Float

NAMED = 3
"""Outlying poses of a sensor that are named one by one."""


@dataclass(frozen=True, eq=False)
class PoseFits:
    """Residuals of R sensors.

    Attributes:
        rms, rms_before: of |f| - g after and before, m/s^2, shape (R,).
        outlying: names of each sensor's poses beyond chance.
        explained: variance of a pose that the scatter within poses explains, (m/s^2)^2, shape (R,); NaN if not known.
    """

    rms: Float
    rms_before: Float
    outlying: list[list[str]]
    explained: Float

    def in_words(self) -> np.ndarray:
        """Return the outlying poses of each sensor, the first few by name, shape (R,)."""
        words = np.full(len(self.outlying), "", dtype=object)
        for at, names in enumerate(self.outlying):
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            words[at] = ", ".join(names[:NAMED]) + more
        return words


def pose_weights(readings: FleetReadings, batch: Batch, settings: Settings) -> Float | None:
    """Return the weights of the poses, mean 1 for each sensor, 0 for repetitions, shape (R, J); None for all alike."""
    real = batch.real
    if settings.weights == "none":
        return None if real.all() else real.astype(float)
    weights = np.ones(real.shape) if batch.behind is None else batch.behind
    if settings.weights == "sd":
        square = np.zeros(real.shape) if batch.scatter is None else np.mean(batch.scatter**2, axis=2)
        weights = np.divide(weights, square, out=np.full(real.shape, np.nan), where=square > 0)
    bad = (batch.behind is None) | ~(np.isfinite(weights) & (weights > 0)) & real
    if np.any(bad):
        at = int(np.argmax(np.broadcast_to(bad, real.shape).any(axis=1)))
        what = {"n": "counts", "sd": "counts and standard deviations above zero"}[settings.weights]
        raise DataError(
            f'{readings.source}: sensor "{readings.sensors[batch.sensors[at]]}": --weights {settings.weights} needs '
            f"{what} (columns n, sx, sy, sz), or at least two readings of every pose"
        )
    weights = np.where(real, weights, 0.0)
    mean: Float = weights.sum(axis=1, keepdims=True) / batch.count[:, None]
    return weights / mean


def residuals(
    readings: FleetReadings,
    batch: Batch,
    K: Float,
    D: Float,
    start: Start,
    seen: Observabilities,
    weights: Float | None,
    settings: Settings,
) -> PoseFits:
    """Return the residuals of a batch of sensors, calibrated to K, gauge `lower`, and D."""
    g, real, poses = settings.g, batch.real, batch.count
    force = (batch.output - D[:, None]) @ np.linalg.inv(K).swapaxes(1, 2)
    size = np.linalg.norm(force, axis=2)
    centre = start.box.centre
    scale, bias, _ = taken_for(centre[:, :3].mean(axis=1), centre[:, -3:], settings)
    before = np.linalg.norm((batch.output - bias[:, None]) / scale[:, None], axis=2)
    rms, rms_before = (np.sqrt(np.sum(real * (f - g) ** 2, axis=1) / poses) for f in (size, before))
    w = np.ones(real.shape) if weights is None else weights
    scaled = np.sqrt(w) * (g * g - size**2) / (2.0 * g)
    unit = force / np.where(size > 0, size, 1.0)[..., None]
    room = room_of(leverages(quality.design(unit), w, seen.cofactor))
    freedom = poses[:, None] - 9
    total = np.sum(scaled**2, axis=1, keepdims=True)
    far = np.where(real, np.abs(studentise(scaled, room, total, freedom)), np.nan)
    sensor, pose = np.nonzero(is_suspect(far, size - g, freedom, g) & real)
    far[sensor, pose] = np.abs(leave_out(force[sensor], w[sensor], pose, g).studentised)
    outlying = beyond_chance(far, *(np.broadcast_to(a, far.shape) for a in (poses[:, None], freedom)))
    names: list[list[str]] = [[] for _ in poses]
    for at in np.flatnonzero(outlying.any(axis=1)):
        found = np.flatnonzero(outlying[at])
        if poses[at] > KEPT:  # as in a single calibration
            found = np.sort(found[np.argsort(-np.abs(scaled[at, found]))[:KEPT_WORST]])
        names[at] = [readings.where(int(pose)) for pose in batch.pose[at, found]]
    return PoseFits(rms, rms_before, names, _explained(batch, unit, K))


def _explained(batch: Batch, unit: Float, K: Float) -> Float:
    """Return the variance of a pose that the scatter within poses explains, (m/s^2)^2, shape (R,), NaN if not known."""
    if batch.scatter is None or batch.behind is None:
        return np.full(len(K), np.nan)
    variance = explained(unit, batch.scatter, batch.behind, np.einsum("rii->ri", K))
    mean: Float = np.sum(np.where(batch.real, variance, 0.0), axis=1) / batch.count
    return mean


def reasons(
    problem: Loetters, start: Start, run: Run, seen: Observabilities, batch: Batch, verdict: Sequence[str]
) -> tuple[np.ndarray, Float]:
    """Return why each verdict is not good, shape (R,), and the dilution of precision that it rests on, shape (R, 9).

    Readings that fix no ellipsoid are seen from the nearest sphere.
    """
    words, dop = np.full(len(verdict), "", dtype=object), seen.dop.copy()
    index = np.flatnonzero([word != "good" for word in verdict])
    if not len(index):
        return words, dop
    middle = np.zeros((len(index), problem.unknowns))
    sphere = Observabilities.of(quality.information(problem.of(index), middle), batch.count[index])
    for k, at in enumerate(index):
        first = sphere.one(k)
        round_ = start.sources[at] == "sphere" and first.verdict == "undetermined"
        lines = reasons_of(
            first if round_ else seen.one(int(at)), (), edge_names(run.x[at]), int(batch.count[at]) - 9
        )
        words[at] = " ".join(lines)
        if round_:
            dop[at] = first.dop
    return words, dop
