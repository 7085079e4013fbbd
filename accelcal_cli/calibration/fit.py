"""A fit: residuals pose by pose, what the poses determine, noise and covariance, computed once for all sensors.

Everything is in gauge `lower` and of the nine parameters of `observability`, whatever is searched or printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import chi_square_chance, student_chance, student_quantile
from accelcal_cli.calibration.observability import (
    ALIGNED,
    ROWS_COLUMNS,
    Geometry,
    Observability,
    design,
    propagate,
)
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.calibration.sample import Sample, loss_slope, loss_weight
from accelcal_cli.calibration.search import NO_NOISE, SLOPES, Search, Solution
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.sensor.model import Gauge, to_gauge

KEPT = 1000
"""Poses whose residuals a fit keeps one by one; of more, the worst KEPT_WORST."""

KEPT_WORST = 20

SUSPECT = 3.0
"""Studentised residuals beyond this may be outliers: those of Student's t with any freedom are as large at least."""

BENT = 0.01
"""A residual beyond this part of g bends the fit so far that no first-order formula holds."""

OUTLIER_LEVEL = 0.01
"""Chance of naming an outlier among all poses where there is none (Bonferroni over the poses)."""

EDGE = 1e-6
"""A parameter within this part of a half-width from the wall of its box is at the edge."""

COVERAGE = 0.95
"""Part of the intervals that hold the true value."""

STEPS, SETTLED = 12, 1e-6
"""Gauss-Newton steps at most of a fit without a pose, and the part of g below which a step is the last: the next would
be its square."""

LEAST_ROOM = 1e-8
"""The trace of a matrix times that of its inverse is below 1 over this where the other poses determine a sensor."""

RIDGE = 1e-14
"""Part of the trace that is added to the diagonal, so that no matrix of a batch is singular to the last bit."""


@dataclass(frozen=True, eq=False)
class PoseResiduals:
    """Residuals of k poses of each of R sensors.

    Attributes:
        pose: their numbers, from 0, shape (R, k); real: which are no repetitions, shape (R, k).
        error, before: |f| - g after and before calibration, m/s^2, shape (R, k).
        force: calibrated specific force, gauge `lower`, m/s^2, shape (R, k, 3).
        leverage: part of the pose's own residual that the fit absorbs, shape (R, k).
        studentised: residual over its standard deviation from the other poses, shape (R, k).
        left_out: |f| - g, m/s^2, that a fit without the pose would show, shape (R, k).
        outlier: whether the studentised residual is beyond chance, shape (R, k).
    """

    pose: Int
    real: Bool
    error: Float
    before: Float
    force: Float
    leverage: Float
    studentised: Float
    left_out: Float
    outlier: Bool


@dataclass(frozen=True, eq=False)
class Fit:
    """What R sensors are found to be, and how well their readings say so.

    Attributes:
        sample: the readings that were fitted; settings: of the calibration; search: how it was found.
        gauge: of K; K, D: the sensors, shapes (R, 3, 3) and (R, 3); lower: K in gauge `lower`.
        sigma_K, sigma_D: one-sigma of K and D, NaN where there is none.
        value: L, shape (R,), (m/s^2)^4.
        observability: what the poses say of the parameters, which the verdict rests on.
        view: the observability that a verdict is explained with; see `_first_sight`.
        dop: dilution of precision of the nine parameters, shape (R, 9); information: J^T J of them, shape (R, 9, 9);
            sight: K and D, gauge `lower`, that directions are seen with, shapes (R, 3, 3) and (R, 3); all of the view.
        freedom: degrees of freedom, shape (R,).
        s: standard deviation of one pose's modulus (with known attitudes of one axis), m/s^2, NaN without freedom,
            shape (R,).
        covariance: of the nine parameters, (m/s^2)^2, shape (R, 9, 9), NaN where it does not hold.
        coverage: factor k by which a sigma becomes the half-width of its 95 % interval, shape (R,); see `coverage_of`.
        at_wall: which unknowns of the search are at a wall of their box, shape (R, D).
        rms, rms_before: of |f| - g after and before, m/s^2, shape (R,); before: what the readings were taken for;
            nominal: scale factors before, shape (R, 3).
        residuals: pose by pose.
        noise: s over the noise that the scatter within the poses predicts, and the p-value of so large a ratio, shape
            (2, R), NaN where nothing tells.
        solution: what was fitted; None with known attitudes.
        notes: of the solution, in sentences.
    """

    sample: Sample
    settings: Settings
    search: Search
    gauge: Gauge
    K: Float
    D: Float
    lower: Float
    sigma_K: Float  # noqa: N815
    sigma_D: Float  # noqa: N815
    value: Float
    observability: Observability
    view: Observability
    dop: Float
    information: Float
    sight: tuple[Float, Float]
    freedom: Int
    s: Float
    covariance: Float
    coverage: Float
    at_wall: Bool
    rms: Float
    rms_before: Float
    before: list[str]
    nominal: Float
    residuals: PoseResiduals
    noise: Float
    solution: Solution | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def attitudes(self) -> list[int | None]:
        """How many distinct attitudes the poses hold, R of them; None where they were not counted."""
        return count_attitudes(self.sample)

    @property
    def temperature(self) -> Temperature | None:
        """The slopes with temperature, where there are any, with their intervals; of one sensor."""
        if self.solution is None or self.solution.slopes is None:
            return None
        return self.solution.slopes.temperature.with_intervals(float(self.coverage[0]))


