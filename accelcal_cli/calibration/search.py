"""From readings to a solution: the problem is stated, searched with the chosen optimizer, polished, and reweighted.

Weights `auto`: poses share an error of their own beside the noise of their readings. The variance of a pose is
m^2 + v_j: v_j from the scatter of its readings and their number, m^2 what the fit leaves beyond that (a table that
gives, a sensor that is not linear), the same for all poses. Weights 1 / (m^2 + v_j) follow the number of readings while
noise rules, and level off where it does not. m^2 is the value for which the weighted squares have their expectation
J - 9 [paule1982].
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, field, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.noise import MOST_TREMOR, PoseNoise, Tremor, directions, pose_noise, tremor
from accelcal_cli.calibration.observability import ROWS_COLUMNS, Observability
from accelcal_cli.calibration.problem import Box, Loetters, Triangle, compress, fit_ellipsoid, pack, packed
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.calibration.sample import NO_NOISE, Sample
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.optimization.minimize import Run, minimize, polish
from accelcal_cli.optimization.optimizer import Optimizer, State
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.model import to_gauge

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""

SPHERE_PRIOR = 1e-3
"""Information a pose lends to the middle of the readings as centre of the sphere, relative to its own: what axes
whose scale factors differ by 3 % pretend to say about an axis that the poses do not turn through."""

ALIKE = 2.0
"""Largest factor between scale factors that count as alike."""

SAME_MINIMUM = 1e-6
"""Two searches ended in the same minimum when their polished costs differ by at most this part."""

ROUNDING = 1e-26
"""A cost per reading, in units of g^4, below which only rounding is left."""

REWEIGHTINGS, SETTLED = 50, 1e-9
"""Robust rounds at most, about ten are the rule; and the step, in half-widths of the box, that ends them."""


SHARED_ROUNDS, SHARED_SETTLED = 10, 0.01
"""Rounds of weights and fit at most, three or four are the rule; and the relative change of m^2 that ends them."""

LEAST_SHARED = 0.01
"""Least m^2, as part of the mean v_j: no pose is free of every other error."""

SLOPES = 6
"""Parameters more where scale factors and biases are linear in temperature."""


@frozen(eq=False)
class Stated:
    """The problem of R sensors as it is stated.

    Attributes:
        sample: their readings, with the length that trembling took given back; settings: of the calibration.
        weights: of the poses, 0 for those that are left out, shape (R, J), or None.
        cost: the Loetters cost in its box; sources: where the box of each sensor comes from, see `search_box`.
        noise: of the poses by the scatter of their readings; tremor: what was given back; None where nothing tells.
        rejected: poses that disagree with the others, left out by a robust loss, shape (R, J), or None.
        own: with weights `auto`: sum e^2 / v and its degrees of freedom, of a fit weighted by 1 / v alone.
    """

    sample: Sample
    settings: Settings
    weights: Float | None
    cost: Loetters
    sources: tuple[str, ...]
    noise: PoseNoise | None = None
    tremor: Tremor | None = None
    rejected: Bool | None = None
    own: tuple[float, int] | None = None

    def with_weights(self, weights: Float | None) -> Stated:
        """Return the same problem with other weights, and the poses that are rejected still left out."""
        if self.rejected is not None and self.rejected.any():
            weights = np.where(self.rejected, 0.0, 1.0 if weights is None else weights)
        cost, sources = opened(self.sample, self.settings, weights)
        return replace(self, weights=weights, cost=cost, sources=sources)


@frozen(eq=False)
class Search:
    """What a search found, and at what expense.

    Attributes:
        optimizer: its name; runs: searches per sensor.
        cost: L of the best run after the search, shape (R,), (m/s^2)^4.
        evaluations: of the cost, search and polish together, shape (R,).
        agreeing: how many runs ended in the best one's minimum, shape (R,).
        parameters: of the optimizer, by name.
        run: all runs, and `best`, the row of each sensor's best one, shape (R,); None where there was no search.
    """

    optimizer: str
    runs: int
    cost: Float
    evaluations: Int
    agreeing: Int
    parameters: Mapping[str, object] = field(default_factory=dict)
    run: Run | None = None
    best: Int | None = None


@frozen(eq=False)
class Slopes:
    """A fit of fifteen parameters; see calibration.temperature.

    Attributes:
        temperature: the slopes.
        loss: information that the slopes take from the nine, shape (R, 9, 9).
        sensor: K, gauge `lower`, and D at the reference temperature, shapes (R, 3, 3) and (R, 3).
        rows: the design of the nine parameters without what the slopes take, and of the slopes, shape (R, J, 15).
        cofactor: of the slopes, shape (R, 6, 6).
        part: what the slopes' columns hold of those of the nine, shape (6, 9).
        units: of the slopes, per degree, in one m/s^2 at half the range of temperature, shape (6,).
    """

    temperature: Temperature
    loss: Float
    sensor: tuple[Float, Float]
    rows: Float
    cofactor: Float
    part: Float
    units: Float

    def with_covariance(self, covariance: Float) -> Temperature:
        """Return the slopes with their sigma and the covariance of all fifteen, from that which belongs to `rows`.

        `covariance`: of the nine parameters and of slopes + part @ nine, (m/s^2)^2, shape (15, 15).
        """
        back = np.eye(9 + SLOPES)
        back[9:, :9] = -self.part
        joint = back @ covariance @ back.T
        scale, bias = np.split(np.sqrt(np.diagonal(joint)[9:]) * self.units, 2)
        return replace(self.temperature, covariance=joint, sigma_scale=scale, sigma_bias=bias)


@frozen(eq=False)
class Solution:
    """What search, polish and robust rounds found.

    Attributes:
        stated: the problem; search: how it was searched.
        sample: the readings that were fitted: with slopes, those at the reference temperature.
        cost: the Loetters cost as last solved, with the weights of a robust loss; plain: without them.
        x: the best point of each sensor, shape (R, D); value: L there, shape (R,), (m/s^2)^4.
        noise: robust standard deviation of e, m/s^2, shape (R,); None without a robust loss.
        slopes: with temperature, where the readings determine them.
        notes: what a user should know of it, in sentences.
    """

    stated: Stated
    search: Search
    sample: Sample
    cost: Loetters
    plain: Loetters
    x: Float
    value: Float
    noise: Float | None = None
    slopes: Slopes | None = None
    notes: tuple[str, ...] = ()

    def robust_weights(self) -> Float | None:
        """Return the weights of the poses with those of a robust loss, shape (R, J), or None where all count alike."""
        weights, noise, settings = self.stated.weights, self.noise, self.stated.settings
        if noise is None or (noise <= NO_NOISE * settings.g).all():
            return weights
        parts = self.sample.reweighted(*self.cost.parameters(self.x), settings, noise, weights)
        return np.concatenate([np.asarray(weight) for _, weight in parts], axis=1)

    def solved_anew(self, cost: Loetters) -> Solution:
        """Return the solution carried over to a cost that differs a little: polished from where it was."""
        polished = polish(cost, self.x)
        search = replace(self.search, evaluations=self.search.evaluations + polished.evaluations)
        return replace(self, cost=cost, x=polished.x, value=polished.cost, search=search)


def opened(sample: Sample, settings: Settings, weights: Float | None) -> tuple[Loetters, tuple[str, ...]]:
    """Return the cost of weighted readings in its box, and where the box of each sensor comes from."""
    triangle = packed(sample, weights)
    box, sources = search_box(triangle, settings)
    return Loetters(triangle, settings.g, box), sources


def search_box(triangle: Triangle, settings: Settings) -> tuple[Box, tuple[str, ...]]:
    """Return the search box of each sensor, and where it comes from: "stated", "closed form" or "sphere".

    The same in any company.

    Args:
        triangle: the compressed readings of R sensors.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 6 if not settings.misalignment else 12 if settings.gauge == "full" else 9
    sensors = len(triangle.scale)
    if settings.nominal is not None:
        K = np.broadcast_to(np.diag(settings.nominal.scale), (sensors, 3, 3))
        D = np.broadcast_to(settings.nominal.bias, (sensors, 3))
        return _box(K, D, settings, unknowns), ("stated",) * sensors
    K, D = _closed_form(triangle, settings.g)
    index = np.flatnonzero(np.isfinite(K).all(axis=(1, 2)))
    index = index[_trustworthy(triangle.take(index), K[index], D[index], settings)]
    closed = np.zeros(sensors, dtype=bool)
    closed[index] = True
    if unknowns == 12:
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K[index] = to_gauge(K[index], "symmetric")
    if not closed.all():
        sphere_K, sphere_D = _sphere(triangle, settings.g)
        K, D = np.where(closed[:, None, None], K, sphere_K), np.where(closed[:, None], D, sphere_D)
    box = _box(K, D, settings, unknowns)
    u = Streams(settings.seed, [0], Purpose.BOX).uniform(1, unknowns)[0, 0]
    moved = box.centre + SHIFT * (2.0 * u - 1.0) * box.half
    return Box(np.where(closed[:, None], moved, box.centre), box.half), tuple(
        "closed form" if c else "sphere" for c in closed
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
    # An angle is a part of the scale factor of its own axis; of the mean where they are alike.
    own = box.misalignment * scale[..., [i for i, _ in ROWS_COLUMNS[3 : unknowns - 3]]]
    alike = scale.max(axis=-1, keepdims=True) <= ALIKE * scale.min(axis=-1, keepdims=True)
    turned = np.where(alike, turned, own)
    return np.concatenate([box.scale * scale, turned, box.bias * g * scale], axis=-1)


def edge_names(at_wall: Bool) -> tuple[str, ...]:
    """Return the names of the unknowns that are at a wall of the box, of those marked in shape (D,)."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(at_wall) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_wall, strict=True) if at)


def state(sample: Sample, settings: Settings) -> Stated:
    """State the problem of readings that give the weights asked for."""
    counts = sample.counts(settings.weights)
    cost, sources = opened(sample, settings, counts)
    stated = Stated(sample, settings, counts, cost, sources)
    if sample.scatter is not None and sample.count is not None:
        stated = _with_noise(stated)
    if settings.robust != "none":
        stated = agreed(stated)
    elif stated.noise is not None and settings.weights in ("sd", "auto"):
        stated = stated.with_weights(own_weights(stated))
    return _shared(stated) if settings.weights == "auto" and stated.noise is not None else stated


def agreed(stated: Stated) -> Stated:
    """Return the problem of one sensor without the poses that disagree with the others, weighted as is asked for."""
    from accelcal_cli.calibration.consensus import consensus

    agreeing = consensus(stated.sample, stated.settings)
    rejected = None if agreeing is None or agreeing.all() else ~agreeing[None]
    return replace(stated, rejected=rejected).with_weights(own_weights(stated))


def own_weights(stated: Stated) -> Float | None:
    """Return the weights asked for, before a pose is left out or an error is shared, shape (R, J), or None."""
    if stated.noise is not None and stated.settings.weights in ("sd", "auto"):
        return stated.sample.normalised(_inverse(stated.noise.variance))
    return stated.sample.counts(stated.settings.weights)


def _inverse(variance: Float) -> Float:
    """Return 1 / v, shape (R, J); a pose without any noise weighs as the quietest one with some."""
    least = np.where(variance > 0, variance, np.inf).min(axis=1, keepdims=True)
    return np.asarray(1.0 / np.maximum(variance, np.where(np.isfinite(least), least, 1.0)))


def _with_noise(stated: Stated) -> Stated:
    """Return the problem with what the scatter within its poses tells: their noise, and trembling, given back."""
    sample, g = stated.sample, stated.settings.g
    K, D = stated.cost.parameters(least_point(stated.cost))
    trembling = tremor(sample, K, D, g)
    if trembling is not None:
        # Directions by a sphere, where the poses fix no ellipsoid, do not tell along from across.
        poor = np.array([source == "sphere" for source in stated.sources]) | (trembling.angle > MOST_TREMOR)
        trembling = replace(trembling, certainty=np.where(poor, 0.0, trembling.certainty))
    if trembling is not None and trembling.sure.any():
        given = np.where(trembling.sure[:, None], trembling.excess / g, 0.0)
        longer = directions(sample, K, D) * given[..., None]
        sample = sample.with_output(sample.output() + longer @ K.swapaxes(1, 2))
        cost, sources = opened(sample, stated.settings, stated.weights)
        stated = replace(stated, sample=sample, tremor=trembling, cost=cost, sources=sources)
        K, D = cost.parameters(least_point(cost))
    return replace(stated, noise=pose_noise(sample, K, D, g, stated.tremor))


def unsearched(stated: Stated) -> Solution:
    """Return the solution of least cost near the box, found without a search: what readings are first seen with."""
    x = least_point(stated.cost)
    value, ones = stated.cost.cost(x[:, None])[:, 0], np.ones(len(x), dtype=np.intp)
    found = Search("closed form", 1, value, ones, ones)
    return Solution(stated, found, stated.sample, stated.cost, stated.cost, x, value)


def least_point(cost: Loetters) -> Float:
    """Return the point of least cost, shape (R, D): in closed form, or polished from the centre of the box."""
    x = cost.least_cost()
    poor = ~(np.abs(np.nan_to_num(x, nan=np.inf)) <= 1.0).all(axis=1)
    if poor.any():
        index = np.flatnonzero(poor)
        x[index] = polish(cost.of(index), np.zeros((len(index), cost.unknowns))).x
    return x


def search(stated: Stated, *, closed: bool = False) -> Solution:
    """Search with the chosen optimizer, then polish every run's best point by Levenberg-Marquardt.

    With `closed` the search is left out where the readings give the point of least cost in closed form, as a fleet
    wants it: one start per sensor, and the polish confirms it with a step.
    """
    settings, cost, sensors = stated.settings, stated.cost, len(stated.sample)
    runs, optimizer = settings.runs, settings.build_optimizer()
    run = _closed(stated, optimizer) if closed else _searched(cost, settings, optimizer, sensors)
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
    found = Search(settings.optimizer, runs, run.cost[row], spent, agreeing, asdict(optimizer), run, row)
    return Solution(stated, found, stated.sample, cost, cost, x[row], least)


def _searched(cost: Loetters, settings: Settings, optimizer: Optimizer[State], sensors: int) -> Run:
    """Return the runs of every sensor, those of the first one first; each sensor has runs 0, 1, ... of its own."""
    numbers = list(range(settings.runs)) * sensors
    problem = _tiled(cost, sensors, settings.runs)
    return minimize(problem, optimizer, runs=numbers, seed=settings.seed)


def _tiled(cost: Loetters, sensors: int, runs: int) -> Loetters:
    """Return the cost of so many runs of every sensor; runs of a single one share it."""
    return cost if sensors == 1 or runs == 1 else cost.of(np.repeat(np.arange(sensors), runs))


def _closed(stated: Stated, optimizer: Optimizer[State]) -> Run:
    """Return one run per sensor at the least cost where the readings give it, else from a search."""
    cost, settings = stated.cost, stated.settings
    x = cost.least_cost()
    inside = np.isfinite(x).all(axis=1) & (np.abs(np.nan_to_num(x)) < 1.0).all(axis=1)
    lacking = np.flatnonzero(~inside | np.array([source == "sphere" for source in stated.sources]))
    evaluations = np.zeros(len(x), dtype=np.int64)
    if len(lacking):
        # Each of them would be run 0 of a calibration of its own.
        zeros = [0] * len(lacking)
        part = minimize(cost.of(lacking), optimizer, runs=zeros, seed=settings.seed, trace=False)
        x[lacking], evaluations[lacking] = part.x, part.evaluations
    value = cost.cost(x[:, None])[:, 0]
    return Run(np.zeros(len(x), dtype=np.int64), x, value, evaluations, 0 * evaluations, ())


def rounding(cost: Loetters) -> Float:
    """Return the cost, (m/s^2)^4, below which only rounding is left, shape (R,)."""
    return np.asarray(ROUNDING * cost.triangle.poses * cost.g**4)


def reweight(solution: Solution) -> Solution:
    """Solve again under the robust loss, if there is one: weights from the residuals, residuals from the weights."""
    settings, sample = solution.stated.settings, solution.stated.sample
    if settings.robust == "none":
        return solution
    for _ in range(REWEIGHTINGS):
        K, D = solution.cost.parameters(solution.x)
        noise = sample.noise(K, D, settings.g, solution.stated.weights)
        if (noise <= NO_NOISE * settings.g).all():  # noise-free readings: every weight is 1
            return replace(solution, noise=noise)
        triangle = solution.cost.triangle
        blocks = sample.reweighted(K, D, settings, noise, solution.stated.weights)
        triangle = compress(blocks, triangle.centre, triangle.scale, triangle.poses)
        before, cost = solution.x, Loetters(triangle, settings.g, solution.cost.box)
        solution = replace(solution.solved_anew(cost), noise=noise)
        if np.abs(solution.x - before).max() < SETTLED:
            break
    return solution


def _shared(stated: Stated) -> Stated:
    """State a problem anew with weights that follow the scatter of the poses and what they share; J > 9 tells it.

    It comes weighted by the scatter alone.
    """
    before = -1.0
    for _ in range(SHARED_ROUNDS):
        sensors = stated.cost.parameters(least_point(stated.cost))
        stated, shared = share(stated, stated.sample, sensors, 9)
        if not shared > 0 or abs(shared - before) <= SHARED_SETTLED * shared:
            break
        before = shared
    return stated


def share(
    stated: Stated, sample: Sample, sensors: tuple[Float, Float], parameters: int
) -> tuple[Stated, float]:
    """Return the problem of one sensor with weights 1 / (m^2 + v), and m^2, (m/s^2)^2; 0 where nothing tells it.

    Args:
        stated: the problem; sample: its readings, at one temperature.
        sensors: K and D that fit them best by the present weights, from so many parameters.
    """
    counted = (
        ~stated.rejected[0] if stated.rejected is not None else np.ones(int(sample.poses[0]), dtype=bool)
    )
    freedom = int(counted.sum()) - parameters
    if freedom < 1 or stated.noise is None:
        return stated, 0.0
    own = stated.noise.variance[0]
    e = np.concatenate([part[0] for _, part, _ in sample.errors(*sensors, stated.settings.g)])
    if stated.own is None and stated.noise.known[0] and (own > 0).all():
        stated = replace(stated, own=(float(np.sum(e[counted] ** 2 / own[counted])), freedom))
    shared = max(shared_variance(e[counted], own[counted], freedom), LEAST_SHARED * float(own.mean()))
    weights = sample.normalised(1.0 / (shared + own)[None])
    return stated.with_weights(weights), shared


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
