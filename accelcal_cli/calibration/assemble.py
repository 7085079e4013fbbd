"""From a solution to the record: uncertainty, verdict, residuals, notes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.calibration import quality
from accelcal_cli.calibration.nominal import Start
from accelcal_cli.calibration.parts import Dop, PoseFit, Sigma
from accelcal_cli.calibration.planner import fixture_directions, next_poses
from accelcal_cli.calibration.quality import Observability
from accelcal_cli.calibration.residuals import Fit, examine, outliers
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.robust import loss_weight, robust_variance
from accelcal_cli.calibration.search import NO_NOISE, Solution, lower_problem, model_at
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import SLOPES, Slopes
from accelcal_cli.calibration.verdict import FEWEST_POSES, edge_names, final_verdict, reasons_of
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import describe
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float

COMFORTABLE = 5.0
"""Suggested poses bring every dilution of precision to this: half of what counts as weak."""

MOST_SUGGESTIONS = 8
NOISE_BIAS = 3.0
"""Isotropic noise of standard deviation s makes scale factors too large by about 3 (s/g)^2: |f|^2 grows by 3 s^2
on average, and the noise in the products of outputs doubles it. Measured at s/g from 0.02 to 0.1."""

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
    nine, point = lower_problem(solution.problem, found)
    low = ErrorModel(*(a[0] for a in nine.parameters(point)))
    information = quality.information(nine, point)[0] - (0.0 if slopes is None else slopes.loss)
    seen = Observability.of(information, readings.poses)
    freedom = readings.poses - 9 - (0 if slopes is None else SLOPES)
    edge = edge_names(solution.x[0])
    centre = start.box.centre[0]
    before, before_model = nominal_before(float(centre[:3].mean()), centre[-3:], settings)
    fit = examine(readings, low, before_model, g, seen.cofactor, weights, _robust_weight(solution, settings))
    variance = _variance(readings, settings, solution, low, weights, freedom)
    # What stops at a wall of its box is not the least-squares answer.
    firm = quality.firm(seen.dop[None], [seen.verdict], np.sqrt([variance]), g)[0] & (not edge)
    covariance = np.where(firm[:, None] & firm, variance * seen.cofactor, np.nan)
    sigma_K, sigma_D = quality.propagate(shown.K, low.K, covariance, settings.gauge, g)
    said, seen_first, sight = _first_sight(solution, start, information, seen, low, readings.poses)
    suggestions = _suggest(said, seen_first, readings.poses)
    scale_sigma = float(np.sqrt(np.diagonal(covariance)[quality.SCALE]).max()) / g
    ratio, chance = _noise(readings, low, np.sqrt(variance), freedom)
    return Calibration(
        K_a=shown.K,
        D_a=shown.D,
        K_A=shown.K_A,
        f_0=shown.f_0,
        gauge=settings.gauge,
        sigma=Sigma(sigma_K, sigma_D),
        dop=_dop(seen),
        verdict=final_verdict(seen.verdict, bool(edge), freedom),
        reasons=reasons_of(seen_first, suggestions, edge, freedom),
        suggestions=suggestions,
        cost_search=float(solution.search.cost[solution.best]),
        cost=solution.cost,
        rms=fit.rms,
        rms_before=fit.rms_before,
        before=before,
        s=float(np.sqrt(variance)),
        freedom=freedom,
        noise_ratio=ratio,
        noise_chance=chance,
        covariance=covariance,
        information=said,
        nominal_scale=np.diagonal(before_model.K).copy(),
        nominal_bias=np.array(settings.nominal.bias) if settings.nominal else np.zeros(3),
        poses=readings.poses,
        evaluations=solution.evaluations,
        runs=settings.runs,
        runs_agreeing=solution.agreeing,
        poses_fit=_pose_fits(readings, fit, low, sight),
        outliers=tuple(int(j) for j in outliers(fit.poses, readings.poses, freedom)),
        convergence=_curve(solution),
        optimizer=settings.optimizer,
        settings=_settings_record(settings, start),
        g=g,
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
        notes=(*readings.notes, *_notes(solution, start, settings, np.sqrt(variance), scale_sigma)),
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


def _first_sight(
    solution: Solution, start: Start, information: Float, seen: Observability, low: ErrorModel, poses: int
) -> tuple[Float, Observability, ErrorModel]:
    """Return the information, the observability and the sensor that the verdict is explained with.

    Readings that fix no ellipsoid let noise choose the undetermined parameters, and the others with them: the
    nearest sphere then sees the attitudes better than the fit does.
    """
    if start.source != "sphere":
        return information, seen, low
    sphere = model_at(solution.problem, np.zeros_like(solution.x))
    nine, point = lower_problem(solution.problem, sphere)
    said = quality.information(nine, point)[0]
    first = Observability.of(said, poses)
    return (said, first, sphere) if first.verdict == "undetermined" else (information, seen, low)


def _robust_weight(solution: Solution, settings: Settings) -> Callable[[Float], Float] | None:
    """Return the weight that the robust fit gave a residual in m/s^2; None when all counted alike."""
    noise = solution.noise
    if noise is None or noise <= NO_NOISE * settings.g:
        return None
    return lambda e: loss_weight(e / noise, settings.robust)


def _suggest(information: Float, seen: Observability, poses: int) -> tuple[str, ...]:
    if seen.verdict == "good":
        return ()
    candidates = fixture_directions()
    chosen = next_poses(information, candidates, MOST_SUGGESTIONS, COMFORTABLE, FEWEST_POSES - poses)
    return tuple(describe(candidates[i]) for i in chosen)


def nominal_before(scale: float, D: Float, settings: Settings) -> tuple[str, ErrorModel]:
    """Return what the readings are taken for before calibration, in words and as a model.

    A stated nominal sensor; else, for readings that are specific force already, themselves; else one scale
    factor for all axes and the bias in the middle, which is what a user without calibration could do.

    Args:
        scale: mean scale factor, output units per m/s^2; D: bias, output units, shape (3,).
        settings: may state a nominal sensor.
    """
    k, bias, words = taken_for(np.array([scale]), D[None], settings)
    return words[0], ErrorModel(np.diag(k[0]), bias[0])


def taken_for(scale: Float, D: Float, settings: Settings) -> tuple[Float, Float, list[str]]:
    """Return scale factors and biases, shape (R, 3), and words of what readings of R sensors are taken for.

    See `nominal_before`; scale has the shape (R,), D (R, 3).
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


