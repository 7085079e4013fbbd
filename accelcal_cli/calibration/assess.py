"""A solution assessed: uncertainty, verdict, residuals and cautions.

What is said of one calibration: its verdict, the poses that would mend it, what a user should know.

From dilution of precision, the walls of the box and the count of poses to the verdict and its reasons.

What a user should know before trusting a calibration whose poses determine it: its residuals and its search.

The verdict is of the poses alone: how an error of one reading comes out in the parameters. Cautions are of the
readings: they do not change the verdict, and stand beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.box import Start
from accelcal_cli.calibration.distributions import chi_square_chance
from accelcal_cli.calibration.fit import NO_NOISE, Fit, covariance, examine, outliers
from accelcal_cli.calibration.observability import Observabilities, Observability, Verdict
from accelcal_cli.calibration.search import Solution, lower_problem, model_at, to_gain
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import SLOPES, Slopes
from accelcal_cli.calibration.weights import beyond_scatter, explained, loss_weight, robust_variance
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import describe, faces


@dataclass(frozen=True, eq=False)
class Assessment:
    """What is to be known of a solution beside its parameters.

    Attributes:
        low: the sensor in gauge `lower`.
        freedom: degrees of freedom; s: standard deviation of one pose's modulus, m/s^2, NaN without any.
        noise: s over what the scatter within poses predicts, and the chance of so large a ratio; None where not known.
        covariance: of the nine parameters, (m/s^2)^2, shape (9, 9), NaN where they have no sigma.
        judged: verdict and reasons; fit: residuals; outliers: numbers of the poses beyond chance.
        cautions: sentences.
    """

    low: ErrorModel
    freedom: int
    s: float
    noise: tuple[float | None, float | None]
    covariance: Float
    judged: Judgement
    fit: Fit
    outliers: tuple[int, ...]
    cautions: tuple[str, ...]


def assess(
    readings: Readings,
    settings: Settings,
    start: Start,
    solution: Solution,
    found: ErrorModel,
    before: ErrorModel,
    weights: Float | None,
    slopes: Slopes | None,
) -> Assessment:
    """Return the assessment of a solution.

    Args:
        readings: with slopes, those at the reference temperature.
        settings, start, solution: of the calibration.
        found: the sensor found, in the gauge of the search; before: what the readings were taken for.
        weights: of the poses, shape (J,), or None.
        slopes: with temperature, or None.
    """
    g, poses = settings.g, readings.poses
    nine, point = lower_problem(solution.stated, found)
    low = ErrorModel(*(a[0] for a in nine.parameters(point)))
    information = quality.information(nine, point)[0] - (0.0 if slopes is None else slopes.loss)
    held = None if settings.misalignment else quality.ALIGNED
    seen = Observabilities.of(information[None], np.array([poses]), held)
    freedom = poses - min(9, solution.problem.unknowns) - (0 if slopes is None else SLOPES)
    judged = judge(solution, start, information, low, poses, freedom, held)
    cofactor = _fitted(solution, found, seen.cofactor[0])
    fit = examine(readings, low, before, g, cofactor, weights, _robust_weight(solution, settings), held)
    variance = _variance(readings, settings, solution, low, weights, freedom)
    spread = covariance(seen, np.array([variance]), np.array([judged.at_wall]), g)[0]
    scale_sigma = float(np.sqrt(np.diagonal(spread)[quality.SCALE]).max()) / g
    s = float(np.sqrt(variance))
    noise = _noise(readings, low, s, freedom)
    named = tuple(int(j) for j in outliers(fit.poses, poses, freedom))
    where = [readings.where(j) for j in named]
    left = 0.0 if settings.polish else to_gain(solution)
    said = cautions(settings, solution.agreeing, left, s, freedom, scale_sigma, noise, where)
    return Assessment(low, freedom, s, noise, spread, judged, fit, named, (*readings.cautions, *said))


def _variance(
    readings: Readings,
    settings: Settings,
    solution: Solution,
    low: ErrorModel,
    weights: Float | None,
    freedom: int,
) -> float:
    """Return s^2 in (m/s^2)^2: sum w e^2 / (J - 9); NaN without degrees of freedom."""
    if freedom < 1:
        return float("nan")
    if solution.noise:
        return robust_variance(readings, low, settings.g, solution.noise, settings.robust, weights)
    return solution.cost / (4.0 * settings.g**2) / freedom  # L = sum (2 g e)^2


def _fitted(solution: Solution, found: ErrorModel, cofactor: Float) -> Float:
    """Return (J^T W J)^-1 of the fit, shape (9, 9): with robust weights, which leverages and residuals rest on."""
    if solution.reweighted_from is None:
        return cofactor
    nine, point = lower_problem(solution.problem, found)
    return quality.Observability.of(quality.information(nine, point)[0], 0).cofactor


def _robust_weight(solution: Solution, settings: Settings) -> Callable[[Float], Float] | None:
    """Return the weight that the robust fit gave a residual in m/s^2; None when all counted alike."""
    noise = solution.noise
    if noise is None or noise <= NO_NOISE * settings.g:
        return None
    return lambda e: loss_weight(e / noise, settings.robust)


def _noise(readings: Readings, low: ErrorModel, s: float, freedom: int) -> tuple[float | None, float | None]:
    """Return s over the noise that the scatter within poses predicts, and the chance of so large a ratio."""
    if readings.scatter is None or readings.count is None:
        return None, None
    u = low.specific_force(readings.output())
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    variance = explained(u, readings.scatter, readings.count, np.diagonal(low.K))
    return beyond_scatter(s, float(np.mean(variance)), freedom)


COMFORTABLE = 5.0
"""Suggested poses bring every dilution of precision to this: half of what counts as weak."""

MOST_SUGGESTIONS = 8


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is said of a solution.

    Attributes:
        verdict: good, weak or undetermined.
        reasons: why it is not good, in sentences; suggestions: poses that would mend it, in words.
        information: J^T J that the words rest on, shape (9, 9).
        dop: dilution of precision of the nine parameters by it, shape (9,).
        sight: the sensor that the directions of the poses are seen with, gauge `lower`.
        at_wall: the search stopped at a wall of its box: what it found is not the least-squares answer.
    """

    verdict: Verdict
    reasons: tuple[str, ...]
    suggestions: tuple[str, ...]
    information: Float
    dop: Float
    sight: ErrorModel
    at_wall: bool


