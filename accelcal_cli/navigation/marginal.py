"""The marginalised filter with differential evolution: particles for position, one Gaussian for all that goes with it.

The roads of resample-move, of a window of measurements, and of Rao-Blackwellisation in one:

1. At the start of a window the twelve errors are Gaussian, x = x_0 + L u with L lower triangular: u_1, u_2 are the
   position error in units of its sigma, and given them the other ten are Gaussian with the regression that L holds.
2. The particles are values of u_1, u_2. Each has a track through the window, by the error model and the regression, and
   is weighed by all measurements so far: a sequence fixes a place where one value cannot.
3. At the window's end the particles are resampled and moved by DE-MC generations, accepted by Metropolis on prior times
   the window's likelihood: nothing is counted twice, and the cloud does not collapse.
4. Mean and covariance of u over the generations, the unmoved ten states attached by L, are the Gaussian at the next
   window's start. The particles go on as they are.

With no generations the filter is a plain marginalised particle filter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.navigation.differential import metropolis
from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.error_model import STATES, process_noise
from accelcal_cli.navigation.filters import UNSEEN, Track, log_likelihood
from accelcal_cli.navigation.resampling import moments, normalised, systematic
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.streams import Float, Streams

MOVED = 2
"""d, evolved coordinates: the position."""

SETTLED = 0.5
"""Part of the generations that is left out of the moments."""

UNEXPLAINED = 4.0
"""Least mean misfit squared over R at which no track explains a window: by chance once in 60 000 windows of ten."""

TINY = 1e-12


@dataclass(frozen=True)
class Gaussian:
    """Mean (R, 12), covariance root L (R, 12, 12), lower triangular, of the metric states."""

    mean: Float
    root: Float


@dataclass(frozen=True)
class Window:
    """Epochs `first` to `last` - 1, seen from the first.

    Attributes:
        base: position error of the mean, m, shape (R, W, 2).
        slope: of the position error by u, shape (R, W, 2, 2); rest: by the other ten coordinates, (R, W, 2, 10).
        through: transition over the window, shape (R, 12, 12); noise: what the process adds in it, (R, 12, 12).
        place: indicated latitude and longitude, rad, and radians of a metre north and east, each (R, W, 1).
        measured: mGal, shape (R, W, 1).
    """

    first: int
    last: int
    base: Float
    slope: Float
    rest: Float
    through: Float
    noise: Float
    place: tuple[Float, Float, Float, Float]
    measured: Float

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


@dataclass(frozen=True)
class Marginal:
    """The filter; see the module and `DePf` for the settings.

    When no track explains a window the cloud is at a wrong place, or too narrow: its covariance then grows by `swell`,
    not beyond the initial error.
    """

    particles: int
    generations: int
    window: int
    variance: float
    inflation: float
    swell: float

    def run(self, scenario: Scenario, streams: Streams) -> Track:
        """Return the track, window by window."""
        track = Track.empty(scenario)
        state = Gaussian(
            np.zeros((scenario.runs, STATES)),
            np.tile(np.diag(np.sqrt(scenario.prior())), (scenario.runs, 1, 1)),
        )
        edge = math.sqrt(3.0)  # of the uniform initial square in sigma
        u = edge * (2.0 * streams.uniform(self.particles, MOVED) - 1.0)
        starts = range(0, scenario.epochs, self.window)
        for first, last in zip(starts, [*starts[1:], scenario.epochs], strict=True):
            state, u = self._window(scenario, state, u, (first, last, edge), track, streams)
            edge = math.inf
        return replace(track, lookups=float(self.particles * (1 + self.generations)))

    def _window(
        self,
        scenario: Scenario,
        state: Gaussian,
        u: Float,
        span: tuple[int, int, float],
        track: Track,
        streams: Streams,
    ) -> tuple[Gaussian, Float]:
        """Fill the track of one window; return the Gaussian and the particles at the next one's start."""
        first, last, edge = span
        window = look(scenario, state, first, last)
        likelihoods = self._likelihoods(scenario, window, u)
        weights = self._estimate(window, u, likelihoods, track)
        chosen = systematic(weights, streams.uniform(1, 1)[:, 0, 0])
        u = np.take_along_axis(u, chosen[:, :, None], axis=1)
        level = np.take_along_axis(likelihoods.sum(axis=1), chosen, axis=1)
        misfit = -2.0 * likelihoods.sum(axis=1).max(axis=1)
        u, mean, covariance = self._moved(scenario, window, (u, level, edge), streams)
        wide = np.square(state.root[:, :2, :2]).sum(axis=(1, 2)) > scenario.initial**2
        lost = (misfit > UNEXPLAINED * (last - first)) & math.isinf(edge) & ~wide
        swell = np.where(lost, self.swell, 1.0)
        return carried(window, state, (mean, self.inflation * covariance, swell), u, streams)

    def _likelihoods(self, scenario: Scenario, window: Window, u: Float) -> Float:
        """Return the log-likelihoods of the tracks of u, shape (R, W, n)."""
        north, east = window.positions(u)
        latitude, longitude, by_north, by_east = window.place
        anomaly = scenario.gravity_map.at(latitude - north * by_north, longitude - east * by_east)
        return log_likelihood(window.measured, anomaly, self.variance)

    def _estimate(self, window: Window, u: Float, likelihoods: Float, track: Track) -> Float:
        """Enter mean and covariance at every epoch, from the measurements up to it; return the last weights."""
        north, east = window.positions(u)
        running = np.cumsum(likelihoods, axis=1)
        weights = likelihoods[:, 0]
        for w, k in enumerate(range(window.first, window.last)):
            weights = normalised(running[:, w])
            place = np.stack([north[:, w], east[:, w]], axis=1).swapaxes(1, 2)
            track.mean[:, k], spread = moments(weights, place)
            track.covariance[:, k] = spread + window.rest[:, w] @ window.rest[:, w].swapaxes(1, 2)
            track.blind[:] += likelihoods[:, w].max(axis=1) < UNSEEN
        return weights

    def _moved(
        self, scenario: Scenario, window: Window, start: tuple[Float, Float, float], streams: Streams
    ) -> tuple[Float, Float, Float]:
        """Return the particles after DE-MC, and the mean and covariance of u over its later generations."""
        u, level, edge = start
        flat = math.isfinite(edge)

        def prior(v: Float) -> Float:
            inside = (np.abs(v) <= edge).all(axis=2)
            return np.where(inside, 0.0 if flat else -0.5 * np.square(v).sum(axis=2), -np.inf)

        def rate(v: Float) -> Float:
            total: Float = prior(v) + self._likelihoods(scenario, window, v).sum(axis=1)
            return total

        level = level + prior(u)
        kept = []
        for generation in range(self.generations):
            u, level = metropolis(u, level, rate, streams)
            if generation >= SETTLED * self.generations:
                kept.append(u)
        pool = np.concatenate(kept or [u], axis=1)
        mean, covariance = moments(np.full(pool.shape[:2], 1.0 / pool.shape[1]), pool)
        return u, mean, covariance