def _noise(readings: Readings, low: ErrorModel, s: float, freedom: int) -> tuple[float | None, float | None]:
    """Return s over the noise that the scatter within poses predicts, and the chance of so large a ratio."""
    if readings.scatter is None or readings.count is None or freedom < 1 or not s > 0:
        return None, None
    force = readings.scatter / np.diagonal(low.K)
    u = low.specific_force(readings.output())
    u = u / np.linalg.norm(u, axis=1, keepdims=True)
    variance = np.mean(np.sum((u * force) ** 2, axis=1) / readings.count)
    if not variance > 0:
        return None, None
    from scipy.special import chdtrc

    ratio = s / float(np.sqrt(variance))
    return ratio, float(chdtrc(freedom, freedom * ratio**2))


def _dop(seen: Observability) -> Dop:
    return Dop(
        misalignment=float(seen.dop[quality.MISALIGNMENT].max()),
        scale=float(seen.dop[quality.SCALE].max()),
        bias=float(seen.dop[quality.BIAS].max()),
        worst=seen.worst,
        parameters=dict(zip(quality.PARAMETERS, seen.dop.tolist(), strict=True)),
    )


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


def _notes(
    solution: Solution, start: Start, settings: Settings, s: float, sigma_scale: float
) -> tuple[str, ...]:
    notes = []
    if start.source == "sphere":
        notes.append("The readings fix no ellipsoid; the search started from the nearest sphere.")
    if not np.isfinite(solution.search.cost).any():
        notes.append(f"The {settings.optimizer} search failed; the result is the polished nominal sensor.")
    if settings.runs > 1 and solution.agreeing < settings.runs:
        notes.append(f"{solution.agreeing} of {settings.runs} searches ended in the best minimum.")
    bias = NOISE_BIAS * (s / settings.g) ** 2
    if bias > sigma_scale:
        notes.append(
            f"The noise of one reading, {s:.3g}, is so large that it makes the scale factors about {bias:.1%} too "
            "large, more than their sigma: average the readings of each pose first (a column that labels the pose)."
        )
    return tuple(notes)


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
