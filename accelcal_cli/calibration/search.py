"""From readings to a solution: the problem is stated, searched with the chosen optimizer, polished, and reweighted.

Weights `auto`: poses share an error of their own beside the noise of their readings. The variance of a pose is
m^2 + v_j: v_j from the scatter of its readings and their number, m^2 what the fit leaves beyond that (a table that
gives, a sensor that is not linear), the same for all poses. Weights 1 / (m^2 + v_j) follow the number of readings while
noise rules, and level off where it does not. m^2 is the value for which the weighted squares have their expectation
J - 9 [paule1982].
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import Observability
from accelcal_cli.calibration.problem import (
    Box,
    Loetters,
    Triangle,
    compress,
    fit_ellipsoid,
    least_squares,
    pack,
)
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.settings import BoxSettings, Robust, Settings
from accelcal_cli.optimization.minimize import Run, minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.model import to_gauge

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""

SPHERE_PRIOR = 1e-3
"""Information a pose lends to the middle of the readings as centre of the sphere, relative to its own: what axes
whose scale factors differ by 3 % pretend to say about an axis that the poses do not turn through."""

HUBER = 1.345
"""Huber's k: 95 % of the efficiency of least squares under normal noise (Huber 1964)."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SAME_MINIMUM = 1e-6
"""Two searches ended in the same minimum when their polished costs differ by at most this part."""

ROUNDING = 1e-26
"""A cost per reading, in units of g^4, below which only rounding is left."""

NO_NOISE = 1e-9
"""Residuals, or their standard deviation, below this part of g are rounding: readings are seldom written with ten
digits, and no accelerometer is as quiet."""

REWEIGHTINGS, SETTLED = 50, 1e-9
"""Robust rounds at most, about ten are the rule; and the step, in half-widths of the box, that ends them."""

SCALE_SAMPLE = 100_000
"""At most about this many residuals decide the scale of a robust loss."""

SHARED_ROUNDS, SHARED_SETTLED = 10, 0.01
"""Rounds of weights and fit at most, three or four are the rule; and the relative change of m^2 that ends them."""

LEAST_SHARED = 0.01
"""Least m^2, as part of the mean v_j: no pose is free of every other error."""

SLOPES = 6
"""Parameters more where scale factors and biases are linear in temperature."""


@dataclass(frozen=True)
class Start:
    """Where searches start.

    Attributes:
        box: the search box of each of R sensors, D = 6, 9 or 12.
        sources: of each: "stated", "closed form" or "sphere".
    """

    box: Box
    sources: tuple[str, ...]

    @property
    def source(self) -> str:
        """That of the first sensor."""
        return self.sources[0]

    def take(self, index: Int) -> Start:
        """Return the starts of the sensors at `index`."""
        return Start(self.box.take(index), tuple(self.sources[i] for i in index))


@dataclass(frozen=True, eq=False)
class Stated:
    """The problem of R sensors as it is stated.

    Attributes:
        sample: their readings; settings: of the calibration.
        weights: of the poses, shape (R, J), or None.
        cost: the Loetters cost in its box; start: where the box comes from.
    """

    sample: Sample
    settings: Settings
    weights: Float | None
    cost: Loetters
    start: Start


@dataclass(frozen=True, eq=False)
class Search:
    """What a search found, and at what expense.

    Attributes:
        optimizer: its name; runs: searches per sensor.
        cost: L of the best run after the search, shape (R,), (m/s^2)^4.
        evaluations: of the cost, search and polish together, shape (R,).
        agreeing: how many runs ended in the best one's minimum, shape (R,).
        run: all runs, and `best`, the row of each sensor's best one, shape (R,); None where there was no search.
    """

    optimizer: str
    runs: int
    cost: Float
    evaluations: Int
    agreeing: Int
    run: Run | None = None
    best: Int | None = None


@dataclass(frozen=True, eq=False)
class Slopes:
    """A fit of fifteen parameters; see calibration.temperature.

    Attributes:
        temperature: the slopes.
        sample: the readings at the reference temperature.
        loss: information that the slopes take from the nine, shape (R, 9, 9).
    """

    temperature: Temperature
    sample: Sample
    loss: Float


@dataclass(frozen=True, eq=False)
class Solution:
    """What search, polish and robust rounds found.

    Attributes:
        stated: the problem; search: how it was searched.
        cost: the Loetters cost as last solved, with the weights of a robust loss; plain: without them.
        x: the best point of each sensor, shape (R, D); value: L there, shape (R,), (m/s^2)^4.
        noise: robust standard deviation of e, m/s^2, shape (R,); None without a robust loss.
        slopes: with temperature, where the readings determine them.
        notes: what a user should know of it, in sentences.
    """

    stated: Stated
    search: Search
    cost: Loetters
    plain: Loetters
    x: Float
    value: Float
    noise: Float | None = None
    slopes: Slopes | None = None
    notes: tuple[str, ...] = ()

    @property
    def sample(self) -> Sample:
        """The readings that were fitted: with slopes, those at the reference temperature."""
        return self.stated.sample if self.slopes is None else self.slopes.sample

    def solved_anew(self, cost: Loetters) -> Solution:
        """Return the solution carried over to a cost that differs a little: polished from where it was."""
        polished = polish(cost, self.x)
        search = replace(self.search, evaluations=self.search.evaluations + polished.evaluations)
        return replace(self, cost=cost, x=polished.x, value=polished.cost, search=search)


