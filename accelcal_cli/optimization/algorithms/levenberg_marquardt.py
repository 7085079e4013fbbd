"""Levenberg-Marquardt with Marquardt's scaling, projected onto the box, batched over runs and points.

Levenberg 1944, Marquardt 1963; the damping schedule is Nielsen's [nielsen1999]. A coordinate that sits on a
wall of the box while the gradient pushes it outwards is held there for the step. With 12 unknowns J^T J has
three zero singular values; the damping keeps the system solvable and the step in the valley stays small. A run none
of whose points has a step (a Jacobian that is zero or no number) has failed.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State, Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class DampedState(State):
    """Points with their linearisation."""

    residuals: Float  # r, (R, P, M)
    normal: Float  # J^T J, (R, P, D, D)
    gradient: Float  # J^T r, (R, P, D)
    damping: Float  # lambda, (R, P)
    growth: Float  # Nielsen's nu, (R, P)


@OPTIMIZERS.register("levenberg-marquardt")
@dataclass(frozen=True)
class LevenbergMarquardt(Optimizer[DampedState]):
    """Damped least squares; the classical reference."""

    family = "least squares"
    paper = "marquardt1963"
    needs = ("residuals",)

    population: int = setting(1, "independent starting points", low=1, high=1_000_000)
    iterations: int = setting(100, "steps at most", low=1, high=1_000_000)
    damping: float = setting(1e-3, "first damping (lambda)", above=0, high=1e6)
    step_tolerance: float = setting(1e-12, "converged: step below this part of the box", low=0, high=1)

    def init(self, problem: Problem, x: Float, rng: Streams) -> DampedState:
        """Linearise at the starting points."""
        r = problem.residuals(x)
        fx = np.einsum("rpm,rpm->rp", r, r)
        normal, gradient = _normal_equations(problem, x, r)
        return DampedState(
            x,
            fx,
            r,
            normal,
            gradient,
            np.full_like(fx, self.damping),
            np.full_like(fx, 2.0),
            status=_status(fx),
        )

    def step(self, problem: Problem, state: DampedState, rng: Streams) -> DampedState:
        """Try one damped step at every point; keep it where the cost falls."""
        x, fx = state.x, state.fx
        on_wall = ((x <= problem.lower) & (state.gradient > 0)) | (
            (x >= problem.upper) & (state.gradient < 0)
        )
        delta, usable = _solve(state, on_wall)
        trial = np.clip(x + delta, problem.lower, problem.upper)
        r = problem.residuals(trial)
        trial_cost = np.einsum("rpm,rpm->rp", r, r)
        better, move = trial_cost < fx, trial - x
        x = np.where(better[..., None], trial, x)
        r = np.where(better[..., None], r, state.residuals)
        normal, gradient = _normal_equations(problem, x, r)
        small = np.abs(move).max(axis=2) <= self.step_tolerance * (problem.upper - problem.lower).max()
        done = (small | (trial_cost == 0) | (state.damping > 1e30)).all(axis=1)
        gain = _gain(state, move, np.where(better, fx - trial_cost, 0.0))
        shrink = np.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
        fx = np.where(better, trial_cost, fx)
        status = _status(fx)
        status[done & (status == Status.RUNNING)] = Status.CONVERGED
        status[~usable.any(axis=1)] = Status.FAILED
        return replace(
            state,
            x=x,
            fx=fx,
            residuals=r,
            normal=normal,
            gradient=gradient,
            damping=state.damping * np.where(better, shrink, state.growth),
            growth=np.where(better, 2.0, 2.0 * state.growth),
            status=status,
        )


def _gain(state: DampedState, move: Float, fall: Float) -> Float:
    """Return the fall of the cost over the one that the linearisation predicts, shape (R, P); 0 where it predicts none.

    Args:
        state: before the move, of shape (R, P, D).
        move: to the trial; fall: of the cost, shape (R, P).
    """
    predicted = -np.einsum("rpd,rpd->rp", move, 2.0 * state.gradient) - np.einsum(
        "rpd,rpde,rpe->rp", move, state.normal, move
    )
    return np.where(predicted > 0, fall / np.where(predicted > 0, predicted, 1.0), 0.0)


def _normal_equations(problem: Problem, x: Float, r: Float) -> tuple[Float, Float]:
    """Return J^T J, shape (R, P, D, D), and J^T r, shape (R, P, D)."""
    jacobian = problem.jacobian(x)
    transposed = jacobian.swapaxes(2, 3)
    return transposed @ jacobian, (transposed @ r[..., None])[..., 0]


def _solve(state: DampedState, on_wall: Bool) -> tuple[Float, Bool]:
    """Return the step (J^T J + lambda diag(J^T J))^-1 (-J^T r) and where it exists; coordinates on a wall rest.

    Shapes (R, P, D) and (R, P); where there is no step it is 0.
    """
    scale = np.einsum("rpdd->rpd", state.normal)
    # A floor keeps a coordinate without influence (a pose set that says nothing of it) from dividing by zero.
    scale = np.maximum(scale, 1e-12 * scale.max(axis=2, keepdims=True))
    free: Bool = np.logical_not(on_wall)
    matrix = state.normal * (free[..., :, None] & free[..., None, :])
    diagonal = np.einsum("rpdd->rpd", matrix)  # a view
    diagonal[...] = np.where(on_wall, 1.0, diagonal + state.damping[..., None] * scale)
    usable: Bool = np.logical_and(
        np.isfinite(matrix).all(axis=(2, 3)), np.isfinite(state.gradient).all(axis=2)
    )
    matrix = np.where(usable[..., None, None], matrix, np.eye(matrix.shape[-1]))
    right = np.where(on_wall | ~usable[..., None], 0.0, -state.gradient)
    step = _solutions(matrix, right)
    usable &= np.isfinite(step).all(axis=2)
    return np.where(usable[..., None], step, 0.0), usable


def _solutions(matrix: Float, right: Float) -> Float:
    """Return the solutions of systems of shape (R, P, D, D), shape (R, P, D); NaN for a singular one."""
    with suppress(np.linalg.LinAlgError):
        return np.asarray(np.linalg.solve(matrix, right[..., None])[..., 0])
    solutions = np.full_like(right, np.nan)
    for place in np.ndindex(right.shape[:2]):  # numpy does not say which of them it was
        with suppress(np.linalg.LinAlgError):
            solutions[place] = np.linalg.solve(matrix[place], right[place])
    return solutions


def _status(fx: Float) -> np.ndarray[tuple[int], np.dtype[np.int8]]:
    return np.where(np.isfinite(fx).any(axis=1), Status.RUNNING, Status.FAILED).astype(np.int8)