def coverage_of(freedom: Float | Int) -> Float:
    """Return the coverage factors of 95 % intervals, Student's t [gum2008], shape (R,); NaN below one of freedom.

    Here a sigma and its degrees of freedom, shape (R,), meet: whole or not, they are those of the sigma that is stated.
    """
    factors = {n: student_quantile(0.5 + 0.5 * COVERAGE, n) for n in set(freedom.tolist()) if n >= 1}
    return np.array([factors.get(n, np.nan) for n in freedom.tolist()])


def count_attitudes(sample: Sample) -> list[int | None]:
    """Return how many distinct attitudes the poses of each sensor hold; None where they were not counted."""
    return [None] * len(sample)


def fit(solution: Solution) -> Fit:
    """Fit a solution: one pass over the readings, everything for all sensors at once."""
    settings, sample = solution.stated.settings, solution.sample
    g, held = settings.g, None if settings.misalignment else ALIGNED
    K, D, lower, own_D, information = _determined(solution)
    observability = Observability.of(information, sample.poses, held)
    freedom = sample.poses - min(9, solution.cost.unknowns) - SLOPES * (solution.slopes is not None)
    centre = solution.stated.cost.box.centre
    nominal, bias, before = uncalibrated(centre[:, :3].mean(axis=1), centre[:, -3:], settings)
    sums, kept = _pass(solution, (lower, own_D), (nominal, bias))
    residuals = _residuals(sums[3], kept, sample, _absorbed(solution, observability), freedom, held, g)
    variance = _variance(solution, sums, freedom)
    noise = _noise_ratio(variance, sums[2] / sample.poses, freedom)
    at_wall, shown = _at_wall(solution.x), to_gauge(K, settings.gauge)
    covariance = _covariance(observability, variance, np.asarray(at_wall.any(axis=1)), g)
    sigma_K, sigma_D = propagate(shown, lower, covariance, settings.gauge, g)
    view, information, sight = _first_sight(solution, observability, information, (lower, D))
    return Fit(
        sample=sample,
        settings=settings,
        search=solution.search,
        gauge=settings.gauge,
        K=shown,
        D=D,
        lower=lower,
        sigma_K=sigma_K,
        sigma_D=sigma_D,
        value=solution.value,
        observability=observability,
        view=view,
        dop=view.dop,
        information=information,
        sight=sight,
        freedom=freedom,
        s=np.sqrt(variance),
        covariance=covariance,
        coverage=coverage_of(freedom),
        at_wall=at_wall,
        rms=np.sqrt(sums[0] / sample.poses),
        rms_before=np.sqrt(sums[1] / sample.poses),
        before=before,
        nominal=nominal,
        residuals=residuals,
        noise=noise,
        solution=solution,
        notes=solution.notes,
    )


def _determined(solution: Solution) -> tuple[Float, Float, Float, Float, Float]:
    """Return K and D, the same in gauge `lower`, and J^T J of the nine parameters, less what slopes take of it."""
    K, D = solution.cost.parameters(solution.x)
    nine, point = solution.plain.in_lower(K, D)
    information = nine.information(point)
    loss = 0.0 if solution.slopes is None else solution.slopes.loss
    return K, D, *nine.parameters(point), information - loss


