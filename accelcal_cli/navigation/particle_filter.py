"""What a navigation filter is, and what it leaves: estimates of the INS position error with their covariance.

Weights and resampling as pure functions; weights are logarithms until they are needed.

All are batched over runs: weights of shape (R, N), draws u that the caller took from each run's own stream.

The sampling-importance-resampling particle filter [gordon1993], and where evolution enters it [depf2015] section 6.

The state is the position error alone, a random walk (`state: 2`), or all twelve errors (`state: 12`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.navigation.gravity_map import OUTSIDE
from accelcal_cli.navigation.ins import STATES, process_noise
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.registry import Registry
from accelcal_cli.rng import Streams
from accelcal_cli.schema import check, setting


@dataclass(frozen=True)
class Track:
    """What a filter says of R runs at K epochs.

    Attributes:
        mean: position error of the INS, m north and east, shape (R, K, 2).
        covariance: of it, m^2, shape (R, K, 2, 2).
        blind: epochs at which no particle was on the map, shape (R,).
        lookups: of the map, for each run and epoch on average.
    """

    mean: Float
    covariance: Float
    blind: Float
    lookups: float

    @classmethod
    def empty(cls, scenario: Scenario) -> Track:
        """Return a track to be filled."""
        shape = scenario.runs, scenario.epochs
        return cls(np.zeros((*shape, 2)), np.zeros((*shape, 2, 2)), np.zeros(shape[0]), 0.0)


class Filter(ABC):
    """A filter; its dataclass fields are its YAML keys."""

    name: ClassVar[str]
    mode: str

    @abstractmethod
    def run(self, scenario: Scenario, streams: Streams) -> Track:
        """Return the filter's track; run r of the streams belongs to run r of the scenario."""


FILTERS: Registry[Filter] = Registry(Filter, "accelcal_cli.navigation.filters", "filter", "accelcal.filters")

UNSEEN = -1e5
"""Greatest log-likelihood of a cloud of which no particle is on the map: above OUTSIDE, below any misfit on it."""


def log_likelihood(measured: Float, anomaly: Float, variance: float) -> Float:
    """Return -(y - map)^2 / 2R, OUTSIDE where the map has no value, and 0 without a measurement.

    Args:
        measured: mGal, broadcast against anomaly; anomaly: mGal; variance: R, mGal^2. [depf2015] eq. 2.
    """
    misfit = measured - anomaly
    misfit *= misfit
    misfit *= -0.5 / variance
    unknown = np.isnan(misfit)
    if unknown.any():
        misfit[unknown] = OUTSIDE
        misfit = np.where(np.isnan(measured), 0.0, misfit)
    return misfit


def normalised(log_weights: Float) -> Float:
    """Return weights that sum to 1, shape (R, N); equal ones where no particle has any likelihood."""
    weights: Float = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    weights /= weights.sum(axis=1, keepdims=True)
    return weights


def effective_size(weights: Float) -> Float:
    """Return N_eff = 1 / sum w^2, shape (R,). [depf2015] eq. 2."""
    size: Float = 1.0 / np.square(weights).sum(axis=1)
    return size


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
    return _repeated(np.diff(np.clip(before, 0, count), axis=1, prepend=0))


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
    return _repeated(copies.astype(np.intp) + np.diff(before, axis=1, prepend=0))


def _repeated(copies: Int) -> Int:
    """Return each particle's number as often as it is copied, shape (R, N); every row of copies sums to N."""
    runs, count = copies.shape
    return np.repeat(np.tile(np.arange(count), runs), copies.ravel()).reshape(runs, count)


SCHEMES = {"systematic": systematic, "residual": residual}


def moments(weights: Float, x: Float) -> tuple[Float, Float]:
    """Return mean, shape (R, D), and covariance, shape (R, D, D), of weighted particles x, shape (R, N, D)."""
    mean = (weights[:, :, None] * x).sum(axis=1)
    away = (x - mean[:, None]).swapaxes(1, 2)
    return mean, (weights[:, None] * away) @ away.swapaxes(1, 2)


Fitness = Callable[[Float], Float]
CHUNK = 60
"""Epochs whose transition matrices are made together."""

GATE = 3.0
"""Evolved particles stay within so many sigma of the predicted cloud [chosen]."""


@dataclass(frozen=True)
class Cloud:
    """Particles of R runs: x, metric states (R, N, D), and the logarithms of their weights, (R, N)."""

    x: Float
    log_weights: Float


class Counted:
    """A fitness that counts the points it was asked for."""

    def __init__(self, rate: Fitness) -> None:
        """Count from nothing."""
        self.rate, self.points = rate, 0

    def __call__(self, position: Float) -> Float:
        """Return the fitness of positions, shape (R, n, 2)."""
        self.points += position.shape[0] * position.shape[1]
        return self.rate(position)


