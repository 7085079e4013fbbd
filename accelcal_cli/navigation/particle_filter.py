"""The generic particle filter: sampling, importance, resampling [gordon1993].

Everything is batched over R runs. Weights of N particles have the shape (R, N) and are kept as logarithms until they
are needed; random numbers come from the stream of each run.

The state is the position error alone, a random walk (`state: 2`), or all twelve errors of the INS (`state: 12`). Given
it, the bias of the gravimeter and the error of the map are Gaussian: every particle carries their mean.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.navigation.filter import Filter, PositionEstimates
from accelcal_cli.navigation.ins import STATES, cholesky, process_noise
from accelcal_cli.navigation.noise import EXTRA, NoiseModel, Offset
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

OFF_MAP = -1e6
"""Log-likelihood of a position where the map has no value."""

BLIND = -1e5
"""Greatest log-likelihood of a cloud of which no particle is on the map: above OFF_MAP, below any misfit on it."""


def rate_misfit(misfit: Float, measured: Bool, variance: Float | float) -> Float:
    """Return -(y - map)^2 / 2R, OFF_MAP where the map has no value, and 0 without a measurement. [depf2015] eq. 2.

    Args:
        misfit: y - map, mGal, overwritten; measured: whether there is a measurement; variance: R, mGal^2.
    """
    misfit *= misfit
    misfit *= -0.5 / variance
    unknown = np.isnan(misfit)
    if unknown.any():
        misfit[unknown] = OFF_MAP
        misfit = np.where(measured, misfit, 0.0)
    return misfit


def normalise(log_weights: Float) -> Float:
    """Return weights that sum to 1, shape (R, N); equal ones where no particle has any likelihood."""
    weights: Float = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def effective_size(weights: Float) -> Float:
    """Return N_eff = 1 / sum w^2, shape (R,). [depf2015] eq. 2."""
    return np.asarray(1.0 / np.square(weights).sum(axis=1))


def systematic(weights: Float, u: Float) -> Int:
    """Return the chosen particles, shape (R, N): one draw and N equal strides [kitagawa1996].

    Args:
        weights: shape (R, N), summing to 1.
        u: U[0, 1), shape (R,).
    """
    count = weights.shape[1]
    cumulative = np.cumsum(weights, axis=1)
    cumulative /= cumulative[:, -1:]
    before = np.ceil(count * cumulative - u[:, None]).astype(np.intp)
    return _repeat(np.diff(np.clip(before, 0, count), axis=1, prepend=0))


def residual(weights: Float, u: Float) -> Int:
    """Return the chosen particles, shape (R, N): the whole parts of N w, and the rest systematically [liu1998].

    Args:
        weights: shape (R, N), summing to 1.
        u: U[0, 1), shape (R,).
    """
    count = weights.shape[1]
    copies = np.floor(count * weights + 1e-12)
    rest = count * weights - copies
    left = count - copies.sum(axis=1, keepdims=True)
    cumulative = np.cumsum(np.maximum(rest, 0.0), axis=1)
    total = np.where(cumulative[:, -1:] > 0, cumulative[:, -1:], 1.0)
    before = np.ceil(left * cumulative / total - u[:, None]).astype(np.intp)
    before = np.clip(before, 0, left.astype(np.intp))
    before[:, -1:] = left.astype(np.intp)
    return _repeat(copies.astype(np.intp) + np.diff(before, axis=1, prepend=0))


def _repeat(copies: Int) -> Int:
    """Return each particle's number as often as it is copied, shape (R, N); every row of copies sums to N."""
    runs, count = copies.shape
    return np.repeat(np.tile(np.arange(count), runs), copies.ravel()).reshape(runs, count)


SCHEMES = {"systematic": systematic, "residual": residual}


def moments(weights: Float, x: Float) -> tuple[Float, Float]:
    """Return mean, shape (R, D), and covariance, shape (R, D, D), of weighted particles x, shape (R, N, D)."""
    mean = (weights[:, :, None] * x).sum(axis=1)
    away = (x - mean[:, None]).swapaxes(1, 2)
    return mean, (weights[:, None] * away) @ away.swapaxes(1, 2)


def take_particles(x: Float, index: Int) -> Float:
    """Return the particles at index (R, n) of x (R, N, D), shape (R, n, D), population-contiguous as streams are."""
    return np.asarray(np.take_along_axis(x.swapaxes(1, 2), index[:, None], axis=2).swapaxes(1, 2))


