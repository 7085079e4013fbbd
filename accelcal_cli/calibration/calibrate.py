"""The flow from readings to calibrations: Readings -> problem -> Solution -> Fit -> Assessment -> Calibration.

Every stage takes one object, of R sensors at once, and returns one; a single sensor is R = 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from typing import Any

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Float
from accelcal_cli.calibration.assess import Assessment, assess
from accelcal_cli.calibration.fit import fit
from accelcal_cli.calibration.result import NO_INTERVAL, Calibration, Dop, Sigma
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import Search, reweight, search, state
from accelcal_cli.calibration.settings import Settings, load_settings, weights_of_log
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.io.readings import Data, Readings, read_readings
from accelcal_cli.sensor.model import local_gravity

CURVE_POINTS = 120
"""Points kept of the convergence curve."""

TOGETHER = 16_384
"""Poses that are calibrated at once, unless one sensor has more: few enough for the processor's caches."""


def calibrate(
    data: Data, settings: Settings | None = None, *, columns: Sequence[str] | None = None, **keys: Any
) -> Calibration:
    """Calibrate one sensor.

    Args:
        data: J static poses: a file, an array of outputs, shape (J, 3), a frame of polars, pandas or Arrow, readings,
            or the detection of a log, whose poses are weighted by their scatter.
        settings: model, box, optimizer, robustness; the defaults when None.
        columns: see `read_readings`.
        keys: fields of `Settings` to change, and `latitude` with `height` in place of `g`. Without `g` readings that
            their file states in units of g or mg are taken so, and all others with 9.80665 m/s^2.

    Raises:
        DataError: readings without any information (all equal, fewer than two), or without the weights asked for.
        ConfigError: unknown setting, optimizer or parameter.

    Examples:
        >>> from accelcal_cli import calibrate, simulate
        >>> readings = simulate("mems", positions=24, seed=3).output
        >>> result = calibrate(readings, g=9.81)
        >>> result.verdict, result.K_a.shape
        ('good', (3, 3))
        >>> result.apply(readings).shape
        (24, 3)
    """
    return calibrate_many([data], settings, columns=columns, **keys)[0]


def calibrate_many(
    data: Sequence[Data],
    settings: Settings | None = None,
    *,
    columns: Sequence[str] | None = None,
    **keys: Any,
) -> list[Calibration]:
    """Calibrate sensors; each comes out as it would alone, to the last bit, and sensors with as many poses are faster.

    Args:
        data: static poses of each sensor; settings, columns, keys: of all of them, see `calibrate`.

    Raises:
        DataError, ConfigError: as in `calibrate`; the message names the sensor.

    Examples:
        >>> from accelcal_cli import calibrate_many, simulate
        >>> results = calibrate_many([simulate("mems", positions=12, seed=s).output for s in (1, 2)])
        >>> [result.verdict for result in results]
        ['good', 'good']
    """
    readings = [one if isinstance(one, Readings) else read_readings(one, columns) for one in data]
    if settings is not None and not keys:
        return _calibrated(readings, settings)
    results: dict[int, Calibration] = {}
    kinds: dict[tuple[str | None, bool], list[int]] = {}
    for at, (one, given) in enumerate(zip(readings, data, strict=True)):
        kinds.setdefault((one.form.unit, one is not given and hasattr(given, "readings")), []).append(at)
    for (unit, of_log), numbers in kinds.items():
        own = _settled(settings, unit, dict(keys), of_log=of_log)
        results |= zip(numbers, _calibrated([readings[at] for at in numbers], own), strict=True)
    return [results[at] for at in range(len(readings))]


def _settled(settings: Settings | None, unit: str | None, keys: dict[str, Any], *, of_log: bool) -> Settings:
    """Return the settings for readings in a unit, from a log or not, with keys that are stated beside them."""
    place = {name: keys.pop(name, None) for name in ("latitude", "height")}
    stated = dict(keys)
    if of_log and settings is None:
        stated.setdefault("weights", weights_of_log(keys))
    if settings is None or "g" in keys or place["latitude"] is not None:
        g = local_gravity(unit, g=keys.get("g"), **place)
        stated |= {} if g is None else {"g": g}
    if settings is None:
        return load_settings(None, stated)
    if unknown := set(stated) - {field.name for field in fields(Settings)}:
        raise ConfigError(f"unknown key{'s' * (len(unknown) > 1)}: {', '.join(sorted(unknown))}")
    return replace(settings, **stated)


def _calibrated(readings: Sequence[Readings], settings: Settings) -> list[Calibration]:
    results: list[Calibration | None] = [None] * len(readings)
    for group in _groups(readings, settings):
        sample = Sample.of([readings[at] for at in group])
        for at, fault in zip(group, sample.faults(settings.weights), strict=True):
            if fault:
                raise DataError(f"{readings[at].source}: {fault}")
        assessment = assessed(sample, settings)
        for place, at in enumerate(group):
            results[at] = record(assessment, place)
    return [result for result in results if result is not None]


def _groups(readings: Sequence[Readings], settings: Settings) -> list[list[int]]:
    """Return which sensors are calibrated together: as many poses, the same columns, and settings that go with it."""
    alone = settings.robust != "none" or settings.weights == "auto" or settings.attitudes == "known"
    groups: dict[object, list[list[int]]] = {}
    for at, one in enumerate(readings):
        columns = tuple(part is None for part in (one.count, one.scatter, one.reference))
        own = alone or one.temperature is not None or one.poses > TOGETHER
        parts = groups.setdefault(at if own else (one.poses, columns), [[]])
        if (len(parts[-1]) + 1) * one.poses > TOGETHER and parts[-1]:
            parts.append([])
        parts[-1].append(at)
    return [part for parts in groups.values() for part in parts]