def judge(
    solution: Solution,
    start: Start,
    information: Float,
    low: ErrorModel,
    poses: int,
    freedom: int,
    held: Bool | None = None,
) -> Judgement:
    """Return the judgement of a solution.

    Args:
        solution: what was found from `start`.
        information: J^T J of the nine parameters, shape (9, 9).
        low: the sensor found, gauge `lower`.
        poses: J; freedom: J less the parameters.
        held: which of the nine are not estimated, shape (9,).
    """
    seen = Observability.of(information, poses, held)
    said, first, sight = _first_sight(solution, start, information, seen, low, poses, held)
    suggestions = _suggest(said, first, poses, held)
    edge = edge_names(solution.x[0])
    verdict = final_verdict(seen.verdict, bool(edge), freedom)
    return Judgement(
        verdict,
        reasons_of(first, suggestions, edge, freedom, 9 if held is None else 9 - int(held.sum())),
        suggestions,
        said,
        first.dop,
        sight,
        bool(edge),
    )


def _first_sight(
    solution: Solution,
    start: Start,
    information: Float,
    seen: Observability,
    low: ErrorModel,
    poses: int,
    held: Bool | None,
) -> tuple[Float, Observability, ErrorModel]:
    """Return the information, the observability and the sensor that the verdict is explained with.

    Readings that fix no ellipsoid let noise choose the undetermined parameters, and the others with them: the
    nearest sphere then sees the attitudes better than the fit does.
    """
    if start.source != "sphere":
        return information, seen, low
    sphere = model_at(solution.problem, np.zeros_like(solution.x))
    nine, point = lower_problem(solution.stated, sphere)
    said = quality.information(nine, point)[0]
    first = Observability.of(said, poses, held)
    return (said, first, sphere) if first.verdict == "undetermined" else (information, seen, low)


def _suggest(information: Float, seen: Observability, poses: int, held: Bool | None) -> tuple[str, ...]:
    if seen.verdict == "good":
        return ()
    from accelcal_cli.calibration.observability import next_poses
    from accelcal_cli.sensor.poses import fixture_directions

    candidates = fixture_directions() if held is None else faces()
    known = information if held is None else quality.knowing(information, held)
    chosen = next_poses(known, candidates, MOST_SUGGESTIONS, COMFORTABLE, FEWEST_POSES - poses)
    return tuple(dict.fromkeys(describe(candidates[i]) for i in chosen))


