"""GWO: the grey wolf optimizer [mirjalili2014].

Mirjalili, Mirjalili and Lewis, "Grey Wolf Optimizer", Advances in Engineering Software 69 (2014) 46-61. The three best
points so far lead, every wolf goes to the mean of three points around them, and their distance shrinks to 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import gather
from accelcal_cli.optimization.optimizer import Optimizer, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class PackState(State):
    """A pack: x and fx are the wolves and their costs."""

    leaders: Float  # alpha, beta and delta, the best three points so far, (R, 3, D)
    leader_cost: Float  # (R, 3)
    iteration: int


@dataclass(frozen=True)
class GreyWolf(Optimizer[PackState]):
    """Grey wolf optimizer."""

    family = "swarm"
    paper = "mirjalili2014"
    converges = (
        False  # a falls with the iterations, whatever the cost: the last step is as long as the first is
    )

    reach: float = setting(2.0, "first reach of the pack, which falls to 0 (a)", above=0, high=10)

    def init(self, problem: Problem, x: Float, rng: Streams) -> PackState:
        """Let the best three of the starting population lead."""
        fx = problem.cost(x)
        return PackState(x, fx, *_best_three(x, fx), iteration=0)

    def step(self, problem: Problem, state: PackState, rng: Streams) -> PackState:
        """Move every wolf to the mean of three points around the leaders."""
        x, (population, dimensions) = state.x, state.x.shape[1:]
        a = self.reach * (1.0 - state.iteration / self.iterations)
        r1, r2 = (rng.uniform(population, 3 * dimensions) for _ in range(2))
        A, C = 2.0 * a * r1 - a, 2.0 * r2  # eq. 3.3 and 3.4
        leaders = state.leaders.reshape(len(x), 1, -1)  # alpha, beta, delta side by side, (R, 1, 3 D)
        distance = np.abs(C * leaders - np.tile(x, 3))  # eq. 3.5
        around = leaders - A * distance  # eq. 3.6
        x = sum(np.split(around, 3, axis=2)) / 3.0  # eq. 3.7
        x = np.clip(x, problem.lower, problem.upper)
        fx = problem.cost(x)
        points = np.concatenate((state.leaders, x), axis=1)
        costs = np.concatenate((state.leader_cost, fx), axis=1)
        return PackState(x, fx, *_best_three(points, costs), iteration=state.iteration + 1)


def _best_three(x: Float, fx: Float) -> tuple[Float, Float]:
    """Return the three points of the least cost, shape (R, 3, D), and their costs, (R, 3)."""
    order = np.argsort(fx, axis=1, kind="stable")[:, :3]
    return gather(x, order), np.take_along_axis(fx, order, axis=1)
