"""A solution assessed: uncertainty, verdict, residuals and cautions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration import quality
from accelcal_cli.calibration.cautions import cautions
from accelcal_cli.calibration.judgement import Judgement, judge
from accelcal_cli.calibration.nominal import Start
from accelcal_cli.calibration.quality import Observabilities
from accelcal_cli.calibration.residuals import NO_NOISE, Fit, examine, outliers
from accelcal_cli.calibration.robust import loss_weight, robust_variance
from accelcal_cli.calibration.scatter import beyond_scatter, explained
from accelcal_cli.calibration.search import Solution, lower_problem, to_gain
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.sigma import covariance
from accelcal_cli.calibration.temperature import SLOPES, Slopes
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float


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
