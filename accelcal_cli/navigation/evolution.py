"""Particle filters whose particles an evolution moves, and where the evolution enters the update [depf2015] section 6.

A filter says how its particles move (`EvolvingFilter.evolve`); a strategy says which of them move, when, and what is
the fitness.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.particle_filter import BLIND, Cloud, ParticleFilter, moments, normalise
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

Fitness = Callable[[Float], Float]
"""Logarithm of the fitness, shape (R, n), of positions, shape (R, n, 2)."""

GATE = 3.0
"""Evolved particles stay within so many sigma of the predicted cloud [chosen]."""


class CountedFitness:
    """A fitness that counts the points at which it is evaluated.

    Attributes:
        points: of all runs together.
    """

    def __init__(self, fitness: Fitness) -> None:
        """Start at zero."""
        self.fitness, self.points = fitness, 0

    def __call__(self, position: Float) -> Float:
        """Return the fitness of positions, shape (R, n, 2)."""
        self.points += position.shape[0] * position.shape[1]
        return self.fitness(position)


@dataclass(frozen=True)
class EvolvingFilter(ParticleFilter):
    """A particle filter whose predicted particles are moved by an evolution.

    Mode `literal` moves all particles at every epoch, as the paper prints it: by the likelihood alone, or with
    `fitness: transition` by all of its eq. 2. In mode `default` only the worst fifth moves, only when the weights
    degenerate, and the fitness is the posterior: the likelihood times the Gaussian of the predicted cloud, within three
    sigma.
    """

    generations: int = setting(20, "of the evolution per epoch", low=0, high=1000)
    fitness: Literal["likelihood", "transition"] = setting(
        "likelihood",
        "in mode literal: the likelihood alone, or times the transition density from the particle's last position, "
        "as eq. 2 of the paper can be read",
    )
    fraction: float = setting(0.2, "part of the particles that moves in mode default", above=0.0, high=1.0)

    @abstractmethod
    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return particles of which the first `movers` have moved.

        Args:
            x: positions, shape (R, N, 2), worst first in mode default.
            fitness: shape (R, N).
            movers: n, how many may move; rate: fitness of positions, shape (R, n, 2).
        """

    def __post_init__(self) -> None:
        """Refuse values out of range, and a fitness that would have no effect."""
        super().__post_init__()
        if self.mode != "literal" and self.fitness != "likelihood":
            raise ConfigError("fitness: has no effect in mode default; set mode: literal or leave it out")

    @property
    def evolution(self) -> Evolution:
        """The strategy that the settings select."""
        return evolve_all if self.mode == "literal" else evolve_degenerate

    def update(self, scenario: Scenario, cloud: Cloud, k: int, streams: Streams) -> tuple[Cloud, float, Bool]:
        """Return the cloud evolved and weighed; see `ParticleFilter.update`."""
        if not self.generations:
            return super().update(scenario, cloud, k, streams)
        return self.evolution(self, scenario, cloud, k, streams)


def best_particle(x: Float, fitness: Float) -> tuple[Float, Float]:
    """Return the best particle, shape (R, 1, 2), and its fitness, shape (R, 1)."""
    index = fitness.argmax(axis=1)[:, None]
    return np.take_along_axis(x, index[:, :, None], axis=1), np.take_along_axis(fitness, index, axis=1)


Evolution = Callable[[EvolvingFilter, Scenario, Cloud, int, Streams], tuple[Cloud, float, Bool]]
"""A strategy: which particles of a filter move at an epoch, and toward what; see `ParticleFilter.update`."""

Move = Callable[[EvolvingFilter, Scenario, Cloud, Float, Streams], tuple[Cloud, int]]
"""How the runs of a weighed cloud move; see `move_worst`."""


def evolve_all(
    form: EvolvingFilter, scenario: Scenario, cloud: Cloud, k: int, streams: Streams
) -> tuple[Cloud, float, Bool]:
    """As printed: all particles move at every epoch toward the fitness, and are then weighed by it."""
    before = cloud.before if form.fitness == "transition" else None
    likelihood = CountedFitness(lambda position: form.likelihood(scenario, cloud, k, position))

    def fitness(position: Float) -> Float:
        if before is None:
            return likelihood(position)
        away = np.square(position - before).sum(axis=2)
        return np.asarray(
            likelihood(position) - 0.5 * away / form.step_noise(scenario) ** 2
        )  # [depf2015] eq. 2

    x = cloud.x.copy()
    level = fitness(x[..., :2])
    x[..., :2] = form.evolve(x[..., :2], level, form.particles, fitness, streams)
    weighed = replace(cloud, x=x, log_weights=cloud.log_weights + fitness(x[..., :2]))
    return weighed, likelihood.points / scenario.runs, level.max(axis=1) > BLIND


