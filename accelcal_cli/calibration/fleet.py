"""Thousands of sensors at once: everything that `calibrate` does for one, for batches of them.

Each sensor goes its own road in the same company of arrays: its box, its start and its steps are those that it would
have alone, with Levenberg-Marquardt as the optimizer. Where the poses determine the ellipsoid, the start is the least
cost itself (calibration.ellipsoid), and the solver confirms it with a step.

Weights, residuals and reasons of a batch of sensors, pose by pose.

The cautions of many sensors: arrays tell which have any, and those are put into the words of `calibrate`.

Sensors that stand out from their fleet: parameters far from all others', or more noise than theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.assess import (
    LARGE,
    MORE_THAN_NOISE,
    NOISE_BIAS,
    at_edge,
    cautions,
    edge_names,
    final_verdict,
    odd_gravity,
    reasons_of,
)
from accelcal_cli.calibration.box import Start, search_box, taken_for
from accelcal_cli.calibration.calibrate import assemble
from accelcal_cli.calibration.distributions import chi_square_chance, student_chance
from accelcal_cli.calibration.fit import (
    KEPT,
    KEPT_WORST,
    NO_NOISE,
    beyond_chance,
    covariance,
    is_suspect,
    leave_out,
    leverages,
    propagate,
    room_of,
    studentise,
)
from accelcal_cli.calibration.observability import (
    MISALIGNMENT,
    PARAMETERS,
    SCALE,
    Observabilities,
    information,
)
from accelcal_cli.calibration.problem import ROWS_COLUMNS, Loetters, compress_each, least_squares
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.search import Solution, polish
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.weights import NORMAL_MAD, beyond_scatter, explained
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.io.fleet import Batch, FleetReadings
from accelcal_cli.io.screening import RAW_ROWS, may_be_doubtful
from accelcal_cli.optimization.minimize import Run, minimize
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor.model import to_gauge

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


def fleet_cautions(
    readings: FleetReadings,
    batch: Batch,
    settings: Settings,
    s: Float,
    covariance: Float,
    fits: PoseFits,
) -> np.ndarray:
    """Return the cautions of each sensor of a batch in one text, empty where there are none, shape (R,).

    Args:
        readings, batch, settings: as they are calibrated.
        s: standard deviation of a pose, m/s^2, shape (R,); covariance: of the nine, (m/s^2)^2, shape (R, 9, 9).
        fits: their residuals.
    """
    g = settings.g
    sigma = np.sqrt(np.einsum("rpp->rp", covariance)[:, SCALE]).max(axis=1) / g
    suspect = (
        (s > LARGE * g) | (NOISE_BIAS * (s / g) ** 2 > sigma) | (s**2 >= MORE_THAN_NOISE**2 * fits.explained)
    )
    suspect |= (batch.count >= RAW_ROWS) | np.array([bool(names) for names in fits.outlying])
    suspect |= may_be_doubtful(batch.output, batch.count) | bool(odd_gravity(g))
    words = np.full(len(s), "", dtype=object)
    for at in np.flatnonzero(suspect).tolist():
        noise = beyond_scatter(float(s[at]), float(fits.explained[at]), int(batch.count[at]) - 9)
        own = cautions(
            settings,
            1,
            0.0,
            float(s[at]),
            int(batch.count[at]) - 9,
            float(sigma[at]),
            noise,
            fits.outlying[at],
        )
        words[at] = " ".join((*readings.cautions(batch, at), *own))
    return words


LEVEL = 0.01
"""Chance of naming a sensor where none stands out (Bonferroni over sensors and quantities)."""

FEWEST = 10
"""Sensors that make a fleet to stand out from."""

EFFICIENCY = 0.37
"""A median absolute deviation of R values is worth the standard deviation of so many times R."""

MOST_FREEDOM = 1000
"""From here on Student's distribution is the normal one to any digit that matters."""


@dataclass(frozen=True)
class Quantity:
    """One quantity of every sensor.

    Attributes:
        name, unit, format: as it is shown; values: shape (R,).
        gain: its error over the noise of a pose in m/s^2, shape (R,); None where the poses do not decide it.
    """

    name: str
    unit: str
    format: str
    values: Float
    gain: Float | None = None


@dataclass(frozen=True)
class Standout:
    """A sensor that stands out: its place in the fleet, the quantity, value and median, and robust z; None for s."""

    at: int
    quantity: Quantity
    value: float
    middle: float
    z: float | None


