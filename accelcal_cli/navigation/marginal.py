"""The marginalised filter with differential evolution: particles for the position, one Gaussian for all other errors.

It combines resample-move, a window of measurements, and Rao-Blackwellisation:

1. At the start of a window the twelve errors are Gaussian, x = x_0 + L u with L lower triangular: u_1, u_2 are the
   position error in units of its sigma, and given them the other ten are Gaussian with the regression that L holds.
2. The particles are values of u_1, u_2. Each has a track through the window, by the error model and the regression, and
   is weighed by all measurements so far: a sequence fixes a position where one value cannot.
3. At the end of the window the particles are resampled and moved by DE-MC generations, accepted by Metropolis on prior
   times the likelihood of the window: nothing counts twice, and the cloud does not collapse.
4. Mean and covariance of u over the generations, with the other ten states attached by L, are the Gaussian at the start
   of the next window. The particles continue as they are.

Without generations the filter is a plain marginalised particle filter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.evolution import Fitness
from accelcal_cli.navigation.ins import STATES, cholesky, metres_per_radian, process_noise
from accelcal_cli.navigation.particle_filter import (
    BLIND,
    PositionEstimates,
    log_likelihood,
    moments,
    normalise,
    systematic,
    take_particles,
)
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams

JITTER = 1e-3
"""Noise of a Metropolis proposal, in sigma: without it the chain would stay in the span of the cloud."""

REACH = 2.38
"""Over sqrt(2 d): the step that mixes best in a Gaussian of d dimensions [terbraak2006]."""

MOVED = 2
"""d, evolved coordinates: the position."""

BURN_IN = 0.5
"""Part of the generations that is left out of the moments."""

UNEXPLAINED = 4.0
"""Least mean misfit squared over R at which no track explains a window: by chance once in 60 000 windows of ten."""


def de_mc_generation(
    x: Float, level: Float, rate: Fitness, streams: Streams, spread: Float | float = 1.0
) -> tuple[Float, Float]:
    """Return particles and log density after one generation of DE-MC: one half of them moves, then the other.

    The differences come from the half that stands still, so that each half has a symmetric proposal and the density is
    invariant [terbraak2006].

    Args:
        x: shape (R, N, d); level: log density, shape (R, N).
        rate: log density of points, shape (R, n, d).
        streams: of the runs.
        spread: sigma of the density, for the jitter.
    """
    x, level = x.copy("K"), level.copy()
    count, d = x.shape[1:]
    half = count // 2
    for mine, others in ((slice(0, half), slice(half, count)), (slice(half, count), slice(0, half))):
        size, donors = len(range(count)[mine]), len(range(count)[others])
        draws = streams.uniform(size, 4)
        one = (draws[..., 0] * donors).astype(np.intp)
        two = (one + 1 + (draws[..., 1] * (donors - 1)).astype(np.intp)) % donors
        difference = take_particles(x[:, others], one) - take_particles(x[:, others], two)
        scale = REACH / np.sqrt(2.0 * d) * (0.55 + 0.9 * draws[..., 2:3])
        trial = x[:, mine] + scale * difference + JITTER * spread * streams.normal(size, d)
        value = rate(trial)
        accepted = np.log(draws[..., 3]) < value - level[:, mine]
        x[:, mine] = np.where(accepted[:, :, None], trial, x[:, mine])
        level[:, mine] = np.where(accepted, value, level[:, mine])
    return x, level


@dataclass(frozen=True)
class Gaussian:
    """Mean (R, 12) and covariance root L (R, 12, 12), lower triangular, of the metric states."""

    mean: Float
    root: Float


@dataclass(frozen=True)
class TrackWindow:
    """Epochs `first` to `last` - 1 of a scenario, predicted from the Gaussian at their start.

    Attributes:
        start: the Gaussian.
        base: position error of its mean, m, shape (R, W, 2).
        slope: of the position error by u, shape (R, W, 2, 2); rest: by the other ten coordinates, (R, W, 2, 10).
        transition: over the window, shape (R, 12, 12); noise: covariance of the process noise in it, (R, 12, 12).
    """

    scenario: Scenario
    first: int
    last: int
    start: Gaussian
    base: Float
    slope: Float
    rest: Float
    transition: Float
    noise: Float

    @classmethod
    def predict(cls, scenario: Scenario, start: Gaussian, first: int, last: int) -> TrackWindow:
        """Return a window of a scenario as the Gaussian at its start predicts it."""
        F = scenario.transitions(first, last)
        Q = np.diag(process_noise(scenario.grade, scenario.period))
        transition = np.broadcast_to(np.eye(STATES), (scenario.runs, STATES, STATES))
        noise = np.zeros((scenario.runs, STATES, STATES))
        rows = []
        for w in range(last - first):
            rows.append(transition[:, :2])
            transition = F[:, w] @ transition
            noise = F[:, w] @ noise @ F[:, w].swapaxes(1, 2) + Q
        track = np.stack(rows, axis=1)
        slope = track @ start.root[:, None]
        base = (track @ start.mean[:, None, :, None])[..., 0]
        return cls(
            scenario, first, last, start, base, slope[..., :MOVED], slope[..., MOVED:], transition, noise
        )

    @cached_property
    def indicated(self) -> tuple[Float, Float, Float, Float]:
        """Indicated latitude and longitude, rad, and the radians per metre north and east, each (R, W, 1)."""
        ins = self.scenario.ins
        latitude = ins.latitude[:, self.first : self.last, None]
        meridian, parallel = metres_per_radian(latitude)
        return latitude, ins.longitude[:, self.first : self.last, None], 1.0 / meridian, 1.0 / parallel

    def positions(self, u: Float) -> tuple[Float, Float]:
        """Return the position errors north and east of the tracks of u, shape (R, n, 2), each (R, W, n), m."""
        first, second = u[:, None, :, 0], u[:, None, :, 1]
        north, east = (
            self.base[:, :, axis, None]
            + self.slope[:, :, axis, 0, None] * first
            + self.slope[:, :, axis, 1, None] * second
            for axis in (0, 1)
        )
        return north, east

    def likelihoods(self, u: Float, variance: float) -> Float:
        """Return the log-likelihoods of the tracks of u at each epoch, shape (R, W, n); variance: R, mGal^2."""
        latitude, longitude, by_north, by_east = self.indicated
        north, east = self.positions(u)
        anomaly = self.scenario.gravity_map.at(latitude - north * by_north, longitude - east * by_east)
        return log_likelihood(self.scenario.measured[:, self.first : self.last, None], anomaly, variance)

    def end(
        self, u: Float, mean: Float, covariance: Float, inflation: Float, streams: Streams
    ) -> tuple[Gaussian, Float]:
        """Return the Gaussian at the start of the next window, and the particles in its coordinates.

        Args:
            u: particles, shape (R, N, 2).
            mean, covariance: of u, shape (R, 2) and (R, 2, 2).
            inflation: of the covariance of all twelve errors, shape (R,).
            streams: of the runs.
        """
        spread = self.transition @ self.start.root
        centre = (self.transition @ self.start.mean[:, :, None])[:, :, 0]
        S = np.tile(np.eye(STATES), (len(u), 1, 1))
        S[:, :MOVED, :MOVED] = covariance
        P = (spread @ S @ spread.swapaxes(1, 2) + self.noise) * inflation[:, None, None]
        after = Gaussian(centre + (spread[:, :, :MOVED] @ mean[:, :, None])[:, :, 0], cholesky(P))
        full = np.concatenate([u, streams.normal(u.shape[1], STATES - MOVED)], axis=2)
        away = (centre - after.mean)[:, :MOVED, None] + spread[:, :MOVED] @ full.swapaxes(1, 2)
        return after, np.linalg.solve(after.root[:, :MOVED, :MOVED], away).swapaxes(1, 2)


@dataclass(frozen=True)
class MarginalFilter:
    """The filter; see the module, and `DePf` for the settings.

    When no track explains a window, the cloud is at a wrong position or too narrow: its covariance is then multiplied
    by `recovery_inflation`, unless it is as wide as the initial error already.
    """

    particles: int
    generations: int
    window: int
    variance: float
    inflation: float
    recovery_inflation: float

    def run(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the estimates, window by window."""
        estimates = PositionEstimates.empty(scenario)
        root = np.tile(cholesky(scenario.prior), (scenario.runs, 1, 1))
        start = Gaussian(np.zeros((scenario.runs, STATES)), root)
        u: Float = streams.normal(self.particles, MOVED)
        for first in range(0, scenario.epochs, self.window):
            last = min(first + self.window, scenario.epochs)
            window = TrackWindow.predict(scenario, start, first, last)
            start, u = self.step(window, u, estimates, streams)
        return replace(estimates, lookups=float(self.particles * (1 + self.generations)))

    def step(
        self, window: TrackWindow, u: Float, estimates: PositionEstimates, streams: Streams
    ) -> tuple[Gaussian, Float]:
        """Fill in the estimates of one window; return the Gaussian and the particles at the start of the next.

        Args:
            window: as predicted.
            u: particles, shape (R, N, 2).
            estimates: of all epochs, to fill in; streams: of the runs.
        """
        likelihoods = window.likelihoods(u, self.variance)
        weights = self._estimate(window, u, likelihoods, estimates)
        chosen = systematic(weights, streams.uniform(1, 1)[:, 0, 0])
        total = likelihoods.sum(axis=1)
        misfit = -2.0 * total.max(axis=1)
        u = np.take_along_axis(u, chosen[:, :, None], axis=1)
        u, mean, covariance = self._move(window, u, np.take_along_axis(total, chosen, axis=1), streams)
        wide = np.square(window.start.root[:, :2, :2]).sum(axis=(1, 2)) > window.scenario.initial**2
        lost = (misfit > UNEXPLAINED * (window.last - window.first)) & (window.first > 0) & ~wide
        inflation = np.where(lost, self.recovery_inflation, 1.0)
        return window.end(u, mean, self.inflation * covariance, inflation, streams)

    def _estimate(
        self, window: TrackWindow, u: Float, likelihoods: Float, estimates: PositionEstimates
    ) -> Float:
        """Fill in mean and covariance at every epoch, from the measurements up to it; return the last weights."""
        north, east = window.positions(u)
        running = np.cumsum(likelihoods, axis=1)
        weights = likelihoods[:, 0]
        for w, k in enumerate(range(window.first, window.last)):
            weights = normalise(running[:, w])
            position = np.stack([north[:, w], east[:, w]], axis=1).swapaxes(1, 2)
            estimates.mean[:, k], spread = moments(weights, position)
            rest = window.rest[:, w]
            estimates.covariance[:, k] = spread + rest @ rest.swapaxes(1, 2)
            estimates.blind[:] += likelihoods[:, w].max(axis=1) < BLIND
        return weights

    def _move(
        self, window: TrackWindow, u: Float, likelihood: Float, streams: Streams
    ) -> tuple[Float, Float, Float]:
        """Return the particles after DE-MC, and the mean and covariance of u over its later generations."""

        def prior(v: Float) -> Float:
            return np.asarray(-0.5 * np.square(v).sum(axis=2))

        def rate(v: Float) -> Float:
            return np.asarray(prior(v) + window.likelihoods(v, self.variance).sum(axis=1))

        level: Float = likelihood + prior(u)
        settled = []
        for generation in range(self.generations):
            u, level = de_mc_generation(u, level, rate, streams)
            if generation >= BURN_IN * self.generations:
                settled.append(u)
        pool = np.concatenate(settled or [u], axis=1)
        mean, covariance = moments(np.full(pool.shape[:2], 1.0 / pool.shape[1]), pool)
        return u, mean, covariance
