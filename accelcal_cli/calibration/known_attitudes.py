"""Known attitudes: all twelve parameters by linear least squares.

    N_j = K_a f_j + D_a + K_a n_j            [dpso2014] eq. 10

With the specific force f_j of every pose known, each row of [K_a D_a] follows from the rows [f_j 1] alone. In the body
frame the errors of the estimate are X = (F^T F)^-1 F^T n, with covariance s^2 (F^T F)^-1 for each of the three axes.

Known attitudes: from the fit of all twelve parameters to the record.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Float
from accelcal_cli.calibration.assess import final_verdict, large_residuals, not_fitting
from accelcal_cli.calibration.box import nominal_before
from accelcal_cli.calibration.fit import KEPT, KEPT_WORST, OUTLIER_LEVEL, room_of
from accelcal_cli.calibration.observability import RANK_TOLERANCE, UNDETERMINED, WEAK, Verdict, verdict_of
from accelcal_cli.calibration.problem import ROWS_COLUMNS
from accelcal_cli.calibration.result import Calibration, Dop, PoseFit, Sigma
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.weights import pose_weights
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import AXES


@dataclass(frozen=True)
class Linear:
    """A linear fit.

    Attributes:
        model: the sensor, all twelve parameters.
        cofactor: (F^T W F)^-1, its pseudo-inverse below rank 4, of g times K_a's columns and of the bias, as force:
            shape (4, 4).
        error: K_a^-1 (N - K_a f - D_a), m/s^2, shape (J, 3).
        leverage: shape (J,).
        rank: of F.
        s: standard deviation of one axis, m/s^2; freedom: 3 J - 12.
    """

    model: ErrorModel
    cofactor: Float
    error: Float
    leverage: Float
    rank: int
    s: float
    freedom: int


def fit(N: Float, f: Float, g: float, weights: Float | None) -> Linear:
    """Return the fit of outputs N to specific forces f in m/s^2, both shape (J, 3), with weights (J,) or None."""
    F = np.concatenate([f / g, np.ones((len(f), 1))], axis=1)
    root = np.ones(len(f)) if weights is None else np.sqrt(weights)
    values, vectors = np.linalg.eigh((F * root[:, None]).T @ (F * root[:, None]))
    known = values > RANK_TOLERANCE * values[-1]
    inverse = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    cofactor = (vectors * inverse) @ vectors.T
    middle = N.mean(axis=0)  # keeps the digits that a large offset would eat
    theta = cofactor @ (F * (root**2)[:, None]).T @ (N - middle)
    K, D = theta[:3].T / g, theta[3] + middle
    if not known.all() or np.linalg.matrix_rank(K) < 3:
        return Linear(
            ErrorModel(K, D), cofactor, np.full_like(f, np.nan), np.ones(len(f)), int(known.sum()), np.nan, 0
        )
    error = np.linalg.solve(K, (N - f @ K.T - D).T).T
    freedom = 3 * len(f) - 12
    square = float(np.sum((root[:, None] * error) ** 2))
    leverage = root**2 * np.einsum("ji,ik,jk->j", F, cofactor, F)
    s = float(np.sqrt(square / freedom)) if freedom > 0 else float("nan")
    return Linear(ErrorModel(K, D), cofactor, error, np.minimum(leverage, 1.0), 4, s, freedom)


NEAR_G = 0.05
"""Largest part by which the mean length of the reference may differ from g: more is another unit."""

FEWEST_POSES = 6


def calibrate_known(readings: Readings, settings: Settings) -> Calibration:
    """Calibrate one sensor whose attitudes are known.

    Args:
        readings: J poses with the reference specific force of each.
        settings: g, weights; the search does not apply.

    Raises:
        DataError: no reference, or one of another unit than g.
        ConfigError: a robust loss, which this fit does not have.
    """
    reference = readings.reference
    if reference is None:
        raise DataError(
            f"{readings.source}: --attitudes known needs the specific force of every pose: fx, fy, fz"
        )
    if settings.robust != "none":
        raise ConfigError(f"robust: {settings.robust} does not go with --attitudes known; expected none")
    if settings.weights == "auto":
        raise ConfigError("weights: auto does not go with --attitudes known; expected none, n or sd")
    length = float(np.linalg.norm(reference, axis=1).mean())
    if abs(length / settings.g - 1.0) > NEAR_G:
        raise DataError(
            f"{readings.source}: the reference specific force has a mean length of {length:.6g}, and g is "
            f"{settings.g:.6g}; state the g of its unit with --g"
        )
    weights = pose_weights(readings, settings.weights)
    return _assembled(
        readings, reference, settings, weights, fit(readings.output(), reference, settings.g, weights)
    )


def _assembled(
    readings: Readings, reference: Float, settings: Settings, weights: Float | None, found: Linear
) -> Calibration:
    """Return the record of a fit of all twelve parameters. Raises DataError where it determines too little."""
    if found.rank < 4:
        raise DataError(
            f"{readings.source}: the known attitudes span {found.rank} of 4 dimensions; turn the sensor to at least "
            f"four attitudes that do not lie in one plane, better {FEWEST_POSES} or more"
        )
    _check_axes(readings, found)
    g, model = settings.g, found.model
    dop = np.sqrt(np.diagonal(found.cofactor))  # of K_a's columns as m/s^2 at 1 g, and of the bias
    nine = _nine(model)
    cofactor = nine @ np.kron(np.eye(3), found.cofactor) @ nine.T
    size = _sizes(model)
    sigma_K = found.s * np.outer(size, dop[:3]) / g
    low = model.in_gauge("lower")
    force = low.specific_force(readings.output())
    directions = force / np.linalg.norm(force, axis=1, keepdims=True)
    modulus = np.linalg.norm(force, axis=1) - np.linalg.norm(reference, axis=1)
    before, before_model = nominal_before(float(size.mean()), model.D, settings)
    raw = np.linalg.norm(before_model.specific_force(readings.output()), axis=1) - g
    square = np.einsum("ji,ji->j", force, force)
    cost = float(np.sum((g * g - square) ** 2))
    w = np.ones(len(force)) if weights is None else weights
    named = _outliers(found, w)
    fits = _pose_fits(readings, found, w, np.column_stack([modulus, raw, directions]))
    return Calibration(
        K_a=model.K,
        D_a=model.D,
        K_A=model.K_A,
        f_0=model.f_0,
        gauge="full",
        sigma=Sigma(sigma_K, found.s * size * dop[3]),
        dop=Dop.of(np.sqrt(np.diagonal(cofactor))),
        verdict=_verdict(dop, found.freedom),
        reasons=_reasons(dop, found.freedom),
        suggestions=(),
        cautions=(
            *readings.cautions,
            *not_fitting([readings.where(j) for j in named], found.freedom),
            *large_residuals(found.s, g, found.freedom),
            *_turned_round(model),
        ),
        cost_search=cost,
        cost=cost,
        rms=float(np.sqrt(np.mean(modulus**2))),
        rms_before=float(np.sqrt(np.mean(raw**2))),
        before=before,
        s=found.s,
        freedom=found.freedom,
        noise_ratio=None,
        noise_chance=None,
        covariance=found.s**2 * cofactor,
        information=np.linalg.pinv(cofactor),
        nominal_scale=np.diagonal(before_model.K).copy(),
        nominal_bias=np.array(settings.nominal.bias) if settings.nominal else np.zeros(3),
        poses=readings.poses,
        evaluations=1,
        runs=1,
        runs_agreeing=1,
        poses_fit=fits,
        outliers=named,
        convergence=(),
        optimizer="linear least squares",
        settings={**asdict(settings), "version": __version__},
        g=g,
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
        notes=(*readings.notes, *_notes(readings)),
        version=__version__,
    )


def _check_axes(readings: Readings, found: Linear) -> None:
    """Raise DataError when the outputs do not follow the force in all three directions."""
    output = readings.output()
    for name, column in zip(readings.columns, output.T, strict=True):
        if np.ptp(column) == 0:
            raise DataError(
                f'{readings.source}: column "{name}" is {column[0]:g} in every pose; an axis that does not answer '
                "cannot be calibrated"
            )
    if not np.isfinite(found.error).all():
        raise DataError(
            f"{readings.source}: columns {', '.join(readings.columns)} depend on each other; three sensor axes were "
            "expected"
        )


def _sizes(model: ErrorModel) -> Float:
    """Return the output of each sensor axis for one unit of force along it, shape (3,), however it lies in the body."""
    return np.asarray(np.sqrt(np.diagonal(model.K @ model.K.T)))


def _turned_round(model: ErrorModel) -> tuple[str, ...]:
    if not (np.diagonal(model.K) < -0.5 * _sizes(model)).all():  # each axis near the other end of its own
        return ()
    return (
        "All scale factors are negative: the reference, or the sensor, counts gravity instead of specific force, which "
        "at rest points up.",
    )


def _notes(readings: Readings) -> tuple[str, ...]:
    known = "The attitudes are known: all twelve parameters are determined; the search does not apply."
    if readings.temperature is None:
        return (known,)
    return (known, "Temperature column not used: with known attitudes the slopes are not fitted.")


def _nine(model: ErrorModel) -> Float:
    """Return d (nine parameters of gauge `lower`) / d Y, shape (9, 12).

    [dK_a dD_a] = K_a Y with Y in units of force (its first three columns at 1 g), rows running slowest. So
    E = -Y / g in the body frame, R E R^T in that of gauge `lower`, and of it the rotation is no change of the sensor.
    """
    low = model.in_gauge("lower").K
    R = np.linalg.solve(low, model.K)
    columns = []
    for p in range(12):
        Y = np.zeros((3, 4))
        Y.flat[p] = 1.0
        E = R @ (-Y[:, :3]) @ R.T
        both = E + E.T
        column = [both[i, j] * (0.5 if i == j else 1.0) for i, j in ROWS_COLUMNS[:6]]
        columns.append([*column, *(model.K @ Y[:, 3] / np.diagonal(low))])
    return np.array(columns).T


def _verdict(dop: Float, freedom: int) -> Verdict:
    return final_verdict(verdict_of(float(dop.max()), 9), edge=False, freedom=freedom)


def _reasons(dop: Float, freedom: int) -> tuple[str, ...]:
    names = (*(f"column {axis} of K_a" for axis in AXES), "bias")
    lines = []
    for limit, words in ((UNDETERMINED, "The known attitudes do not determine"), (WEAK, "Weakly determined")):
        poor = [name for name, value in zip(names, dop, strict=True) if value > limit]
        if poor:
            lines.append(f"{words}: {', '.join(poor)}.")
            break
    if freedom < 1:
        lines.append(f"Four poses fit exactly and say nothing of their noise. Take at least {FEWEST_POSES}.")
    return tuple(lines)


def _square(found: Linear, w: Float) -> Float:
    """Return the squared residual of all three axes over what the fit leaves of it, (m/s^2)^2, shape (J,)."""
    square: Float = w * np.einsum("ji,ji->j", found.error, found.error) / room_of(found.leverage)
    return square


def _outliers(found: Linear, w: Float) -> tuple[int, ...]:
    """Return the poses whose three residuals are beyond chance (F test, Bonferroni)."""
    if found.freedom <= 3:
        return ()
    from scipy.special import fdtrc

    square, freedom = _square(found, w), found.freedom - 3
    others = (found.s**2 * found.freedom - square) / freedom
    chance = fdtrc(3, freedom, square / 3.0 / np.where(others > 0, others, np.nan)) * len(square)
    return tuple(int(j) for j in np.flatnonzero(chance < OUTLIER_LEVEL))


def _pose_fits(readings: Readings, found: Linear, w: Float, seen: Float) -> tuple[PoseFit, ...]:
    """Return the fit pose by pose; `seen` is |f| - |reference|, |f| - g before, and the direction, shape (J, 5)."""
    room = room_of(found.leverage)
    with np.errstate(divide="ignore", invalid="ignore"):
        studentised = np.sqrt(w) * seen[:, 0] / (found.s * np.sqrt(room))
    kept = np.arange(len(w))
    if len(w) > KEPT:
        kept = np.sort(np.argsort(-np.nan_to_num(_square(found, w)))[:KEPT_WORST])
    return tuple(
        PoseFit(
            int(j),
            readings.where(int(j)),
            float(seen[j, 0]),
            float(studentised[j]),
            float(found.leverage[j]),
            float(seen[j, 0] / room[j]),
            float(seen[j, 1]),
            (float(seen[j, 2]), float(seen[j, 3]), float(seen[j, 4])),
        )
        for j in kept
    )
