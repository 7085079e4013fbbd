"""A fit: what solutions say of R sensors, computed once: residuals, geometry, noise bias, covariance.

Everything is in gauge `lower` and of the nine parameters of `observability`, whatever is searched or printed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.noise import (
    Clusters,
    NoiseSpread,
    autocorrelated,
    directions,
    isotropic_bias,
    jumps,
    noise_bias,
    plain_spread,
    scattered_spread,
)
from accelcal_cli.calibration.observability import (
    ALIGNED,
    STANDARD,
    CellCount,
    Geometry,
    Observability,
    PoseVerdict,
    design,
    distinct,
    lessened,
    moved_sensor,
    propagate,
    unit,
)
from accelcal_cli.calibration.residuals import KEPT, PoseResiduals, bend_and_drift, pose_residuals, worst
from accelcal_cli.calibration.result import PoseFit, Temperature
from accelcal_cli.calibration.sample import (
    NO_NOISE,
    NOISE_TOLD,
    Sample,
    length_error,
    loss_slope,
    loss_weight,
)
from accelcal_cli.calibration.search import SLOPES, Search, Solution, state, unsearched
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.model import ErrorModel, Gauge, misalignment, to_gauge

EDGE = 1e-6
"""A parameter within this part of a half-width from the wall of its box is at the edge."""

NOTABLE_BIAS = 0.05
"""Sigmas of a parameter from which on the noise bias is taken off."""

KNOWN_BIAS, UNALIKE = 0.1, 0.6
"""What may remain of the noise bias: the formula is right to a tenth. That of single readings is supposed to be alike
on all axes; for any attitudes that adds UNALIKE (s/g) sqrt(J) sigma, and 2 to 3 times as much where one axis is twice
as noisy."""


@frozen(eq=False)
class Fit:
    """What R sensors are found to be, and how well their readings say so.

    Attributes:
        sample: the readings that were fitted; settings: of the calibration; search: how it was found.
        gauge: of K; K, D: the sensors, shapes (R, 3, 3) and (R, 3); lower: K in gauge `lower`.
        sigma_K, sigma_D: one-sigma of K and D, NaN where there is none.
        value: L, shape (R,), (m/s^2)^4.
        view: the observability of the poses as they count in the fit; see `_first_sight`.
        information: J^T J of the nine parameters, shape (R, 9, 9); sight: K and D, gauge `lower`, that directions are
            seen with, shapes (R, 3, 3) and (R, 3); both of the view.
        geometry: what the distinct attitudes determine: the verdict on the poses.
        freedom: degrees of freedom of the residuals, shape (R,).
        spread: noise and covariance, before it is asked whether the covariance holds.
        covariance: of the nine parameters, (m/s^2)^2, shape (R, 9, 9), NaN where it does not hold.
        bias: what may remain of the noise bias, m/s^2, shape (R, 9); see `_unbiased`.
        clusters: rows that follow each other are summed over so many clusters, shape (R,); 0 where they do not.
        at_wall: which unknowns of the search are at a wall of their box, shape (R, D).
        rms, rms_before: of |f| - g after and before, m/s^2, shape (R,); before: what the readings were taken for;
            nominal: scale factors before, shape (R, 3).
        residuals: pose by pose.
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
    view: Observability
    information: Float
    sight: tuple[Float, Float]
    geometry: Geometry
    freedom: Int
    spread: NoiseSpread
    covariance: Float
    bias: Float
    clusters: Int
    at_wall: Bool
    rms: Float
    rms_before: Float
    before: list[str]
    nominal: Float
    residuals: PoseResiduals
    solution: Solution | None = None
    notes: tuple[str, ...] = ()

    @cached_property
    def s(self) -> Float:
        """Standard deviation of one pose's modulus, m/s^2, NaN without freedom, shape (R,); see `NoiseSpread`."""
        return np.sqrt(self.spread.variance)

    @cached_property
    def coverage(self) -> Float:
        """Factor k by which a sigma becomes the half-width of its 95 % interval, shape (R,)."""
        return self.spread.coverage()

    @cached_property
    def sigma(self) -> Float:
        """One-sigma of the nine parameters, m/s^2, shape (R, 9), NaN where there is none."""
        return np.asarray(np.sqrt(np.einsum("rpp->rp", self.covariance)))

    @cached_property
    def largest_misalignment(self) -> Float:
        """Largest angle by which two axes miss 90 degrees, rad, shape (R,)."""
        return np.asarray(np.abs(misalignment(self.lower)).max(axis=1))

    @cached_property
    def K_A(self) -> Float:  # noqa: N802
        """Inverse matrices, m/s^2 per output unit, shape (R, 3, 3)."""
        return np.linalg.inv(self.K)

    @cached_property
    def patterns(self) -> tuple[Float, Float]:
        """P-values of residuals that bend with the direction, and that drift from pose to pose, shape (R,) each.

        NaN with known attitudes, with slopes, for poses in time, whose sigma has drift, and where not all are kept.
        """
        poses = self.sample.poses
        told = self.residuals.pose.shape[1] >= int(poses.max()) and not self.sample.in_time.all()
        if self.solution is None or self.solution.slopes is not None or not told:
            return np.full(len(poses), np.nan), np.full(len(poses), np.nan)
        return bend_and_drift(self.residuals, poses, self.settings.g)

    @property
    def temperature(self) -> Temperature | None:
        """The slopes with temperature, where there are any, with their intervals; of one sensor."""
        if self.solution is None or self.solution.slopes is None:
            return None
        slopes = self.solution.slopes.with_covariance(self.spread.covariance[0])
        return slopes.with_intervals(float(self.coverage[0]))

    def pose_fits(self, at: int) -> tuple[PoseFit, ...]:
        """Return the kept residuals of the sensor number `at`, pose by pose, with the directions they are seen in."""
        sample, residuals, (K, D) = self.sample, self.residuals, self.sight
        real = residuals.real[at]
        output = ErrorModel(self.lower[at], self.D[at]).output(residuals.force[at, real])
        directions = unit(ErrorModel(K[at], D[at]).specific_force(output)).tolist()
        return tuple(
            PoseFit(
                pose=int(pose),
                where=sample.where(at, int(pose)),
                residual=float(residuals.error[at, k]),
                studentised=float(residuals.studentised[at, k]),
                leverage=float(residuals.leverage[at, k]),
                left_out=float(residuals.left_out[at, k]),
                residual_before=float(residuals.before[at, k]),
                direction=tuple(direction),
            )
            for k, (pose, direction) in enumerate(zip(residuals.pose[at, real], directions, strict=True))
        )


