"""The road from readings to a calibration: nominal, search, polish, uncertainty, verdict."""

from __future__ import annotations

from dataclasses import replace

from accelcal_cli.calibration.assemble import assemble
from accelcal_cli.calibration.lotters import Loetters
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.robust import pose_weights
from accelcal_cli.calibration.search import Solution, model_at, resolve, reweight, search
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import Slopes, fit
from accelcal_cli.calibration.weighting import opened, packed, shared_weights
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float


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
        from accelcal_cli.calibration.known_record import calibrate_known

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
