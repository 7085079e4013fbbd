"""Weights of poses that share an error of their own beside the noise of their readings.

The variance of a pose is m^2 + v_j: v_j from the scatter of its readings and their number, m^2 what the fit leaves
beyond that (a table that gives, a sensor that is not linear), the same for all poses. Weights 1 / (m^2 + v_j) follow
the number of readings while noise rules, and level off where it does not. m^2 is the value for which the weighted
squares have their expectation J - 9 [paule1982].
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from accelcal_cli.calibration.compress import Triangle, compress
from accelcal_cli.calibration.lotters import Loetters
from accelcal_cli.calibration.nominal import Start, search_box
from accelcal_cli.calibration.residuals import modulus_errors
from accelcal_cli.calibration.scatter import explained
from accelcal_cli.calibration.search import model_at, polish
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Float

ROUNDS = 10
"""Rounds of weights and fit at most; three or four are the rule."""

SETTLED = 0.01
"""Relative change of m^2 that ends the rounds."""

LEAST = 0.01
"""Least m^2, as part of the mean v_j: no pose is free of every other error."""


def packed(readings: Readings, weights: Float | None, within: Readings | None = None) -> Triangle:
    """Return weighted readings compressed, centred and scaled by their own extent or by that of other readings."""
    extent = within or readings
    centre = 0.5 * (extent.lower + extent.upper)
    scale = 0.5 * float((extent.upper - extent.lower).max())
    return compress(_weighted(readings, weights), centre, scale)


def _weighted(readings: Readings, weights: Float | None) -> Iterator[tuple[Float, Float | None]]:
    """Yield readings with their weights, block by block."""
    for first, block in readings.blocks():
        yield block, None if weights is None else weights[first : first + len(block)]


def shared_weights(readings: Readings, settings: Settings) -> Float | None:
    """Return the weights, mean 1, shape (J,); None when nine poses or fewer leave nothing to tell them by.

    Raises:
        DataError: the readings carry no count or no scatter.
    """
    if readings.count is None or readings.scatter is None or np.isnan(readings.scatter).any():
        raise DataError(
            f"{readings.source}: --weights auto needs the number of readings and their standard deviation (columns "
            "n, sx, sy, sz), or at least two readings of every pose"
        )
    if readings.poses <= 9:
        return None
    weights, before = None, -1.0
    for _ in range(ROUNDS):
        problem, x = fitted(readings, settings, weights)
        errors, own = _errors(readings, model_at(problem, x), settings.g)
        shared = shared_variance(errors, own, readings.poses - 9)
        shared = max(shared, LEAST * float(own.mean()))
        if not shared > 0 or abs(shared - before) <= SETTLED * shared:
            break
        weights, before = 1.0 / (shared + own), shared
        weights = weights / weights.mean()
    return weights


def shared_variance(errors: Float, own: Float, freedom: int) -> float:
    """Return m^2 >= 0 with sum e_j^2 / (m^2 + v_j) = freedom; 0 when the v_j explain the errors alone.

    Args:
        errors: e_j, m/s^2, shape (J,); own: v_j, (m/s^2)^2, shape (J,).
        freedom: J - 9.
    """
    square = errors**2

    def excess(m: float) -> float:
        total = m + own
        return float(np.sum(np.divide(square, total, out=np.zeros_like(square), where=total > 0))) - freedom

    low, high = 0.0, float(square.sum()) / freedom
    if excess(low) <= 0 and (own > 0).all():
        return 0.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return high


def opened(readings: Readings, settings: Settings, weights: Float | None) -> tuple[Loetters, Start]:
    """Return the problem of the weighted readings, and where its box comes from."""
    triangle = packed(readings, weights)
    start = search_box(triangle, settings)
    return Loetters(triangle, settings.g, start.box), start


def fitted(readings: Readings, settings: Settings, weights: Float | None) -> tuple[Loetters, Float]:
    """Return the problem of the weighted readings and the point, shape (1, D), polished from the middle of its box."""
    problem, _ = opened(readings, settings, weights)
    return problem, polish(problem, np.zeros_like(problem.box.centre)).x


def _errors(readings: Readings, model: ErrorModel, g: float) -> tuple[Float, Float]:
    """Return the error of each pose's modulus, m/s^2, and the variance that its readings lend it, both (J,)."""
    errors = np.concatenate([e for _, e, _ in modulus_errors(readings, model, g)])
    force = model.specific_force(readings.output())
    u = force / np.linalg.norm(force, axis=1, keepdims=True)
    if readings.scatter is None or readings.count is None:
        return errors, np.zeros_like(errors)
    return errors, explained(u, readings.scatter, readings.count, np.diagonal(model.K))