def _first_sight(
    solution: Solution, observability: Observability, information: Float, found: tuple[Float, Float]
) -> tuple[Observability, Float, tuple[Float, Float]]:
    """Return the observability that verdicts are explained with, the information, and the sensors' K and D.

    Readings that fix no ellipsoid let noise choose the undetermined parameters, and the others with them: the
    nearest sphere then sees the attitudes better than the fit does.
    """
    sphere = np.array([source == "sphere" for source in solution.stated.sources])
    if not sphere.any():
        return observability, information, found
    held = None if solution.stated.settings.misalignment else ALIGNED
    K, D = solution.cost.parameters(np.zeros_like(solution.x))
    nine, point = solution.plain.in_lower(K, D)
    round_information = nine.information(point)
    view = Observability.of(round_information, solution.sample.poses, held)
    sphere &= np.array([verdict == "undetermined" for verdict in view.verdicts])
    square = sphere[:, None, None]
    sight = np.where(square, K, found[0]), np.where(sphere[:, None], D, found[1])
    return observability.replaced(sphere, view), np.where(square, round_information, information), sight


def _noise_ratio(variance: Float, expected: Float, freedom: Int) -> Float:
    """Return s over the noise of an expected variance, and the p-value of so large a ratio, shape (2, R), or NaN."""
    known = np.flatnonzero((freedom > 0) & (variance > 0) & (expected > 0))
    noise = np.full((2, len(variance)), np.nan)
    noise[0, known] = np.sqrt(variance[known]) / np.sqrt(expected[known])
    noise[1, known] = chi_square_chance(freedom[known] * noise[0, known] ** 2, freedom[known])
    return noise


def _absorbed(solution: Solution, observability: Observability) -> Float:
    """Return (J^T W J)^-1 that leverages rest on, shape (R, 9, 9): with the weights of a robust loss, too."""
    if solution.noise is None:
        return observability.cofactor
    nine, point = solution.cost.in_lower(*solution.cost.parameters(solution.x))
    return Observability.of(nine.information(point), 0).cofactor


def _at_wall(x: Float) -> Bool:
    """Return which unknowns are at a wall of the search box, shape (R, D), for points of the box, same shape.

    Where they are, the least cost lies outside the box. In gauge `full` the free rotation reaches the walls of the
    off-diagonals by itself, which says nothing.
    """
    edge: Bool = np.asarray(np.abs(x) >= 1.0 - EDGE)
    if x.shape[-1] == 12:
        edge[..., 3:9] = False
    return edge


def _variance(solution: Solution, sums: Float, freedom: Int) -> Float:
    """Return s^2, (m/s^2)^2, shape (R,): sum w e^2 over the degrees of freedom, NaN without any; `sums` as of `_pass`.

    Under a robust loss the factor of (J^T W J)^-1 in the covariance of the M-estimate [huber1981]:
    sum psi^2 / (J - p) / (mean psi')^2, W the weights of the poses without those of the loss.
    """
    room = np.where(freedom > 0, freedom, np.nan)
    if _robust(solution) is None:
        return np.asarray(solution.value / (4.0 * solution.stated.settings.g**2) / room)  # L = sum (2 g e)^2
    return np.asarray(sums[4] / room / (sums[5] / solution.sample.poses) ** 2)


def uncalibrated(scale: Float, D: Float, settings: Settings) -> tuple[Float, Float, list[str]]:
    """Return scale factors and biases, shape (R, 3), that readings have before calibration, and the same in words.

    A stated nominal sensor; else, for readings that are specific force already, themselves; else one scale factor for
    all axes and the bias in the middle, which is what a user without calibration could do.

    Args:
        scale: mean scale factor, output units per m/s^2, shape (R,); D: bias, output units, shape (R, 3).
        settings: may state a nominal sensor.
    """
    if settings.nominal is not None:
        k, bias = (np.broadcast_to(v, D.shape) for v in (settings.nominal.scale, settings.nominal.bias))
        return k, bias, ["the stated nominal sensor"] * len(D)
    # A nominal scale factor carries no more than three significant digits.
    rounded = np.array([float(f"{value:.3g}") for value in scale.tolist()])
    force = (rounded > 0.8) & (rounded < 1.25)  # specific force already, in m/s^2 or in g
    words = "one scale factor for all axes and the estimated bias, no misalignment"
    return (
        np.repeat(np.where(force, 1.0, rounded)[:, None], 3, axis=1),
        np.where(force[:, None], 0.0, D),
        ["the readings as they are" if f else words for f in force],
    )


