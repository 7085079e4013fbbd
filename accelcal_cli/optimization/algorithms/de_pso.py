"""DE-PSO: a particle swarm and a differential evolution that share one global best [dpso2014].

Dai Shaowu, Wang Kehong, Qing Zenghong, "Rapid calibration of accelerometer based on hybrid PSO", 2014. Two
equal sub-populations evolve in parallel from different halves of the box; after each iteration the better of
their two best points leads both. The inertia weight and the share of the own position in the differential
mutation fall along an S-curve; the swarm starts with an inertia above 1 and lives on its velocity limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.optimization.algorithms.pso import SwarmState, velocity
from accelcal_cli.optimization.operators import (
    best_of,
    better_of,
    clip,
    gather,
    integers,
    mutated_genes,
    partners,
)
from accelcal_cli.optimization.optimizer import OPTIMIZERS, RANDOMS, Optimizer, Randoms
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class HybridState(SwarmState):
    """Both halves, the swarm first: x and fx are the points of the last evaluation, positions and trials.

    Only the swarm has a velocity, shape (R, P/2, D). The memory is pbest, then the evolving individuals: what only a
    better point replaces. The leader is the common best.
    """

    iteration: int


@OPTIMIZERS.register("de-pso")
@dataclass(frozen=True)
class HybridSwarm(Optimizer[HybridState]):
    """DE-PSO with the settings of the paper's calibration (section 4.2)."""

    family = "swarm and evolution"
    paper = "dpso2014"

    population: int = setting(100, "points of both halves together (N)", low=8, high=1_000_000)
    social: float = setting(2.0, "pull towards the common best (c1)", low=0, high=10)
    cognitive: float = setting(2.0, "pull towards the own best (c2)", low=0, high=10)
    inertia_max: float = setting(1.4, "inertia weight before the S-curve (w_max)", low=0, high=10)
    inertia_min: float = setting(0.2, "inertia weight after it (w_min)", low=0, high=10)
    own_max: float = setting(1.0, "share of the own position before the S-curve (beta_max)", low=0, high=1)
    own_min: float = setting(0.1, "share of the own position after it (beta_min)", low=0, high=1)
    curve_a: float = setting(30.0, "S-curve: a", above=0, high=1e6)
    curve_b: float = setting(0.88, "S-curve: b", above=0, high=1)
    weight: float = setting(0.2, "weight of the difference vector (F)", above=0, high=2)
    crossover: float = setting(0.4, "probability to keep the parent's gene (P_c)", low=0, high=1)
    speed: float = setting(0.2, "velocity limit as a part of the half box (v_max)", above=0, high=100)
    randoms: Randoms = setting("coordinate", RANDOMS)

    def init(self, problem: Problem, x: Float, rng: Streams) -> HybridState:
        """Press the two sub-populations into different halves of the box along the first coordinate."""
        half = x.shape[1] // 2
        x = x.copy(order="K")
        lower, upper = problem.lower[0], problem.upper[0]
        x[:, :half, 0] = 0.5 * (x[:, :half, 0] + lower)
        x[:, half:, 0] = 0.5 * (x[:, half:, 0] + upper)
        fx = problem.cost(x)
        return HybridState(x, fx, np.zeros_like(x[:, :half]), x, fx, best_of(x, fx), iteration=0)

    def step(self, problem: Problem, state: HybridState, rng: Streams) -> HybridState:
        """Move both halves once; one call evaluates them together."""
        x, v = self._moved(problem, state, rng)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)  # [dpso2014] eq. 6
        return HybridState(
            x, fx, v, memory, memory_cost, best_of(memory, memory_cost), iteration=state.iteration + 1
        )

    def _moved(self, problem: Problem, state: HybridState, rng: Streams) -> tuple[Float, Float]:
        """Return both halves' next points and the swarm's velocities."""
        (population, dimensions), half = state.x.shape[1:], state.velocity.shape[1]
        r1, r2, picks, mutated = rng.ahead(
            self._choices, population - half, 2 * self._width(dimensions) + dimensions + 3
        )
        x, curve = np.empty_like(state.x), self._curve(state.iteration)
        low, high = problem.limits
        limit = 0.5 * self.speed * (high - low)
        inertia = self.inertia_max - (self.inertia_max - self.inertia_min) * curve  # [dpso2014] eq. 7
        swarm = (state.x[:, :half], state.velocity, state.memory[:, :half], state.leader)
        v = velocity(*swarm, r1[:, :half], r2[:, :half], inertia, self.social, self.cognitive)
        clip(v, -limit, limit)
        np.add(state.x[:, :half], v, out=x[:, :half])  # [dpso2014] eq. 2
        individuals = state.memory[:, half:].copy(order="K")
        change = self._change(individuals, state.leader, picks, curve)
        change *= mutated  # [dpso2014] eq. 5
        np.add(individuals, change, out=x[:, half:])
        clip(x, low, high)
        return x, v

    def _choices(self, u: Float) -> tuple[Float, Float, Int, Float]:
        """Return r1 and r2, partners n and m, shape (R, K, 2, P/2), and where a trial takes the mutant's gene.

        The genes are of shape (R, K, P/2, D), r1 and r2 likewise or, one per particle, of (R, K, P/2, 1).
        """
        rest, columns = u.shape[2], u.shape[3] - 3
        dimensions = columns // 3 if self.randoms == "coordinate" else columns - 2
        width = self._width(dimensions)
        r1, r2, genes = u[..., :width], u[..., width : 2 * width], u[..., 2 * width : -3]
        picks = integers(u[..., -3:], rest - 1, rest - 2, dimensions)
        mutated = mutated_genes(genes, self.crossover, picks[..., 2, :])
        partners(picks[..., :2, :])
        return r1, r2, picks[..., :2, :], mutated

    def _width(self, dimensions: int) -> int:
        """Return how many numbers each pull of a particle takes."""
        return dimensions if self.randoms == "coordinate" else 1

    def _curve(self, iteration: int) -> float:
        """Return 1 / (1 + a b^(100 k / k_max)), which rises from 1 / (1 + a) to 1."""
        return float(1.0 / (1.0 + self.curve_a * self.curve_b ** (100.0 * iteration / self.iterations)))

    def _change(self, x: Float, leader: Float, picks: Int, curve: float) -> Float:
        """Return what mutation adds to the evolving half.

        The paper's beta x + (1 - beta) leader is x + (1 - beta) (leader - x).
        """
        own = self.own_max - (self.own_max - self.own_min) * curve  # [dpso2014] eq. 9
        change = gather(x, picks[:, 0])
        change -= gather(x, picks[:, 1])
        change *= self.weight
        pull = leader[:, None] - x
        pull *= 1.0 - own
        change += pull  # [dpso2014] eq. 8
        return change
