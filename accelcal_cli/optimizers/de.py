"""Differential evolution, as Storn and Price wrote it [storn1997] and as the DPSO paper prints it [dpso2014].

The paper prints equation 3, DE/rand/1, with the individual itself as base vector ("current/1"); Storn and
Price take a random one. Its crossover keeps the parent's gene where the random number is at most P_c, so that
P_c is the share of parental genes; Storn and Price's CR is the share of mutant genes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

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
from accelcal_cli.problem import Problem
from accelcal_cli.registry import setting
from accelcal_cli.streams import Float, Int, Streams


def mutates(u: Float, share: float, gene: Int) -> NDArray[np.bool_]:
    """Return where a trial takes the mutant's gene, shape (R, P, D), [dpso2014] eq. 5.

    Args:
        u: uniform numbers, one a gene, shape (R, P, D).
        share: P_c, the probability to keep the parent's gene.
        gene: J_rand, the gene always taken from the mutant, shape (R, P).
    """
    taken = u > share
    taken[np.arange(u.shape[0])[:, None], np.arange(u.shape[1]), gene] = True
    return taken


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
        picks = integers(u[..., :4], population - 1, population - 2, population, dimensions)
        share = self.crossover if self.crossover_keeps == "parent" else 1.0 - self.crossover
        trial = self._change(x, fx, picks)
        trial *= mutates(u[..., 4:], share, picks[:, 3])  # [dpso2014] eq. 5
        trial += x
        press(trial, *problem.limits)
        return State(*better_of(x, fx, trial, problem.cost(trial)))  # [dpso2014] eq. 6

    def _change(self, x: Float, fx: Float, picks: Int) -> Float:
        """Return what mutation adds to x, [dpso2014] eq. 3 and 4: (base - x) + F (x_n - x_m)."""
        n, m = partners(picks[:, :2])
        change = gather(x, n)
        change -= gather(x, m)
        change *= self.weight
        if self.strategy == "rand/1":
            change += gather(x, picks[:, 2])
            change -= x
        elif self.strategy == "best/1":
            change += best_of(x, fx)[:, None]
            change -= x
        return change
