"""Differential evolution, as Storn and Price wrote it [storn1997] and as the DPSO paper prints it [dpso2014].

The paper prints equation 3, DE/rand/1, with the individual itself as base vector ("current/1"); Storn and
Price take a random one. Its crossover keeps the parent's gene where the random number is at most P_c, so that
P_c is the share of parental genes; Storn and Price's CR is the share of mutant genes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.optimizers.base import OPTIMIZERS, Optimizer, State, best_of, gather, partners
from accelcal_cli.problem import Problem
from accelcal_cli.registry import setting
from accelcal_cli.streams import Float, Streams


def keeps_parent(u: Float, share: float, forced: Float) -> NDArray[np.bool_]:
    """Return where a trial keeps its parent's gene, [dpso2014] eq. 5.

    Args:
        u: uniform numbers, one a gene, shape (R, P, D).
        share: P_c, the probability to keep the parent's gene.
        forced: uniform numbers, shape (R, P), that choose the gene J_rand always taken from the mutant.
    """
    keep = u <= share
    gene = (forced * u.shape[2]).astype(np.intp)
    keep &= gene[..., None] != np.arange(u.shape[2])
    return keep


@OPTIMIZERS.register("de")
@dataclass(frozen=True)
class DifferentialEvolution(Optimizer):
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

    def init(self, problem: Problem, x: Float, rng: Streams) -> State:
        """Evaluate the starting population."""
        return State(x, problem.cost(x))

    def step(self, problem: Problem, state: State, rng: Streams) -> State:
        """Make one generation, all trials from the old population."""
        x, fx = state.x, state.fx
        population, dimensions = x.shape[1:]
        u = rng.uniform(population, dimensions + 4)
        chosen = gather(x, partners(u[..., :2], population))
        mutant = chosen[:, :population] - chosen[:, population:]
        mutant *= self.weight
        mutant += self._base(x, fx, u[..., 2])  # [dpso2014] eq. 3 and 4
        np.clip(mutant, problem.lower, problem.upper, out=mutant)
        share = self.crossover if self.crossover_keeps == "parent" else 1.0 - self.crossover
        np.copyto(mutant, x, where=keeps_parent(u[..., 4:], share, u[..., 3]))
        trial_cost = problem.cost(mutant)
        better = trial_cost < fx  # [dpso2014] eq. 6
        return replace(state, x=np.where(better[..., None], mutant, x), fx=np.where(better, trial_cost, fx))

    def _base(self, x: Float, fx: Float, u: Float) -> Float:
        if self.strategy == "best/1":
            return best_of(x, fx)[0]
        if self.strategy == "current/1":
            return x
        return gather(x, (u * x.shape[1]).astype(np.intp))
