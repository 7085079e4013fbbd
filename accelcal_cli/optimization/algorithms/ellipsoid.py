"""The closed form: no search, only the problem's own linear solution.

For calibration this is the algebraic ellipsoid fit of `calibration.ellipsoid`: the start of every search, and
the baseline that a search has to beat.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State, Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@OPTIMIZERS.register("ellipsoid")
@dataclass(frozen=True)
class Ellipsoid(Optimizer[State]):
    """The problem's closed form, evaluated once."""

    family = "closed form"
    paper = "gander1994"
    needs = ("closed_form",)

    population: int = setting(1, "one point", low=1, high=1)
    iterations: int = setting(1, "one evaluation", low=1, high=1)

    def init(self, problem: Problem, x: Float, rng: Streams) -> State:
        """Evaluate the closed form; the starting point is not used."""
        solution = np.broadcast_to(problem.closed_form()[:, None, :], x.shape)
        fx = problem.cost(solution)
        status = np.where(np.isfinite(fx[:, 0]), Status.CONVERGED, Status.FAILED).astype(np.int8)
        return State(solution, fx, status=status)

    def step(self, problem: Problem, state: State, rng: Streams) -> State:
        """Leave the solution as it is."""
        return state