@dataclass(frozen=True)
class Cloud:
    """Particles of R runs.

    Attributes:
        x: metric states, shape (R, N, D); log_weights: shape (R, N).
        level: bias and map error of each particle, mGal, shape (R, N, 2); offset: their covariance.
        before: positions at the epoch before, shape (R, N, 2); None at the first epoch, and where nothing reads them.
    """

    x: Float
    log_weights: Float
    level: Float
    offset: Offset
    before: Float | None = None

    @classmethod
    def of(cls, x: Float, log_weights: Float, model: NoiseModel = NoiseModel()) -> Cloud:  # noqa: B008  # frozen
        """Return particles that have measured nothing yet."""
        return cls(x, log_weights, np.zeros((*x.shape[:2], EXTRA)), Offset.start(model, len(x)))

    def part(self, rows: Int) -> Cloud:
        """Return some of the runs."""
        offset = Offset(self.offset.covariance[rows])
        return Cloud(self.x[rows], self.log_weights[rows], self.level[rows], offset)


CHUNK = 60
"""Epochs whose transition matrices are computed at once."""


@dataclass(frozen=True)
class ParticleFilter(Filter):
    """The plain particle filter; [depf2015] section 6 without step 3."""

    particles: int = setting(100, "N, particles", low=4, high=1_000_000)
    roughening: float = setting(
        30.0, "noise of the position error per step of 10 s, m", low=0.0, high=10_000.0
    )
    variance: float | None = setting(
        None,
        "R in the filter, mGal^2; not set: that of the gravimeter, times four in mode default except with strategy "
        "marginal of de-pf",
        above=0.0,
    )
    threshold: float = setting(2 / 3, "resample when N_eff is below this part of N", low=0.0, high=1.0)
    resampling: Literal["systematic", "residual"] = setting("systematic", "scheme")
    state: Literal[2, 12] = setting(2, "position error alone, or all twelve errors")

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the estimates: propagate, weigh, evolve, estimate, resample; [depf2015] steps 1 to 5."""
        scenario = self._believed(scenario)
        estimates = PositionEstimates.empty(scenario)
        cloud = self._start(scenario, streams)
        F: Float = np.empty(0)
        total = 0.0
        for k in range(scenario.epochs):
            if k and self.state == STATES and (k - 1) % CHUNK == 0:
                F = scenario.transitions(k - 1, min(k - 1 + CHUNK, scenario.epochs))
            if k:
                step = F[:, (k - 1) % CHUNK] if self.state == STATES else None
                offset = cloud.offset.predict(scenario.model, scenario.decay[:, k - 1])
                level = (
                    cloud.level
                    * np.stack([np.ones(scenario.runs), scenario.decay[:, k - 1]], axis=1)[:, None]
                )
                x = self._propagate(scenario, cloud.x, step, streams)
                cloud = Cloud(x, cloud.log_weights, level, offset, cloud.x[..., :2])
            used = self._gate(scenario, cloud, k, estimates)
            cloud, lookups, on_map = self.update(scenario, cloud, k, streams)
            cloud = self._learn(scenario, cloud, k, used)
            weights = normalise(cloud.log_weights)
            estimates.mean[:, k], estimates.covariance[:, k] = moments(weights, cloud.x[..., :2])
            estimates.blind[:] += ~on_map
            total += lookups + self.particles * (1 + bool(scenario.model.prior.any()))
            cloud = self._resample(cloud, weights, streams)
        return replace(estimates, lookups=total / scenario.epochs)

    def _believed(self, scenario: Scenario) -> Scenario:
        """Return the scenario as the state can tell it: without velocities the Eoetvoes error is one of the map."""
        if not scenario.model.eotvos or self.state == STATES:
            return scenario
        error = np.square(scenario.coupling.mean(axis=(0, 1))) @ np.diagonal(scenario.prior)[2:4]
        size = float(np.hypot(scenario.model.map_error, np.sqrt(error)))
        return replace(scenario, models=(replace(scenario.model, map_error=size, eotvos=False),))

    def residual(self, scenario: Scenario, cloud: Cloud, k: int, x: Float) -> Float:
        """Return measured minus expected gravity at epoch k of states x of the first n particles, mGal, (R, n)."""
        count = x.shape[1]
        anomaly = scenario.anomaly(k, x[..., 0], x[..., 1])
        if scenario.model.prior.any():
            anomaly = anomaly + cloud.level[:, :count].sum(axis=2)
        if scenario.model.eotvos:
            anomaly = anomaly + (cloud.x[:, :count, 2:4] * scenario.coupling[:, k, None]).sum(axis=2)
        return np.asarray(scenario.measured[:, k, None] - anomaly)

    def _gate(self, scenario: Scenario, cloud: Cloud, k: int, estimates: PositionEstimates) -> Float:
        """Note the innovations of epoch k, leave outliers out, and return which runs use theirs, shape (R,)."""
        misfit = self.residual(scenario, cloud, k, cloud.x)
        known = np.isfinite(misfit)
        weights = np.where(known, normalise(cloud.log_weights), 0.0)
        total = weights.sum(axis=1)
        misfit = np.where(known, misfit, 0.0)
        mean = (weights * misfit).sum(axis=1) / total
        spread = (weights * np.square(misfit - mean[:, None])).sum(axis=1) / total
        variance = spread + cloud.offset.variance + self.believed_variance(scenario)
        used = estimates.note(k, mean, variance, scenario.model.gate)
        scenario.measured[estimates.rejected[:, k] > 0.0, k] = np.nan
        return used

    def _learn(self, scenario: Scenario, cloud: Cloud, k: int, used: Float) -> Cloud:
        """Return the cloud whose bias and map error have learned from epoch k, at every particle by itself."""
        if not scenario.model.prior.any():
            return cloud
        variance = np.full(scenario.runs, self.believed_variance(scenario))
        misfit = np.nan_to_num(self.residual(scenario, cloud, k, cloud.x))
        gain = cloud.offset.gain(variance) * used[:, None]
        level = cloud.level + gain[:, None] * misfit[:, :, None]
        return replace(cloud, level=level, offset=cloud.offset.update(variance, used))

    def update(
        self,
        scenario: Scenario,
        cloud: Cloud,
        k: int,
        streams: Streams,  # noqa: ARG002  # an evolution draws from them
    ) -> tuple[Cloud, float, Bool]:
        """Return the cloud weighed by the measurement of epoch k, look-ups per run, and which runs are on the map."""
        likelihood = self.likelihood(scenario, cloud, k, cloud.x)
        on_map = likelihood.max(axis=1) > BLIND
        return replace(cloud, log_weights=cloud.log_weights + likelihood), self.particles, on_map

    def likelihood(self, scenario: Scenario, cloud: Cloud, k: int, x: Float) -> Float:
        """Return the log-likelihood at epoch k of states x, shape (R, n, D), of the first n particles of a cloud."""
        measured = np.isfinite(scenario.measured[:, k])
        misfit = self.residual(scenario, cloud, k, x)
        variance = cloud.offset.variance[:, None] + self.believed_variance(scenario)
        return rate_misfit(misfit, measured[:, None], variance)

    def believed_variance(self, scenario: Scenario) -> float:
        """Return R in mGal^2: as set, or that of the gravimeter, times four in mode default."""
        if self.variance is not None:
            return self.variance
        return scenario.noise**2 * (1.0 if self.mode == "literal" else 4.0)

    def step_noise(self, scenario: Scenario) -> float:
        """Return the noise of the position error per step. Units: m."""
        return self.roughening * math.sqrt(scenario.period / 10.0)

    def degenerate(self, weights: Float) -> Bool:
        """Return which runs have too small an effective size, shape (R,)."""
        return np.asarray(effective_size(weights) < self.threshold * self.particles)

    def _start(self, scenario: Scenario, streams: Streams) -> Cloud:
        """Return the particles of step 1, drawn from the prior."""
        x = streams.normal(self.particles, self.state)
        x = x @ cholesky(scenario.prior[: self.state, : self.state]).T
        return Cloud.of(x, np.zeros(x.shape[:2]), scenario.model)

    def _propagate(self, scenario: Scenario, x: Float, F: Float | None, streams: Streams) -> Float:
        """Return the particles one step on: a random walk of the position, or all errors by the transition F."""
        rough = self.step_noise(scenario)
        if F is None:
            return np.asarray(x + rough * streams.normal(self.particles, 2))
        noise = streams.normal(self.particles, STATES)
        noise *= np.sqrt(process_noise(scenario.grade, scenario.period, rough))
        return np.asarray((F @ x.swapaxes(1, 2)).swapaxes(1, 2) + noise)

    def _resample(self, cloud: Cloud, weights: Float, streams: Streams) -> Cloud:
        """Return the cloud with equal weights in the runs whose effective size is too small."""
        low = self.degenerate(weights)[:, None]
        chosen = SCHEMES[self.resampling](weights, streams.uniform(1, 1)[:, 0, 0])
        chosen = np.where(low, chosen, np.arange(self.particles))
        logs = np.where(low, 0.0, cloud.log_weights - cloud.log_weights.max(axis=1, keepdims=True))
        level = take_particles(cloud.level, chosen) if cloud.level.any() else cloud.level
        return Cloud(take_particles(cloud.x, chosen), logs, level, cloud.offset)
