"""Differential evolution of position particles: the paper's operators, and its Markov chain kin [terbraak2006].

Names are those of optimizers.ade, which minimises a cost by the same equations. Here the fitness is a logarithm and its
exponential, the weight, is maximised, as the paper does; the mutation is best-r unless stated, as its text reads; and
only the first particles move, while best and worst are of all.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.navigation.particle import Fitness
from accelcal_cli.streams import Float, Int, Streams

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