@dataclass(frozen=True)
class Sir(Filter):
    """The plain particle filter; [depf2015] section 6 without step 3."""

    mode: Literal["default", "literal"] = setting("default", "`literal`: R as stated; `default`: widened")
    particles: int = setting(100, "N, particles", low=4, high=1_000_000)
    roughening: float = setting(
        30.0, "noise of the position error in a step of 10 s, m", low=0.0, high=10_000.0
    )
    variance: float | None = setting(
        None,
        "R in the filter, mGal^2; not set: that of the gravimeter, in mode default four times as much but for de-pf's "
        "road marginal",
        above=0.0,
    )
    threshold: float = setting(2 / 3, "resample when N_eff is below this part of N", low=0.0, high=1.0)
    resampling: Literal["systematic", "residual"] = setting("systematic", "scheme")
    state: Literal[2, 12] = setting(2, "position error alone, or all twelve errors")

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)

    def run(self, scenario: Scenario, streams: Streams) -> Track:
        """Return the track: propagate, weigh, evolve, estimate, resample; [depf2015] steps 1 to 5."""
        track = Track.empty(scenario)
        cloud = self._start(scenario, streams)
        F: Float = np.empty(0)
        lookups = 0.0
        for k in range(scenario.epochs):
            if k and self.state == STATES and (k - 1) % CHUNK == 0:
                F = scenario.transitions(k - 1, min(k - 1 + CHUNK, scenario.epochs))
            if k:
                step = F[:, (k - 1) % CHUNK] if self.state == STATES else None
                cloud = replace(cloud, x=self._propagated(scenario, cloud.x, step, streams))
            cloud, weights, used, seen = self.update(scenario, cloud, k, streams)
            lookups += used
            track.mean[:, k], track.covariance[:, k] = moments(weights, cloud.x[..., :2])
            track.blind[:] += ~seen
            cloud = self._resampled(cloud, weights, streams)
        return replace(track, lookups=lookups / scenario.epochs)

    def update(
        self,
        scenario: Scenario,
        cloud: Cloud,
        k: int,
        streams: Streams,  # noqa: ARG002  # an evolution draws from them
    ) -> tuple[Cloud, Float, float, Bool]:
        """Return the cloud with its new weights, these as numbers, a run's look-ups, and which runs see the map."""
        likelihood = self.likelihood(scenario, k, cloud.x)
        cloud = replace(cloud, log_weights=cloud.log_weights + likelihood)
        seen: Bool = likelihood.max(axis=1) > UNSEEN
        return cloud, normalised(cloud.log_weights), self.particles, seen

    def likelihood(self, scenario: Scenario, k: int, x: Float) -> Float:
        """Return the log-likelihood of particles x, shape (R, n, D), at epoch k."""
        anomaly = scenario.anomaly(k, x[..., 0], x[..., 1])
        return log_likelihood(scenario.measured[:, k, None], anomaly, self.believed_variance(scenario))

    def believed_variance(self, scenario: Scenario) -> float:
        """Return R in mGal^2: stated, or the gravimeter's, four times as much in the default mode."""
        if self.variance is not None:
            return self.variance
        return scenario.noise**2 * (1.0 if self.mode == "literal" else 4.0)

    def _start(self, scenario: Scenario, streams: Streams) -> Cloud:
        """Return the particles of step 1: position uniform in the initial square."""
        x = streams.normal(self.particles, self.state) * np.sqrt(scenario.prior()[: self.state])
        x[..., :2] = scenario.initial * (2.0 * streams.uniform(self.particles, 2) - 1.0)
        return Cloud(x, np.zeros(x.shape[:2]))

    def _propagated(self, scenario: Scenario, x: Float, F: Float | None, streams: Streams) -> Float:
        rough = self.roughening * np.sqrt(scenario.period / 10.0)
        if F is None:
            walked: Float = x + rough * streams.normal(self.particles, 2)
            return walked
        noise = streams.normal(self.particles, STATES)
        noise *= np.sqrt(process_noise(scenario.grade, scenario.period, rough))
        moved: Float = (F @ x.swapaxes(1, 2)).swapaxes(1, 2) + noise
        return moved

    def _resampled(self, cloud: Cloud, weights: Float, streams: Streams) -> Cloud:
        """Return the cloud with equal weights in the runs whose effective size is too small."""
        low = effective_size(weights) < self.threshold * self.particles
        chosen = SCHEMES[self.resampling](weights, streams.uniform(1, 1)[:, 0, 0])
        chosen = np.where(low[:, None], chosen, np.arange(self.particles))
        logs = np.where(low[:, None], 0.0, cloud.log_weights - cloud.log_weights.max(axis=1, keepdims=True))
        x = np.take_along_axis(cloud.x.swapaxes(1, 2), chosen[:, None], axis=2).swapaxes(1, 2)
        return Cloud(x, logs)


