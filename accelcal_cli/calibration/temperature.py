"""Scale factors and biases that are linear in temperature.

    N_i = (1 + k_i t) (K_a f)_i + D_i + b_i t,    t = T - T_0, T_0 the mean temperature of the poses

Six parameters more than the nine. They come from Gauss-Newton on all fifteen, starting at the plain solution. Readings
brought to T_0 are then those of a plain sensor, and everything else is done with them as ever.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import RANK_TOLERANCE, WEAK
from accelcal_cli.calibration.problem import ROWS_COLUMNS
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.io.readings import Readings
from accelcal_cli.io.stream import RowStore
from accelcal_cli.sensor.model import ErrorModel

SMALLEST_RANGE = 5.0
"""Degrees between the coldest and the warmest pose below which slopes would be extrapolated at once."""

SLOPES = 6
MOST_POSES = 100_000
STEPS, SETTLED = 30, 1e-12
"""Gauss-Newton steps at most, and the step, as part of g, that ends them."""


@dataclass(frozen=True, eq=False)
class Slopes:
    """A fit of fifteen parameters.

    Attributes:
        temperature: the slopes.
        readings: the readings at the reference temperature.
        loss: information that the slopes take from the nine, shape (9, 9).
    """

    temperature: Temperature
    readings: Readings
    loss: Float


def fit(readings: Readings, model: ErrorModel, g: float, weights: Float | None) -> tuple[Slopes | None, str]:
    """Return the slopes with temperature, or None, and a sentence that says what was done.

    Args:
        readings: J poses, with temperatures.
        model: the plain solution.
        g: local gravity, m/s^2.
        weights: of the poses, shape (J,), or None.
    """
    why = _unsuitable(readings)
    degrees = readings.temperature
    if why or degrees is None:
        return None, f"Temperature column not used: {why}."
    low, middle = model.in_gauge("lower"), float(degrees.mean())
    half = 0.5 * float(np.ptp(degrees))
    N, t = readings.output(), (degrees - middle) / half
    root = np.ones(len(N)) if weights is None else np.sqrt(weights)
    p: Float = np.zeros(9 + SLOPES)
    dop: Float = np.zeros(SLOPES)
    for _ in range(STEPS):
        e, J = _linearised(N, t, low, p, g)
        information = (J * root[:, None]).T @ (J * root[:, None])
        dop = _slope_dop(information)
        if not dop.max() <= WEAK:
            return None, "Temperature column not used: the poses do not determine slopes with temperature."
        step = np.linalg.solve(information, -(J * root[:, None]).T @ (root * e))
        p = p + step
        if np.abs(step).max() <= SETTLED * g:
            break
    s = float(np.sqrt((root * e) @ (root * e) / (readings.poses - 9 - SLOPES)))
    units = np.repeat([1.0 / g, 1.0], 3) * np.concatenate([np.ones(3), np.diagonal(low.K)]) / half
    (scale, bias), (sigma_scale, sigma_bias) = np.split(p[9:] * units, 2), np.split(s * dop * units, 2)
    span = float(degrees.min()), float(degrees.max())
    found = Temperature(middle, *span, scale, bias, sigma_scale, sigma_bias, dop)
    B, C = information[:9, 9:], information[9:, 9:]
    brought = found.at_reference(N, degrees, _moved(low, p, g).D)
    note = f"Scale factors and biases are linear in temperature; the others hold at {middle:.4g} degrees."
    return Slopes(found, at(readings, brought), B @ np.linalg.solve(C, B.T)), note


def at(readings: Readings, output: Float) -> Readings:
    """Return readings with other outputs, shape (J, 3)."""
    store = RowStore()
    store.append(np.asarray(output, dtype=np.float64))
    return replace(readings, lower=output.min(axis=0), upper=output.max(axis=0), _store=store)


def _unsuitable(readings: Readings) -> str:
    """Return why the temperatures cannot be used, or nothing."""
    degrees = readings.temperature
    if degrees is None:
        return "there is none"
    if readings.poses > MOST_POSES:
        return f"more than {MOST_POSES:,} poses"
    if not np.isfinite(degrees).all():
        return f"it is missing in {int((~np.isfinite(degrees)).sum())} poses"
    if np.ptp(degrees) < SMALLEST_RANGE:
        return f"the poses differ by {np.ptp(degrees):.2g} degrees, and {SMALLEST_RANGE:g} are needed"
    if readings.poses < 17:
        return f"{readings.poses} poses are too few for fifteen parameters; take at least 17"
    return ""


def _moved(low: ErrorModel, p: Float, g: float) -> ErrorModel:
    """Return the sensor of gauge `lower` at the first nine parameters, m/s^2."""
    E = np.zeros((3, 3))
    for value, (i, j) in zip(p[:6], ROWS_COLUMNS[:6], strict=True):
        E[i, j] = value / g
    return ErrorModel(low.K @ np.linalg.inv(np.eye(3) + E), low.D + np.diagonal(low.K) * p[6:9])


def _linearised(N: Float, t: Float, low: ErrorModel, p: Float, g: float) -> tuple[Float, Float]:
    """Return e = (|f|^2 - g^2) / 2g, shape (J,), and its Jacobian, shape (J, 15), m/s^2.

    Parameters: the nine of `quality`, then g k_i and b_i / K_ii, both at half the range of temperature (t = 1).
    """
    here = _moved(low, p, g)
    scale, bias = p[9:12] / g, p[12:15] * np.diagonal(low.K)
    plain = (N - here.D - bias * t[:, None]) / (1.0 + scale * t[:, None])  # K f
    f = plain @ here.K_A.T
    e = (np.einsum("ji,ji->j", f, f) - g * g) / (2.0 * g)
    back = f @ here.K_A / g  # row j: f^T K_A / g
    columns = [f[:, i] * f[:, j] / (g * g) for i, j in ROWS_COLUMNS[:6]]
    inner = back * np.diagonal(low.K) / (1.0 + scale * t[:, None])
    columns += [-inner[:, i] for i in range(3)]
    columns += [-back[:, i] * plain[:, i] * t / (1.0 + scale[i] * t) / g for i in range(3)]
    columns += [-inner[:, i] * t for i in range(3)]
    return e, np.stack(columns, axis=1)


def _slope_dop(information: Float) -> Float:
    """Return the dilution of precision of the six slopes, infinite below full rank."""
    values = np.linalg.eigvalsh(information)
    if values[0] <= RANK_TOLERANCE * values[-1]:
        return np.full(SLOPES, np.inf)
    dop: Float = np.sqrt(np.diagonal(np.linalg.inv(information))[9:])
    return dop
