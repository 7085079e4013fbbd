"""The road from readings to a calibration: nominal, search, polish, uncertainty, verdict.

From a solution to the record.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Float
from accelcal_cli.calibration.assess import assess, notes
from accelcal_cli.calibration.box import Start, nominal_before
from accelcal_cli.calibration.fit import Fit, propagate
from accelcal_cli.calibration.problem import Loetters
from accelcal_cli.calibration.result import Calibration, Dop, PoseFit, Sigma
from accelcal_cli.calibration.search import (
    Solution,
    model_at,
    opened,
    packed,
    resolve,
    reweight,
    search,
    shared_weights,
)
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import Slopes, fit
from accelcal_cli.calibration.weights import pose_weights
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel


def calibrate(readings: Readings, settings: Settings) -> Calibration:
    """Calibrate one sensor.

    Args:
        readings: J static poses.
        settings: model, box, optimizer, robustness.

    Raises:
        DataError: readings without any information (all equal, fewer than two).
        ConfigError: unknown optimizer or parameter.
    """
    if settings.attitudes == "known":
        from accelcal_cli.calibration.known_attitudes import calibrate_known

        return calibrate_known(readings, settings)
    if readings.poses < 2 or not (readings.upper > readings.lower).any():
        raise DataError(f"{readings.source}: all readings are equal; expected poses that differ in attitude")
    shared = settings.weights == "auto"
    weights = shared_weights(readings, settings) if shared else pose_weights(readings, settings.weights)
    problem, start = opened(readings, settings, weights)
    solution = search(problem, settings)
    if settings.robust != "none":
        solution = reweight(solution, readings, settings, weights)
    if readings.reference is not None:
        readings = noted(
            readings, "The columns of a reference specific force are used with --attitudes known only."
        )
    if readings.temperature is None or not settings.temperature:
        return assemble(readings, settings, start, solution, weights)
    slopes, note = _slopes(readings, solution, settings, weights)
    if slopes is None:
        return assemble(noted(readings, note), settings, start, solution, weights)
    warmed = packed(slopes.readings, weights, within=readings)
    solution = resolve(solution, Loetters(warmed, settings.g, start.box))
    return assemble(noted(slopes.readings, note), settings, start, solution, weights, slopes)


def noted(readings: Readings, note: str) -> Readings:
    """Return readings with one more note."""
    return replace(readings, notes=(*readings.notes, note))


def _slopes(
    readings: Readings, solution: Solution, settings: Settings, weights: Float | None
) -> tuple[Slopes | None, str]:
    """Return the slopes with temperature, if the readings determine them, and a sentence about it."""
    if settings.robust != "none":
        return None, "Temperature column not used: slopes with temperature go with plain least squares only."
    if not settings.misalignment:
        return (
            None,
            "Temperature column not used: slopes with temperature are fitted beside misalignments only.",
        )
    return fit(readings, model_at(solution.problem, solution.x), settings.g, weights)


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
    found = model_at(solution.problem, solution.x)
    shown = found.in_gauge(settings.gauge)
    centre = start.box.centre[0]
    before, before_model = nominal_before(float(centre[:3].mean()), centre[-3:], settings)
    seen = assess(readings, settings, start, solution, found, before_model, weights, slopes)
    judged, fit = seen.judged, seen.fit
    sigma_K, sigma_D = propagate(shown.K, seen.low.K, seen.covariance, settings.gauge, settings.g)
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
        cautions=seen.cautions,
        cost_search=float(solution.search.cost[solution.best]),
        cost=solution.cost,
        rms=fit.rms,
        rms_before=fit.rms_before,
        before=before,
        s=seen.s,
        freedom=seen.freedom,
        noise_ratio=seen.noise[0],
        noise_chance=seen.noise[1],
        covariance=seen.covariance,
        information=judged.information,
        nominal_scale=np.diagonal(before_model.K).copy(),
        nominal_bias=np.array(settings.nominal.bias) if settings.nominal else np.zeros(3),
        poses=readings.poses,
        evaluations=solution.evaluations,
        runs=settings.runs,
        runs_agreeing=solution.agreeing,
        poses_fit=_pose_fits(readings, fit, seen.low, judged.sight),
        outliers=seen.outliers,
        convergence=_curve(solution),
        optimizer=settings.optimizer,
        settings=_settings_record(settings, start),
        g=settings.g,
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
        notes=(*readings.notes, *notes(solution, start, settings)),
        version=__version__,
        temperature=None if slopes is None else slopes.temperature,
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
