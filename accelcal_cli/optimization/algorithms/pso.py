"""Particle swarm optimization with inertia weight, global best, clipped velocity and position.

Kennedy and Eberhart 1995; the inertia weight is Shi and Eberhart's; w = 0.7298 with c1 = c2 = 1.49618 is the
constriction of Clerc and Kennedy [clerc2002]. The DPSO paper runs it with c1 = c2 = 2 and the same w, which
is beyond the order-2 stability bound c1 + c2 < 24 (1 - w^2) / (7 - 5 w) = 3.35 and stalls.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import Chance, best_of, better_of, drawn, each, press
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State
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
    chances: tuple[Chance, ...] = ()  # r1 and r2, (R, 2, P, D)


def pairs(u: Float) -> Float:
    """Return the random numbers of both pulls side by side, shape (R, K, 2, P, D), from u, shape (R, K, P, 2 D)."""
    runs, steps, population, columns = u.shape
    return u.swapaxes(2, 3).reshape(runs, steps, 2, columns // 2, population).swapaxes(3, 4)


def velocity(
    x: Float, v: Float, memory: Float, leader: Float, r: Float, inertia: float, c1: float, c2: float
) -> Float:
    """Return the new velocity, [dpso2014] eq. 1, where c1 goes with the global best.

    All of shape (R, P, D), leader (R, D), r uniform of shape (R, 2, P, D).
    """
    social = leader[:, None] - x
    social *= r[:, 0]
    social *= c1
    cognitive = memory - x
    cognitive *= r[:, 1]
    cognitive *= c2
    social += cognitive
    moved = v * inertia
    moved += social
    return moved


@OPTIMIZERS.register("pso")
@dataclass(frozen=True)
class ParticleSwarm(Optimizer):
    """Particle swarm optimization."""

    family = "swarm"
    paper = "clerc2002"

    inertia: float = setting(0.7298, "inertia weight (w)", low=0, high=2)
    social: float = setting(1.49618, "pull towards the global best (c1)", low=0, high=10)
    cognitive: float = setting(1.49618, "pull towards the own best (c2)", low=0, high=10)
    speed: float = setting(0.2, "velocity limit as a part of the half box (v_max)", above=0, high=100)
    draws: int = setting(1, "uniform numbers averaged for each pull", low=1, high=100)

    def init(self, problem: Problem, x: Float, rng: Streams) -> SwarmState:
        """Start at rest: v = 0."""
        fx = problem.cost(x)
        return SwarmState(x, fx, np.zeros_like(x), x, fx, best_of(x, fx))

    def step(self, problem: Problem, state: SwarmState, rng: Streams) -> SwarmState:
        """Move the swarm once."""
        x = state.x
        (r,), *ahead = state.chances or self._draw(state, rng)
        v = velocity(
            x, state.velocity, state.memory, state.leader, r, self.inertia, self.social, self.cognitive
        )
        low, high = problem.limits
        limit = 0.5 * self.speed * (high - low)
        press(v, -limit, limit)
        x = x + v  # [dpso2014] eq. 2
        press(x, low, high)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)
        return SwarmState(x, fx, v, memory, memory_cost, best_of(memory, memory_cost), tuple(ahead))

    def _draw(self, state: SwarmState, rng: Streams) -> tuple[Chance, ...]:
        """Return r1 and r2 of the iterations to come, each the mean of `draws` uniform numbers."""
        population, dimensions = state.x.shape[1:]
        u = drawn(rng, state.fx, population, self.draws * 2 * dimensions)
        if self.draws > 1:
            parts = u.swapaxes(2, 3).reshape(*u.shape[:2], self.draws, 2 * dimensions, population)
            u = (np.add.reduce(parts, axis=2) / self.draws).swapaxes(2, 3)
        return each(pairs(u))