@frozen(eq=False)
class _Point:
    """The sensors of a solution, and what the readings say of them.

    Attributes:
        K, D: shapes (R, 3, 3) and (R, 3); lower: K in gauge `lower`.
        information: J^T J less what slopes take of it, shape (R, 9, 9); observability: of it.
        freedom: degrees of freedom of the residuals, shape (R,).
        bias: what may remain of the noise bias, m/s^2, shape (R, 9).
    """

    K: Float
    D: Float
    lower: Float
    information: Float
    observability: Observability
    freedom: Int
    bias: Float


def fit(solution: Solution) -> Fit:
    """Fit a solution: everything for all sensors at once, in one or two passes over the readings."""
    settings, sample = solution.stated.settings, solution.sample
    g, held = settings.g, None if settings.misalignment else ALIGNED
    point = _unbiased(solution, _point(solution, held), g)
    observability, freedom = point.observability, point.freedom
    centre = solution.stated.cost.box.centre
    nominal, bias, before = uncalibrated(centre[:, :3].mean(axis=1), centre[:, -3:], settings)
    sums, kept = _pass(solution, (point.lower, point.D), (nominal, bias))
    absorbed, rejected = _absorbed(solution, observability), solution.stated.rejected
    residuals = pose_residuals(sums[2], kept, sample, absorbed, freedom, held, rejected, g)
    spread, clusters = _spread(solution, point, sums)
    at_wall, shown = _at_wall(solution.x), to_gauge(point.K, settings.gauge)
    view, information, sight = _first_sight(solution, point)
    geometry = _geometry(solution, view, information, sight, held)
    verdicts, walled = geometry.observability.verdicts, np.asarray(at_wall.any(axis=1))
    covariance = _covariance(observability, verdicts, spread, walled, g)
    sigma_K, sigma_D = propagate(shown, point.lower, covariance, settings.gauge, g)
    return Fit(
        sample=sample,
        settings=settings,
        search=solution.search,
        gauge=settings.gauge,
        K=shown,
        D=point.D,
        lower=point.lower,
        sigma_K=sigma_K,
        sigma_D=sigma_D,
        value=solution.value,
        view=view,
        information=information,
        sight=sight,
        geometry=geometry,
        freedom=freedom,
        spread=spread,
        covariance=covariance,
        bias=point.bias,
        clusters=clusters,
        at_wall=at_wall,
        rms=np.sqrt(sums[0] / sample.poses),
        rms_before=np.sqrt(sums[1] / sample.poses),
        before=before,
        nominal=nominal,
        residuals=residuals,
        solution=solution,
        notes=solution.notes,
    )


