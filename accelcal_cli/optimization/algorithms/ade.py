"""ADE: differential evolution with F and CR of each individual adapted to its rank [depf2015].

The evolution inside the DE-PF particle filter, as an optimizer of its own: a large F for an individual far from the
best cost, a large CR for a promising mutant, greedy selection. The paper maximises a weight; here a cost is minimised,
with the same differences of cost.

Names are those of navigation.differential, which moves particles by the same equations and differs in three things: it
maximises the weight, its mutation is best-r unless stated, and only the first of its particles may move, while best
and worst are of all. Here the mutation is current-to-best, because best-r stalls on a cost (docs/optimizers/ade.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import best_of, better_of, gather, integers, partners
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, PopulationAlone, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

LAMBDA = 1e-13
"""Keeps the ratios finite when all costs are equal; the paper's value."""


@OPTIMIZERS.register("ade")
@dataclass(frozen=True)
class AdaptiveEvolution(PopulationAlone, Optimizer[State]):
    """Adaptive differential evolution of the DE-PF paper."""

    family = "evolution"
    paper = "depf2015"

    weight_min: float = setting(0.4, "F of the best individual (F_min)", above=0, high=2)
    weight_max: float = setting(1.0, "F of the worst individual (F_max)", above=0, high=2)
    crossover_min: float = setting(0.0, "CR of the worst mutant (CR_min)", low=0, high=1)
    crossover_max: float = setting(1.0, "CR of the best mutant (CR_max)", low=0, high=1)
    mutation: Literal["best-r", "current-to-best"] = setting(
        "current-to-best",
        "best-r: m + F (best - m_r) as the paper's text reads; current-to-best: m + F (best - m) + F (m_r1 - m_r2)",
    )

    def step(self, problem: Problem, state: State, rng: Streams) -> State:
        """Make one generation: mutants, their costs, trials, selection; two evaluations an individual."""
        x, fx = state.x, state.fx
        population, dimensions = x.shape[1:]
        u = rng.uniform(population, dimensions + 3)
        F = self.weight_min + (self.weight_max - self.weight_min) * _distance(fx, fx)  # [depf2015] eq. 4
        mutant = self._mutants(x, fx, F[..., None], u[..., :2])
        np.clip(mutant, problem.lower, problem.upper, out=mutant)
        mutant_cost = problem.cost(mutant)
        spread = self.crossover_max - self.crossover_min
        CR = self.crossover_max - spread * _distance(mutant_cost, fx)  # [depf2015] eq. 6
        gene = (u[..., 2] * dimensions).astype(np.intp)
        take = (u[..., 3:] <= CR[..., None]) | (gene[..., None] == np.arange(dimensions))
        trial = np.where(take, mutant, x)  # [depf2015] eq. 5
        return State(*better_of(x, fx, trial, problem.cost(trial)))  # [depf2015] eq. 7

    def _mutants(self, x: Float, fx: Float, F: Float, u: Float) -> Float:
        """Return the mutants, [depf2015] eq. 3."""
        towards = best_of(x, fx)[:, None] - x
        first, second = partners(integers(u, x.shape[1] - 1, x.shape[1] - 2))
        if self.mutation == "best-r":
            towards = towards + x - gather(x, first)
        else:
            towards += gather(x, first) - gather(x, second)
        return np.asarray(x + F * towards)


def _distance(cost: Float, fx: Float) -> Float:
    """Return the cost's distance from the best over the worst's, cut to [0, 1], shape (R, P)."""
    best, worst = fx.min(axis=1, keepdims=True), fx.max(axis=1, keepdims=True)
    ratio = (cost - best) / (worst - best + LAMBDA)
    return np.clip(np.where(np.isnan(ratio), 1.0, ratio), 0.0, 1.0)
