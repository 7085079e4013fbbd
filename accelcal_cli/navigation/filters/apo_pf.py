"""APO-PF: artificial physics moves the predicted particles [xie2009], reconstructed from [depf2015] section 1.

Better particles attract and worse ones repel, F_ij = +-G m_i m_j (x_j - x_i). Sorted by fitness, the sums over j are
cumulative sums of m_j and m_j x_j, so that a generation costs N log N instead of N^2.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.evolution import EvolvingFilter, Fitness
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@FILTERS.register("apo-pf")
@dataclass(frozen=True)
class ApoPf(EvolvingFilter):
    """Particle filter with artificial physics optimisation [xie2009]."""

    inertia: float = setting(0.6, "w, part of the velocity that is kept", low=0.0, high=1.0)

    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return the particles after `generations` of v = w v + lambda F / m, x += v; G = 1 / sum m."""
        x, fitness = x.copy(), fitness.copy()
        velocity = np.zeros_like(x[:, :movers])
        for _ in range(self.generations):
            push = forces(x, fitness)[:, :movers]
            velocity = self.inertia * velocity + streams.uniform(movers, 1) * push
            x[:, :movers] += velocity
            fitness[:, :movers] = rate(x[:, :movers])
        return x


def masses(fitness: Float) -> Float:
    """Return m_i = exp((f_i - f_best) / (f_best - f_worst)), shape (R, N), of weights f = exp(log fitness)."""
    best = fitness.max(axis=1, keepdims=True)
    weights = np.exp(fitness - best)
    span = 1.0 - weights.min(axis=1, keepdims=True)
    return np.asarray(np.exp((weights - 1.0) / np.where(span > 0, span, 1.0)))


def forces(x: Float, fitness: Float) -> Float:
    """Return sum_j F_ij / m_i on each particle, shape (R, N, 2), with G = 1 / sum_j m_j.

    Args:
        x: shape (R, N, 2); fitness: shape (R, N), larger is better; the force on the best is zero.
    """
    runs, count = fitness.shape
    order = np.argsort(-fitness, axis=1, kind="stable")
    flat = order + count * np.arange(runs)[:, None]
    mass = masses(fitness).ravel()[flat]
    better = np.cumsum(mass, axis=1) - mass
    total = mass.sum(axis=1, keepdims=True)
    worse = total - better - mass
    force = np.empty((runs, 2, count))
    for axis in (0, 1):
        place = np.ascontiguousarray(x[..., axis]).ravel()[flat]
        moment = mass * place
        below = np.cumsum(moment, axis=1) - moment
        above = moment.sum(axis=1, keepdims=True) - below - moment
        push = (below - better * place - above + worse * place) / total
        push[:, 0] = 0.0
        own = np.empty(runs * count)
        own[flat] = push
        force[:, axis] = own.reshape(runs, count)
    return force.swapaxes(1, 2)
