"""Particle swarm optimization with inertia weight, global best, clipped velocity and position.

Kennedy and Eberhart 1995; the inertia weight is Shi and Eberhart's; w = 0.7298 with c1 = c2 = 1.49618 is the
constriction of Clerc and Kennedy [clerc2002]. The DPSO paper runs it with c1 = c2 = 2 and the same w, which
is beyond the order-2 stability bound c1 + c2 < 24 (1 - w^2) / (7 - 5 w) = 3.35 and stalls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import best_of, better_of, clip
from accelcal_cli.optimization.optimizer import OPTIMIZERS, RANDOMS, Optimizer, Randoms, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class SwarmState(State):
    """A swarm: x and fx are the positions and their costs."""

    velocity: Float  # (R, P, D)
    memory: Float  # pbest, (R, P, D)
    memory_cost: Float  # (R, P)
    leader: Float  # gbest, (R, D)


def velocity(
    x: Float,
    v: Float,
    memory: Float,
    leader: Float,
    r1: Float,
    r2: Float,
    inertia: float,
    social: float,
    cognitive: float,
) -> Float:
    """Return w v + c1 r1 (leader - x) + c2 r2 (memory - x), [dpso2014] eq. 1, where c1 goes with the global best.

    All of shape (R, P, D), but leader (R, D); r1 and r2 are uniform numbers, (R, P, 1) where a particle has one for all
    coordinates; inertia is w, social c1, cognitive c2.
    """
    to_leader = leader[:, None] - x
    to_leader *= r1
    to_leader *= social
    to_memory = memory - x
    to_memory *= r2
    to_memory *= cognitive
    to_leader += to_memory
    new = v * inertia
    new += to_leader
    return new


@OPTIMIZERS.register("pso")
@dataclass(frozen=True)
class ParticleSwarm(Optimizer[SwarmState]):
    """Particle swarm optimization."""

    family = "swarm"
    paper = "clerc2002"

    inertia: float = setting(0.7298, "inertia weight (w)", low=0, high=2)
    social: float = setting(1.49618, "pull towards the global best (c1)", low=0, high=10)
    cognitive: float = setting(1.49618, "pull towards the own best (c2)", low=0, high=10)
    speed: float = setting(0.2, "velocity limit as a part of the half box (v_max)", above=0, high=100)
    draws: int = setting(1, "uniform numbers averaged for each pull", low=1, high=100)
    randoms: Randoms = setting("coordinate", RANDOMS)

    def init(self, problem: Problem, x: Float, rng: Streams) -> SwarmState:
        """Start at rest: v = 0."""
        fx = problem.cost(x)
        return SwarmState(x, fx, np.zeros_like(x), x, fx, best_of(x, fx))

    def step(self, problem: Problem, state: SwarmState, rng: Streams) -> SwarmState:
        """Move the swarm once."""
        x, (population, dimensions) = state.x, state.x.shape[1:]
        width = dimensions if self.randoms == "coordinate" else 1
        r1, r2 = rng.ahead(self._pulls, population, self.draws * 2 * width)
        pulls = self.inertia, self.social, self.cognitive
        v = velocity(x, state.velocity, state.memory, state.leader, r1, r2, *pulls)
        low, high = problem.limits
        limit = 0.5 * self.speed * (high - low)
        clip(v, -limit, limit)
        x = x + v  # [dpso2014] eq. 2
        clip(x, low, high)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)
        return SwarmState(x, fx, v, memory, memory_cost, best_of(memory, memory_cost))

    def _pulls(self, u: Float) -> tuple[Float, Float]:
        """Return r1 and r2, each the mean of `draws` of the uniform numbers u, shape (R, K, P, D)."""
        means = np.add.reduce(np.split(u, self.draws, axis=3)) / self.draws if self.draws > 1 else u
        width = means.shape[3] // 2
        return means[..., :width], means[..., width:]
