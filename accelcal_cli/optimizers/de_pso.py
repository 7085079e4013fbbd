"""DE-PSO: a particle swarm and a differential evolution that share one global best [dpso2014].

Dai Shaowu, Wang Kehong, Qing Zenghong, "Rapid calibration of accelerometer based on hybrid PSO", 2014. Two
equal sub-populations evolve in parallel from different halves of the box; after each iteration the better of
their two best points leads both. The inertia weight and the share of the own position in the differential
mutation fall along an S-curve; the swarm starts with an inertia above 1 and lives on its velocity limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.optimizers.base import (
    OPTIMIZERS,
    Optimizer,
    State,
    best_of,
    better_of,
    gather,
    integers,
    partners,
    press,
)
from accelcal_cli.optimizers.de import mutates
from accelcal_cli.optimizers.pso import velocity
from accelcal_cli.problem import Problem
from accelcal_cli.registry import setting
from accelcal_cli.streams import Float, Int, Streams

AHEAD = 1600
"""Points whose chances are drawn at once: several iterations of a small batch. Each run draws its own in the order
of its iterations, so that they do not depend on its company."""


@dataclass(frozen=True)
class Chances:
    """What chance decides in K iterations."""

    r: Float  # uniform numbers of the swarm, (R, K, P/2, 2 D)
    picks: Int  # partners n and m of the individuals, modulo their number, and J_rand, (R, K, 3, P/2)
    taken: Float  # 1 where a trial takes the mutant's gene, 0 where its parent's, (R, K, P/2, D)


@dataclass(frozen=True)
class HybridState(State):
    """Both halves, the swarm first: x and fx are the points of the last evaluation, positions and trials."""

    velocity: Float  # (R, P/2, D)
    memory: Float  # pbest, then the evolving individuals: what only a better point replaces, (R, P, D)
    memory_cost: Float  # (R, P)
    leader: Float  # common best, (R, D)
    iteration: int
    ahead: int = 0  # iterations drawn and not yet made, the last of the K
    chances: Chances | None = None


@OPTIMIZERS.register("de-pso")
@dataclass(frozen=True)
class HybridSwarm(Optimizer):
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
        ahead, chances = state.ahead, state.chances
        if chances is None:
            ahead = max(1, min(AHEAD // state.fx.size, self.iterations - state.iteration))
            chances = self._draw(state, ahead, rng)
        x, v = self._moved(problem, state, chances, -ahead)
        ahead, chances = (ahead - 1, chances) if ahead > 1 else (0, None)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)  # [dpso2014] eq. 6
        leader, k = best_of(memory, memory_cost), state.iteration + 1
        return HybridState(x, fx, v, memory, memory_cost, leader, k, ahead, chances)

    def _moved(self, problem: Problem, state: HybridState, chances: Chances, k: int) -> tuple[Float, Float]:
        """Return both halves' next points and the swarm's velocities by the k-th chances."""
        x, half, curve = np.empty_like(state.x), state.velocity.shape[1], self._curve(state.iteration)
        low, high = problem.limits
        limit = 0.5 * self.speed * (high - low)
        v = self._velocity(state, chances.r[:, k], curve)
        press(v, -limit, limit)
        np.add(state.x[:, :half], v, out=x[:, :half])  # [dpso2014] eq. 2
        individuals = state.memory[:, half:].copy(order="K")
        change = self._change(individuals, state.leader, chances.picks[:, k], curve)
        change *= chances.taken[:, k]  # [dpso2014] eq. 5
        np.add(individuals, change, out=x[:, half:])
        press(x, low, high)
        return x, v

    def _draw(self, state: HybridState, steps: int, rng: Streams) -> Chances:
        """Return the chances of the next steps."""
        runs, population, dimensions = state.x.shape
        half = state.velocity.shape[1]
        rest, columns = population - half, 3 * dimensions + 3
        u = rng.uniform(rest, steps * columns).transpose(0, 2, 1).reshape(-1, columns, rest)
        u = u.transpose(0, 2, 1)
        picks = integers(u[..., -3:], rest - 1, rest - 2, dimensions)
        taken = mutates(u[..., 2 * dimensions : -3], self.crossover, picks[:, 2]).astype(float)
        partners(picks)
        r, shape = u[:, :half, : 2 * dimensions], (runs, steps)
        return Chances(
            r.reshape(*shape, half, -1), picks.reshape(*shape, 3, rest), taken.reshape(*shape, rest, -1)
        )

    def _curve(self, iteration: int) -> float:
        """Return 1 / (1 + a b^(100 k / k_max)), which rises from 1 / (1 + a) to 1."""
        return float(1.0 / (1.0 + self.curve_a * self.curve_b ** (100.0 * iteration / self.iterations)))

    def _velocity(self, state: HybridState, r: Float, curve: float) -> Float:
        """Return the swarm's velocities before their limit."""
        half = state.velocity.shape[1]
        inertia = self.inertia_max - (self.inertia_max - self.inertia_min) * curve  # [dpso2014] eq. 7
        x, memory = state.x[:, :half], state.memory[:, :half]
        return velocity(x, state.velocity, memory, state.leader, r, inertia, self.social, self.cognitive)

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
