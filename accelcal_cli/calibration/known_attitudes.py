"""Known attitudes: all twelve parameters by linear least squares.

    N_j = K_a f_j + D_a + K_a n_j            [dpso2014] eq. 10

With the specific force f_j of every pose known, each row of [K_a D_a] follows from the rows [f_j 1] alone. In the body
frame the errors of the estimate are X = (F^T F)^-1 F^T n. Each sensor axis has a noise of its own, s_i from its J - 4
degrees of freedom, and its row of [K_a D_a] the covariance s_i^2 (F^T F)^-1.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.fit import Fit, uncalibrated
from accelcal_cli.calibration.noise import alike_weights, plain_spread
from accelcal_cli.calibration.observability import (
    RANK_TOLERANCE,
    ROWS_COLUMNS,
    Geometry,
    Observability,
    distinct,
    unit,
)
from accelcal_cli.calibration.residuals import KEPT, KEPT_WORST, OUTLIER_LEVEL, PoseResiduals, room_of
from accelcal_cli.calibration.result import Calibration
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
    g, (N, f, w) = settings.g, _inputs(sample, settings, sample.readings(0))
    K, D, cofactor, leverage = _solved(N, f, w, g, sample.readings(0))
    free = len(f) - 4
    s, axes = _noise(K, left := N - f @ K.T - D, w, free)
    low = to_gauge(K, "lower")
    covariance, nine = _two_of_nine(K, low, cofactor, axes)
    dop = np.sqrt(np.diagonal(cofactor))  # of K_a's columns as m/s^2 at 1 g, and of the bias
    size = np.sqrt(np.diagonal(K @ K.T))  # the output of each axis for one unit of force along it
    nominal, bias, before = uncalibrated(np.array([size.mean()]), D[None], settings)
    raw = np.linalg.norm((N - bias) / nominal, axis=1) - g
    force = (N - D) @ np.linalg.inv(low).T
    length = np.linalg.norm(force, axis=1)
    modulus, value = length - np.linalg.norm(f, axis=1), np.sum((g * g - length**2) ** 2, keepdims=True)
    columns = Observability(cofactor[None], dop[None], dop[None], np.array([4]), NAMES)
    information = np.linalg.pinv(nine)
    view = Observability(nine, np.sqrt(np.einsum("rpp->rp", nine)), columns.bounded, np.array([9]))
    spread = plain_spread(np.array([s**2]), nine, np.array([free]))
    return Fit(
        sample=sample,
        settings=settings,
        search=Search("linear least squares", 1, value, np.ones(1, np.intp), np.ones(1, np.intp)),
        gauge="full",
        K=K[None],
        D=D[None],
        lower=low[None],
        sigma_K=(np.outer(axes, dop[:3]) / g)[None],
        sigma_D=(axes * dop[3])[None],
        value=value,
        view=view,
        information=information,
        sight=(low[None], D[None]),
        geometry=Geometry(_attitudes(f, sample), columns, information),
        freedom=np.array([3 * free]),
        spread=replace(spread, covariance=covariance),
        covariance=covariance,
        bias=np.zeros((1, 9)),
        clusters=np.zeros(1, np.intp),
        at_wall=np.zeros((1, 12), dtype=bool),
        rms=np.sqrt([np.mean(modulus**2)]),
        rms_before=np.sqrt([np.mean(raw**2)]),
        before=before,
        nominal=nominal,
        residuals=_residuals(left / axes, w, leverage, s, free, modulus, raw, force),
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
    weights = alike_weights(sample) if settings.weights == "sd" else sample.counts(settings.weights)
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


def _noise(K: Float, left: Float, w: Float, free: int) -> tuple[float, Float]:
    """Return the standard deviation s of what is left as force, m/s^2, and s_i in output units, shape (3,).

    Args:
        K: shape (3, 3); left: N - K_a f - D_a, output units, shape (J, 3); w: weights, shape (J,); free: J - 4.
    """
    error, room = np.linalg.solve(K, left.T).T, free if free > 0 else np.nan
    s = float(np.sqrt(np.sum(w[:, None] * error**2) / (3 * room)))
    return s, np.sqrt(np.sum(w[:, None] * left**2, axis=0) / room)


def _attitudes(f: Float, sample: Sample) -> Int:
    """Return how many distinct attitudes the specific force has, m/s^2, shape (J, 3): shape (1,)."""
    return distinct(unit(f)[None], np.ones((1, len(f)), dtype=bool), sample.labelled)[0]


def _two_of_nine(K: Float, low: Float, cofactor: Float, axes: Float) -> tuple[Float, Float]:
    """Return covariance and cofactor of the nine parameters, shape (1, 9, 9), for axes of the noise s_i, shape (3,)."""
    back = np.linalg.solve(K, np.diag(axes))
    return _nine(K, low, cofactor, back @ back.T)[None], _nine(K, low, cofactor, np.eye(3))[None]


def _nine(K: Float, low: Float, cofactor: Float, noise: Float) -> Float:
    """Return the covariance of the nine parameters, shape (9, 9), for K, K in gauge `lower`, and (F^T W F)^-1.

    `noise` is the covariance of one pose as force, shape (3, 3).
    """
    chain = _chain(K, low)
    return np.asarray(chain @ np.kron(noise, cofactor) @ chain.T)


def _chain(K: Float, low: Float) -> Float:
    """Return d (nine parameters of gauge `lower`) / d Y, shape (9, 12), for K and K in gauge `lower`.

    [dK_a dD_a] = K_a Y with Y in units of force (its first three columns at 1 g), rows running slowest. So E = -Y / g
    in the body frame, R E R^T in that of gauge `lower`, and of it the rotation is no change of the sensor.
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
    return np.array(columns).T