@frozen(eq=False)
class QuickFit:
    """What the least cost says of one sensor, without search, noise bias and covariance: it compares sets of poses.

    Attributes:
        model: the sensor, gauge `lower`.
        rms: of |f| - g, m/s^2; sigma: of the worst parameter, m/s^2, as if the attitudes were twelve; NaN where the
            poses fix no ellipsoid, sigma also where they leave no freedom.
        verdict: on the attitudes.
    """

    model: ErrorModel
    rms: float
    sigma: float
    verdict: PoseVerdict


def quick_fit(readings: Readings, settings: Settings) -> QuickFit:
    """Fit the readings of one sensor at the least cost."""
    sample = Sample.of([readings])
    plain = state(sample, replace(settings, weights="none"))
    if plain.sources[0] == "sphere":
        # Where the poses determine no more than the nearest sphere, no search has to find that out.
        centre = np.zeros_like(plain.cost.box.centre)
        if Observability.of(plain.cost.information(centre), sample.poses)[0].verdict == "undetermined":
            K, D = plain.cost.parameters(centre)
            return QuickFit(ErrorModel(K[0], D[0]), np.nan, np.nan, "undetermined")
    solution = unsearched(plain if settings.weights == "none" else state(sample, settings))
    point = _point(solution, None)
    geometry = _geometry(solution, *_first_sight(solution, point), None).observability[0]
    s = np.sqrt(_variance(solution, np.zeros((7, 1)), point.freedom)[0])
    parts = [length_error(e[0], settings.g) for _, e, _ in sample.errors(point.lower, point.D, settings.g)]
    rms = np.sqrt(np.mean(np.concatenate(parts) ** 2))
    verdict = "undetermined" if _at_wall(solution.x).any() else geometry.verdict
    return QuickFit(ErrorModel(point.lower[0], point.D[0]), float(rms), float(s * geometry.worst), verdict)


def _point(solution: Solution, held: Bool | None) -> _Point:
    """Return the sensors at the least cost."""
    sample = solution.sample
    K, D = solution.cost.parameters(solution.x)
    nine, x = solution.plain.in_lower(K, D)
    slopes = solution.slopes
    information = nine.information(x) - (0.0 if slopes is None else slopes.loss)
    observability = Observability.of(information, sample.poses, held)
    unknowns = min(9, solution.cost.unknowns) + SLOPES * (slopes is not None)
    counted = solution.sample.counted(solution.stated.rejected)
    lower, bias = nine.parameters(x)[0], np.zeros((len(sample), 9))
    return _Point(K, D, lower, information, observability, counted - unknowns, bias)


