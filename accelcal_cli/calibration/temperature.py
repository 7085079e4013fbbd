"""Scale factors and biases that are linear in temperature.

    N_i = (1 + k_i t) (K_a f)_i + D_i + b_i t,    t = T - T_0, T_0 the mean temperature of the poses

Six parameters more than the nine. They come from Gauss-Newton on all fifteen, starting at the plain solution. Readings
brought to T_0 are then those of a plain sensor, and everything else is done with them as ever.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import RANK_TOLERANCE, ROWS_COLUMNS, WEAK
from accelcal_cli.calibration.problem import Loetters, packed
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.calibration.search import SLOPES, Slopes, Solution
from accelcal_cli.sensor.model import ErrorModel, to_gauge

SMALLEST_RANGE = 5.0
"""Degrees between the coldest and the warmest pose below which slopes would be extrapolated at once."""

MOST_POSES = 100_000
STEPS, SETTLED = 30, 1e-12
"""Gauss-Newton steps at most, and the step, as part of g, that ends them."""


def with_slopes(solution: Solution) -> Solution:
    """Return the solution with slopes, where there is a temperature column that determines them, and a note of it.

    One sensor; the parameters of a solution with slopes hold at the mean temperature.
    """
    sample, settings = solution.stated.sample, solution.stated.settings
    if sample.temperature is None:
        return solution
    degrees = sample.temperature[0]
    why = _unsuitable(solution, degrees)
    slopes = None if why else _fit(solution, degrees)
    if slopes is None:
        why = why or "the poses do not determine slopes with temperature"
        return replace(solution, notes=(*solution.notes, f"Temperature column not used: {why}."))
    triangle = packed(slopes.sample, solution.stated.weights, within=sample)
    cost = Loetters(triangle, settings.g, solution.cost.box)
    middle = slopes.temperature.reference
    note = f"Scale factors and biases are linear in temperature; the others hold at {middle:.4g} degrees."
    return replace(solution.solved_anew(cost), plain=cost, slopes=slopes, notes=(*solution.notes, note))


def _fit(solution: Solution, degrees: Float) -> Slopes | None:
    """Return the slopes of poses of these temperatures, shape (J,), or None where they do not determine them."""
    sample, g, weights = solution.stated.sample, solution.stated.settings.g, solution.stated.weights
    K, D = solution.cost.parameters(solution.x)
    low = ErrorModel(to_gauge(K[0], "lower"), D[0])
    N = sample.output()[0]
    middle, half = float(degrees.mean()), 0.5 * float(np.ptp(degrees))
    t = (degrees - middle) / half
    root = np.ones(len(N)) if weights is None else np.sqrt(weights[0])
    p: Float = np.zeros(9 + SLOPES)
    dop: Float = np.zeros(SLOPES)
    for _ in range(STEPS):
        e, J = _linearised(N, t, low, p, g)
        information = (J * root[:, None]).T @ (J * root[:, None])
        dop = _slope_dop(information)
        if not dop.max() <= WEAK:
            return None
        step = np.linalg.solve(information, -(J * root[:, None]).T @ (root * e))
        p = p + step
        if np.abs(step).max() <= SETTLED * g:
            break
    s = float(np.sqrt((root * e) @ (root * e) / (len(N) - 9 - SLOPES)))
    units = np.repeat([1.0 / g, 1.0], 3) * np.concatenate([np.ones(3), np.diagonal(low.K)]) / half
    (scale, bias), (sigma_scale, sigma_bias) = np.split(p[9:] * units, 2), np.split(s * dop * units, 2)
    temperature = Temperature(
        reference=middle,
        low=float(degrees.min()),
        high=float(degrees.max()),
        scale=scale,
        bias=bias,
        sigma_scale=sigma_scale,
        sigma_bias=sigma_bias,
        interval_scale=np.full(3, np.nan),  # the fit knows their factor
        interval_bias=np.full(3, np.nan),
        dop=dop,
    )
    B, C = information[:9, 9:], information[9:, 9:]
    brought = temperature.at_reference(N, degrees, _moved(low, p, g).D)
    return Slopes(temperature, sample.with_output(brought[None]), (B @ np.linalg.solve(C, B.T))[None])


def _unsuitable(solution: Solution, degrees: Float) -> str:
    """Return why temperatures, shape (J,), cannot be used, or nothing."""
    settings, poses = solution.stated.settings, len(degrees)
    if settings.robust != "none":
        return "slopes with temperature go with plain least squares only"
    if not settings.misalignment:
        return "slopes with temperature are fitted beside misalignments only"
    if poses > MOST_POSES:
        return f"more than {MOST_POSES:,} poses"
    if not np.isfinite(degrees).all():
        return f"it is missing in {int((~np.isfinite(degrees)).sum())} poses"
    if np.ptp(degrees) < SMALLEST_RANGE:
        return f"the poses differ by {np.ptp(degrees):.2g} degrees, and {SMALLEST_RANGE:g} are needed"
    if poses < 17:
        return f"{poses} poses are too few for fifteen parameters; take at least 17"
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
    return np.asarray(np.sqrt(np.diagonal(np.linalg.inv(information))[9:]))