def covariance_of_twelve(result: Calibration) -> Float:
    """Return the covariance of Y, shape (12, 12), (m/s^2)^2, of a result with known attitudes: see `_chain`.

    Definition: B x C, B the noise of the three axes in the body frame (one, where it is the same in all), C the
    covariance (F^T W F)^-1 s^2 of a row of Y. A record has C as what its nine parameters' covariance is made of:
    linear in C, and with more equations than C has entries. NaN where it has none.
    """
    K = result.K_a
    if not np.isfinite(result.covariance).all():
        return np.full((12, 12), np.nan)
    noise = np.linalg.solve(K, np.diag(result.sigma.D_a))
    B = noise @ noise.T
    B *= 3.0 / np.trace(B)
    chain = _chain(K, to_gauge(K, "lower"))
    entries = [(i, j) for i in range(4) for j in range(i + 1)]
    units = [np.zeros((4, 4)) for _ in entries]
    for part, (i, j) in zip(units, entries, strict=True):
        part[i, j] = part[j, i] = 1.0
    parts = np.stack([(chain @ np.kron(B, part) @ chain.T).ravel() for part in units], axis=1)
    sizes = np.linalg.lstsq(parts, result.covariance.ravel())[0]
    return np.asarray(np.kron(B, np.tensordot(sizes, units, axes=1)), dtype=float)


def _residuals(
    error: Float, w: Float, leverage: Float, s: float, freedom: int, modulus: Float, raw: Float, force: Float
) -> PoseResiduals:
    """Return the kept residuals, those of the modulus; outliers by all three axes, each of its own noise (Bonferroni).

    The p-values of the axes become normal scores, whose squares add up to chi-square of three degrees of freedom.
    `error` is what is left in units of the s_i, shape (J, 3), of so many degrees of freedom per axis.
    """
    room = room_of(leverage)
    each = w[:, None] * error**2 / room[:, None]
    square = each.sum(axis=1)
    outlier = np.zeros(len(w), dtype=bool)
    if freedom > 1:
        from scipy.special import chdtrc, chdtri, fdtrc

        others = (freedom - each) / (freedom - 1)
        chance = fdtrc(1, freedom - 1, each / np.where(others > 0, others, np.nan))
        outlier = len(w) * chdtrc(3, chdtri(1, chance).sum(axis=1)) < OUTLIER_LEVEL
    with np.errstate(divide="ignore", invalid="ignore"):
        studentised = np.sqrt(w) * modulus / (s * np.sqrt(room))
    kept = np.arange(len(w))
    if len(w) > KEPT:
        kept = np.sort(np.argsort(-np.nan_to_num(square))[:KEPT_WORST])
    return PoseResiduals(
        pose=kept[None],
        real=np.ones((1, len(kept)), dtype=bool),
        weight=w[None, kept],
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