def _unbiased(solution: Solution, point: _Point, g: float) -> _Point:
    """Return the sensors without the bias that noise adds where it is notable, and what may remain of it.

    Taken off as a change of the nine parameters, to first order.
    """
    cofactor, noise = point.observability.cofactor, solution.stated.noise
    room = np.where(point.freedom > 0, point.freedom, np.nan)
    variance = solution.value / (4.0 * g * g) / room if solution.noise is None else solution.noise**2
    nine, x = solution.plain.in_lower(point.K, point.D)
    R = solution.plain.triangle.R
    ones = (nine.design(x).swapaxes(1, 2) @ R[:, :, 10:])[..., 0]  # the last column is of ones, compressed
    bias = -isotropic_bias(ones, variance, cofactor, g)
    unalike = UNALIKE * np.sqrt(variance * solution.sample.poses) / g
    if noise is not None and noise.known.any():
        u = directions(solution.sample, point.lower, point.D)
        w = solution.sample.each_weight(solution.stated.weights)
        own = noise_bias(u, w, noise.covariance, cofactor, g)
        # A vibration scatters the readings and averages out: their means are less noisy than the scatter says.
        expected = np.sum(w * noise.variance, axis=1) / solution.sample.poses
        with np.errstate(divide="ignore", invalid="ignore"):
            own = own * np.fmin(1.0, variance / expected)[:, None]
        bias = np.where(noise.known[:, None], own, bias)
        unalike = np.where(noise.known, 0.0, unalike)
    sigma = np.sqrt(variance[:, None] * np.einsum("rpp->rp", cofactor))
    with np.errstate(divide="ignore", invalid="ignore"):
        notable = (np.abs(bias) > NOTABLE_BIAS * sigma).any(axis=1) & (np.abs(bias) < 0.1 * g).all(axis=1)
        notable &= variance > (NO_NOISE * g) ** 2
        notable &= ~_at_wall(solution.x).any(axis=1)
    if not notable.any():
        return point
    taken = np.where(notable[:, None], bias, 0.0)
    lower, D = moved_sensor(point.lower, point.D, -taken, g)
    square = notable[:, None, None]
    # In its own gauge the sensor changes as in gauge `lower`, seen from its own body frame.
    K = np.where(square, lower @ np.linalg.solve(point.lower, point.K), point.K)
    return replace(
        point,
        K=K,
        D=np.where(notable[:, None], D, point.D),
        lower=np.where(square, lower, point.lower),
        bias=np.where(square[..., 0], KNOWN_BIAS * np.abs(taken) + unalike[:, None] * sigma, 0.0),
    )


def _spread(solution: Solution, point: _Point, sums: Float) -> tuple[NoiseSpread, Int]:
    """Return noise and covariance, and into how many clusters rows that follow each other are summed (0: none)."""
    sample, stated = solution.sample, solution.stated
    cofactor, freedom = point.observability.cofactor, point.freedom
    if solution.slopes is not None:
        whole = np.zeros((1, 9 + SLOPES, 9 + SLOPES))
        whole[:, :9, :9], whole[:, 9:, 9:] = cofactor, solution.slopes.cofactor
        cofactor = whole
    part = 1.0 if _robust(solution) is None else NOISE_TOLD[stated.settings.robust]
    spread = plain_spread(_variance(solution, sums, freedom), cofactor, part * freedom)
    clusters = np.zeros(len(sample), dtype=np.intp)
    if stated.noise is not None and solution.noise is None:
        u = directions(sample, point.lower, point.D)
        w = sample.each_weight(stated.weights)
        rows = design(u) if solution.slopes is None else solution.slopes.rows
        spread = scattered_spread(spread, rows, w, cofactor, stated.noise, freedom)
        if stated.own is not None:
            spread = spread.by_own(stated.own, stated.noise.freedom(np.ones_like(w)))
    for at in np.flatnonzero(autocorrelated(sums[6], sums[2], sample.poses) | sample.in_time).tolist():
        one, in_time = _clusters(solution, point, at), bool(sample.in_time[at])
        spread.covariance[at], spread.freedom[at], clusters[at] = one.spread(cofactor[at], in_time=in_time)
    return spread, clusters


