"""DE-PSO: a particle swarm and a differential evolution that share one global best [dpso2014].

Dai Shaowu, Wang Kehong, Qing Zenghong, "Rapid calibration of accelerometer based on hybrid PSO", 2014. Two
equal sub-populations evolve in parallel from different halves of the box; after each iteration the better of
their two best points leads both. The inertia weight and the share of the own position in the differential
mutation fall along an S-curve; the swarm starts with an inertia above 1 and lives on its velocity limit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.optimizers.base import OPTIMIZERS, Optimizer, State, best_of, gather, partners
from accelcal_cli.optimizers.de import keeps_parent
from accelcal_cli.optimizers.pso import remember, velocity
from accelcal_cli.problem import Problem
from accelcal_cli.registry import setting
from accelcal_cli.streams import Float, Streams


@dataclass(frozen=True)
class HybridState(State):
    """Both halves: x and fx hold the swarm's positions first, then the evolving individuals."""

    velocity: Float  # (R, P/2, D)
    memory: Float  # pbest, (R, P/2, D)
    memory_cost: Float  # (R, P/2)
    leader: Float  # common best, (R, 1, D)
    iteration: int


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
        return HybridState(
            x, fx, np.zeros_like(x[:, :half]), x[:, :half], fx[:, :half], best_of(x, fx)[0], iteration=0
        )

    def step(self, problem: Problem, state: HybridState, rng: Streams) -> HybridState:
        """Move both halves once; one call evaluates them together."""
        population, dimensions = state.x.shape[1:]
        half = population // 2
        u = rng.uniform(population - half, 3 * dimensions + 3)
        falling = self._curve(state.iteration)
        v = velocity(
            state.x[:, :half],
            state.velocity,
            state.memory,
            state.leader,
            u[:, :half, : 2 * dimensions],
            self.inertia_max - (self.inertia_max - self.inertia_min) * falling,  # [dpso2014] eq. 7
            self.social,
            self.cognitive,
        )
        limit = 0.5 * self.speed * (problem.upper - problem.lower)
        np.clip(v, -limit, limit, out=v)
        trial = np.empty_like(state.x)
        np.add(state.x[:, :half], v, out=trial[:, :half])  # [dpso2014] eq. 2
        own = self.own_max - (self.own_max - self.own_min) * falling  # [dpso2014] eq. 9
        trial[:, half:] = self._mutants(state.x[:, half:], state.leader, own, u[..., 2 * dimensions :])
        np.clip(trial, problem.lower, problem.upper, out=trial)
        fx = problem.cost(trial)
        return self._select(state, trial, fx, v)

    def _curve(self, iteration: int) -> float:
        """Return 1 / (1 + a b^(100 k / k_max)), which rises from 1 / (1 + a) to 1."""
        return float(1.0 / (1.0 + self.curve_a * self.curve_b ** (100.0 * iteration / self.iterations)))

    def _mutants(self, x: Float, leader: Float, own: float, u: Float) -> Float:
        """Return the trials of the evolving half: mutation and crossover."""
        population, dimensions = x.shape[1:]
        chosen = gather(x, partners(u[..., :2], population))
        mutant = chosen[:, :population] - chosen[:, population:]
        mutant *= self.weight
        mutant += own * x
        mutant += (1.0 - own) * leader  # [dpso2014] eq. 8
        np.copyto(mutant, x, where=keeps_parent(u[..., 3:], self.crossover, u[..., 2]))  # [dpso2014] eq. 5
        return mutant

    def _select(self, state: HybridState, trial: Float, fx: Float, v: Float) -> HybridState:
        """Keep every swarm position, and a trial only where it is better than its parent."""
        half = v.shape[1]
        memory, memory_cost = remember(state.memory, state.memory_cost, trial[:, :half], fx[:, :half])
        worse = fx[:, half:] >= state.fx[:, half:]  # [dpso2014] eq. 6
        np.copyto(trial[:, half:], state.x[:, half:], where=worse[..., None])
        fx = np.concatenate((fx[:, :half], np.where(worse, state.fx[:, half:], fx[:, half:])), axis=1)
        swarm_best, swarm_cost = best_of(memory, memory_cost)
        evolved_best, evolved_cost = best_of(trial[:, half:], fx[:, half:])
        leader = np.where((swarm_cost < evolved_cost)[:, None, None], swarm_best, evolved_best)
        return HybridState(trial, fx, v, memory, memory_cost, leader, iteration=state.iteration + 1)