@dataclass(frozen=True)
class Evolving(Sir):
    """A particle filter whose predicted particles an evolution moves before they are weighed.

    In mode `literal` all particles move at every epoch, by the likelihood alone, as the paper has it. In mode
    `default` only the worst fifth moves, only when the weights degenerate, and the fitness is the posterior: likelihood
    times the Gaussian of the predicted cloud, within three sigma.
    """

    generations: int = setting(20, "of the evolution at an epoch", low=0, high=1000)
    fraction: float = setting(0.2, "part of the particles that moves in mode default", above=0.0, high=1.0)

    @abstractmethod
    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return particles whose first `movers` have moved.

        Args:
            x: positions, shape (R, N, 2), worst first in mode default.
            fitness: shape (R, N).
            movers: n, how many may move; rate: fitness of positions, shape (R, n, 2).
        """

    def update(
        self, scenario: Scenario, cloud: Cloud, k: int, streams: Streams
    ) -> tuple[Cloud, Float, float, Bool]:
        """Return the cloud evolved and weighed; see `Sir.update`."""
        if self.mode == "literal" and self.generations:
            return self._literal(scenario, cloud, k, streams)
        old = cloud
        cloud, weights, used, seen = super().update(scenario, cloud, k, streams)
        if not self.generations:
            return cloud, weights, used, seen
        rows = np.flatnonzero(effective_size(weights) < self.threshold * self.particles)
        if len(rows):
            part = Cloud(cloud.x[rows], cloud.log_weights[rows])
            prior = normalised(old.log_weights[rows])
            now = scenario.instant(rows, max(0, k + 1 - self.memory), k + 1)
            part, lookups = self._safe(now, part, prior, now.epochs - 1, streams.take(rows))
            cloud.x[rows], cloud.log_weights[rows] = part.x, part.log_weights
            used += lookups / scenario.runs
        return cloud, normalised(cloud.log_weights), used, seen

    @property
    def memory(self) -> int:
        """Epochs that the fitness looks at."""
        return 1

    def _literal(
        self, scenario: Scenario, cloud: Cloud, k: int, streams: Streams
    ) -> tuple[Cloud, Float, float, Bool]:
        """Evolve all particles toward the likelihood alone, then weigh them; see `Sir.update`."""
        rate = Counted(lambda position: self.likelihood(scenario, k, position))
        x = cloud.x.copy()
        fitness = rate(x)
        x[..., :2] = self.evolve(x[..., :2], fitness, self.particles, rate, streams)
        moved = Cloud(x, cloud.log_weights + rate(x))
        seen: Bool = fitness.max(axis=1) > UNSEEN
        return moved, normalised(moved.log_weights), rate.points / scenario.runs, seen

    def _safe(
        self, scenario: Scenario, cloud: Cloud, prior: Float, k: int, streams: Streams
    ) -> tuple[Cloud, int]:
        """Evolve the worst particles toward the posterior; their old weight becomes the mean one.

        Also return the look-ups of all runs.
        """
        mean, covariance = moments(prior, cloud.x[..., :2])
        scale = np.sqrt(np.einsum("rii->ri", covariance)) + 1e-9
        inverse = np.linalg.inv(covariance + 1e-6 * np.eye(2))

        def posterior(position: Float) -> Float:
            away = position - mean[:, None]
            distance = ((away @ inverse) * away).sum(axis=2)
            inside = (np.abs(away) <= GATE * scale[:, None]).all(axis=2)
            return np.where(inside, self.fitness(scenario, k, position) - 0.5 * distance, -np.inf)

        rate = Counted(posterior)
        order = np.argsort(cloud.log_weights, axis=1, kind="stable")
        x = np.take_along_axis(cloud.x, order[:, :, None], axis=1)
        logs = np.take_along_axis(cloud.log_weights, order, axis=1)
        movers = max(1, round(self.fraction * self.particles))
        place = x[..., :2]
        moved = self.evolve(place, rate(place), movers, rate, streams)[:, :movers]
        inside = np.isfinite(rate(moved))[:, :, None]
        x[:, :movers, :2] = np.where(inside, moved, place[:, :movers])
        share = np.take_along_axis(prior / prior.max(axis=1, keepdims=True), order, axis=1)[:, :movers]
        likelihood = self.likelihood(scenario, k, x[:, :movers])
        logs[:, :movers] = likelihood + np.log(share.mean(axis=1, keepdims=True) + 1e-300)
        return Cloud(x, logs), rate.points * scenario.epochs + likelihood.size

    def fitness(self, scenario: Scenario, k: int, position: Float) -> Float:
        """Return the likelihood part of the fitness; shape (R, n)."""
        return self.likelihood(scenario, k, position)
