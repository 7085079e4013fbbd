"""The road from readings to a calibration: nominal, search, polish, uncertainty, verdict."""

from __future__ import annotations

from accelcal_cli.calibration.assemble import assemble
from accelcal_cli.calibration.compress import compress
from accelcal_cli.calibration.lotters import Loetters
from accelcal_cli.calibration.nominal import search_box
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.robust import pose_weights
from accelcal_cli.calibration.search import reweight, search
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.weighting import shared_weights, weighted
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.readings import Readings


def calibrate(readings: Readings, settings: Settings) -> Calibration:
    """Calibrate one sensor.

    Args:
        readings: J static poses.
        settings: model, box, optimizer, robustness.

    Raises:
        DataError: readings without any information (all equal, fewer than two).
        ConfigError: unknown optimizer or parameter.
    """
    if readings.poses < 2 or not (readings.upper > readings.lower).any():
        raise DataError(f"{readings.source}: all readings are equal; expected poses that differ in attitude")
    shared = settings.weights == "auto"
    weights = shared_weights(readings, settings) if shared else pose_weights(readings, settings.weights)
    centre = 0.5 * (readings.lower + readings.upper)
    scale = 0.5 * float((readings.upper - readings.lower).max())
    triangle = compress(weighted(readings, weights), centre, scale)
    start = search_box(triangle, settings)
    problem = Loetters(triangle, settings.g, start.box)
    solution = search(problem, settings)
    if settings.robust != "none":
        solution = reweight(solution, readings, settings, weights)
    return assemble(readings, settings, start, solution, weights)
