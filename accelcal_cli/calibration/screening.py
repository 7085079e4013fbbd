"""A quick calibration that tells sets of poses apart: closed form, polish, residual and dilution of precision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.quality import Observability, information
from accelcal_cli.calibration.residuals import modulus_errors, square_error
from accelcal_cli.calibration.search import model_at
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.verdict import at_edge
from accelcal_cli.calibration.weighting import fitted, opened, shared_weights
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings


@dataclass(frozen=True)
class Screened:
    """What a set of poses is worth.

    Attributes:
        model: the sensor they fit; rms: of |f| - g, m/s^2, NaN where the poses fix no ellipsoid.
        s: standard deviation of one pose's modulus, m/s^2; NaN for nine poses or fewer.
        dop: the worst dilution of precision; verdict: good, weak or undetermined.
    """

    model: ErrorModel
    rms: float
    s: float
    dop: float
    verdict: str


def screen(readings: Readings, g: float) -> Screened:
    """Calibrate readings that carry count and scatter, weighted by both and by what the poses share."""
    settings = Settings(g=g)
    rough = _rough(readings, settings)
    if rough is not None:
        return rough
    problem, x = fitted(readings, settings, shared_weights(readings, settings))
    model = model_at(problem, x)
    seen = Observability.of(information(problem, x)[0], readings.poses)
    freedom = readings.poses - 9
    cost = float(problem.cost(x[:, None])[0, 0])
    s = np.sqrt(cost / (4.0 * g**2) / freedom) if freedom > 0 else np.nan
    square = sum(square_error(e, g) for _, e, _ in modulus_errors(readings, model, g))
    return Screened(
        model,
        float(np.sqrt(square / readings.poses)),
        float(s),
        seen.worst,
        "undetermined" if at_edge(x).any() else seen.verdict,
    )


def _rough(readings: Readings, settings: Settings) -> Screened | None:
    """Return the nearest sphere where the poses determine no more, so that no search has to find that out."""
    problem, start = opened(readings, settings, None)
    middle = np.zeros_like(problem.box.centre)
    seen = Observability.of(information(problem, middle)[0], readings.poses)
    if start.source != "sphere" or seen.verdict != "undetermined":
        return None
    return Screened(model_at(problem, middle), np.nan, np.nan, np.inf, seen.verdict)