def assessed(sample: Sample, settings: Settings, *, closed: bool = False) -> Assessment:
    """Take a sample without faults through the flow; `closed` as in `search`."""
    if settings.attitudes == "known":
        from accelcal_cli.calibration.known_attitudes import fit_known

        result = fit_known(sample, settings)
    else:
        stated = state(sample, settings)
        solution = reweight(search(stated, closed=closed))
        if sample.temperature is not None and settings.temperature:
            from accelcal_cli.calibration.temperature import with_slopes

            solution = with_slopes(solution)
        result = fit(solution)
    return assess(result)


def record(assessment: Assessment, at: int) -> Calibration:
    """Return the record of the sensor number `at` of an assessment."""
    fit = assessment.fit
    return Calibration(
        K_a=fit.K[at],
        D_a=fit.D[at],
        K_A=fit.K_A[at],
        f_0=fit.K_A[at] @ fit.D[at],
        gauge=fit.gauge,
        sigma=Sigma(fit.sigma_K[at], fit.sigma_D[at]),
        interval=NO_INTERVAL,
        dop=Dop.of(fit.view.dop[at]),
        geometry=Dop.of(_nine_of(fit.geometry.observability.dop[at], fit.view.dop[at])),
        verdict=assessment.verdicts[at],
        reasons=assessment.reasons[at],
        suggestions=assessment.suggestions[at],
        warnings=assessment.warnings[at],
        cost_search=float(fit.search.cost[at]),
        cost=float(fit.value[at]),
        rms=float(fit.rms[at]),
        rms_before=float(fit.rms_before[at]),
        before=fit.before[at],
        s=float(fit.s[at]),
        freedom=int(fit.freedom[at]),
        residual_noise_ratio=_number(fit.spread.ratio[at]),
        residual_noise_p=_number(fit.spread.p_more[at]),
        covariance=fit.covariance[at],
        information=fit.information[at],
        nominal_scale=np.array(fit.nominal[at]),
        nominal_bias=np.array(fit.settings.nominal.bias) if fit.settings.nominal else np.zeros(3),
        poses=int(fit.sample.poses[at]),
        attitudes=int(fit.geometry.attitudes[at]),
        evaluations=int(fit.search.evaluations[at]),
        runs=fit.search.runs,
        runs_agreeing=int(fit.search.agreeing[at]),
        poses_fit=fit.pose_fits(at),
        outliers=assessment.outliers[at],
        convergence=_curve(fit.search, at),
        optimizer=fit.search.optimizer,
        settings=_settings_record(assessment, at),
        g=fit.settings.g,
        data=_origin(fit.sample.readings(at)),
        notes=_notes(assessment, at),
        version=__version__,
        temperature=fit.temperature,
        shared_noise=_number(np.sqrt(fit.spread.shared[at])),
    ).with_intervals(float(fit.coverage[at]))


def _number(value: float) -> float | None:
    return None if np.isnan(value) else float(value)


def _origin(readings: Readings) -> dict[str, object]:
    named = {"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)}
    form = asdict(readings.form)
    if form["correction"] is None:
        del form["correction"]
    return {**named, **form}


def _nine_of(geometry: Float, view: Float) -> Float:
    """Return the dilution of precision of nine parameters by the geometry; with known attitudes it has four columns."""
    return geometry if len(geometry) == len(view) else view


def _curve(search: Search, at: int) -> tuple[tuple[int, float], ...]:
    """Return the best run's best cost so far against its evaluations, thinned."""
    run, best = search.run, search.best
    if run is None or best is None or run.trace is None or run.trace_evaluations is None:
        return ()
    row = int(best[at])
    last = int(run.iterations[row]) + 1
    kept = sorted({round(k) for k in np.linspace(0, last - 1, min(last, CURVE_POINTS))})
    counts, costs = run.trace_evaluations[row][kept], run.trace[row][kept]
    return tuple((int(n), float(cost)) for n, cost in zip(counts, costs, strict=True) if np.isfinite(cost))


def _settings_record(assessment: Assessment, at: int) -> dict[str, object]:
    """Return the settings as stated, with the optimizer's parameters and the box filled in."""
    settings, solution = assessment.fit.settings, assessment.fit.solution
    stated = asdict(settings)
    if solution is not None:
        problem, box = solution.stated, solution.stated.cost.box
        stated["parameters"] = assessment.fit.search.parameters
        stated["box"] = {
            **asdict(settings.box),
            "centre": box.centre[at].tolist(),
            "half_width": box.half[at].tolist(),
            "source": problem.sources[at],
        }
    return {**stated, "version": __version__}


def _notes(assessment: Assessment, at: int) -> tuple[str, ...]:
    """Return what a user should know of the readings, the fit and the search, in sentences."""
    fit, readings = assessment.fit, assessment.fit.sample.readings(at)
    solution, search = fit.solution, fit.search
    lines = list(readings.notes)
    if solution is not None and readings.reference is not None:
        lines.append("The columns of a reference specific force are used with --attitudes known only.")
    lines += fit.notes
    if solution is not None and solution.stated.sources[at] == "sphere":
        lines.append("The readings fix no ellipsoid; the search started from the nearest sphere.")
    if not np.isfinite(search.cost[at]):
        lines.append(f"The {search.optimizer} search failed; the result is the polished nominal sensor.")
    return tuple(lines)