def _robust(solution: Solution) -> Float | None:
    """Return the noise that a robust loss rests on, m/s^2, shape (R,); None when all poses counted alike."""
    noise = solution.noise
    return None if noise is None or (noise <= NO_NOISE * solution.stated.settings.g).all() else noise


def _pass(
    solution: Solution, found: tuple[Float, Float], taken_for: tuple[Float, Float]
) -> tuple[Float, list[Float]]:
    """Go over the readings once, block by block.

    Args:
        solution: of R sensors; found: their K, gauge `lower`, and D.
        taken_for: scale factors and biases of the readings before calibration, shape (R, 3).

    Returns:
        Sums over the poses, shape (6, R): of (|f| - g)^2 after and before, of the variance that scatter explains, of
        w e^2 (weights of a robust loss and all), and of psi^2, all (m/s^2)^2, and psi' under a robust loss. Columns of
        the poses that are kept: number, sqrt(w) e, w, f and e before, shapes (R, k) and (R, k, 3).
    """
    settings, sample, weights = solution.stated.settings, solution.sample, solution.stated.weights
    g, noise, sensors = settings.g, _robust(solution), len(solution.sample)
    raw = sample.errors(taken_for[0][..., None] * np.eye(3), taken_for[1], g)
    sums: list[Float] = []
    parts: list[list[Float]] = []
    for (first, e, f), (_, e_raw, _) in zip(sample.errors(*found, g), raw, strict=True):
        real = sample.real(first, e.shape[1])
        w = real.astype(float) if weights is None else weights[:, first : first + e.shape[1]]
        psi: Float = np.zeros((sensors, 1))
        slope: Float = psi
        if noise is not None:
            z = np.sqrt(w) * e / noise[:, None]
            psi = loss_weight(z, settings.robust) * z * noise[:, None]
            slope = loss_slope(z, settings.robust)
            w = w * loss_weight(z, settings.robust)
        scaled = np.sqrt(w) * e
        expected = np.where(real, sample.explained(first, f, found[0]), 0.0)
        squares = (real * length_error(e, g) ** 2, real * length_error(e_raw, g) ** 2, expected, scaled**2)
        sums.append(np.stack([np.sum(part, axis=1) for part in (*squares, psi**2, slope)]))
        number = np.broadcast_to(first + np.arange(e.shape[1]), e.shape)
        parts.append(_worst([number.astype(float), scaled, w, f, e_raw], sample))
    kept = _worst([np.concatenate(column, axis=1) for column in zip(*parts, strict=True)], sample)
    return np.sum(sums, axis=0), kept


def _worst(columns: list[Float], sample: Sample) -> list[Float]:
    """Return the columns of the poses that are kept: all of few; of many those with the largest residuals, in order."""
    if int(sample.poses.max()) <= KEPT:
        return columns
    size = np.abs(columns[1])
    last = min(KEPT_WORST, size.shape[1]) - 1
    index = np.sort(np.argpartition(-size, last, axis=1)[:, :KEPT_WORST], axis=1)
    rows = np.arange(len(size))[:, None]
    return [column[rows, index] for column in columns]


def length_error(e: Float, g: float) -> Float:
    """Return |f| - g in m/s^2 from e = (g^2 - |f|^2) / 2g, same shape."""
    return np.asarray(np.sqrt(np.maximum(g * g - 2.0 * g * e, 0.0)) - g)


def _residuals(
    total: Float,
    kept: list[Float],
    sample: Sample,
    cofactor: Float,
    freedom: Int,
    held: Bool | None,
    g: float,
) -> PoseResiduals:
    """Return the kept residuals with their leverage, studentised and with the pose left out, and the outliers."""
    order, scaled, w, f, e_raw = kept
    number = order.astype(np.intp)
    real, free = number < sample.poses[:, None], freedom[:, None]
    f = np.ascontiguousarray(f)
    size = np.linalg.norm(f, axis=2)
    leverage = leverages(design(f / np.where(size > 0, size, 1.0)[..., None]), w, cofactor)
    room = room_of(leverage)
    error, studentised = size - g, studentise(scaled, room, total[:, None], free)
    left_out = error / room
    sensor, pose = np.nonzero(is_suspect(studentised, error, free, g) & real)
    if number.shape[1] < int(
        sample.poses.max()
    ):  # of so many poses none bends the fit, unless beyond all measure
        blown = np.isnan(studentised[sensor, pose])
        at = sensor[blown], pose[blown]
        studentised[at] = np.copysign(np.inf, error[at])
    elif len(sensor):
        at = sensor, pose
        studentised[at], left_out[at] = leave_out(f[sensor], w[sensor], pose, g, held)
    beyond = beyond_chance(np.abs(studentised), sample.poses[:, None], free)
    outlier = beyond & real & (np.abs(error) > NO_NOISE * g)
    return PoseResiduals(
        number, real, error, length_error(e_raw, g), f, leverage, studentised, left_out, outlier
    )


