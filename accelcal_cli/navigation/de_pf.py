"""DE-PF: differential evolution inside a particle filter [depf2015], as printed and in the forms that were tried.

`mode: literal` is the paper's text. In `mode: default` the setting `road` chooses what keeps the evolution from
destroying the posterior; see docs/explanation/gravity-navigation.md for what each is worth.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Literal

import numpy as np

from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.differential import Operators, evolve, metropolis
from accelcal_cli.navigation.filters import FILTERS, Track
from accelcal_cli.navigation.marginal import Marginal
from accelcal_cli.navigation.particle import Cloud, Counted, Evolving, Fitness
from accelcal_cli.navigation.resampling import moments, systematic
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.registry import setting
from accelcal_cli.streams import Float, Streams

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
