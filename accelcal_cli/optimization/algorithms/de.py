"""Differential evolution, as Storn and Price wrote it [storn1997] and as the DPSO paper prints it [dpso2014].

The paper prints equation 3, DE/rand/1, with the individual itself as base vector ("current/1"); Storn and
Price take a random one. Its crossover keeps the parent's gene where the random number is at most P_c, so that
P_c is the share of parental genes; Storn and Price's CR is the share of mutant genes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from accelcal_cli.arrays import Float, Int
from accelcal_cli.optimization.operators import (
    best_of,
    better_of,
    clip,
    gather,
    integers,
    mutated_genes,
    partners,
)
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, PopulationAlone, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@OPTIMIZERS.register("de")
@dataclass(frozen=True)
class DifferentialEvolution(PopulationAlone, Optimizer[State]):
    """Differential evolution with greedy selection."""

    family = "evolution"
    paper = "storn1997"

    weight: float = setting(0.3, "weight of the difference vector (F)", above=0, high=2)
    crossover: float = setting(0.5, "crossover probability (P_c, or CR)", low=0, high=1)
    strategy: Literal["rand/1", "current/1", "best/1"] = setting(
        "rand/1", "base vector: rand/1 of Storn and Price, current/1 as the DPSO paper prints, best/1"
    )
    crossover_keeps: Literal["parent", "mutant"] = setting(
        "parent",
        "what the crossover probability keeps: parent as in the DPSO paper, mutant as in Storn and Price",
    )

    def step(self, problem: Problem, state: State, rng: Streams) -> State:
        """Make one generation, all trials from the old population."""
        x, fx = state.x, state.fx
        population, dimensions = x.shape[1:]
        picks, mutated = rng.ahead(self._choices, population, 4 + dimensions)
        trial = self._change(x, fx, picks)
        trial *= mutated  # [dpso2014] eq. 5
        trial += x
        clip(trial, *problem.limits)
        return State(*better_of(x, fx, trial, problem.cost(trial)))  # [dpso2014] eq. 6

    def _choices(self, u: Float) -> tuple[Int, Float]:
        """Return n, m and base vector, shape (R, K, 3, P), and 1 where a trial takes the mutant's gene, else 0."""
        population, dimensions = u.shape[2], u.shape[3] - 4
        picks = integers(u[..., :4], population - 1, population - 2, population, dimensions)
        keep = self.crossover if self.crossover_keeps == "parent" else 1.0 - self.crossover
        mutated = mutated_genes(u[..., 4:], keep, picks[..., 3, :])
        partners(picks[..., :2, :])
        return picks[..., :3, :], mutated

    def _change(self, x: Float, fx: Float, picks: Int) -> Float:
        """Return what mutation adds to x, [dpso2014] eq. 3 and 4: (base - x) + F (x_n - x_m)."""
        change = gather(x, picks[:, 0])
        change -= gather(x, picks[:, 1])
        change *= self.weight
        if self.strategy == "rand/1":
            change += gather(x, picks[:, 2])
            change -= x
        elif self.strategy == "best/1":
            change += best_of(x, fx)[:, None]
            change -= x
        return change
