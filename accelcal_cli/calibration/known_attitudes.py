"""Known attitudes: all twelve parameters by linear least squares.

    N_j = K_a f_j + D_a + K_a n_j            [dpso2014] eq. 10

With the specific force f_j of every pose known, each row of [K_a D_a] follows from the rows [f_j 1] alone. In the body
frame the errors of the estimate are X = (F^T F)^-1 F^T n, with covariance s^2 (F^T F)^-1 for each of the three axes.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.fit import (
    KEPT,
    KEPT_WORST,
    OUTLIER_LEVEL,
    Fit,
    PoseResiduals,
    coverage_of,
    room_of,
    uncalibrated,
)
from accelcal_cli.calibration.observability import RANK_TOLERANCE, ROWS_COLUMNS, Observability
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import Search
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.sensor.poses import AXES

NEAR_G = 0.05
"""Largest part by which the mean length of the reference may differ from g: more is another unit."""

FEWEST_POSES = 6

NAMES = (*(f"column {axis} of K_a" for axis in AXES), "bias")
"""What the rows [f_j 1] determine."""


def fit_known(sample: Sample, settings: Settings) -> Fit:
    """Fit one sensor whose attitudes are known.

    Args:
        sample: poses of one sensor with the reference specific force of each.
        settings: g, weights; the search does not apply.

    Raises:
        DataError: no reference, or one of another unit than g; attitudes that determine too little.
    """
    readings, g = sample.readings(0), settings.g
    N, f, w = _inputs(sample, settings, readings)
    K, D, cofactor, leverage = _solved(N, f, w, g, readings)
    error = np.linalg.solve(K, (N - f @ K.T - D).T).T  # K_a^-1 (N - K_a f - D_a), m/s^2, shape (J, 3)
    freedom = 3 * len(f) - 12
    s = np.sqrt(np.sum(w[:, None] * error**2) / freedom) if freedom > 0 else np.float64(np.nan)
    low = to_gauge(K, "lower")
    nine = _nine(K, low, cofactor)
    dop = np.sqrt(np.diagonal(cofactor))  # of K_a's columns as m/s^2 at 1 g, and of the bias
    size = np.sqrt(np.diagonal(K @ K.T))  # the output of each axis for one unit of force along it
    nominal, bias, before = uncalibrated(np.array([size.mean()]), D[None], settings)
    raw = np.linalg.norm((N - bias) / nominal, axis=1) - g
    force = (N - D) @ np.linalg.inv(low).T
    length = np.linalg.norm(force, axis=1)
    modulus, value = length - np.linalg.norm(f, axis=1), np.array([np.sum((g * g - length**2) ** 2)])
    columns = Observability(cofactor[None], dop[None], dop[None], np.array([4]), NAMES)
    return Fit(
        sample=sample,
        settings=settings,
        search=Search("linear least squares", 1, value, np.ones(1, np.intp), np.ones(1, np.intp)),
        gauge="full",
        K=K[None],
        D=D[None],
        lower=low[None],
        sigma_K=(s * np.outer(size, dop[:3]) / g)[None],
        sigma_D=(s * size * dop[3])[None],
        value=value,
        observability=columns,
        view=columns,
        dop=np.sqrt(np.diagonal(nine))[None],
        information=np.linalg.pinv(nine)[None],
        sight=(low[None], D[None]),
        freedom=np.array([freedom]),
        s=np.array([s]),
        covariance=s**2 * nine[None],
        coverage=coverage_of(np.array([freedom])),
        at_wall=np.zeros((1, 12), dtype=bool),
        rms=np.sqrt([np.mean(modulus**2)]),
        rms_before=np.sqrt([np.mean(raw**2)]),
        before=before,
        nominal=nominal,
        residuals=_residuals(error, w, leverage, s, freedom, modulus, raw, force),
        noise=np.full((2, 1), np.nan),
        notes=_notes(sample),
    )


def _inputs(sample: Sample, settings: Settings, readings: Readings) -> tuple[Float, Float, Float]:
    """Return outputs and known specific force, shape (J, 3), and weights, shape (J,), if they are usable."""
    if sample.reference is None:
        raise DataError(
            f"{readings.source}: --attitudes known needs the specific force of every pose: fx, fy, fz"
        )
    length = float(np.linalg.norm(sample.reference, axis=2).mean())
    if abs(length / settings.g - 1.0) > NEAR_G:
        raise DataError(
            f"{readings.source}: the reference specific force has a mean length of {length:.6g}, and g is "
            f"{settings.g:.6g}; state the g of its unit with --g"
        )
    weights = sample.weights(settings.weights)
    w = np.ones(len(sample.reference[0])) if weights is None else weights[0]
    return sample.output()[0], sample.reference[0], w


def _solved(N: Float, f: Float, w: Float, g: float, readings: Readings) -> tuple[Float, Float, Float, Float]:
    """Return K, D, (F^T W F)^-1, shape (4, 4), and leverages, shape (J,), if attitudes and axes determine them.

    N: outputs, f: specific force, m/s^2, shape (J, 3); w: weights, shape (J,). F: rows [f 1], f in g, shape (J, 4).
    """
    F = np.column_stack([f / g, np.ones(len(f))])
    root = np.sqrt(w)[:, None]
    values, vectors = np.linalg.eigh((F * root).T @ (F * root))
    rank = int((values > RANK_TOLERANCE * values[-1]).sum())
    if rank < 4:
        raise DataError(
            f"{readings.source}: the known attitudes span {rank} of 4 dimensions; turn the sensor to at least "
            f"four attitudes that do not lie in one plane, better {FEWEST_POSES} or more"
        )
    cofactor = (vectors * (1.0 / values)) @ vectors.T
    middle = N.mean(axis=0)  # keeps the digits that a large offset would eat
    theta = cofactor @ (F * root**2).T @ (N - middle)
    K = theta[:3].T / g
    _check_axes(readings, N, K)
    leverage = np.minimum(w * np.einsum("ji,ik,jk->j", F, cofactor, F), 1.0)
    return K, theta[3] + middle, cofactor, leverage


def _check_axes(readings: Readings, N: Float, K: Float) -> None:
    """Raise DataError when the outputs do not follow the force in all three directions."""
    for name, column in zip(readings.columns, N.T, strict=True):
        if np.ptp(column) == 0:
            raise DataError(
                f'{readings.source}: column "{name}" is {column[0]:g} in every pose; an axis that does not answer '
                "cannot be calibrated"
            )
    if np.linalg.matrix_rank(K) < 3:
        raise DataError(
            f"{readings.source}: columns {', '.join(readings.columns)} depend on each other; three sensor axes were "
            "expected"
        )


def _nine(K: Float, low: Float, cofactor: Float) -> Float:
    """Return the cofactor of the nine parameters, shape (9, 9), for K, K in gauge `lower`, and (F^T W F)^-1.

    By d (nine parameters of gauge `lower`) / d Y, shape (9, 12): [dK_a dD_a] = K_a Y with Y in units of force (its
    first three columns at 1 g), rows running slowest. So E = -Y / g in the body frame, R E R^T in that of gauge
    `lower`, and of it the rotation is no change of the sensor.
    """
    R = np.linalg.solve(low, K)
    columns = []
    for p in range(12):
        Y = np.zeros((3, 4))
        Y.flat[p] = 1.0
        E = R @ (-Y[:, :3]) @ R.T
        both = E + E.T
        column = [both[i, j] * (0.5 if i == j else 1.0) for i, j in ROWS_COLUMNS[:6]]
        columns.append([*column, *(K @ Y[:, 3] / np.diagonal(low))])
    chain = np.array(columns).T
    return np.asarray(chain @ np.kron(np.eye(3), cofactor) @ chain.T)


def _residuals(
    error: Float, w: Float, leverage: Float, s: float, freedom: int, modulus: Float, raw: Float, force: Float
) -> PoseResiduals:
    """Return the kept residuals, those of the modulus; outliers by all three axes (F test, Bonferroni)."""
    room = room_of(leverage)
    square = w * np.einsum("ji,ji->j", error, error) / room
    outlier = np.zeros(len(w), dtype=bool)
    if freedom > 3:
        from scipy.special import fdtrc

        others = (s**2 * freedom - square) / (freedom - 3)
        chance = fdtrc(3, freedom - 3, square / 3.0 / np.where(others > 0, others, np.nan)) * len(w)
        outlier = chance < OUTLIER_LEVEL
    with np.errstate(divide="ignore", invalid="ignore"):
        studentised = np.sqrt(w) * modulus / (s * np.sqrt(room))
    kept = np.arange(len(w))
    if len(w) > KEPT:
        kept = np.sort(np.argsort(-np.nan_to_num(square))[:KEPT_WORST])
    return PoseResiduals(
        pose=kept[None],
        real=np.ones((1, len(kept)), dtype=bool),
        error=modulus[None, kept],
        before=raw[None, kept],
        force=force[None, kept],
        leverage=leverage[None, kept],
        studentised=studentised[None, kept],
        left_out=(modulus / room)[None, kept],
        outlier=outlier[None, kept],
    )


def _notes(sample: Sample) -> tuple[str, ...]:
    known = "The attitudes are known: all twelve parameters are determined; the search does not apply."
    if sample.temperature is None:
        return (known,)
    return (known, "Temperature column not used: with known attitudes the slopes are not fitted.")