def state(sample: Sample, settings: Settings) -> Stated:
    """State the problem of readings that give the weights asked for."""
    if settings.weights == "auto":
        return _shared(sample, settings)
    return _stated(sample, settings, sample.weights(settings.weights))


def _stated(sample: Sample, settings: Settings, weights: Float | None) -> Stated:
    triangle = packed(sample, weights)
    start = search_box(triangle, settings)
    return Stated(sample, settings, weights, Loetters(triangle, settings.g, start.box), start)


def packed(sample: Sample, weights: Float | None, within: Sample | None = None) -> Triangle:
    """Return weighted readings compressed, centred and scaled by their own extent or by that of other readings."""
    extent = within or sample
    centre = 0.5 * (extent.lower + extent.upper)
    scale = 0.5 * (extent.upper - extent.lower).max(axis=1)
    blocks = (
        (block, None if weights is None else weights[:, first : first + block.shape[1]])
        for first, block in sample.blocks()
    )
    return compress(blocks, centre, scale, sample.poses)


def search_box(triangle: Triangle, settings: Settings) -> Start:
    """Return the search box of each sensor; the same in any company.

    Args:
        triangle: the compressed readings of R sensors.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 6 if not settings.misalignment else 12 if settings.gauge == "full" else 9
    sensors = len(triangle.scale)
    if settings.nominal is not None:
        K = np.broadcast_to(np.diag(settings.nominal.scale), (sensors, 3, 3))
        D = np.broadcast_to(settings.nominal.bias, (sensors, 3))
        return Start(_box(K, D, settings, unknowns), ("stated",) * sensors)
    K, D = _closed_form(triangle, settings.g)
    index = np.flatnonzero(np.isfinite(K).all(axis=(1, 2)))
    index = index[_trustworthy(triangle.take(index), K[index], D[index], settings)]
    closed = np.zeros(sensors, dtype=bool)
    closed[index] = True
    sphere_K, sphere_D = _sphere(triangle, settings.g)
    if unknowns == 12:
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K[index] = to_gauge(K[index], "symmetric")
    K, D = np.where(closed[:, None, None], K, sphere_K), np.where(closed[:, None], D, sphere_D)
    box = _box(K, D, settings, unknowns)
    u = Streams(settings.seed, [0], Purpose.BOX).uniform(1, unknowns)[0, 0]
    moved = box.centre + SHIFT * (2.0 * u - 1.0) * box.half
    return Start(
        Box(np.where(closed[:, None], moved, box.centre), box.half),
        tuple("closed form" if c else "sphere" for c in closed),
    )


def _box(K: Float, D: Float, settings: Settings, unknowns: int) -> Box:
    half = half_widths(np.einsum("rii->ri", K), settings.box, settings.g, unknowns)
    return Box(pack(K, D, unknowns), half)


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    K, d = fit_ellipsoid(triangle)
    return K * triangle.scale[:, None, None] / g, d * triangle.scale[:, None] + triangle.centre


def _trustworthy(triangle: Triangle, K: Float, D: Float, settings: Settings) -> Bool:
    """Whether the poses determine what the closed form says, shape (R,); where they do not, noise has decided it."""
    problem = Loetters(triangle, settings.g, _box(K, D, settings, 9))
    seen = Observability.of(problem.information(np.zeros((len(K), 9))), triangle.poses)
    return np.array([verdict != "undetermined" for verdict in seen.verdicts], dtype=bool)


def _sphere(triangle: Triangle, g: float) -> tuple[Float, Float]:
    """Return K, shape (R, 3, 3), and D, shape (R, 3), of the spheres nearest to readings that fix no ellipsoid.

    |x|^2 = 2 c x + (r^2 - |c|^2) is linear in c and the constant. A direction that the poses do not turn through
    is held at the middle of the readings by the prior.
    """
    left, right = triangle.R[..., 6:10], triangle.R[..., :3].sum(axis=2)
    transposed = left.swapaxes(1, 2)
    prior = SPHERE_PRIOR * triangle.poses[:, None, None] * np.diag([1.0, 1.0, 1.0, 0.0])
    c = np.linalg.solve(transposed @ left + prior, transposed @ right[..., None])[..., 0]
    radius = np.sqrt(np.maximum(c[:, 3] + np.sum(c[:, :3] ** 2, axis=1), 0.0))
    # Far from the readings' own extent, which is 1, it is noise.
    radius = np.where((radius > 0.3) & (radius < 3.0), radius, 1.0)
    K = (radius * triangle.scale / g)[:, None, None] * np.eye(3)
    return K, c[:, :3] * triangle.scale[:, None] + triangle.centre


def half_widths(scale: Float, box: BoxSettings, g: float, unknowns: int) -> Float:
    """Return the half-widths in the units of the unknowns, shape (..., unknowns), for scale factors (..., 3)."""
    mean = scale.mean(axis=-1, keepdims=True)
    turned = np.repeat(box.misalignment * mean, unknowns - 6, axis=-1)
    return np.concatenate([box.scale * scale, turned, box.bias * g * scale], axis=-1)


def modulus_errors(sample: Sample, K: Float, D: Float, g: float) -> Iterator[tuple[int, Float, Float]]:
    """Yield (first pose, e, f) block by block: e = (g^2 - |f|^2) / 2g and f, m/s^2, shapes (R, B) and (R, B, 3).

    K, shape (R, 3, 3), and D, shape (R, 3), are those of the sensors.
    """
    K_A = np.linalg.inv(K)
    for first, block in sample.blocks():
        # Columns of contiguous memory: ten times as fast as rows of three for many poses.
        f = K_A @ np.subtract(block.swapaxes(1, 2), D[..., None], order="C")
        yield first, (g * g - np.einsum("rij,rij->rj", f, f)) / (2.0 * g), f.swapaxes(1, 2)


def search(stated: Stated, *, closed: bool = False) -> Solution:
    """Search with the chosen optimizer, then polish every run's best point by Levenberg-Marquardt.

    With `closed` the search is left out where the readings give the point of least cost in closed form, as a fleet
    wants it: one start per sensor, and the polish confirms it with a step.
    """
    settings, cost, sensors = stated.settings, stated.cost, len(stated.sample)
    runs = settings.runs
    run = _closed(stated) if closed else _searched(cost, settings, sensors)
    x, value = run.x, run.cost
    evaluations = run.evaluations
    if not np.isfinite(value).all():
        # A search that failed altogether (a closed form without a solution): the box centre is still a start.
        failed = ~np.isfinite(value.reshape(sensors, runs)).any(axis=1).repeat(runs)
        x = np.where(failed[:, None], 0.0, x)
        value = np.where(failed, _tiled(cost, sensors, runs).cost(x[:, None])[:, 0], value)
    if settings.polish:
        polished = polish(_tiled(cost, sensors, runs), np.where(np.isfinite(x), x, 0.0))
        evaluations = evaluations + polished.evaluations
        x, value = polished.x, polished.cost
    value = value.reshape(sensors, runs)
    best = np.nanargmin(value, axis=1)
    least = value[np.arange(sensors), best]
    agreeing = (value <= least[:, None] * (1.0 + SAME_MINIMUM) + rounding(cost)[:, None]).sum(axis=1)
    row = np.arange(sensors) * runs + best
    spent = evaluations.reshape(sensors, runs).sum(axis=1)
    found = Search(settings.optimizer, runs, run.cost[row], spent, agreeing, run, row)
    return Solution(stated, found, cost, cost, x[row], least)


def _searched(cost: Loetters, settings: Settings, sensors: int) -> Run:
    """Return the runs of every sensor, those of the first one first; each sensor has runs 0, 1, ... of its own."""
    numbers = list(range(settings.runs)) * sensors
    problem = _tiled(cost, sensors, settings.runs)
    return minimize(problem, settings.build_optimizer(), runs=numbers, seed=settings.seed)


def _tiled(cost: Loetters, sensors: int, runs: int) -> Loetters:
    """Return the cost of so many runs of every sensor; runs of a single one share it."""
    return cost if sensors == 1 or runs == 1 else cost.of(np.repeat(np.arange(sensors), runs))


def _closed(stated: Stated) -> Run:
    """Return one run per sensor at the least cost where the readings give it, else from a search."""
    cost, settings = stated.cost, stated.settings
    triangle = cost.triangle
    K, d = least_squares(triangle)
    K = K * triangle.scale[:, None, None] / cost.g
    x = cost.coordinates(K, d * triangle.scale[:, None] + triangle.centre)
    inside = np.isfinite(x).all(axis=1) & (np.abs(np.nan_to_num(x)) < 1.0).all(axis=1)
    lacking = np.flatnonzero(~inside | np.array([source == "sphere" for source in stated.start.sources]))
    evaluations = np.zeros(len(x), dtype=np.int64)
    if len(lacking):
        # Each of them would be run 0 of a calibration of its own.
        zeros = [0] * len(lacking)
        part = minimize(
            cost.of(lacking), settings.build_optimizer(), runs=zeros, seed=settings.seed, trace=False
        )
        x[lacking], evaluations[lacking] = part.x, part.evaluations
    value = cost.cost(x[:, None])[:, 0]
    return Run(np.zeros(len(x), dtype=np.int64), x, value, evaluations, 0 * evaluations, ())


def rounding(cost: Loetters) -> Float:
    """Return the cost, (m/s^2)^4, below which only rounding is left, shape (R,)."""
    return np.asarray(ROUNDING * cost.triangle.poses * cost.g**4)


def polish(cost: Loetters, x: Float) -> Run:
    """Return Levenberg-Marquardt runs from x, shape (R, D), inside the box."""
    solver = OPTIMIZERS.get("levenberg-marquardt")()
    return minimize(cost, solver, runs=len(x), start=x[:, None, :], trace=False)


def reweight(solution: Solution) -> Solution:
    """Solve again under the robust loss, if there is one: weights from the residuals, residuals from the weights."""
    settings, sample = solution.stated.settings, solution.stated.sample
    if settings.robust == "none":
        return solution
    for _ in range(REWEIGHTINGS):
        K, D = solution.cost.parameters(solution.x)
        noise = _noise_scale(sample, K, D, settings.g)
        if (noise <= NO_NOISE * settings.g).all():  # noise-free readings: every weight is 1
            return replace(solution, noise=noise)
        triangle = solution.cost.triangle
        blocks = _robust_blocks(solution, K, D, noise)
        triangle = compress(blocks, triangle.centre, triangle.scale, triangle.poses)
        before, cost = solution.x, Loetters(triangle, settings.g, solution.cost.box)
        solution = replace(solution.solved_anew(cost), noise=noise)
        if np.abs(solution.x - before).max() < SETTLED:
            break
    return solution


def _noise_scale(sample: Sample, K: Float, D: Float, g: float) -> Float:
    """Return a robust standard deviation of e, m/s^2, shape (R,): its median absolute value times 1.4826."""
    poses = int(sample.poses.max())
    stride = max(1, poses // SCALE_SAMPLE)
    sizes = [np.abs(e)[:, (-first) % stride :: stride] for first, e, _ in modulus_errors(sample, K, D, g)]
    # Nine parameters follow the smallest residuals: the factor gives the scale back what they took.
    freedom = max(1.0, poses - 9.0) / poses
    return np.asarray(NORMAL_MAD * np.median(np.concatenate(sizes, axis=1), axis=1) / np.sqrt(freedom))


def _robust_blocks(
    solution: Solution, K: Float, D: Float, noise: Float
) -> Iterator[tuple[Float, Float | None]]:
    """Yield readings with their robust weights, block by block."""
    settings, sample, weights = solution.stated.settings, solution.stated.sample, solution.stated.weights
    errors = modulus_errors(sample, K, D, settings.g)
    for (first, block), (_, e, _) in zip(sample.blocks(), errors, strict=True):
        own: Float | float = 1.0 if weights is None else weights[:, first : first + e.shape[1]]
        yield block, own * loss_weight(np.sqrt(own) * e / noise[:, None], settings.robust)


def loss_weight(z: Float, loss: Robust) -> Float:
    """Return the weight psi(z) / z of residuals z in units of the noise, same shape."""
    if loss == "huber":
        return HUBER / np.maximum(np.abs(z), HUBER)
    return 1.0 / np.sqrt(1.0 + z * z)  # soft-L1: rho = 2 (sqrt(1 + z^2) - 1)


def loss_slope(z: Float, loss: Robust) -> Float:
    """Return psi'(z), same shape."""
    if loss == "huber":
        return (np.abs(z) <= HUBER).astype(float)
    return (1.0 + z * z) ** -1.5


def _shared(sample: Sample, settings: Settings) -> Stated:
    """State the problem with weights that follow the scatter of the poses and what they share; J > 9 tells it."""
    stated = _stated(sample, settings, None)
    if sample.poses.max() <= 9 or sample.count is None or sample.scatter is None:
        return stated
    before = -1.0
    for _ in range(SHARED_ROUNDS):
        x = polish(stated.cost, np.zeros_like(stated.cost.box.centre)).x
        K, D = stated.cost.parameters(x)
        parts = list(modulus_errors(sample, K, D, settings.g))
        errors, force = (np.concatenate([part[k] for part in parts], axis=1) for k in (1, 2))
        own = sample.explained(0, force, K)
        shared = shared_variance(errors[0], own[0], int(sample.poses[0]) - 9)
        shared = max(shared, LEAST_SHARED * float(own.mean()))
        if not shared > 0 or abs(shared - before) <= SHARED_SETTLED * shared:
            break
        before, weights = shared, 1.0 / (shared + own)
        stated = _stated(sample, settings, weights / weights.mean())
    return stated


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
