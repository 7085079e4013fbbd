"""PSO-PF: a Gaussian particle swarm moves the particles [fang2007], reconstructed from [depf2015] section 1."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.evolution import EvolvingFilter, Fitness, best_particle
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.rng import Streams


@FILTERS.register("pso-pf")
@dataclass(frozen=True)
class PsoPf(EvolvingFilter):
    """Particle filter with a Gaussian particle swarm, without inertia or velocity limit [fang2007]."""

    def evolve(self, x: Float, fitness: Float, movers: int, rate: Fitness, streams: Streams) -> Float:
        """Return the particles after `generations` of v = |n1| (pbest - x) + |n2| (gbest - x)."""
        place, own, own_fitness = x[:, :movers], x[:, :movers].copy(), fitness[:, :movers]
        best, best_fitness = best_particle(x, fitness)
        for _ in range(self.generations):
            pull = np.abs(streams.normal(movers, 4))
            place = place + pull[..., :2] * (own - place) + pull[..., 2:] * (best - place)
            new = rate(place)
            better = new > own_fitness
            own = np.where(better[:, :, None], place, own)
            own_fitness = np.where(better, new, own_fitness)
            challenger, value = best_particle(own, own_fitness)
            best = np.where((value > best_fitness)[:, :, None], challenger, best)
            best_fitness = np.maximum(value, best_fitness)
        return np.concatenate([place, x[:, movers:]], axis=1)
