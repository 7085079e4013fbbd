"""Search with the chosen optimizer, polish by Levenberg-Marquardt, and the robust rounds after it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.calibration import robust
from accelcal_cli.calibration.compress import compress
from accelcal_cli.calibration.lotters import Box, Loetters
from accelcal_cli.calibration.residuals import NO_NOISE
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.optimizers.base import OPTIMIZERS
from accelcal_cli.optimizers.minimize import Run, minimize
from accelcal_cli.sensor.model import ErrorModel, to_gauge
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float

SAME_MINIMUM = 1e-6
"""Two searches ended in the same minimum when their polished costs differ by at most this part."""

ROUNDING = 1e-26
"""A cost per reading, in units of g^4, below which only rounding is left."""

REWEIGHTINGS = 50
"""Robust rounds at most; they converge in about ten."""


@dataclass(frozen=True, eq=False)
class Solution:
    """What search and polish found.

    Attributes:
        problem: the problem as last solved (with the robust weights, if any).
        x: the best run's point, shape (1, D).
        search: the search, all runs.
        best: number of the best run's row in `search`.
        cost: L at x; evaluations: all of them.
        agreeing: how many runs ended in the same minimum.
        noise: robust standard deviation of e, m/s^2; None without a robust loss.
        reweighted_from: with a robust loss the problem before it, with the weights of the poses alone.
    """

    problem: Loetters
    x: Float
    search: Run
    best: int
    cost: float
    evaluations: int
    agreeing: int
    noise: float | None = None
    reweighted_from: Loetters | None = None

    @property
    def stated(self) -> Loetters:
        """The problem as it was stated, without robust weights: what the poses alone say."""
        return self.problem if self.reweighted_from is None else self.reweighted_from


def search(problem: Loetters, settings: Settings) -> Solution:
    """Search with the chosen optimizer, then polish every run's best point by Levenberg-Marquardt."""
    optimizer = settings.build_optimizer()
    found = minimize(problem, optimizer, runs=settings.runs, seed=settings.seed)
    x, cost = found.x, found.cost
    evaluations = int(found.evaluations.sum())
    if not np.isfinite(cost).any():
        # The search failed altogether (a closed form without a solution): the box centre is still a start.
        x = np.zeros_like(x)
        cost = problem.cost(x[:, None])[:, 0]
    if settings.polish:
        x = np.where(np.isfinite(x), x, 0.0)
        polished = polish(problem, x)
        evaluations += int(polished.evaluations.sum())
        x, cost = polished.x, polished.cost
    best = int(np.nanargmin(cost))
    agreeing = int((cost <= cost[best] * (1.0 + SAME_MINIMUM) + rounding(problem)).sum())
    return Solution(problem, x[best : best + 1], found, best, float(cost[best]), evaluations, agreeing)


def rounding(problem: Loetters) -> float:
    """Return the cost, (m/s^2)^4, below which only rounding is left."""
    return float(ROUNDING * problem.triangle.poses.max() * problem.g**4)


def to_gain(solution: Solution) -> float:
    """Return the part of the cost that a Gauss-Newton step is expected to take off, 0 where only rounding is left."""
    problem, x = solution.problem, solution.x[:, None]
    if solution.cost <= rounding(problem):
        return 0.0
    residual, slope = problem.residuals(x)[0, 0], problem.jacobian(x)[0, 0]
    step = np.linalg.lstsq(slope, residual)[0]
    return float(np.sum((slope @ step) ** 2) / np.sum(residual**2))


def polish(problem: Loetters, x: Float) -> Run:
    """Return Levenberg-Marquardt runs from x, shape (R, D), inside the box."""
    solver = OPTIMIZERS.get("levenberg-marquardt")()
    return minimize(problem, solver, runs=len(x), start=x[:, None, :], trace=False)


def resolve(solution: Solution, problem: Loetters) -> Solution:
    """Return a solution carried over to a problem that differs a little: polished from where it was."""
    polished = polish(problem, solution.x)
    evaluations = solution.evaluations + int(polished.evaluations.sum())
    return replace(
        solution, problem=problem, x=polished.x, cost=float(polished.cost[0]), evaluations=evaluations
    )


def reweight(solution: Solution, readings: Readings, settings: Settings, weights: Float | None) -> Solution:
    """Solve again under the robust loss: weights from the residuals, residuals from the weights."""
    g, triangle = settings.g, solution.problem.triangle
    solution = replace(solution, reweighted_from=solution.problem)
    for _ in range(REWEIGHTINGS):
        model = model_at(solution.problem, solution.x)
        noise = robust.noise_scale(readings, model, g)
        if noise <= NO_NOISE * g:  # noise-free readings: every weight is 1
            return replace(solution, noise=noise)
        blocks = robust.robust_blocks(readings, model, g, noise, settings.robust, weights)
        problem = Loetters(compress(blocks, triangle.centre[0], triangle.scale[0]), g, solution.problem.box)
        polished = polish(problem, solution.x)
        moved = float(np.abs(polished.x - solution.x).max())
        evaluations = solution.evaluations + int(polished.evaluations.sum())
        solution = replace(
            solution,
            problem=problem,
            x=polished.x,
            cost=float(polished.cost[0]),
            evaluations=evaluations,
            noise=noise,
        )
        if moved < 1e-9:
            break
    return solution


def model_at(problem: Loetters, x: Float) -> ErrorModel:
    """Return the sensor at x, shape (1, D), as the search's gauge has it (`lower` or `full`)."""
    K, D = problem.parameters(x)
    return ErrorModel(K[0], D[0])


def lower_problem(problem: Loetters, model: ErrorModel) -> tuple[Loetters, Float]:
    """Return the nine-parameter problem and its point, shape (1, 9), of the same readings and sensor.

    Uncertainty is always computed in gauge `lower`, whatever is searched or printed.
    """
    K = to_gauge(model.K, "lower")
    half = problem.box.half
    turned = (
        half[:, 3:6] if problem.unknowns > 6 else half[:, :3]
    )  # any width: derivatives alone are asked for
    half = np.concatenate([half[:, :3], turned, half[:, -3:]], axis=1)
    nine = Loetters(problem.triangle, problem.g, Box(np.zeros((1, 9)), half))
    return nine, nine.coordinates(K[None], model.D[None])