def _clusters(solution: Solution, point: _Point, at: int) -> Clusters:
    """Return the sums over rows of one sensor that follow each other."""
    sample, weights = solution.sample.take(np.array([at])), solution.stated.weights
    place, last, count = slice(at, at + 1), None, 0
    sensor = point.lower[place], point.D[place], solution.stated.settings.g
    for _, _, f in sample.errors(*sensor):
        u = unit(f[0])
        count, last = count + int(jumps(u, last).sum()), u[-1]
    clusters = Clusters.of(int(sample.poses[0]), count)
    for first, e, f in sample.errors(*sensor):
        u, part = np.ascontiguousarray(unit(f[0])), slice(first, first + f.shape[1])
        w = np.ones(len(u)) if weights is None else weights[at, part]
        rows = design(u) if solution.slopes is None else solution.slopes.rows[0, part]
        clusters.add(u, rows, np.sqrt(w) * e[0], w)
    return clusters


def _geometry(
    solution: Solution,
    view: Observability,
    information: Float,
    sight: tuple[Float, Float],
    held: Bool | None,
) -> Geometry:
    """Return what the distinct attitudes of the poses determine, seen with the sensors `sight`.

    Labels, and poses that are all distinct and count alike, are what the view says already.
    """
    sample, slopes = solution.sample, solution.slopes
    poses = int(sample.poses.max())
    if poses <= KEPT:
        real = sample.real(0, poses)
        if solution.stated.rejected is not None:
            real = real & ~solution.stated.rejected
        attitudes, once = distinct(directions(sample, *sight), real, sample.labelled)
    else:
        cells = [CellCount() for _ in range(len(sample))]
        for first, _, f in sample.errors(*sight, solution.stated.settings.g):
            u = unit(f)
            real = sample.real(first, f.shape[1])
            for at, cell in enumerate(cells):
                cell.add(u[at, real[at]])
        counted = [cell.distinct() for cell in cells]
        attitudes, once = np.array([n for n, _ in counted]), np.stack([rows for _, rows in counted])
        attitudes = np.where(sample.labelled, sample.poses, attitudes)
    if slopes is not None:
        once = lessened(once, information + slopes.loss, slopes.loss)
    alike = attitudes == sample.poses
    if solution.stated.settings.weights != "none" or solution.stated.rejected is not None:
        alike = np.zeros_like(alike)
    if alike.all() and int(attitudes.max()) <= STANDARD:
        return Geometry(attitudes, view, information)
    return Geometry.of(np.where(alike[:, None, None], information, once), attitudes, held)


def _first_sight(solution: Solution, point: _Point) -> tuple[Observability, Float, tuple[Float, Float]]:
    """Return the observability that verdicts are explained with, the information, and the sensors' K and D.

    Readings that fix no ellipsoid let noise choose the undetermined parameters, and the others with them: the
    nearest sphere then sees the attitudes better than the fit does.
    """
    sphere = np.array([source == "sphere" for source in solution.stated.sources])
    if not sphere.any():
        return point.observability, point.information, (point.lower, point.D)
    held = None if solution.stated.settings.misalignment else ALIGNED
    K, D = solution.cost.parameters(np.zeros_like(solution.x))
    nine, x = solution.plain.in_lower(K, D)
    round_information = nine.information(x)
    view = Observability.of(round_information, solution.sample.poses, held)
    sphere &= np.array([verdict == "undetermined" for verdict in view.verdicts])
    square = sphere[:, None, None]
    sight = np.where(square, K, point.lower), np.where(sphere[:, None], D, point.D)
    information = np.where(square, round_information, point.information)
    return point.observability.replaced(sphere, view), information, sight


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


