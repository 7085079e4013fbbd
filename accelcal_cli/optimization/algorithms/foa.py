"""FOA: the fruit fly optimization algorithm [pan2012], steps 1 to 7 as the IFOA paper repeats them [ifoa2021].

Every parameter has a swarm of flies in a plane; fly j of all swarms together is candidate j. The smell is judged
not at the fly but at S = 1 / distance from the origin, so that a candidate's coordinates are always positive: a
minimum with a negative coordinate cannot be reached. The IFOA paper removes that (full_foa, ifoa).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import moved_to_best
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class PlaneState(State):
    """Swarms in the plane: x and fx are the last candidates S and their smells."""

    axis: Float  # X_axis and Y_axis, (R, 1, 2 D)
    smell: Float  # Smell_best, (R,)


@OPTIMIZERS.register("foa")
@dataclass(frozen=True)
class FruitFly(Optimizer[PlaneState]):
    """FOA as published: candidates are reciprocal distances."""

    family = "fruit fly"
    paper = "pan2012"
    converges = False

    population: int = setting(50, "flies of a swarm (n)", low=4, high=1_000_000)
    iterations: int = setting(300, "generations (Maxgen)", low=1, high=100_000_000)
    radius: float = setting(1.0, "search radius, in the problem's own units", above=0, high=1e12)
    start: Literal["point", "plane"] = setting(
        "point", "point: 1 / distance is the first starting point; plane: X and Y uniform within the radius"
    )
    outside: Literal["wall", "swarm"] = setting(
        "wall", "a coordinate S outside the box goes to the wall, or stays where its swarm is"
    )

    def init(self, problem: Problem, x: Float, rng: Streams) -> PlaneState:
        """Place the swarm in the plane (steps 1 to 3)."""
        if self.start == "plane":
            axis = self.radius * (2.0 * rng.uniform(1, 2 * x.shape[2]) - 1.0)
        else:
            start = 1.0 / np.maximum(np.abs(x[:, :1]), 1e-12)
            angle = 2.0 * np.pi * rng.uniform(1, x.shape[2])
            axis = np.concatenate((start * np.cos(angle), start * np.sin(angle)), axis=2)
        candidates = self._candidates(problem, axis, x.shape[1])
        fx = problem.cost(candidates)
        return PlaneState(candidates, fx, axis, fx[:, 0])

    def step(self, problem: Problem, state: PlaneState, rng: Streams) -> PlaneState:
        """Fly at random, judge the smell, and move the swarm to the best fly if it is better."""
        population, dimensions = state.x.shape[1:]
        u = 2.0 * rng.uniform(population, 2 * dimensions) - 1.0
        flies = state.axis + self.radius * u  # step 2
        if self.outside == "swarm":
            S = 1.0 / np.maximum(_distance(flies), 1e-12)
            beyond = (problem.lower > S) | (problem.upper < S)
            flies = np.where(np.concatenate((beyond, beyond), axis=2), state.axis, flies)
        candidates = self._candidates(problem, flies, population)
        fx = problem.cost(candidates)  # step 4
        axis, smell = moved_to_best(state.axis, state.smell, flies, fx)  # steps 5 and 6
        return PlaneState(candidates, fx, axis, smell)

    def _candidates(self, problem: Problem, flies: Float, population: int) -> Float:
        """Return S = 1 / sqrt(X^2 + Y^2) in the box, shape (R, P, D) (step 3)."""
        S = np.clip(1.0 / np.maximum(_distance(flies), 1e-12), problem.lower, problem.upper)
        return np.broadcast_to(S, (len(S), population, S.shape[2]))


def _distance(flies: Float) -> Float:
    """Return sqrt(X^2 + Y^2), shape (R, P, D), of X and Y side by side, shape (R, P, 2 D)."""
    return np.asarray(np.hypot(*np.split(flies, 2, axis=2)))