def look(scenario: Scenario, state: Gaussian, first: int, last: int) -> Window:
    """Return a window of the scenario as the Gaussian at its start sees it."""
    F = scenario.transitions(first, last)
    Q = np.diag(process_noise(scenario.grade, scenario.period))
    through = np.broadcast_to(np.eye(STATES), (scenario.runs, STATES, STATES))
    noise = np.zeros((scenario.runs, STATES, STATES))
    rows = []
    for w in range(last - first):
        rows.append(through[:, :2])
        through = F[:, w] @ through
        noise = F[:, w] @ noise @ F[:, w].swapaxes(1, 2) + Q
    track = np.stack(rows, axis=1)
    slope = track @ state.root[:, None]
    base = (track @ state.mean[:, None, :, None])[..., 0]
    latitude = scenario.ins.latitude[:, first:last, None]
    meridian, parallel = metres_per_radian(latitude)
    place = latitude, scenario.ins.longitude[:, first:last, None], 1.0 / meridian, 1.0 / parallel
    measured = scenario.measured[:, first:last, None]
    return Window(first, last, base, slope[..., :MOVED], slope[..., MOVED:], through, noise, place, measured)


def carried(
    window: Window, state: Gaussian, found: tuple[Float, Float, Float], u: Float, streams: Streams
) -> tuple[Gaussian, Float]:
    """Return the Gaussian at the next window's start, and the particles in its coordinates.

    Args:
        window: that ends; state: at its start.
        found: mean and covariance of u, shape (R, 2) and (R, 2, 2), and what the whole covariance grows by, (R,).
        u: particles, shape (R, N, 2).
    """
    mean, covariance, swell = found
    spread = window.through @ state.root
    centre = (window.through @ state.mean[:, :, None])[:, :, 0]
    S = np.tile(np.eye(STATES), (len(u), 1, 1))
    S[:, :MOVED, :MOVED] = covariance
    P = (spread @ S @ spread.swapaxes(1, 2) + window.noise) * swell[:, None, None]
    moved = Gaussian(centre + (spread[:, :, :MOVED] @ mean[:, :, None])[:, :, 0], root(P))
    full = np.concatenate([u, streams.normal(u.shape[1], STATES - MOVED)], axis=2)
    away = (centre - moved.mean)[:, :MOVED, None] + spread[:, :MOVED] @ full.swapaxes(1, 2)
    return moved, np.linalg.solve(moved.root[:, :MOVED, :MOVED], away).swapaxes(1, 2)


def root(P: Float) -> Float:
    """Return the Cholesky root of covariances of very different scales, shape (R, 12, 12)."""
    sigma = np.sqrt(np.einsum("rii->ri", P))
    correlation = P / (sigma[:, :, None] * sigma[:, None, :])
    correlation = 0.5 * (correlation + correlation.swapaxes(1, 2)) + TINY * np.eye(STATES)
    factor: Float = np.linalg.cholesky(correlation) * sigma[:, :, None]
    return factor