def is_suspect(studentised: Float, error: Float, freedom: Int | int, g: float) -> Bool:
    """Return which poses may be outliers, or bend the fit too far for the first-order formula, shape (..., J).

    Args:
        studentised: by that formula, NaN where it has nothing to say; error: |f| - g, m/s^2.
        freedom: J - 9, a scalar or of shape (..., 1).
    """
    large = ~(np.abs(studentised) <= SUSPECT) & (np.abs(error) > NO_NOISE * g)
    return np.asarray((large | (np.abs(error) > BENT * g)) & (np.asarray(freedom) >= 2))


def leverages(rows: Float, w: Float, cofactor: Float) -> Float:
    """Return the part of each pose's own residual that the fit absorbs, shape (..., J).

    Args:
        rows: their design, shape (..., J, 9); w: their weights, shape (..., J).
        cofactor: (J^T W J)^-1, shape (..., 9, 9).
    """
    return np.asarray(np.minimum(w * np.sum((rows @ cofactor) * rows, axis=-1), 1.0))


def room_of(leverage: Float) -> Float:
    """Return 1 - leverage; NaN for a pose that the fit follows completely: it has no error to judge it by."""
    return np.where(leverage < 1.0 - 1e-9, 1.0 - leverage, np.nan)


def studentise(scaled: Float, room: Float, total: Float | float, freedom: Int | int) -> Float:
    """Return residuals over their standard deviation from the other poses, shape (..., J), NaN below 2 of freedom.

    Args:
        scaled: sqrt(w) e, m/s^2, and `room`, both of shape (..., J).
        total: the sum of all their squares; freedom: J - 9; both scalars or of shape (..., 1).
    """
    others = np.maximum(total - scaled**2 / room, 0.0) / np.maximum(freedom - 1, 1)
    deviation = np.sqrt(np.where((others > 0) & (np.asarray(freedom) >= 2), others, np.nan) * room)
    return np.asarray(-scaled / deviation)


def beyond_chance(size: Float, poses: Int, freedom: Int) -> Bool:
    """Return which studentised residuals are so large that none of a sensor's would be by chance (Student's t).

    Args:
        size: absolute values, shape (..., J), NaN for none; poses, freedom: of their sensor, broadcast to that shape.
    """
    beyond: Bool = np.zeros(size.shape, dtype=bool)
    suspect = np.nonzero((size > SUSPECT) & (freedom >= 2))
    poses, freedom = (np.broadcast_to(a, size.shape)[suspect] for a in (poses, freedom))
    beyond[suspect] = poses * student_chance(size[suspect], freedom - 1) < OUTLIER_LEVEL
    return beyond


