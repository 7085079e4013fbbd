"""DE-PF: differential evolution inside a particle filter [depf2015], as printed and in the forms that were tried.

`mode: literal` is the paper's text. In `mode: default` the setting `road` chooses what keeps the evolution from
destroying the posterior; see docs/explanation/gravity-navigation.md for what each is worth.

Differential evolution of position particles: the paper's operators, and its Markov chain kin [terbraak2006].

Names are those of optimizers.ade, which minimises a cost by the same equations. Here the fitness is a logarithm and its
exponential, the weight, is maximised, as the paper does; the mutation is best-r unless stated, as its text reads; and
only the first particles move, while best and worst are of all.

The marginalised filter with differential evolution: particles for position, one Gaussian for all that goes with it.

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
from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.ins import STATES, metres_per_radian, process_noise
from accelcal_cli.navigation.particle_filter import (
    FILTERS,
    UNSEEN,
    Cloud,
    Counted,
    Evolving,
    Fitness,
    Track,
    log_likelihood,
    moments,
    normalised,
    systematic,
)
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

EVOLUTION = ("weight_min", "weight_max", "crossover_min", "crossover_max", "mutation")
IDLE = {
    "marginal": ("roughening", "threshold", "resampling", "state", "fraction", *EVOLUTION),
    "metropolis": ("fraction", "window", "inflation", "swell", *EVOLUTION),
    "window": ("inflation", "swell"),
    "safe": ("window", "inflation", "swell"),
}
"""Settings that have no effect in mode default, by road."""


@FILTERS.register("de-pf")
@dataclass(frozen=True)
class DePf(Evolving):
    """Particle filter with differential evolution, F and CR adapting to each individual [depf2015]."""

    road: Literal["marginal", "metropolis", "window", "safe"] = setting(
        "marginal", "form of mode default: particles for position with a Gaussian for the rest; moves that are "
        "accepted by Metropolis; fitness over a window; evolution of the worst alone",
    )  # fmt: skip
    window: int = setting(10, "W, measurements of a window (roads marginal and window)", low=1, high=1000)
    inflation: float = setting(
        1.02, "of the covariance at a window's end: the error of moments from N particles", low=1.0, high=2.0
    )
    swell: float = setting(
        4.0, "growth of the covariance when no track explains a window; 1: none", low=1.0, high=100.0
    )
    weight_min: float = setting(0.4, "F of the best particle (F_min) [depf2015]", low=0.0, high=2.0)
    weight_max: float = setting(1.0, "F of the worst particle (F_max) [depf2015]", low=0.0, high=2.0)
    crossover_min: float = setting(0.0, "CR of the worst mutant (CR_min) [depf2015]", low=0.0, high=1.0)
    crossover_max: float = setting(1.0, "CR of the best mutant (CR_max) [depf2015]", low=0.0, high=1.0)
    mutation: Literal["best-r", "current-to-best", "rand-to-best"] = setting(
        "best-r", "reading of the mutation: m + F (best - r), current-to-best/1 or rand-to-best/1"
    )

    def __post_init__(self) -> None:
        """Refuse values out of range, and those that would have no effect."""
        super().__post_init__()
        if self.mode == "literal":
            return
        for part in fields(self):
            if part.name in IDLE[self.road] and getattr(self, part.name) != part.default:
                raise ConfigError(f"{part.name}: has no effect on road {self.road}; leave it out")

    def run(self, scenario: Scenario, streams: Streams) -> Track:
        """Return the filter's track; see `Filter`."""
        if self.mode == "literal" or self.road != "marginal":
            return super().run(scenario, streams)
        variance = self.variance or scenario.noise**2
        form = Marginal(self.particles, self.generations, self.window, variance, self.inflation, self.swell)
        return form.run(scenario, streams)

    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return the particles after the paper's generations; see `Evolving.evolve`."""
        operators = Operators(
            self.weight_min, self.weight_max, self.crossover_min, self.crossover_max, self.mutation
        )
        return evolve(operators, x, fitness, movers, self.generations, rate, streams)

    @property
    def memory(self) -> int:
        """Epochs that the fitness looks at."""
        return self.window if self.road == "window" else 1

    def fitness(self, scenario: Scenario, k: int, position: Float) -> Float:
        """Return the likelihood of one measurement, or of the last W as if the error had not changed."""
        total = np.zeros(position.shape[:2])
        for epoch in range(k + 1 - min(k + 1, self.memory), k + 1):
            total += self.likelihood(scenario, epoch, position)
        return total

    def _safe(
        self, scenario: Scenario, cloud: Cloud, prior: Float, k: int, streams: Streams
    ) -> tuple[Cloud, int]:
        if self.road != "metropolis":
            return super()._safe(scenario, cloud, prior, k, streams)
        return self._metropolis(scenario, cloud, prior, k, streams)

    def _metropolis(
        self, scenario: Scenario, cloud: Cloud, prior: Float, k: int, streams: Streams
    ) -> tuple[Cloud, int]:
        """Resample, then move all by DE-MC on prior times likelihood; the weights are equal after."""
        x = cloud.x[..., :2]
        mean, covariance = moments(prior, x)
        inverse = np.linalg.inv(covariance + 1e-6 * np.eye(2))
        weights = np.exp(cloud.log_weights - cloud.log_weights.max(axis=1, keepdims=True))
        chosen = systematic(weights / weights.sum(axis=1, keepdims=True), streams.uniform(1, 1)[:, 0, 0])

        def posterior(position: Float) -> Float:
            away = position - mean[:, None]
            distance: Float = ((away @ inverse) * away).sum(axis=2)
            return self.likelihood(scenario, k, position) - 0.5 * distance

        rate = Counted(posterior)
        moved = np.take_along_axis(cloud.x, chosen[:, :, None], axis=1)
        position, level = moved[..., :2], rate(moved[..., :2])
        for _ in range(self.generations):
            position, level = metropolis(position, level, rate, streams)
        moved[..., :2] = position
        return Cloud(moved, np.zeros(cloud.log_weights.shape)), rate.points


