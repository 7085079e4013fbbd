"""The marginalised filter with differential evolution: particles for the position, one Gaussian for all other errors.

It combines resample-move, a window of measurements, and Rao-Blackwellisation:

1. At the start of a window the fourteen errors, twelve of the INS and two of the measurement, are Gaussian,
   x = x_0 + L s with L lower triangular: s_1, s_2 = u are the position error in units of its sigma.
2. The particles are values of u. Each has a track through the window, and is weighed by all measurements so far: a
   sequence fixes a position where one value cannot. Given u, the other twelve errors, and the noise that drives the
   error of the map, are Gaussian and enter the measurements linearly, with the slope of the map on the mean track: the
   misfits of a track are whitened by one matrix for all particles.
3. At the end of the window the particles are resampled and moved by DE-MC generations, accepted by Metropolis on prior
   times the likelihood of the window: nothing counts twice, and the cloud does not collapse.
4. Mean and covariance of u and of the whitened misfits over the generations, and through them those of the other
   errors, are the Gaussian at the start of the next window. The particles continue as they are.

Without generations the filter is a plain marginalised particle filter with a Gaussian at every window's end.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.navigation.filter import PositionEstimates
from accelcal_cli.navigation.ins import STATES, cholesky, metres_per_radian
from accelcal_cli.navigation.noise import EXTRA
from accelcal_cli.navigation.particle_filter import OFF_MAP, moments, normalise, systematic, take_particles
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams

ALL = STATES + EXTRA
"""Errors of the INS and of the measurement."""

Rate = Callable[[Float], tuple[Float, Float]]
"""Log density of points (R, n, d), and a payload (R, n, W) that the points carry."""

JITTER = 1e-3
"""Noise of a Metropolis proposal, in sigma: without it the chain would stay in the span of the cloud."""

REACH = 2.38
"""Over sqrt(2 d): the step that mixes best in a Gaussian of d dimensions [terbraak2006]."""

MOVED = 2
"""d, evolved coordinates: the position."""

BURN_IN = 0.5
"""Part of the generations that is left out of the moments."""

UNEXPLAINED = 4.0
"""Least mean squared whitened misfit at which no track explains a window: by chance once in 60 000 windows of ten."""

RECOVERY_COST = 20.0
"""What a recovery takes from the logarithm of the evidence: under a noise model that is right it hardly happens."""

PATIENCE, REFUSED = 1200.0, 0.6
"""A cloud that has left out more than this part of its measurements, as a running mean over so many seconds, is at a
wrong position: sixty milligal for ten minutes are 0.4."""


def de_mc_generation(
    x: Float, level: Float, rate: Callable[[Float], Float], streams: Streams, spread: Float | float = 1.0
) -> tuple[Float, Float]:
    """Return particles and log density after one generation of DE-MC; see `de_mc`."""
    carried = np.zeros((*level.shape, 0))

    def both(v: Float) -> tuple[Float, Float]:
        return rate(v), np.zeros((*v.shape[:2], 0))

    return de_mc(x, level, carried, both, streams, spread)[:2]


def de_mc(
    x: Float,
    level: Float,
    carried: Float,
    rate: Rate,
    streams: Streams,
    spread: Float | float = 1.0,
    power: float = 1.0,
) -> tuple[Float, Float, Float]:
    """Return the particles after one generation of DE-MC: one half of them moves, then the other.

    The differences come from the half that stands still, so that each half has a symmetric proposal and the density is
    invariant [terbraak2006].

    Args:
        x: shape (R, N, d); level: log density, shape (R, N); carried: what goes with the particles, shape (R, N, W).
        rate: log density, and what goes with them, of points, shape (R, n, d).
        streams: of the runs.
        spread: sigma of the density, for the jitter.
        power: of the likelihood, where the density is that of a standard Gaussian prior times a likelihood.
    """
    x, level, carried = x.copy("K"), level.copy(), carried.copy()
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
        value, goes = rate(trial)
        gain = power * (value - level[:, mine])
        if power < 1.0:
            gain -= 0.5 * (1.0 - power) * np.square(trial).sum(axis=2)
            gain += 0.5 * (1.0 - power) * np.square(x[:, mine]).sum(axis=2)
        accepted = np.log(draws[..., 3]) < gain
        x[:, mine] = np.where(accepted[:, :, None], trial, x[:, mine])
        level[:, mine] = np.where(accepted, value, level[:, mine])
        carried[:, mine] = np.where(accepted[:, :, None], goes, carried[:, mine])
    return x, level, carried


@dataclass(frozen=True)
class Gaussian:
    """Mean (R, 14) and covariance root L (R, 14, 14), lower triangular, of all errors."""

    mean: Float
    root: Float


@dataclass(frozen=True)
class TrackWindow:
    """Epochs `first` to `last` - 1 of a scenario, predicted from the Gaussian at their start.

    Attributes:
        start: the Gaussian.
        base: position error of its mean, m, shape (R, W, 2).
        slope: of the position error by u, shape (R, W, 2, 2); rest: by the other coordinates, (R, W, 2, 12 + W).
        level: what the mean adds to measured gravity beside the map, mGal, (R, W); tilt: the same by u, (R, W, 2);
            reach: by the other coordinates, shape (R, W, 12 + W).
        after: of all errors at the end, mean (R, 14), and by all coordinates, (R, 14, 14 + W).
        noise: covariance of the process noise at the end, but for that of the map error, shape (R, 14, 14).
    """

    scenario: Scenario
    first: int
    last: int
    start: Gaussian
    base: Float
    slope: Float
    rest: Float
    level: Float
    tilt: Float
    reach: Float
    after: tuple[Float, Float]
    noise: Float

    @classmethod
    def predict(cls, scenario: Scenario, start: Gaussian, first: int, last: int) -> TrackWindow:
        """Return a window of a scenario as the Gaussian at its start predicts it."""
        F, size = scenario.steps(first, last), last - first
        mean, spread = start.mean, np.concatenate([start.root, np.zeros((scenario.runs, ALL, size))], axis=2)
        noise = np.zeros((scenario.runs, ALL, ALL))
        means, spreads = [], []
        for w, k in enumerate(range(first, last)):
            means.append(mean)
            spreads.append(spread)
            mean, spread = (F[:, w] @ mean[:, :, None])[:, :, 0], F[:, w] @ spread
            Q = scenario.step_noise(k)
            spread[:, -1, ALL + w] = np.sqrt(Q[:, -1])  # the map error's noise is a coordinate of its own
            Q[:, -1] = 0.0
            noise = F[:, w] @ noise @ F[:, w].swapaxes(1, 2) + Q[:, :, None] * np.eye(ALL)
        track, tracks = np.stack(means, axis=1), np.stack(spreads, axis=1)
        base, by = track[:, :, :2], tracks[:, :, :2]
        coupling = scenario.coupling[:, first:last]
        level = (coupling * track[:, :, 2:4]).sum(axis=2) + track[:, :, STATES:].sum(axis=2)
        direct = (coupling[..., None] * tracks[:, :, 2:4]).sum(axis=2) + tracks[:, :, STATES:].sum(axis=2)
        along = cls._map_slope(scenario, first, last, base)
        reach = direct - (along[..., None] * by).sum(axis=2)
        parts = base, by[..., :MOVED], by[..., MOVED:], level, direct[..., :MOVED], reach[..., MOVED:]
        return cls(scenario, first, last, start, *parts, (mean, spread), noise)

    @staticmethod
    def _map_slope(scenario: Scenario, first: int, last: int, base: Float) -> Float:
        """Return the slope of the map on the mean track, mGal/m, shape (R, W, 2); 0 where the map has none."""
        ins = scenario.ins
        latitude, longitude = ins.latitude[:, first:last], ins.longitude[:, first:last]
        meridian, parallel = metres_per_radian(latitude)
        north, east = scenario.gravity_map.slope(
            latitude - base[..., 0] / meridian, longitude - base[..., 1] / parallel
        )
        return np.nan_to_num(np.stack([north / meridian, east / parallel], axis=-1))

    @cached_property
    def indicated(self) -> tuple[Float, Float, Float, Float]:
        """Indicated latitude and longitude, rad, and the radians per metre north and east, each (R, W, 1)."""
        ins = self.scenario.ins
        latitude = ins.latitude[:, self.first : self.last, None]
        meridian, parallel = metres_per_radian(latitude)
        return latitude, ins.longitude[:, self.first : self.last, None], 1.0 / meridian, 1.0 / parallel

    @property
    def measured(self) -> Float:
        """Measured gravity, mGal, shape (R, W); one that is left out becomes NaN."""
        return self.scenario.measured[:, self.first : self.last]

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

    def misfits(self, u: Float) -> Float:
        """Return measured minus expected gravity along the tracks of u, mGal, shape (R, W, n); NaN where unknown."""
        latitude, longitude, by_north, by_east = self.indicated
        north, east = self.positions(u)
        expected = self.scenario.gravity_map.at(latitude - north * by_north, longitude - east * by_east)
        expected += self.level[:, :, None]
        if self.tilt.any():
            expected += self.tilt @ u.swapaxes(1, 2)
        return self.measured[:, :, None] - expected

    def whitening(self, variance: float) -> tuple[Float, Float]:
        """Return what whitens misfits, shape (R, W, W), and the whitened reach, (R, W, 12 + W); variance: R, mGal^2.

        A measurement that is missing has no weight.
        """
        known = np.isfinite(self.measured)
        reach = np.where(known[:, :, None], self.reach, 0.0)
        C = reach @ reach.swapaxes(1, 2) + variance * np.eye(reach.shape[1])
        inverse = np.linalg.inv(np.linalg.cholesky(C))
        return np.where(known[:, None, :] & known[:, :, None], inverse, 0.0), inverse @ reach

    def end(
        self,
        u: Float,
        white: Float,
        reach: Float,
        mean: Float,
        covariance: Float,
        added: Float,
        streams: Streams,
    ) -> tuple[Gaussian, Float]:
        """Return the Gaussian at the start of the next window, and the particles in its coordinates.

        Args:
            u: particles, shape (R, N, 2); white: their whitened misfits, (R, N, W).
            reach: whitened, see `whitening`.
            mean, covariance: of u and the whitened misfits together, shape (R, 2 + W) and (R, 2 + W, 2 + W).
            added: part of the prior that is added to the covariance of all errors, shape (R,).
            streams: of the runs.
        """
        centre, spread = self.after
        own, other = spread[:, :, :MOVED], spread[:, :, MOVED:]
        learned = other @ reach.swapaxes(1, 2)  # of a whitened misfit
        known = np.concatenate([own, learned], axis=2)
        left = other @ other.swapaxes(1, 2) - learned @ learned.swapaxes(1, 2)
        P = known @ covariance @ known.swapaxes(1, 2) + left + self.noise
        P += added[:, None, None] * self.scenario.full_prior()
        after = Gaussian(centre + (known @ mean[:, :, None])[:, :, 0], cholesky(P))
        drawn = cholesky(left[:, :2, :2]) @ streams.normal(u.shape[1], MOVED).swapaxes(1, 2)
        places = known[:, :2] @ np.concatenate([u, white], axis=2).swapaxes(1, 2) + drawn
        away = (centre - after.mean)[:, :2, None] + places
        return after, np.linalg.solve(after.root[:, :2, :2], away).swapaxes(1, 2)


def rate_tracks(window: TrackWindow, variance: float) -> tuple[Rate, Float]:
    """Return what rates tracks by prior times likelihood of a window, and the whitened reach; variance: R, mGal^2."""
    whiten, reach = window.whitening(variance)

    def rate(u: Float) -> tuple[Float, Float]:
        misfit = window.misfits(u)
        unknown = np.isnan(misfit)
        lost = 0.0
        if unknown.any():
            lost = OFF_MAP * (unknown & np.isfinite(window.measured)[:, :, None]).sum(axis=1)
            misfit[unknown] = 0.0
        white = whiten @ misfit
        level = lost - 0.5 * (np.square(white).sum(axis=1) + np.square(u).sum(axis=2))
        return level, white.swapaxes(1, 2)

    return rate, reach


def estimate_epochs(
    window: TrackWindow,
    u: Float,
    white: Float,
    level: Float,
    reach: Float,
    estimates: PositionEstimates,
    prior: Float | float = 0.0,
) -> Float:
    """Fill in mean and covariance at every epoch, from the measurements up to it; return the last weights, (R, N).

    Args:
        window: as predicted.
        u: tracks, shape (R, N, 2); white: their whitened misfits, (R, N, W); level: their log density, (R, N).
        reach: whitened, see `TrackWindow.whitening`.
        estimates: of all epochs.
        prior: log weights of the tracks before the window, shape (R, N).
    """
    north, east = window.positions(u)
    running = -0.5 * np.cumsum(np.square(white), axis=2)
    off = np.where(level < 0.5 * OFF_MAP, OFF_MAP, 0.0)
    weights = level
    for w, k in enumerate(range(window.first, window.last)):
        weights = normalise(running[:, :, w] + off + prior)
        rest = window.rest[:, w]
        learned = rest @ reach[:, : w + 1].swapaxes(1, 2)  # of the whitened misfits so far
        position = np.stack([north[:, w], east[:, w]], axis=1).swapaxes(1, 2)
        position = position + white[:, :, : w + 1] @ learned.swapaxes(1, 2)
        estimates.mean[:, k], spread = moments(weights, position)
        left = rest @ rest.swapaxes(1, 2) - learned @ learned.swapaxes(1, 2)
        estimates.covariance[:, k] = spread + left
        estimates.blind[:] += off.max(axis=1) < 0.0
    return weights


def note_window(window: TrackWindow, u: Float, variance: float, estimates: PositionEstimates) -> None:
    """Note the innovations of a window one after the other, and leave outliers out.

    Args:
        window: as predicted; u: tracks of equal weight, shape (R, N, 2).
        variance: R, mGal^2; estimates: of all epochs.
    """
    misfit = window.misfits(u)
    seen = np.isfinite(misfit)
    count = np.maximum(seen.sum(axis=2), 1)
    mean = np.where(seen, misfit, 0.0).sum(axis=2) / count
    away = np.where(seen, misfit - mean[:, :, None], 0.0)
    known = np.isfinite(window.measured) & seen.any(axis=2)
    S = away @ away.swapaxes(1, 2) / u.shape[1] + window.reach @ window.reach.swapaxes(1, 2)
    S += variance * np.eye(S.shape[1])
    gate = window.scenario.model.gate
    for w, k in enumerate(range(window.first, window.last)):
        used = estimates.note(k, np.where(known[:, w], mean[:, w], np.nan), S[:, w, w], gate) > 0.0
        window.measured[estimates.rejected[:, k] > 0.0, w] = np.nan
        gain = np.where(used[:, None], S[:, :, w] / S[:, w, w, None], 0.0)
        mean = mean - gain * np.where(used, mean[:, w], 0.0)[:, None]
        S = S - gain[:, :, None] * S[:, None, w]


@dataclass(frozen=True)
class MarginalFilter:
    """The filter; see the module, and `DePf` for the settings.

    When no track explains a window, or most measurements were left out for a long time, the cloud is at a wrong
    position or too narrow: a part `recovery` of the prior is then added to its covariance, unless it is as wide.
    """

    particles: int
    generations: int
    window: int
    variance: float
    inflation: float
    recovery: float

    def run(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the estimates, window by window."""
        estimates = PositionEstimates.empty(scenario)
        root = np.tile(cholesky(scenario.full_prior()), (scenario.runs, 1, 1))
        start = Gaussian(np.zeros((scenario.runs, ALL)), root)
        u: Float = streams.normal(self.particles, MOVED)
        refused = np.zeros(scenario.runs)
        for first in range(0, scenario.epochs, self.window):
            last = min(first + self.window, scenario.epochs)
            window = TrackWindow.predict(scenario, start, first, last)
            note_window(window, u, self.variance, estimates)
            part = min(1.0, (last - first) * scenario.period / PATIENCE)
            refused += part * (estimates.rejected[:, first:last].mean(axis=1) - refused)
            start, u = self.step(window, u, refused > REFUSED, estimates, streams)
            refused[refused > REFUSED] = 0.0
        return replace(estimates, lookups=float(self.particles * (2 + self.generations)))

    def step(
        self, window: TrackWindow, u: Float, refused: Bool, estimates: PositionEstimates, streams: Streams
    ) -> tuple[Gaussian, Float]:
        """Fill in the estimates of one window; return the Gaussian and the particles at the start of the next.

        Args:
            window: as predicted, without outliers.
            u: particles, shape (R, N, 2).
            refused: runs that leave too much out, shape (R,).
            estimates: of all epochs, to fill in; streams: of the runs.
        """
        rate, reach = rate_tracks(window, self.variance)
        level, white = rate(u)
        weights = estimate_epochs(window, u, white, level, reach, estimates)
        best = np.square(white).sum(axis=2).min(axis=1)
        used = np.isfinite(window.measured).sum(axis=1)
        pool = self._move(u, white, level, weights, rate, streams)
        u, white = pool[-1]
        together = np.concatenate([np.concatenate(both, axis=2) for both in pool], axis=1)
        mean, covariance = moments(np.full(together.shape[:2], 1.0 / together.shape[1]), together)
        wide = np.square(window.start.root[:, :2, :2]).sum(axis=(1, 2)) > window.scenario.initial**2
        lost = ((best > UNEXPLAINED * used) & (used > 0) & (window.first > 0)) | refused
        added = np.where(lost & ~wide, self.recovery, 0.0)
        estimates.evidence[:, window.last - 1] -= RECOVERY_COST * (added > 0.0)
        return window.end(u, white, reach, mean, self.inflation * covariance, added, streams)

    def _move(
        self, u: Float, white: Float, level: Float, weights: Float, rate: Rate, streams: Streams
    ) -> list[tuple[Float, Float]]:
        """Return the particles and their whitened misfits after each of the later generations.

        In the earlier ones the likelihood counts more and more, and they are resampled by what it gains [delmoral2006]:
        resampled at once, a hundred particles of the first window would be copies of one.
        """

        def resample(weights: Float) -> tuple[Float, Float, Float]:
            chosen = systematic(weights, streams.uniform(1, 1)[:, 0, 0])
            places, misfits = (np.take_along_axis(part, chosen[:, :, None], axis=1) for part in (u, white))
            return places, misfits, np.take_along_axis(level, chosen, axis=1)

        if not self.generations:
            u, white, level = resample(weights)
            return [(u, white)]
        steps = math.ceil(BURN_IN * self.generations)
        settled, before = [], 0.0
        for generation in range(self.generations):
            power = min(1.0, ((generation + 1) / steps) ** 3)
            if power > before:
                gained = (power - before) * (level + 0.5 * np.square(u).sum(axis=2))
                u, white, level = resample(normalise(gained))
                before = power
            u, level, white = de_mc(u, level, white, rate, streams, power=power)
            if generation >= BURN_IN * self.generations:
                settled.append((u, white))
        return settled or [(u, white)]