def move_worst(
    form: EvolvingFilter, recent: Scenario, cloud: Cloud, prior: Float, streams: Streams
) -> tuple[Cloud, int]:
    """Move the worst particles toward the posterior, within three sigma; their old weight becomes the mean one.

    Args:
        form: the filter.
        recent: the measurements that the fitness looks at; the last one is that of the epoch.
        cloud: weighed particles; prior: their weights as predicted, shape (R, N).
        streams: of the runs.

    Returns:
        The cloud moved, and the look-ups of all its runs.
    """
    mean, covariance = moments(prior, cloud.x[..., :2])
    scale = np.sqrt(np.einsum("rii->ri", covariance)) + 1e-9
    order = np.argsort(cloud.log_weights, axis=1, kind="stable")
    x, level = (np.take_along_axis(part, order[:, :, None], axis=1) for part in (cloud.x, cloud.level))
    logs = np.take_along_axis(cloud.log_weights, order, axis=1)
    cloud = replace(cloud, x=x.copy(), level=level, log_weights=logs)
    fitness = posterior(form, recent, cloud, mean, covariance)

    def gated(position: Float) -> Float:
        inside = (np.abs(position - mean[:, None]) <= GATE * scale[:, None]).all(axis=2)
        return np.where(inside, fitness(position), -np.inf)

    rate = CountedFitness(gated)
    movers = max(1, round(form.fraction * form.particles))
    position = x[..., :2]
    moved = form.evolve(position, rate(position), movers, rate, streams)[:, :movers]
    inside = np.isfinite(rate(moved))[:, :, None]
    x[:, :movers, :2] = np.where(inside, moved, position[:, :movers])
    share = np.take_along_axis(prior / prior.max(axis=1, keepdims=True), order, axis=1)[:, :movers]
    likelihood = form.likelihood(recent, cloud, recent.epochs - 1, x[:, :movers])
    logs[:, :movers] = likelihood + np.log(share.mean(axis=1, keepdims=True) + 1e-300)
    return replace(cloud, x=x), rate.points * recent.epochs + likelihood.size


def evolve_degenerate(
    form: EvolvingFilter,
    scenario: Scenario,
    cloud: Cloud,
    k: int,
    streams: Streams,
    move: Move = move_worst,
    span: float = 0.0,
) -> tuple[Cloud, float, Bool]:
    """Weigh the particles, and move them where the weights degenerate; the measurements of a span in s count."""
    predicted = cloud.log_weights
    cloud, lookups, on_map = ParticleFilter.update(form, scenario, cloud, k, streams)
    rows = np.flatnonzero(form.degenerate(normalise(cloud.log_weights)))
    if len(rows):
        recent = scenario.part(rows, max(0, k + 1 - scenario.epochs_in(span)), k + 1)
        part, points = move(form, recent, cloud.part(rows), normalise(predicted[rows]), streams.take(rows))
        cloud.x[rows], cloud.log_weights[rows], cloud.level[rows] = part.x, part.log_weights, part.level
        lookups += points / scenario.runs
    return cloud, lookups, on_map


def posterior(
    form: EvolvingFilter, recent: Scenario, cloud: Cloud, mean: Float, covariance: Float
) -> Fitness:
    """Return the logarithm of the likelihood of the recent measurements times the Gaussian of the predicted cloud.

    Of several measurements it is the likelihood that holds if the position error is the same at all of them.

    Args:
        form: the filter; recent: the measurements; cloud: whose first particles stand at the positions.
        mean, covariance: of the predicted positions, shape (R, 2) and (R, 2, 2).
    """
    inverse = np.linalg.inv(covariance + 1e-6 * np.eye(2))

    def fitness(position: Float) -> Float:
        away = position - mean[:, None]
        distance = ((away @ inverse) * away).sum(axis=2)
        likelihood = np.zeros(position.shape[:2])
        for epoch in range(recent.epochs):
            likelihood += form.likelihood(recent, cloud, epoch, position)
        likelihood -= 0.5 * distance
        return likelihood

    return fitness