def edge_names(at_wall: Bool) -> tuple[str, ...]:
    """Return the names of the unknowns that are at a wall of the box, of those marked in shape (D,)."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(at_wall) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_wall, strict=True) if at)


def _variance(solution: Solution, sums: Float, freedom: Int) -> Float:
    """Return s^2, (m/s^2)^2, shape (R,): sum w e^2 over the degrees of freedom, NaN without any; `sums` as of `_pass`.

    Under a robust loss the factor of (J^T W J)^-1 in the covariance of the M-estimate [huber1981] eq. 7.6.5 and 7.6.8:
    K^2 sum psi^2 / (J - p) / (mean psi')^2 with K = 1 + p / J var psi' / (mean psi')^2, W the weights of the poses
    without those of the loss. Of few poses that is too small: by about 1 / (J - p) for normal and for t3 residuals.
    """
    room = np.where(freedom > 0, freedom, np.nan)
    if _robust(solution) is None:
        return np.asarray(solution.value / (4.0 * solution.stated.settings.g**2) / room)  # L = sum (2 g e)^2
    poses = solution.sample.counted(solution.stated.rejected)
    mean = sums[4] / poses
    unequal = np.maximum(sums[5] / poses / mean**2 - 1.0, 0.0)
    K = 1.0 + (poses - freedom) / poses * unequal
    return np.asarray((1.0 + 1.0 / room) * K**2 * sums[3] / room / mean**2)


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
        Sums over the poses, shape (7, R): of (|f| - g)^2 after and before, of w e^2 (weights of a robust loss and all),
        of psi^2, all (m/s^2)^2, of psi' and its square under a robust loss, and of products of w e^2 of neighbours.
        Columns of the poses that are kept: number, sqrt(w) e, w, f and e before, shapes (R, k) and (R, k, 3).
    """
    settings, sample, weights = solution.stated.settings, solution.sample, solution.stated.weights
    g, noise, sensors = settings.g, _robust(solution), len(solution.sample)
    raw = sample.errors(taken_for[0][..., None] * np.eye(3), taken_for[1], g)
    sums: list[Float] = []
    parts: list[list[Float]] = []
    last: Float = np.zeros((sensors, 1))
    for (first, e, f), (_, e_raw, _) in zip(sample.errors(*found, g), raw, strict=True):
        real = sample.real(first, e.shape[1])
        w = real.astype(float) if weights is None else weights[:, first : first + e.shape[1]]
        psi: Float = np.zeros((sensors, 1))
        slope: Float = psi
        if noise is not None:
            z = np.sqrt(w) * e / noise[:, None]
            psi = loss_weight(z, settings.robust) * z * noise[:, None]
            slope = loss_slope(z, settings.robust) * (w > 0)
            w = w * loss_weight(z, settings.robust)
        scaled = np.sqrt(w) * e
        lagged = np.sum(scaled * np.concatenate([last, scaled[:, :-1]], axis=1), axis=1)
        last = scaled[:, -1:]
        squares = (real * length_error(e, g) ** 2, real * length_error(e_raw, g) ** 2, scaled**2)
        totals = [np.sum(part, axis=1) for part in (*squares, psi**2, slope, slope**2)]
        sums.append(np.stack([*totals, lagged]))
        number = np.broadcast_to(first + np.arange(e.shape[1]), e.shape)
        parts.append(worst([number.astype(float), scaled, w, f, e_raw], sample))
    kept = worst([np.concatenate(column, axis=1) for column in zip(*parts, strict=True)], sample)
    return np.sum(sums, axis=0), kept


def _covariance(
    observability: Observability, verdicts: Sequence[PoseVerdict], spread: NoiseSpread, walled: Bool, g: float
) -> Float:
    """Return the covariance of the nine parameters, (m/s^2)^2, shape (R, 9, 9); NaN where it does not hold.

    Args:
        observability: what the poses of R sensors say; verdicts: on them.
        spread: noise and covariance as they would hold.
        walled: whose search stopped at a wall of its box, shape (R,): that is not the least-squares answer.
        g: local gravity, m/s^2.
    """
    held = firm(observability.dop, verdicts, np.sqrt(spread.variance), g) & ~walled[:, None]
    held &= (spread.freedom > 0)[:, None]
    return np.where(held[:, :, None] & held[:, None], spread.covariance[:, :9, :9], np.nan)


def firm(dop: Float, verdict: Sequence[PoseVerdict], s: Float, g: float) -> Bool:
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