def notes(solution: Solution, start: Start, settings: Settings) -> tuple[str, ...]:
    """Return what a user should know of the search, in sentences."""
    lines = []
    if start.source == "sphere":
        lines.append("The readings fix no ellipsoid; the search started from the nearest sphere.")
    if not np.isfinite(solution.search.cost).any():
        lines.append(f"The {settings.optimizer} search failed; the result is the polished nominal sensor.")
    return tuple(lines)


FEWEST_POSES = 12
"""Suggested poses bring a poor set to at least this many: nine fit exactly and say nothing of their noise."""

EDGE = 1e-6
"""A parameter within this part of a half-width from the wall of its box is at the edge."""


def at_edge(x: Float) -> Bool:
    """Return which unknowns are at a wall of the search box, shape (..., D), for points of the box, same shape.

    Where they are, the least cost lies outside the box. In gauge `full` the free rotation reaches the walls of
    the off-diagonals by itself, which says nothing.
    """
    edge: Bool = np.asarray(np.abs(x) >= 1.0 - EDGE)
    if x.shape[-1] == 12:
        edge[..., 3:9] = False
    return edge


def edge_names(x: Float) -> tuple[str, ...]:
    """Return the names of the unknowns of a point, shape (D,), that are at a wall of the box."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(x) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_edge(x), strict=True) if at)


def final_verdict(seen: Verdict, edge: bool, freedom: int) -> Verdict:
    """Return the verdict of the poses, lowered where the search or the count of poses does not bear it out."""
    if edge:
        return "undetermined"
    return "weak" if freedom == 0 and seen == "good" else seen


def reasons_of(
    seen: Observability,
    suggestions: tuple[str, ...],
    edge: tuple[str, ...],
    freedom: int,
    parameters: int = 9,
) -> tuple[str, ...]:
    """Return why a verdict is not good, in sentences; freedom is the number of poses less that of parameters."""
    number = {6: "six", 9: "nine"}[parameters]
    lines = list(quality.in_words(seen, suggestions))
    if freedom < 0:
        lines.insert(
            0,
            f"{parameters + freedom} poses are fewer than the {number} parameters; take at least {FEWEST_POSES}.",
        )
    if freedom == 0:
        lines.append(
            f"{number.capitalize()} poses leave nothing to judge their noise by: no sigma. "
            f"Take at least {FEWEST_POSES}."
        )
    if edge and seen.verdict != "undetermined":  # of poses that leave a valley, the wall only ends it
        lines.append(
            f"The least cost lies outside the search box, beyond {', '.join(edge)}: "
            "widen the box or state the nominal sensor (--config, keys box and nominal)."
        )
    return tuple(lines)


MORE_THAN_NOISE, SURELY = 2.0, 1e-3
"""Residuals this many times their noise, and by chance this rarely, are told of."""

MOST_NAMED = 8
"""Poses that one caution names."""

FEW = 6
"""Degrees of freedom up to which poses stand in for each other: of twelve edges, which leave three, opposite ones."""

LARGE = 0.005
"""A noise of one pose above this part of g is told of. Data sheets of MEMS accelerometers state nonlinearities of up to
0.5 % of full scale, and the real recordings of the tests leave 0.01 to 0.04 %."""

PERPENDICULAR = (
    "The axes were taken as perpendicular, no misalignment was estimated: one of 10 mrad, usual in low-cost sensors, "
    "moves 1 % of the force along one axis to another."
)

STOPPED_SHORT = 0.01
"""Part of the cost that one more step would take off, from which on a search is told to be unfinished."""

EARTH = 9.76, 9.84
"""Gravity on Earth, m/s^2, from the top of the Andes to the Arctic Ocean."""

NOISE_BIAS = 3.5
"""Isotropic noise of standard deviation s, in units of g, makes scale factors too large by about 3.5 s^2: of c that
minimises E (1 - c^2 |u + n|^2)^2, c^2 = E |u + n|^2 / E |u + n|^4 = (1 + 3 s^2) / (1 + 10 s^2 + 15 s^4), and the scale
factor is 1 / c."""


def cautions(
    settings: Settings,
    agreeing: int,
    left: float,
    s: float,
    freedom: int,
    sigma_scale: float,
    noise: tuple[float | None, float | None],
    outlying: Sequence[str],
) -> tuple[str, ...]:
    """Return the cautions of a solution, in sentences, the gravest first.

    Args:
        settings: of the calibration; agreeing: how many of its searches ended in the best minimum.
        left: the part of the cost that one more step would take off.
        s: standard deviation of one pose's modulus, in the unit of g, NaN where nothing tells it; freedom: of it.
        sigma_scale: the largest of a scale factor, as a part of it.
        noise: s over what the scatter within poses predicts, and the chance of so large a ratio; None where nothing
            tells them.
        outlying: the poses that do not fit, by line or label.
    """
    return (
        *not_fitting(outlying, freedom, robust=settings.robust == "none"),
        *large_residuals(s, settings.g, freedom, aligned=not settings.misalignment),
        *_more_than_noise(*noise),
        *_noise_bias(s, settings.g, sigma_scale),
        *_search(agreeing, settings.runs, left),
        *(() if settings.misalignment else (PERPENDICULAR,)),
        *odd_gravity(settings.g),
    )


def is_large(s: float, g: float, freedom: int) -> bool:
    """Whether a noise of one pose is beyond LARGE g, and not by the chance of its own estimate (chi-square)."""
    if freedom < 1 or not s > LARGE * g:
        return False
    x = freedom * (s / (LARGE * g)) ** 2
    return bool(chi_square_chance(np.array([x]), np.array([freedom]))[0] < SURELY)


def large_residuals(s: float, g: float, freedom: int, *, aligned: bool = False) -> tuple[str, ...]:
    """Return a caution of residuals that are large beside g.

    Args:
        s, g: as in `cautions`; freedom: degrees of freedom of s.
        aligned: whether the axes were taken as perpendicular, which may be what the residuals say.
    """
    if not is_large(s, g, freedom):
        return ()
    other = ", or its axes are not perpendicular" if aligned else ""
    return (
        f"After calibration one pose errs by {s / g:.2%} of g, where {LARGE:.1%} is much for an accelerometer at rest: "
        f"the sensor moved, the readings are averaged too little, or they are not what they are taken for{other}.",
    )


def not_fitting(outlying: Sequence[str], freedom: int, *, robust: bool = False) -> tuple[str, ...]:
    """Return a caution that names the poses that do not fit, and what to do.

    Args:
        outlying: the poses, by line or label.
        freedom: degrees of freedom: with few, a sound pose can take the blame of another.
        robust: whether a robust loss is a way out.
    """
    if not outlying:
        return ()
    other = ", or use calibrate --robust" if robust else ""
    doubt = (
        " With so few poses one can take the blame of another."
        if freedom <= FEW and len(outlying) > 1
        else ""
    )
    named = ", ".join(outlying[:MOST_NAMED])
    more = f" and {len(outlying) - MOST_NAMED:,} more" if len(outlying) > MOST_NAMED else ""
    again = "it" if len(outlying) == 1 else "them"
    return (f"Beyond chance off the others: {named}{more}. Measure {again} again{other}.{doubt}",)


def _more_than_noise(ratio: float | None, chance: float | None) -> tuple[str, ...]:
    if ratio is None or chance is None or ratio < MORE_THAN_NOISE or chance > SURELY:
        return ()
    return (
        f"The residuals are {ratio_in_words(ratio)} times what the scatter within the poses explains: the sensor "
        "moved in them, changed its temperature or is not linear. Sigma counts that as noise; the verdict is of the "
        "poses alone.",
    )


def ratio_in_words(ratio: float) -> str:
    """Return a ratio with two digits, or more where it is large."""
    return f"{ratio:.2g}" if ratio < 100 else f"{ratio:,.0f}"


def _noise_bias(s: float, g: float, sigma_scale: float) -> tuple[str, ...]:
    bias = NOISE_BIAS * (s / g) ** 2
    if not bias > sigma_scale:
        return ()
    return (
        f"The noise of one reading, {s:.3g}, is so large that it makes the scale factors about {bias:.1%} too "
        "large, more than their sigma: average the readings of each pose first (a column that labels the pose).",
    )


def _search(agreeing: int, runs: int, left: float) -> tuple[str, ...]:
    lines = []
    if left > STOPPED_SHORT:
        lines.append(
            f"The search stopped short of the minimum: a step more would take {left:.0%} off the cost. "
            "Leave out --no-polish, or search longer."
        )
    if agreeing < runs:
        lines.append(f"{agreeing} of {runs} searches ended in the best minimum.")
    return tuple(lines)


def odd_gravity(g: float) -> tuple[str, ...]:
    """Return a caution of a gravity, m/s^2 or 1 for units of g, that is not found on Earth."""
    if g == 1.0 or EARTH[0] <= g <= EARTH[1]:
        return ()
    return (
        f"g = {g:g} is neither gravity on Earth, {EARTH[0]} to {EARTH[1]} m/s^2, nor 1, for readings in units of g: "
        "scale factors are proportional to it.",
    )
