"""Scale factors and biases that are linear in temperature.

    N_i = (1 + k_i t) (K_a f)_i + D_i + b_i t,    t = T - T_0, T_0 the mean temperature of the poses

Six parameters more than the nine. They come from Gauss-Newton on all fifteen, starting at the plain solution. Readings
brought to T_0 are then those of a plain sensor, and everything else is done with them as ever.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import RANK_TOLERANCE, ROWS_COLUMNS, WEAK, design, moved_sensor
from accelcal_cli.calibration.problem import Loetters, packed
from accelcal_cli.calibration.result import Temperature
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import (
    SHARED_ROUNDS,
    SHARED_SETTLED,
    SLOPES,
    Slopes,
    Solution,
    agreed,
    reweight,
    share,
)
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.model import ErrorModel, to_gauge

SMALLEST_RANGE = 5.0
"""Degrees between the coldest and the warmest pose below which slopes would be extrapolated at once."""

RANGE_IN_TIME = 2.5
"""The same for poses in time, whose temperature goes up and down every day: hundreds of them tell slopes in less."""

FEWEST_FOR_SLOPES = 17
"""Poses, two more than parameters."""

MOST_POSES = 100_000
ROBUST_ROUNDS, ROBUST_SETTLED = 10, 0.1
"""Rounds at most in which slopes and robust weights follow each other, and the part of a sigma that ends them."""

TYPICAL_DRIFT, SHOWN = 5e-4, 3.0
"""Drift of a bias in parts of g per degree that data sheets of MEMS accelerometers allow, and the noises of a pose that
a drift adds to the root sum of squares of the residuals before it shows."""

HIDDEN = 15.0
"""Sigmas by which a drift that does not show may move a parameter before that is told of: where the temperature does
not go with the attitudes, by 2 to 5."""

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
    fitted = None
    if not why:
        solution, fitted = _settled(solution, degrees)
    if fitted is None:
        why = why or "the poses do not determine slopes with temperature"
        return replace(solution, notes=(*solution.notes, f"Temperature column not used: {why}."))
    slopes, brought = fitted
    plain, cost = (
        Loetters(packed(brought, weights, within=sample), settings.g, solution.cost.box)
        for weights in (solution.stated.weights, solution.robust_weights())
    )
    middle = slopes.temperature.reference
    note = f"Scale factors and biases are linear in temperature; the others hold at {middle:.4g} degrees."
    notes = (*solution.notes, note)
    return replace(solution.solved_anew(cost), sample=brought, plain=plain, slopes=slopes, notes=notes)


def _settled(solution: Solution, degrees: Float) -> tuple[Solution, tuple[Slopes, Sample] | None]:
    """Return the solution with the weights that go with slopes, and these as `_fit` does: they leave a shared error."""
    if solution.stated.settings.robust != "none":
        return _robust(solution, degrees)
    fitted, stated = _fit(solution, degrees), solution.stated
    if fitted is None or stated.settings.weights != "auto" or stated.noise is None:
        return solution, fitted
    weights = stated.sample.normalised(1.0 / stated.noise.variance)
    stated, before = replace(stated.with_weights(weights), own=None), -1.0
    for _ in range(SHARED_ROUNDS):
        solution = replace(solution, stated=stated)
        # Means of many readings may outweigh all others until the error that they share is known.
        fitted = _fit(solution, degrees) or (fitted if before < 0 else None)
        if fitted is None:
            return solution, None
        stated, shared = share(stated, fitted[1], fitted[0].sensor, 9 + SLOPES)
        if not shared > 0 or abs(shared - before) <= SHARED_SETTLED * shared:
            break
        before = shared
    solution = replace(solution, stated=stated)
    return solution, _fit(solution, degrees)


def _robust(solution: Solution, degrees: Float) -> tuple[Solution, tuple[Slopes, Sample] | None]:
    """Return a robust solution with slopes: readings brought to one temperature say anew which of them agree.

    Drift makes sound poses look wrong at first; as the slopes come out, they come back.
    """
    readings = solution.stated.sample
    fitted, before = _fit(solution, degrees), np.full(6, np.inf)
    for _ in range(ROBUST_ROUNDS):
        if fitted is None:
            return solution, None
        slopes, brought = fitted
        here = np.concatenate([slopes.temperature.scale, slopes.temperature.bias])
        sigma = np.concatenate([slopes.temperature.sigma_scale, slopes.temperature.sigma_bias])
        if (np.abs(here - before) <= ROBUST_SETTLED * sigma).all():
            break
        before = here
        stated = agreed(replace(solution.stated, sample=brought))
        x = stated.cost.coordinates(*slopes.sensor)
        start = replace(solution, stated=stated, sample=brought, cost=stated.cost, plain=stated.cost, x=x)
        solution = reweight(start.solved_anew(stated.cost))
        fitted = _fit(replace(solution, stated=replace(stated, sample=readings)), degrees)
    return replace(solution, stated=replace(solution.stated, sample=readings)), fitted


def _fit(solution: Solution, degrees: Float) -> tuple[Slopes, Sample] | None:
    """Return the slopes, and the readings brought to the reference temperature; None where nothing determines them.

    `degrees`: temperatures of the poses, shape (J,).
    """
    sample, g, weights = solution.stated.sample, solution.stated.settings.g, solution.robust_weights()
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
    units = np.repeat([1.0 / g, 1.0], 3) * np.concatenate([np.ones(3), np.diagonal(low.K)]) / half
    (scale, bias), nothing = np.split(p[9:] * units, 2), np.full(3, np.nan)
    temperature = Temperature(
        reference=middle,
        low=float(degrees.min()),
        high=float(degrees.max()),
        scale=scale,
        bias=bias,
        sigma_scale=nothing,  # the fit knows their noise
        sigma_bias=nothing,
        interval_scale=nothing,
        interval_bias=nothing,
        dop=dop,
    )
    B, C = information[:9, 9:], information[9:, 9:]
    sensor = _moved(low, p, g)
    brought = temperature.at_reference(N, degrees, sensor.D)
    part = np.linalg.solve(C, B.T)
    # What the slopes' columns take from those of the nine parameters does not determine these.
    rows = np.column_stack([J[:, :9] - J[:, 9:] @ part, J[:, 9:]])
    found = sensor.K[None], sensor.D[None]
    loss, cofactor = (B @ part)[None], np.linalg.inv(C)[None]
    slopes = Slopes(temperature, loss, found, rows[None], cofactor, part, units)
    return slopes, sample.with_output(brought[None])


def drift_unseen(
    u: Float, w: Float, degrees: Float, s: float, g: float, *, shown: bool
) -> tuple[Notice, ...]:
    """Return a warning where a drift with the temperature may bias the parameters, and no slopes are fitted.

    Args:
        u: unit directions of the poses, shape (J, 3); w: their weights, degrees: temperatures, shape (J,).
        s: standard deviation of one pose's modulus, m/s^2; g: m/s^2.
        shown: whether the residuals are more than noise.
    """
    span, shift = float(np.ptp(degrees)), hidden_shift(u, w, degrees, s, g)
    if span < SMALLEST_RANGE or not (shown or shift > HIDDEN):
        return ()
    text = f"No slopes are fitted, the temperature changes by {span:.2g} degrees, and the residuals exceed their noise."
    if not shown:
        text = (
            f"The temperature goes with the attitude: a bias that drifts by {TYPICAL_DRIFT * 1e3:g} mg per degree, as "
            f"data sheets allow, would move a parameter by {shift:.2g} sigma and not show in the residuals."
        )
    remedy = "Take the poses in another order, or again at another temperature, 17 or more in all."
    return (Notice("drift", "warning", text, remedy),)


def hidden_shift(u: Float, w: Float, degrees: Float, s: float, g: float) -> float:
    """Return by how many sigmas a drift that the residuals do not show may move a parameter; see `drift_unseen`.

    Biases b_i t with |b| up to TYPICAL_DRIFT move the nine parameters by M b, the least-squares answer to what they add
    to the errors, and leave P b in the residuals, shown from SHOWN s on: the largest M b / sigma in that ellipsoid.
    """
    half = 0.5 * float(np.ptp(degrees))
    if not (half > 0 and s > 0):
        return 0.0
    root = np.sqrt(w)[:, None]
    A, C = root * design(u), root * u * ((degrees - degrees.mean()) / half)[:, None]
    cofactor = np.linalg.pinv(A.T @ A)
    M = cofactor @ A.T @ C
    P = C - A @ M
    inner = P.T @ P / (SHOWN * s) ** 2 + np.eye(3) / (TYPICAL_DRIFT * half * g) ** 2
    shift = np.einsum("pi,ij,pj->p", M, np.linalg.inv(inner), M)
    return float(np.sqrt(np.max(shift / np.maximum(s * s * np.diagonal(cofactor), 1e-300))))


def slope_rows(output: Float, degrees: Float, slopes: Temperature, sensor: ErrorModel, g: float) -> Float:
    """Return d e / d slopes of readings, e = (g^2 - |f|^2) / 2g, slopes as force at half the range, shape (J, 6).

    Args:
        output: readings at their own temperatures, shape (J, 3); degrees: these, shape (J,).
        slopes: of the sensor; sensor: at the reference temperature, gauge `lower`; g: m/s^2.
    """
    half = 0.5 * (slopes.high - slopes.low)
    p = np.concatenate([np.zeros(9), g * half * slopes.scale, half * slopes.bias / np.diagonal(sensor.K)])
    _, J = _linearised(output, (degrees - slopes.reference) / half, sensor, p, g)
    return -J[:, 9:]


def _unsuitable(solution: Solution, degrees: Float) -> str:
    """Return why temperatures, shape (J,), cannot be used, or nothing."""
    settings, poses = solution.stated.settings, len(degrees)
    if not settings.misalignment:
        return "slopes with temperature are fitted beside misalignments only"
    if poses > MOST_POSES:
        return f"more than {MOST_POSES:,} poses"
    if not np.isfinite(degrees).all():
        return f"it is missing in {int((~np.isfinite(degrees)).sum())} poses"
    least = RANGE_IN_TIME if solution.stated.sample.in_time[0] else SMALLEST_RANGE
    if np.ptp(degrees) < least:
        return f"the poses differ by {np.ptp(degrees):.2g} degrees, and {least:g} are needed"
    if poses < FEWEST_FOR_SLOPES:
        return f"{poses} poses are too few for fifteen parameters; take at least {FEWEST_FOR_SLOPES}"
    return ""


def _moved(low: ErrorModel, p: Float, g: float) -> ErrorModel:
    """Return the sensor of gauge `lower` at the first nine parameters, m/s^2."""
    K, D = moved_sensor(low.K[None], low.D[None], p[None, :9], g)
    return ErrorModel(K[0], D[0])


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
