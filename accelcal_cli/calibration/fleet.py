"""Thousands of sensors at once: everything that `calibrate` does for one, for batches of them.

Each sensor goes its own road in the same company of arrays: its box, its start and its steps are those that it would
have alone, with Levenberg-Marquardt as the optimizer. Where the poses determine the ellipsoid, the start is the least
cost itself (calibration.ellipsoid), and the solver confirms it with a step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np

from accelcal_cli.calibration.assemble import assemble
from accelcal_cli.calibration.compress import compress_each
from accelcal_cli.calibration.ellipsoid import least_squares
from accelcal_cli.calibration.fleet_cautions import fleet_cautions
from accelcal_cli.calibration.fleet_fit import pose_weights, reasons, residuals
from accelcal_cli.calibration.lotters import Loetters
from accelcal_cli.calibration.nominal import Start, search_box
from accelcal_cli.calibration.quality import Observabilities, information
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.search import Solution, polish
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.sigma import covariance, propagate
from accelcal_cli.calibration.verdict import at_edge, final_verdict
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimizers.minimize import Run, minimize
from accelcal_cli.sensor.fleet import Batch, FleetReadings
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.streams import Bool, Float, Int

FAILED = "failed"
"""Verdict on a sensor whose readings say nothing: a single pose, or all of them equal."""


@dataclass(frozen=True)
class Fleet:
    """R calibrated sensors; units as in `Calibration`, NaN for a sensor that failed.

    Attributes:
        number: the sensors' numbers among the readings, shape (R,); poses: J of each.
        K_a, D_a: in the gauge of the settings, shapes (R, 3, 3) and (R, 3); sigma_k, sigma_d: their one-sigma.
        lower: K_a in gauge `lower`, shape (R, 3, 3).
        dop: dilution of precision of the nine parameters, shape (R, 9).
        cost: L, (m/s^2)^4; s: standard deviation of a pose; rms, rms_before: of |f| - g; m/s^2, shape (R,).
        verdict: good, weak, undetermined or failed, shape (R,); reason: why it is not good, in sentences.
        caution: what speaks against the readings, in the sentences of `calibrate`, shape (R,).
        outlying: the poses beyond chance, in words.
    """

    number: Int
    poses: Int
    K_a: Float
    D_a: Float
    sigma_k: Float
    sigma_d: Float
    lower: Float
    dop: Float
    cost: Float
    s: Float
    rms: Float
    rms_before: Float
    verdict: np.ndarray
    reason: np.ndarray
    caution: np.ndarray
    outlying: np.ndarray

    @property
    def determined(self) -> Bool:
        """Which sensors are good or weak, shape (R,)."""
        return np.asarray((self.verdict == "good") | (self.verdict == "weak"))


def check_settings(settings: Settings) -> None:
    """Refuse what is not done for a fleet.

    Raises:
        ConfigError: a robust loss, weights "auto", known attitudes, gauge `full`, or several runs.
    """
    for key, allowed in {
        "optimizer": ("levenberg-marquardt",),
        "robust": ("none",),
        "weights": ("none", "n", "sd"),
        "attitudes": ("unknown",),
        "misalignment": (True,),
        "gauge": ("lower", "upper", "symmetric"),
        "runs": (1,),
        "polish": (True,),
    }.items():
        value = getattr(settings, key)
        if value not in allowed:
            words = ", ".join(map(str, allowed))
            raise ConfigError(
                f"{key}: {value}: a fleet goes with {words} only; calibrate this sensor by itself"
            )


def calibrate_fleet(
    readings: FleetReadings,
    settings: Settings,
    keep: Callable[[int, Calibration], None] | None = None,
) -> Fleet:
    """Calibrate every sensor of a fleet.

    Args:
        readings: static poses of R sensors.
        settings: as of one calibration with `levenberg-marquardt`; see `check_settings`.
        keep: takes the number and the whole record of each sensor that did not fail, one by one.

    Raises:
        ConfigError: settings that are not for a fleet.
        DataError: weights that a sensor's readings do not give.
    """
    check_settings(settings)
    parts = []
    for batch in readings.batches():
        useful = (batch.output.max(axis=1) > batch.output.min(axis=1)).any(axis=1)
        if not useful.all():
            parts.append(_failed(batch.take(np.flatnonzero(~useful))))
            batch = batch.take(np.flatnonzero(useful))
        if len(batch.sensors):
            parts.append(_calibrated(readings, batch, settings, keep))
    order = np.argsort(np.concatenate([part.number for part in parts]))
    return Fleet(
        **{f.name: np.concatenate([getattr(part, f.name) for part in parts])[order] for f in fields(Fleet)}
    )


def _failed(batch: Batch) -> Fleet:
    """Return the part of sensors without any information."""

    def nan(*shape: int) -> Float:
        return np.full((len(batch.sensors), *shape), np.nan)

    words = ["only one pose" if n == 1 else f"all {n} poses are equal" for n in batch.count]
    return Fleet(
        number=batch.sensors,
        poses=batch.count,
        K_a=nan(3, 3),
        D_a=nan(3),
        sigma_k=nan(3, 3),
        sigma_d=nan(3),
        lower=nan(3, 3),
        dop=nan(9),
        cost=nan(),
        s=nan(),
        rms=nan(),
        rms_before=nan(),
        verdict=np.full(len(words), FAILED, dtype=object),
        reason=np.array([f"Nothing to calibrate: {word}." for word in words], dtype=object),
        caution=np.full(len(words), "", dtype=object),
        outlying=np.full(len(words), "", dtype=object),
    )


def _calibrated(
    readings: FleetReadings,
    batch: Batch,
    settings: Settings,
    keep: Callable[[int, Calibration], None] | None,
) -> Fleet:
    """Return the part of a batch whose readings differ."""
    g = settings.g
    weights = pose_weights(readings, batch, settings)
    triangle = compress_each(batch.output, weights, batch.count)
    start = search_box(triangle, settings)
    problem = Loetters(triangle, g, start.box)
    run = _solve(problem, start, settings)
    lower, D = problem.parameters(run.x)
    seen = Observabilities.of(information(problem, run.x), batch.count)
    freedom = batch.count - 9
    variance = np.where(freedom > 0, run.cost / (4.0 * g**2) / np.maximum(freedom, 1), np.nan)
    walled = np.any(at_edge(run.x), axis=1)
    K = to_gauge(lower, settings.gauge)
    verdict = [
        final_verdict(word, bool(wall), int(left))
        for word, wall, left in zip(seen.verdicts, walled, freedom, strict=True)
    ]
    nine, s = covariance(seen, variance, walled, g), np.sqrt(variance)
    sigma_k, sigma_d = propagate(K, lower, nine, settings.gauge, g)
    fits = residuals(readings, batch, lower, D, start, seen, weights, settings)
    if keep is not None:
        for at, number in enumerate(batch.sensors.tolist()):
            own = None if weights is None else weights[at, : batch.count[at]]
            box, solution = start.take(np.array([at])), _solution(problem, run, at)
            keep(number, assemble(readings.one(batch, at), settings, box, solution, own))
    reason, dop = reasons(problem, start, run, seen, batch, verdict)
    return Fleet(
        number=batch.sensors,
        poses=batch.count,
        K_a=K,
        D_a=D,
        sigma_k=sigma_k,
        sigma_d=sigma_d,
        lower=lower,
        dop=dop,
        cost=run.cost,
        s=s,
        rms=fits.rms,
        rms_before=fits.rms_before,
        verdict=np.array(verdict, dtype=object),
        reason=reason,
        caution=fleet_cautions(readings, batch, settings, s, nine, fits),
        outlying=fits.in_words(),
    )


def _solve(problem: Loetters, start: Start, settings: Settings) -> Run:
    """Return the polished runs, one a sensor: from the least cost where readings give it, else from a search."""
    x = problem.coordinates(*_least_cost(problem))
    inside = np.isfinite(x).all(axis=1) & (np.abs(np.nan_to_num(x)) < 1.0).all(axis=1)
    closed = np.array([source != "sphere" for source in start.sources])
    searched = np.flatnonzero(~(inside & closed))
    if len(searched):
        x[searched] = minimize(
            problem.of(searched),
            settings.build_optimizer(),
            runs=[0] * len(searched),  # each of them would be run 0 of a calibration of its own
            seed=settings.seed,
            trace=False,
        ).x
    return polish(problem, np.where(np.isfinite(x), x, 0.0))


def _least_cost(problem: Loetters) -> tuple[Float, Float]:
    triangle = problem.triangle
    K, d = least_squares(triangle)
    return K * triangle.scale[:, None, None] / problem.g, d * triangle.scale[:, None] + triangle.centre


def _solution(problem: Loetters, run: Run, at: int) -> Solution:
    """Return what was found for one sensor as the solution of its own calibration."""
    index = np.array([at])
    own = Run(
        np.zeros(1, dtype=np.int64),
        run.x[index],
        run.cost[index],
        run.evaluations[index],
        run.iterations[index],
        (run.status[at],),
    )
    cost, spent = float(run.cost[at]), int(run.evaluations[at])
    return Solution(problem.of(index), own.x, own, 0, cost, spent, 1)