def parameters(fleet: Fleet, g: float) -> list[Quantity]:
    """Return the nine parameters as an engineer takes them, gauge `lower`: K_ii, K_ij / K_ii, D_i / K_ii."""
    per_unit = f"units per {'g' if g == 1.0 else 'm/s^2'}"
    K, dop = fleet.lower, fleet.dop / g
    scale = np.einsum("rii->ri", K)
    mrad, micro_g = units.MRAD, units.MICRO_G
    return [
        *(
            Quantity(f"scale factor {a}", per_unit, ".7g", scale[:, i], scale[:, i] * dop[:, i])
            for i, a in enumerate("xyz")
        ),
        *(
            Quantity(name, "mrad", ".3f", K[:, i, j] / scale[:, i] * mrad, dop[:, p] * mrad)
            for p, name, (i, j) in zip((3, 4, 5), PARAMETERS[MISALIGNMENT], ROWS_COLUMNS[3:6], strict=True)
        ),
        *(
            Quantity(f"bias {a}", "micro-g", ",.1f", bias * micro_g, dop[:, 6 + i] * micro_g)
            for i, (a, bias) in enumerate(zip("xyz", (fleet.D_a / scale / g).T, strict=True))
        ),
    ]


def noise(fleet: Fleet, g: float) -> Quantity:
    """Return the noise of a pose of each sensor."""
    return Quantity("noise of a pose, s", "g" if g == 1.0 else "m/s^2", ".3g", fleet.s)


def standouts(fleet: Fleet, g: float) -> list[Standout]:
    """Return the sensors that stand out from those whose verdict is good or weak, farthest first, the noisy ones last.

    Parameters by their distance from the median over 1.4826 times the median absolute deviation, under Student's
    distribution; s by chi-square against the noise that the fleet shares. A sensor whose poses tell less of a parameter
    than most others' do may be farther off.
    """
    known = np.flatnonzero(fleet.determined)
    if len(known) < FEWEST:
        return []
    quantities = parameters(fleet, g)
    tests = len(known) * (len(quantities) + 1)
    found = []
    pose = np.fmax(
        fleet.s[known], np.sqrt(_shared_variance(fleet))
    )  # few poses estimate it too small at times
    for quantity in quantities:
        values = quantity.values[known]
        middle = float(np.median(values))
        spread = NORMAL_MAD * float(np.median(np.abs(values - middle)))
        if spread <= 1e-9 * float(np.abs(values).max()):
            continue  # all alike, but for rounding
        own = 0.0 if quantity.gain is None else (pose * quantity.gain[known]) ** 2
        z = (values - middle) / np.sqrt(spread**2 + np.maximum(own - np.median(own), 0.0))
        far = np.flatnonzero(np.abs(z) > 3.0)
        freedom = np.full(len(far), min(MOST_FREEDOM, int(EFFICIENCY * len(known))))
        far = far[student_chance(np.abs(z[far]), freedom) * tests < LEVEL]
        found += [Standout(int(known[k]), quantity, float(values[k]), middle, float(z[k])) for k in far]
    found.sort(key=lambda one: -abs(one.z or 0.0))
    return found + _noisy(fleet, g, tests)


def _shared_variance(fleet: Fleet) -> float:
    """Return the variance of a pose that the sensors share, (m/s^2)^2, by the median; 0 of too few sensors."""
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    if len(known) < FEWEST:
        return 0.0
    # The median of chi-square with n degrees of freedom is n (1 - 2 / 9n)^3.
    middle = (1.0 - 2.0 / (9.0 * (fleet.poses[known] - 9))) ** 3
    return float(np.median(fleet.s[known] ** 2 / middle))


def _noisy(fleet: Fleet, g: float, tests: int) -> list[Standout]:
    """Return the sensors whose s is beyond chance above what the fleet shares, worst first."""
    shared = _shared_variance(fleet)
    if shared <= (NO_NOISE * g) ** 2:
        return []
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    freedom = fleet.poses[known] - 9
    x = freedom * fleet.s[known] ** 2 / shared
    far = np.flatnonzero(x > freedom + 3.0 * np.sqrt(2.0 * freedom))
    far = far[chi_square_chance(x[far], freedom[far]) * tests < LEVEL]
    far = known[far[np.argsort(-x[far])]]
    quantity, middle = noise(fleet, g), float(np.sqrt(shared))
    return [Standout(int(at), quantity, float(fleet.s[at]), middle, None) for at in far]
