"""Newton's iteration with the full Hessian, undamped: the baseline of the IFOA paper [ifoa2021, skog2006].

theta <- theta - H^-1 grad L. Far from the minimum the Hessian may be singular or indefinite and the iteration
diverges: such a run ends as a counted failure. A step that leaves the box ends at its wall. Levenberg-Marquardt is
the same idea with the damping that it lacks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, PopulationAlone, State, Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

SINGULAR = 1e-14
"""Reciprocal condition number below which the Hessian counts as singular: about fifty roundings of a double."""


@OPTIMIZERS.register("newton")
@dataclass(frozen=True)
class Newton(PopulationAlone, Optimizer[State]):
    """Newton's iteration."""

    family = "least squares"
    paper = "skog2006"

    population: int = setting(1, "independent starting points", low=1, high=1_000_000)
    iterations: int = setting(100, "steps at most", low=1, high=1_000_000)
    step_tolerance: float = setting(1e-12, "converged: step below this part of the box", low=0, high=1)

    def step(self, problem: Problem, state: State, rng: Streams) -> State:
        """Take one full Newton step at every point."""
        gradient, hessian = problem.gradient_hessian(state.x)
        usable: Bool = np.logical_and(
            np.isfinite(hessian).all(axis=(2, 3)), np.isfinite(gradient).all(axis=2)
        )
        hessian = np.where(usable[..., None, None], hessian, 0.0)
        values = np.abs(np.linalg.eigvalsh(hessian))
        usable &= values.min(axis=2) > SINGULAR * values.max(axis=2)
        hessian = np.where(usable[..., None, None], hessian, np.eye(state.x.shape[2]))
        step = np.linalg.solve(hessian, np.where(usable[..., None], gradient, 0.0)[..., None])[..., 0]
        x = np.clip(state.x - step, problem.lower, problem.upper)
        fx = problem.cost(x)
        small = np.abs(step).max(axis=2) <= self.step_tolerance * (problem.upper - problem.lower).max()
        failed = ~usable | ~np.isfinite(fx)
        status = np.where(
            (small & usable).any(axis=1),
            Status.CONVERGED,
            np.where(failed.all(axis=1), Status.FAILED, Status.RUNNING),
        )
        x = np.where(failed[..., None], state.x, x)
        return State(x, fx, status=status.astype(np.int8))
