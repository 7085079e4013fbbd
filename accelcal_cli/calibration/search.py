"""Search with the chosen optimizer, polish by Levenberg-Marquardt, and the robust rounds after it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration import weights as robust
from accelcal_cli.calibration.box import Start, search_box
from accelcal_cli.calibration.fit import NO_NOISE, modulus_errors
from accelcal_cli.calibration.problem import Box, Loetters, Triangle, compress
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.weights import explained
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.minimize import Run, minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.sensor.model import ErrorModel, to_gauge

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


ROUNDS = 10
"""Rounds of weights and fit at most; three or four are the rule."""


SETTLED = 0.01
"""Relative change of m^2 that ends the rounds."""


LEAST = 0.01
"""Least m^2, as part of the mean v_j: no pose is free of every other error."""


def packed(readings: Readings, weights: Float | None, within: Readings | None = None) -> Triangle:
    """Return weighted readings compressed, centred and scaled by their own extent or by that of other readings."""
    extent = within or readings
    centre = 0.5 * (extent.lower + extent.upper)
    scale = 0.5 * float((extent.upper - extent.lower).max())
    return compress(_weighted(readings, weights), centre, scale)


def _weighted(readings: Readings, weights: Float | None) -> Iterator[tuple[Float, Float | None]]:
    """Yield readings with their weights, block by block."""
    for first, block in readings.blocks():
        yield block, None if weights is None else weights[first : first + len(block)]


def shared_weights(readings: Readings, settings: Settings) -> Float | None:
    """Return the weights, mean 1, shape (J,); None when nine poses or fewer leave nothing to tell them by.

    Raises:
        DataError: the readings carry no count or no scatter.
    """
    if readings.count is None or readings.scatter is None or np.isnan(readings.scatter).any():
        raise DataError(
            f"{readings.source}: --weights auto needs the number of readings and their standard deviation (columns "
            "n, sx, sy, sz), or at least two readings of every pose"
        )
    if readings.poses <= 9:
        return None
    weights, before = None, -1.0
    for _ in range(ROUNDS):
        problem, x = fitted(readings, settings, weights)
        errors, own = _errors(readings, model_at(problem, x), settings.g)
        shared = shared_variance(errors, own, readings.poses - 9)
        shared = max(shared, LEAST * float(own.mean()))
        if not shared > 0 or abs(shared - before) <= SETTLED * shared:
            break
        weights, before = 1.0 / (shared + own), shared
        weights = weights / weights.mean()
    return weights


def shared_variance(errors: Float, own: Float, freedom: int) -> float:
    """Return m^2 >= 0 with sum e_j^2 / (m^2 + v_j) = freedom; 0 when the v_j explain the errors alone.

    Args:
        errors: e_j, m/s^2, shape (J,); own: v_j, (m/s^2)^2, shape (J,).
        freedom: J - 9.
    """
    square = errors**2

    def excess(m: float) -> float:
        total = m + own
        return float(np.sum(np.divide(square, total, out=np.zeros_like(square), where=total > 0))) - freedom

    low, high = 0.0, float(square.sum()) / freedom
    if excess(low) <= 0 and (own > 0).all():
        return 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def opened(readings: Readings, settings: Settings, weights: Float | None) -> tuple[Loetters, Start]:
    """Return the problem of the weighted readings, and where its box comes from."""
    triangle = packed(readings, weights)
    start = search_box(triangle, settings)
    return Loetters(triangle, settings.g, start.box), start


def fitted(readings: Readings, settings: Settings, weights: Float | None) -> tuple[Loetters, Float]:
    """Return the problem of the weighted readings and the point, shape (1, D), polished from the middle of its box."""
    problem, _ = opened(readings, settings, weights)
    return problem, polish(problem, np.zeros_like(problem.box.centre)).x


def _errors(readings: Readings, model: ErrorModel, g: float) -> tuple[Float, Float]:
    """Return the error of each pose's modulus, m/s^2, and the variance that its readings lend it, both (J,)."""
    errors = np.concatenate([e for _, e, _ in modulus_errors(readings, model, g)])
    force = model.specific_force(readings.output())
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    if readings.scatter is None or readings.count is None:
        return errors, np.zeros_like(errors)
    return errors, explained(u, readings.scatter, readings.count, np.diagonal(model.K))
