"""What new readings say of the nine parameters of a result, and with which noise.

They are weighed as those of the result were, by the functions that calibrated it, and brought to its temperature. Where
they determine all parameters they are fitted anew from those of the result, else one linear step is taken in the
directions that they determine. What the result says of the noise tells what to expect of theirs.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.assess import Assessment, assess
from accelcal_cli.calibration.distributions import Noise
from accelcal_cli.calibration.fit import fit
from accelcal_cli.calibration.noise import NoiseSpread, directions, plain_spread, sandwich, scattered_spread
from accelcal_cli.calibration.observability import UNDETERMINED, design
from accelcal_cli.calibration.residuals import leverages
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import SLOPES, Search, Solution, Stated, reweight, state
from accelcal_cli.calibration.settings import BoxSettings, Nominal, Settings, Weights
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.minimize import polish
from accelcal_cli.sensor.model import ErrorModel

FARTHEST = BoxSettings(scale=0.3, misalignment=0.6, bias=1.0)
"""Box for the new parameters about the old ones."""

TOUCH = 0.1
"""A parameter is known alone when the undetermined directions have at most this part of it: the axes of a poor sensor
are not quite those of the cube that it was turned on."""

POORER: dict[Weights, Weights] = {"auto": "n", "sd": "n", "n": "none"}
"""Weights that need less of the readings."""


@dataclass(frozen=True, eq=False)
class Brought:
    """The readings as the result sees them.

    Attributes:
        readings: new readings, as they would be at the temperature of the result.
        felt: d e / d slopes of the result, shape (J, 6), where it has any and the readings have temperatures.
        notes: what is assumed, in sentences.
    """

    readings: Readings
    felt: Float | None = None
    notes: tuple[str, ...] = ()


def at_reference(old: Calibration, readings: Readings) -> Brought:
    """Return readings as they would be at the temperature of the result, as far as both are known."""
    slopes = old.temperature
    if slopes is None:
        return Brought(readings)
    degrees = readings.temperature
    if degrees is None or not np.isfinite(degrees).all():
        note = f"The new readings have no temperatures; they are assumed to be at {slopes.reference:.4g} degrees."
        return Brought(readings, notes=(note,))
    from accelcal_cli.calibration.temperature import slope_rows

    output = readings.output()
    felt = slope_rows(output, degrees, slopes, old.model.in_gauge("lower"), old.g)
    notes: tuple[str, ...] = ()
    if degrees.min() < slopes.low or degrees.max() > slopes.high:
        notes = (
            f"The new readings, at {degrees.min():.4g} to {degrees.max():.4g} degrees, go beyond the {slopes.low:.4g} "
            f"to {slopes.high:.4g} degrees of the result: how uncertain its slopes with temperature are counts there.",
        )
    return Brought(readings.with_output(slopes.at_reference(output, degrees, old.D_a)), felt, notes)


def stated_as(old: Calibration, readings: Readings) -> tuple[Stated, tuple[str, ...]]:
    """State the problem of new readings with the settings of the result, in a wide box about it, and say what differs.

    Weights `auto` rest on the error that the poses of the result share.
    """
    model, sample = old.model.in_gauge("lower"), Sample.of([readings])
    scale = np.diagonal(model.K)
    # The extent of a sphere keeps the arithmetic sound where the readings have none.
    reach = old.g * float(scale.mean())
    sample = replace(
        sample,
        lower=np.minimum(sample.lower, model.D - reach),
        upper=np.maximum(sample.upper, model.D + reach),
    )
    stated = old.settings.get("weights", "none")
    weights = cast(Weights, stated)
    while sample.without_weights(weights)[0]:
        weights = POORER[weights]
    notes: tuple[str, ...] = ()
    if weights != stated:
        told = "by their number of readings" if weights == "n" else "all alike"
        notes = (
            f"The result has weights {stated}, for which the new readings do not say enough; they are weighed {told}.",
        )
    shared = None if weights != "auto" else old.shared_noise
    settings = Settings(
        optimizer="levenberg-marquardt",
        g=old.g,
        robust=old.settings.get("robust", "none"),
        weights="sd" if shared is not None else weights,
        misalignment=not old.held.any(),
        box=FARTHEST,
        nominal=Nominal(*(cast(Any, tuple(part.tolist())) for part in (scale, model.D))),
    )
    problem = state(sample, settings)
    if shared is not None and problem.noise is not None:
        total = shared**2 + problem.noise.variance
        problem = problem.with_weights(sample.normalised(1.0 / np.maximum(total, np.finfo(float).tiny)))
    return problem, notes


@dataclass(frozen=True, eq=False)
class Shift:
    """What the new readings say of the nine parameters, relative to the old ones.

    Attributes:
        value: difference, m/s^2, shape (9,).
        covariance: of the new estimate, (m/s^2)^2, shape (9, 9).
        felt: what errors of the slopes of the result, as force, do to the new estimate, shape (9, 6); None without any.
        basis: directions that the readings determine, shape (9, r).
        known: which parameters they determine one by one, shape (9,).
        noise: variance of weight 1 of the new readings, and the degrees of freedom of `covariance`; expected: the
            variance that the result leads to expect.
        variance: of each pose by what the result says of the noise, (m/s^2)^2, shape (J,) or (1,) for all alike.
        sample: the new readings; weights: theirs, shape (J,), or None.
        model: the sensor that their residuals are seen with, gauge `lower`; step: what the residuals are still to be
            moved by, to first order, m/s^2, shape (9,): none where the model is fitted to them.
        cofactor: of the new estimate, shape (9, 9); g: local gravity of the result, m/s^2.
        assessment: of the fit, where the readings determine all parameters.
    """

    value: Float
    covariance: Float
    felt: Float | None
    basis: Float
    known: Bool
    noise: Noise
    expected: float
    variance: Float
    sample: Sample
    weights: Float | None
    model: ErrorModel
    step: Float
    cofactor: Float
    g: float
    assessment: Assessment | None = None


def shift_of(old: Calibration, stated: Stated, felt: Float | None) -> Shift:
    """Return what new readings say of the parameters: a fit where they determine all, else one linear step.

    Args:
        old: the result; stated: the problem of the new readings; felt: d e / d slopes, shape (J, 6), or None.
    """
    model, free = old.model.in_gauge("lower"), np.flatnonzero(~old.held)
    problem, x = stated.cost.in_lower(model.K[None], model.D[None])
    J = problem.design(x)[0][:, free]
    values, vectors = np.linalg.eigh(J.T @ J)
    # A direction with less information has an error above UNDETERMINED times the noise of a pose.
    determined = values > 1.0 / UNDETERMINED**2
    basis = np.zeros((9, int(determined.sum())))
    if determined.all() and int(stated.sample.poses[0]) >= len(free):
        basis[free, np.arange(len(free))] = 1.0
        return _fitted(old, stated, felt, basis)
    basis[free] = vectors[:, determined]
    cofactor = (basis / values[determined]) @ basis.T
    e = problem.residuals(x[:, None])[0, 0] / (2.0 * old.g)
    value = -cofactor[:, free] @ (J.T @ e)
    rest = float(e @ e - (basis[free].T @ J.T @ e) ** 2 @ (1.0 / values[determined]))
    known = (np.einsum("pq,pq->p", basis, basis) > 1.0 - TOUCH**2) & ~old.held
    freedom = _counted(stated) - basis.shape[1]
    view = _View(old, stated, model, cofactor, basis)
    variance = max(rest, 0.0) / max(freedom, 1)
    return view.shift(view.spread(variance, freedom), value, felt, known, step=value)


def _fitted(old: Calibration, stated: Stated, felt: Float | None, basis: Float) -> Shift:
    """Return the shift of a fit of all parameters from those of the result: K_A = (I + E) K_A0."""
    before, cost = old.model.in_gauge("lower"), stated.cost
    start = np.clip(cost.coordinates(before.K[None], before.D[None]), -1.0, 1.0)
    run = polish(cost, start)
    search = Search("levenberg-marquardt", 1, run.cost, run.evaluations, np.ones(1, np.intp))
    found = fit(reweight(Solution(stated, search, stated.sample, cost, cost, run.x, run.cost)))
    model = ErrorModel(found.lower[0], found.D[0])
    E = np.linalg.solve(model.K, before.K) - np.eye(3)
    value = np.concatenate([old.g * E[ROWS, COLUMNS], (model.D - before.D) / np.diagonal(before.K)])
    view = _View(old, stated, model, found.view.cofactor[0], basis)
    shift = view.shift(found.spread, value, felt, ~old.held, step=np.zeros(9))
    return replace(shift, assessment=assess(found))


ROWS, COLUMNS = [0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]
"""Entries of the lower-triangular E, in the order of the parameters."""


def _counted(stated: Stated) -> int:
    """Return how many poses count."""
    rejected = stated.rejected
    return int(stated.sample.poses[0]) - (0 if rejected is None else int(rejected.sum()))


@dataclass(frozen=True, eq=False)
class _View:
    """New readings as a sensor sees them: `model`, in gauge `lower`; `cofactor` and `basis` as of a `Shift`."""

    old: Calibration
    stated: Stated
    model: ErrorModel
    cofactor: Float
    basis: Float

    @property
    def u(self) -> Float:
        """Directions of the force, shape (1, J, 3); of readings that are held in memory."""
        return directions(self.stated.sample, self.model.K[None], self.model.D[None])

    def spread(self, variance: float, freedom: int) -> NoiseSpread:
        """Return noise and covariance of a linear step that leaves so much variance of weight 1."""
        spread = plain_spread(np.array([variance]), self.cofactor[None], np.array([freedom]))
        if self.stated.noise is None or freedom < 1:
            return spread
        rows, noise, count = design(self.u), self.stated.noise, np.array([freedom])
        return scattered_spread(
            spread,
            rows,
            self.stated.sample.each_weight(self.stated.weights),
            self.cofactor[None],
            noise,
            count,
        )

    def shift(self, spread: NoiseSpread, value: Float, felt: Float | None, known: Bool, step: Float) -> Shift:
        """Return the shift with the noise that the new readings show, or else that of the result."""
        variance, expected, assumed = self._by_result()
        freedom = float(spread.freedom[0]) if self._shows_noise(spread) else 0.0
        weights = self.stated.weights
        return Shift(
            value=value,
            covariance=spread.covariance[0] if freedom else assumed,
            felt=None if felt is None else self._moved_by(felt),
            basis=self.basis,
            known=known,
            noise=Noise(float(spread.variance[0]) if freedom else expected, freedom),
            expected=expected,
            variance=variance,
            sample=self.stated.sample,
            weights=None if weights is None else weights[0],
            model=self.model,
            step=step,
            cofactor=self.cofactor,
            g=self.old.g,
        )

    def _shows_noise(self, spread: NoiseSpread) -> bool:
        """Whether residuals tell the noise; scatter alone says nothing of what the poses share."""
        return _counted(self.stated) > self.basis.shape[1] and bool(spread.freedom[0] >= 1)

    def _by_result(self) -> tuple[Float, float, Float]:
        """Return the variance of each pose, that of weight 1, and the covariance of the estimate, by the result."""
        old, noise, weights = self.old, self.stated.noise, self.stated.weights
        if noise is None or not noise.known[0] or old.shared_noise is None:
            every = np.ones(1) if weights is None else weights[0]
            variance = old.s**2 / np.where(every > 0, every, np.nan)
            return variance, old.s**2, old.s**2 * self.cofactor
        # Where nothing is shared the scatter may overstate the noise.
        ratio = 1.0 if old.residual_noise_ratio is None else min(old.residual_noise_ratio, 1.0)
        part = ratio**2 if old.shared_noise == 0 else 1.0
        own: Float = old.shared_noise**2 + part * noise.variance
        w, rows = self.stated.sample.each_weight(self.stated.weights), design(self.u)
        room = 1.0 - leverages(rows, w, self.cofactor[None])
        if _counted(self.stated) <= self.basis.shape[1]:
            room = np.ones_like(w)
        expected = float(np.sum(w * own * room) / np.sum(room * (w > 0)))
        return own[0], expected, sandwich(rows, w, w * own, self.cofactor[None])[0]

    def _moved_by(self, felt: Float) -> Float:
        """Return what errors of the slopes do to the estimate, shape (9, 6)."""
        A, w = design(self.u)[0], self.stated.sample.each_weight(self.stated.weights)[0]
        return np.asarray(self.cofactor @ (A * w[:, None]).T @ felt)


def joint_covariance(old: Calibration) -> Float:
    """Return the covariance of the nine parameters and the slopes of a result, as force, (m/s^2)^2, shape (15, 15).

    Files of earlier versions have it of the nine, and of each slope alone: those are taken as independent.
    """
    slopes = old.temperature
    if slopes is None or np.isfinite(slopes.covariance).all():
        return np.zeros((15, 15)) if slopes is None else slopes.covariance
    half = 0.5 * (slopes.high - slopes.low)
    joint: Float = np.zeros((9 + SLOPES, 9 + SLOPES))
    scale = np.diagonal(old.model.in_gauge("lower").K)
    sigma = half * np.concatenate([old.g * slopes.sigma_scale, slopes.sigma_bias / scale])
    joint[:9, :9], joint[9:, 9:] = old.covariance, np.diag(sigma**2)
    return joint


def old_covariance(old: Calibration, shift: Shift) -> Float:
    """Return the part of the covariance of the difference that is the result's, (m/s^2)^2, shape (9, 9).

    Errors of its slopes move the new estimate, too, since they brought the new readings to its temperature.
    """
    if shift.felt is None:
        return old.covariance
    both = np.hstack([np.eye(9), shift.felt])
    return np.asarray(both @ joint_covariance(old) @ both.T)