LAMBDA = 1e-13
"""Keeps the ratios finite when all weights are equal; the paper's value."""

JITTER = 1e-3
"""Noise of a Metropolis proposal, in sigma: without it the chain would stay in the span of the cloud."""

REACH = 2.38
"""Over sqrt(2 d): the step that mixes best in a Gaussian of d dimensions [terbraak2006]."""


@dataclass(frozen=True)
class Operators:
    """[depf2015] section 2: F and CR adapt to every individual."""

    weight_min: float = 0.4
    weight_max: float = 1.0
    crossover_min: float = 0.0
    crossover_max: float = 1.0
    mutation: Literal["best-r", "current-to-best", "rand-to-best"] = "best-r"


def evolve(
    operators: Operators,
    x: Float,
    fitness: Float,
    movers: int,
    generations: int,
    rate: Fitness,
    streams: Streams,
) -> Float:
    """Return the particles after greedy generations in which the first `movers` may move.

    Args:
        x: shape (R, N, 2); fitness: its logarithm, shape (R, N), larger is better.
        movers, generations: how many and how often.
        rate: log fitness of positions, shape (R, movers, 2).
    """
    x, fitness = x.copy("K"), fitness.copy()
    count = x.shape[1]
    for _ in range(generations):
        best = fitness.argmax(axis=1)[:, None]
        level = np.take_along_axis(fitness, best, axis=1)
        leader = np.take_along_axis(x, best[:, :, None], axis=1)
        distance = 1.0 - np.exp(fitness - level)
        worst = distance.max(axis=1, keepdims=True) + LAMBDA
        spread = operators.weight_max - operators.weight_min
        F = operators.weight_min + spread * distance[:, :movers] / worst  # eq. 4
        draws = streams.uniform(movers, 5)
        mutant = _mutants(operators.mutation, x, leader, F[:, :, None], draws, count, movers)
        mutant_distance = np.maximum(1.0 - np.exp(rate(mutant) - level), 0.0) / worst
        spread = operators.crossover_max - operators.crossover_min
        CR = operators.crossover_max - spread * np.minimum(mutant_distance, 1.0)  # eq. 6
        gene = (draws[..., 2:3] * 2).astype(np.intp)
        take = (draws[..., 3:5] <= CR[:, :, None]) | (gene == np.arange(2))
        trial = np.where(take, mutant, x[:, :movers])  # eq. 5
        value = rate(trial)
        better = value > fitness[:, :movers]  # eq. 7
        x[:, :movers] = np.where(better[:, :, None], trial, x[:, :movers])
        fitness[:, :movers] = np.where(better, value, fitness[:, :movers])
    return x


def _mutants(kind: str, x: Float, leader: Float, F: Float, draws: Float, count: int, movers: int) -> Float:
    """Return the mutants, shape (R, n, 2): the three readings of [depf2015] eq. 3."""
    own = x[:, :movers]
    first = (np.arange(movers) + 1 + (draws[..., 0] * (count - 1)).astype(np.intp)) % count
    one = _taken(x, first)
    if kind == "best-r":
        return own + F * (leader - one)
    second = (first + 1 + (draws[..., 1] * (count - 1)).astype(np.intp)) % count
    base = own if kind == "current-to-best" else one
    return base + F * (leader - base) + F * (one - _taken(x, second))


def metropolis(
    x: Float, level: Float, rate: Fitness, streams: Streams, spread: Float | float = 1.0
) -> tuple[Float, Float]:
    """Return particles and log density after one generation of DE-MC: half of them, then the other.

    Differences come from the half that stands still, so that each half has a symmetric proposal and the density is
    left as it is [terbraak2006].

    Args:
        x: shape (R, N, d); level: log density, shape (R, N).
        rate: log density of points, shape (R, n, d).
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
        difference = _taken(x[:, others], one) - _taken(x[:, others], two)
        scale = REACH / np.sqrt(2.0 * d) * (0.55 + 0.9 * draws[..., 2:3])
        trial = x[:, mine] + scale * difference + JITTER * spread * streams.normal(size, d)
        value = rate(trial)
        accepted = np.log(draws[..., 3]) < value - level[:, mine]
        x[:, mine] = np.where(accepted[:, :, None], trial, x[:, mine])
        level[:, mine] = np.where(accepted, value, level[:, mine])
    return x, level


def _taken(x: Float, index: Int) -> Float:
    """Return the particles at index, shape (R, n, d), population-contiguous as the streams are."""
    taken: Float = np.take_along_axis(x.swapaxes(1, 2), index[:, None], axis=2).swapaxes(1, 2)
    return taken


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
