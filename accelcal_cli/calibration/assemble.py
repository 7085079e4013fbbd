"""From a solution to the record: uncertainty, verdict, residuals, notes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.calibration import quality, sigma
from accelcal_cli.calibration.cautions import cautions
from accelcal_cli.calibration.judgement import judge, notes
from accelcal_cli.calibration.nominal import Start, nominal_before
from accelcal_cli.calibration.parts import Dop, PoseFit, Sigma
from accelcal_cli.calibration.quality import Observabilities
from accelcal_cli.calibration.residuals import NO_NOISE, Fit, examine, outliers
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.robust import loss_weight, robust_variance
from accelcal_cli.calibration.scatter import beyond_scatter, explained
from accelcal_cli.calibration.search import Solution, lower_problem, model_at, to_gain
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import SLOPES, Slopes
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float

CURVE_POINTS = 120
"""Points kept of the convergence curve."""


def assemble(
    readings: Readings,
    settings: Settings,
    start: Start,
    solution: Solution,
    weights: Float | None,
    slopes: Slopes | None = None,
) -> Calibration:
    """Return the calibration record of a solution; with slopes, `readings` are those at the reference temperature."""
    g = settings.g
    found = model_at(solution.problem, solution.x)
    shown = found.in_gauge(settings.gauge)
    nine, point = lower_problem(solution.stated, found)
    low = ErrorModel(*(a[0] for a in nine.parameters(point)))
    information = quality.information(nine, point)[0] - (0.0 if slopes is None else slopes.loss)
    held = None if settings.misalignment else quality.ALIGNED
    known = Observabilities.of(information[None], np.array([readings.poses]), held)
    seen = known.one(0)
    freedom = readings.poses - min(9, solution.problem.unknowns) - (0 if slopes is None else SLOPES)
    judged = judge(solution, start, information, low, readings.poses, freedom, held)
    centre = start.box.centre[0]
    before, before_model = nominal_before(float(centre[:3].mean()), centre[-3:], settings)
    fitted = _fitted(solution, found, seen.cofactor)
    fit = examine(readings, low, before_model, g, fitted, weights, _robust_weight(solution, settings), held)
    variance = _variance(readings, settings, solution, low, weights, freedom)
    covariance = sigma.covariance(known, np.array([variance]), np.array([judged.at_wall]), g)[0]
    sigma_K, sigma_D = sigma.propagate(shown.K, low.K, covariance, settings.gauge, g)
    scale_sigma = float(np.sqrt(np.diagonal(covariance)[quality.SCALE]).max()) / g
    s = float(np.sqrt(variance))
    ratio, chance = noise = _noise(readings, low, s, freedom)
    named = tuple(int(j) for j in outliers(fit.poses, readings.poses, freedom))
    where = [readings.where(j) for j in named]
    left = 0.0 if settings.polish else to_gain(solution)
    return Calibration(
        K_a=shown.K,
        D_a=shown.D,
        K_A=shown.K_A,
        f_0=shown.f_0,
        gauge=settings.gauge,
        sigma=Sigma(sigma_K, sigma_D),
        dop=Dop.of(judged.dop),
        verdict=judged.verdict,
        reasons=judged.reasons,
        suggestions=judged.suggestions,
        cautions=(
            *readings.cautions,
            *cautions(settings, solution.agreeing, left, s, scale_sigma, noise, where),
        ),
        cost_search=float(solution.search.cost[solution.best]),
        cost=solution.cost,
        rms=fit.rms,
        rms_before=fit.rms_before,
        before=before,
        s=s,
        freedom=freedom,
        noise_ratio=ratio,
        noise_chance=chance,
        covariance=covariance,
        information=judged.information,
        nominal_scale=np.diagonal(before_model.K).copy(),
        nominal_bias=np.array(settings.nominal.bias) if settings.nominal else np.zeros(3),
        poses=readings.poses,
        evaluations=solution.evaluations,
        runs=settings.runs,
        runs_agreeing=solution.agreeing,
        poses_fit=_pose_fits(readings, fit, low, judged.sight),
        outliers=named,
        convergence=_curve(solution),
        optimizer=settings.optimizer,
        settings=_settings_record(settings, start),
        g=g,
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
        notes=(*readings.notes, *notes(solution, start, settings)),
        version=__version__,
        temperature=None if slopes is None else slopes.temperature,
    )


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


def _pose_fits(readings: Readings, fit: Fit, low: ErrorModel, sight: ErrorModel) -> tuple[PoseFit, ...]:
    r = fit.poses
    force = sight.specific_force(low.output(r.force))
    directions = (force / np.linalg.norm(force, axis=1, keepdims=True)).tolist()
    return tuple(
        PoseFit(
            int(j),
            readings.where(int(j)),
            float(r.error[i]),
            float(r.studentised[i]),
            float(r.leverage[i]),
            float(r.left_out[i]),
            float(r.before[i]),
            tuple(directions[i]),
        )
        for i, j in enumerate(r.pose)
    )


def _curve(solution: Solution) -> tuple[tuple[int, float], ...]:
    """Return the best run's best cost so far against its evaluations, thinned."""
    search = solution.search
    if search.trace is None or search.trace_evaluations is None:
        return ()
    last = int(search.iterations[solution.best]) + 1
    keep = sorted({round(k) for k in np.linspace(0, last - 1, min(last, CURVE_POINTS))})
    counts, costs = search.trace_evaluations[solution.best][keep], search.trace[solution.best][keep]
    return tuple((int(n), float(cost)) for n, cost in zip(counts, costs, strict=True) if np.isfinite(cost))


def _settings_record(settings: Settings, start: Start) -> dict[str, object]:
    """Return the settings as stated, with the optimizer's parameters and the box filled in."""
    record = asdict(settings)
    record["parameters"] = asdict(settings.build_optimizer())
    record["box"] = {
        **asdict(settings.box),
        "centre": start.box.centre[0].tolist(),
        "half_width": start.box.half[0].tolist(),
        "source": start.source,
    }
    record["version"] = __version__
    return record