def leave_out(
    force: Float, weights: Float, pose: Int, g: float, held: Bool | None = None
) -> tuple[Float, Float]:
    """Fit S sensors anew, each without one of its poses: what a pose looks like to the others.

    The formula of linear regression subtracts a pose's part from the sum of squares. A pose that is wrong by several
    per cent bends the fit so far that its part comes out larger than the whole, and the formula has nothing to say.

    Args:
        force: specific force by the fit with all poses, m/s^2, shape (S, J, 3).
        weights: of the poses, 0 for none, shape (S, J).
        pose: which one to leave out, shape (S,).
        g: local gravity, m/s^2.
        held: which of the nine parameters are not estimated, shape (9,).

    Returns:
        |f| - g of the pose left out over its standard deviation, from the residuals of the others, and |f| - g itself,
        m/s^2, shape (S,) both; NaN where the others do not determine the sensor, or where too few are left.
    """
    free = np.arange(9) if held is None else np.flatnonzero(~held)
    sensors = np.arange(len(pose))
    kept = weights.copy()
    kept[sensors, pose] = 0.0
    with np.errstate(all="ignore"):
        going = np.ones((len(pose), 1), dtype=bool)
        for _ in range(STEPS):
            e, rows, cofactor = _linearised(force, kept, g, free)
            step = np.zeros((len(pose), 9))
            step[:, free] = -(cofactor @ (rows.swapaxes(1, 2) @ (kept * e)[..., None]))[..., 0]
            force = _moved(
                force, np.where(going, step, 0.0), g
            )  # each comes to the same point in any company
            going &= (np.abs(step) > SETTLED * g).any(axis=1, keepdims=True)
            if not going.any():
                break
        e, rows, cofactor = _linearised(force, kept, g, free)
        freedom = np.count_nonzero(kept, axis=1) - len(free)
        variance = np.sum(kept * e * e, axis=1) / np.where(freedom > 0, freedom, np.nan)
        at = rows[sensors, pose]
        spread = 1.0 / weights[sensors, pose] + np.sum((cofactor @ at[..., None])[..., 0] * at, axis=1)
        error = np.linalg.norm(force[sensors, pose], axis=1) - g
        return -e[sensors, pose] / np.sqrt(variance * spread), error


def _linearised(force: Float, weights: Float, g: float, free: Int) -> tuple[Float, Float, Float]:
    """Return e = (g^2 - |f|^2) / 2g, its derivatives by the changes of `_moved`, and the inverse of their products.

    Shapes (S, J), (S, J, p) and (S, p, p) for the p parameters at `free`; NaN where the weighted poses do not determine
    a sensor.
    """
    e = (g * g - np.sum(force * force, axis=2)) / (2.0 * g)
    rows = design(force / g)[..., free]
    normal = (rows * weights[..., None]).swapaxes(1, 2) @ rows
    size = np.einsum("spp->s", normal)
    finite = np.isfinite(size)[:, None, None]
    inverse = np.linalg.inv(
        np.where(finite, normal + RIDGE * size[:, None, None] * np.eye(len(free)), np.eye(len(free)))
    )
    spread = np.einsum("spp->s", inverse) * size
    known = (spread > 0) & (spread < 1.0 / LEAST_ROOM)
    return e, rows, np.where(known[:, None, None], inverse, np.nan)


def _moved(force: Float, step: Float, g: float) -> Float:
    """Return (I + E) f - b, with the lower triangle E (times g) and b from a step, m/s^2, shape (S, 9)."""
    E = np.zeros((len(step), 3, 3))
    for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
        E[:, i, j] = step[:, p] / g
    return np.asarray(force + force @ E.swapaxes(1, 2) - step[:, None, 6:])


def _covariance(observability: Observability, variance: Float, walled: Bool, g: float) -> Float:
    """Return the covariance of the nine parameters, (m/s^2)^2, shape (R, 9, 9); NaN where it does not hold.

    Args:
        observability: what the poses of R sensors say.
        variance: of one pose's modulus, (m/s^2)^2, shape (R,).
        walled: whose search stopped at a wall of its box, shape (R,): that is not the least-squares answer.
        g: local gravity, m/s^2.
    """
    held = firm(observability.dop, observability.verdicts, np.sqrt(variance), g) & ~walled[:, None]
    return np.where(
        held[:, :, None] & held[:, None], variance[:, None, None] * observability.cofactor, np.nan
    )


def firm(dop: Float, verdict: Sequence[Geometry], s: Float, g: float) -> Bool:
    """Return which of the nine parameters of R sensors the linear covariance holds for, shape (R, 9).

    Poses that leave a direction open leave a valley of almost equal cost, and the valley bends: an error d along
    it moves every other parameter by about d^2 / 2g. Where that is more than their own error, or d is without
    bound, the covariance tells less than what chance decides.

    Args:
        dop: dilution of precision, shape (R, 9); verdict: on the poses, R of them.
        s: standard deviation of one pose's modulus, m/s^2, shape (R,); g: local gravity, m/s^2.
    """
    bounded = np.isfinite(dop).all(axis=1, keepdims=True)
    error = s[:, None] * np.where(bounded, dop, 0.0)
    bend = error.max(axis=1, keepdims=True) ** 2 / (2.0 * g)
    poor = np.array([word == "undetermined" for word in verdict], dtype=bool)
    return np.where(poor[:, None], bounded & (error >= bend), True)
