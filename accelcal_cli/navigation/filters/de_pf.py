"""DE-PF: differential evolution inside a particle filter [depf2015], as printed and in the forms that were tried.

`mode: literal` is the paper's text. In `mode: default` the setting `strategy` selects what keeps the evolution from
destroying the posterior; docs/explanation/gravity-navigation.md says how well each does.

The operators are those of `optimization.algorithms.ade`, which minimises a cost by the same equations. Here the fitness
is a logarithm, and its exponential, the weight, is maximised as in the paper. The mutation is best-r unless stated, as
the paper's text reads. Only the first particles move, while best and worst are taken from all.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.evolution import (
    CountedFitness,
    Evolution,
    EvolvingFilter,
    Fitness,
    best_particle,
    evolve_degenerate,
    posterior,
)
from accelcal_cli.navigation.filter import FILTERS, PositionEstimates
from accelcal_cli.navigation.marginal import MarginalFilter, de_mc_generation
from accelcal_cli.navigation.particle_filter import (
    Cloud,
    moments,
    normalise,
    systematic,
    take_particles,
)
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

OPERATORS = ("weight_min", "weight_max", "crossover_min", "crossover_max", "mutation")
IDLE = {
    "marginal": ("roughening", "threshold", "resampling", "state", "fraction", *OPERATORS),
    "metropolis": ("fraction", "window", "inflation", "recovery", *OPERATORS),
    "window": ("inflation", "recovery"),
    "safe": ("window", "inflation", "recovery"),
}
"""Settings that have no effect in mode default, by strategy."""

LAMBDA = 1e-13
"""Keeps the ratios finite when all weights are equal; the paper's value."""


@FILTERS.register("de-pf")
@dataclass(frozen=True)
class DePf(EvolvingFilter):
    """Particle filter with differential evolution, F and CR adapting to each individual [depf2015]."""

    strategy: Literal["marginal", "metropolis", "window", "safe"] = setting(
        "marginal",
        "form of mode default: particles for position with a Gaussian for the other errors; moves accepted by "
        "Metropolis; fitness over a window; evolution of the worst particles alone",
    )
    window: float = setting(
        300.0,
        "W, of measurements that count at once, s (strategies marginal and window)",
        above=0.0,
        high=36000.0,
    )
    inflation: float = setting(
        1.02,
        "of the covariance at the end of a window: corrects the moments of N particles",
        low=1.0,
        high=2.0,
    )
    recovery: float = setting(
        0.1, "part of the prior that is added when no track explains a window; 0: none", low=0.0, high=10.0
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
        for key in fields(self):
            if key.name in IDLE[self.strategy] and getattr(self, key.name) != key.default:
                raise ConfigError(f"{key.name}: has no effect with strategy {self.strategy}; leave it out")

    @property
    def evolution(self) -> Evolution:
        """The strategy that the settings select; `marginal` is a filter of its own, see `run`."""
        if self.mode == "default" and self.strategy == "window":
            return partial(evolve_degenerate, span=self.window)
        if self.mode == "default" and self.strategy == "metropolis":
            return partial(evolve_degenerate, move=resample_move)
        return super().evolution

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the filter's estimates; see `Filter`."""
        if self.mode == "literal" or self.strategy != "marginal":
            return super().track(scenario, streams)
        return MarginalFilter(
            self.particles,
            self.generations,
            scenario.epochs_in(self.window),
            self.variance or scenario.noise**2,
            self.inflation,
            self.recovery,
        ).run(scenario, streams)

    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return the particles after the paper's greedy generations; see `EvolvingFilter.evolve`."""
        x, fitness = x.copy("K"), fitness.copy()
        F_span, CR_span = self.weight_max - self.weight_min, self.crossover_max - self.crossover_min
        for _ in range(self.generations):
            leader, level = best_particle(x, fitness)
            distance = 1.0 - np.exp(fitness - level)
            worst = distance.max(axis=1, keepdims=True) + LAMBDA
            F = self.weight_min + F_span * distance[:, :movers] / worst  # [depf2015] eq. 4
            draws = streams.uniform(movers, 5)
            mutant = self._mutants(x, leader, F[:, :, None], draws)  # [depf2015] eq. 3
            mutant_distance = np.maximum(1.0 - np.exp(rate(mutant) - level), 0.0) / worst
            CR = self.crossover_max - CR_span * np.minimum(mutant_distance, 1.0)  # [depf2015] eq. 6
            gene = (draws[..., 2:3] * 2).astype(np.intp)
            crossed = (draws[..., 3:5] <= CR[:, :, None]) | (gene == np.arange(2))
            trial = np.where(crossed, mutant, x[:, :movers])  # [depf2015] eq. 5
            value = rate(trial)
            better = value > fitness[:, :movers]  # [depf2015] eq. 7
            x[:, :movers] = np.where(better[:, :, None], trial, x[:, :movers])
            fitness[:, :movers] = np.where(better, value, fitness[:, :movers])
        return x

    def _mutants(self, x: Float, leader: Float, F: Float, draws: Float) -> Float:
        """Return the mutants, shape (R, n, 2): the three readings of [depf2015] eq. 3."""
        count, movers = x.shape[1], draws.shape[1]
        own = x[:, :movers]
        first = (np.arange(movers) + 1 + (draws[..., 0] * (count - 1)).astype(np.intp)) % count
        one = take_particles(x, first)
        if self.mutation == "best-r":
            return own + F * (leader - one)
        second = (first + 1 + (draws[..., 1] * (count - 1)).astype(np.intp)) % count
        base = own if self.mutation == "current-to-best" else one
        return base + F * (leader - base) + F * (one - take_particles(x, second))


def resample_move(
    form: EvolvingFilter, recent: Scenario, cloud: Cloud, prior: Float, streams: Streams
) -> tuple[Cloud, int]:
    """Resample, and move all by DE-MC on prior times likelihood [terbraak2006]; the weights are equal after.

    See `move_worst` for arguments and results.
    """
    mean, covariance = moments(prior, cloud.x[..., :2])
    weights = normalise(cloud.log_weights)
    chosen = systematic(weights, streams.uniform(1, 1)[:, 0, 0])
    x = np.take_along_axis(cloud.x, chosen[:, :, None], axis=1)
    bias = np.broadcast_to(
        moments(weights, cloud.level)[0][:, None], cloud.level.shape
    )  # whoever moves where
    cloud = replace(cloud, x=x, level=bias, log_weights=np.zeros(weights.shape))
    rate = CountedFitness(posterior(form, recent, cloud, mean, covariance))
    position = x[..., :2].copy()
    level = rate(position)
    for _ in range(form.generations):
        position, level = de_mc_generation(position, level, rate, streams)
    x[..., :2] = position
    return cloud, rate.points
