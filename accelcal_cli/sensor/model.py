"""The linear error model of a three-axis accelerometer and the gauges of its matrix.

    N = K_a f + D_a                    [dpso2014] eq. 10 without noise
    f = K_A N - f_0,  K_A = K_a^-1, f_0 = K_A D_a      eq. 11

N is the output (pulse/s, counts, any linear output), f the specific force in the body frame (m/s^2).
A rotation of the body frame changes K_a to K_a R^T and leaves every |f| as it was: readings without known
attitudes determine K_a only up to that rotation, and a gauge is the convention that chooses it (`to_gauge`).

The engineering units of the parameters stand at the end (scale-factor errors, misalignment angles, bias as force), and
local gravity: stated, or the normal gravity of WGS84 at a latitude and height.
"""

from __future__ import annotations

import math
from typing import Literal, get_args

import numpy as np
from numpy.linalg import cholesky, eigh, qr, svd

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.schema import frozen

Gauge = Literal["lower", "upper", "symmetric", "full"]
GAUGES: tuple[str, ...] = get_args(Gauge)

SQUARABLE = 1e-6
"""Least ratio of the smallest singular value of K to the largest at which K K^T still has digits of it."""

STANDARD_GRAVITY = 9.80665
"""m/s^2, the conventional value of 1 g (CGPM 1901)."""

LEAST_GRAVITY, MOST_GRAVITY = 1e-3, 1e6
"""Gravity in any unit of acceleration that a sensor is calibrated in: 1 for g, 9.8 for m/s^2, 1000 for mg."""

PPM = 1e6
MRAD = 1e3
ARCSEC = 180 * 3600 / math.pi
"""Arc seconds in a radian."""
MICRO_G = 1e6

OUTPUT_OF_1_G = {"g": 1.0, "mg": 1000.0, "m/s^2": STANDARD_GRAVITY, "m/s2": STANDARD_GRAVITY}
"""By the name of the unit. A sensor with output in one of them has a small bias, unlike one with raw counts."""

AWAY = 2.0
"""At rest a sensor reads 1 g within this factor, whatever its errors, unless its unit is another one."""


def to_gauge(K: Float, gauge: str) -> Float:
    """Return K_a in a gauge: the K R^T, R a rotation, that has the gauge's form.

    Definition:
        lower: Cholesky factor of K K^T, positive diagonal: body x along the x sensor axis, body y in the plane
        of the x and y sensor axes. upper: the same with the axes in reverse order. symmetric: (K K^T)^(1/2),
        the polar factor, closest to no rotation. full: as it is.

    Args:
        K: shape (..., 3, 3), finite and not singular, output units per m/s^2.
        gauge: one of GAUGES.
    """
    if gauge == "full":
        return K
    if gauge == "upper":
        return to_gauge(K[..., ::-1, :], "lower")[..., ::-1, ::-1]
    above, diagonal = K[..., [0, 0, 1], [1, 2, 2]], np.einsum("...ii->...i", K)
    there = (above == 0).all(axis=-1) & (diagonal > 0).all(axis=-1)
    if gauge == "lower" and there.all():
        return K
    sizes = svd(K, compute_uv=False)
    poor = sizes[..., 2] < SQUARABLE * sizes[..., 0]
    squared = np.where(poor[..., None, None], np.eye(3), K)
    product = squared @ squared.swapaxes(-1, -2)
    if gauge == "lower":
        factor = cholesky(product)
        if poor.any():
            factor[poor] = triangular(K[poor])
        return np.where(there[..., None, None], K, factor)
    values, vectors = eigh(product)
    root: Float = (vectors * np.sqrt(values)[..., None, :]) @ vectors.swapaxes(-1, -2)
    if poor.any():
        axes, sizes, _ = svd(K[poor])
        root[poor] = (axes * sizes[:, None, :]) @ axes.swapaxes(-1, -2)
    return root


AROUND = np.array(
    [
        [3 * ((j + 1 + a) % 3) + (i + 1 + b) % 3 for i in range(3) for j in range(3)]
        for a, b in ((0, 0), (1, 1), (0, 1), (1, 0))
    ]
)
"""Which entries of a 3 x 3 matrix the two products of each entry of its adjugate are made of, all as rows of nine; the
indices go round, which makes the sign."""


def inverse(K: Float) -> Float:
    """Return K^-1 by cofactors, shape (..., 3, 3); inf or NaN where K is singular, and there alone."""
    flat = K.reshape(-1, 9)
    first, second, third, fourth = AROUND
    with np.errstate(all="ignore"):
        adjugate = flat.take(first, axis=1) * flat.take(second, axis=1)
        adjugate -= flat.take(third, axis=1) * flat.take(fourth, axis=1)
        determinant = flat[:, 0] * adjugate[:, 0] + flat[:, 1] * adjugate[:, 3] + flat[:, 2] * adjugate[:, 6]
        adjugate /= determinant[:, None]
    return np.asarray(adjugate.reshape(K.shape))


def inverse_triangles(L: Float) -> Float:
    """Return the inverses of lower triangles, shape (p, p, R), in the same layout, all of them at once."""
    X = np.zeros(L.shape)
    for k in range(len(L)):
        X[k, k] = 1.0
        X[k, : k + 1] /= L[k, k]
        X[k + 1 :, : k + 1] -= L[k + 1 :, None, k] * X[k, : k + 1]
    return X


def inverse_normal(normal: Float) -> Float:
    """Return the inverses of symmetric matrices, shape (R, p, p), by their Cholesky factors; NaN where there are none.

    Written column by column over all matrices: twice as fast as LAPACK one by one, and none decides over the others.
    """
    A = np.ascontiguousarray(normal.transpose(1, 2, 0))
    with np.errstate(all="ignore"):
        for k in range(len(A)):
            A[k:, k] /= np.sqrt(A[k, k])
            A[k + 1 :, k + 1 :] -= A[k + 1 :, None, k] * A[k + 1 :, k]
        X = inverse_triangles(A)
        P = np.zeros(A.shape)
        for k in range(len(A)):
            P[: k + 1, : k + 1] += X[k, : k + 1, None] * X[k, : k + 1]
    return np.ascontiguousarray(P.transpose(2, 0, 1))


def triangular(K: Float) -> Float:
    """Return K in gauge `lower`, shape (R, 3, 3), for any finite K: K Q with Q from the QR of K^T."""
    R: Float = qr(K.swapaxes(1, 2), mode="r")  # type: ignore[assignment]  # typed as "reduced"
    sign = np.where(np.einsum("rii->ri", R) < 0, -1.0, 1.0)
    return R.swapaxes(1, 2) * sign[:, None]


@frozen(eq=False)
class ErrorModel:
    """Scale factors, misalignments and bias of one accelerometer.

    Attributes:
        K: K_a, shape (3, 3), output units per m/s^2; diagonal = scale factors, off-diagonal = misalignment.
        D: D_a, bias, shape (3,), output units.
    """

    K: Float
    D: Float

    @property
    def K_A(self) -> Float:  # noqa: N802
        """Inverse matrix. Definition: K_a^-1. Units: m/s^2 per output unit. Shape (3, 3)."""
        return inverse(self.K)

    @property
    def f_0(self) -> Float:
        """Bias as specific force. Definition: K_a^-1 D_a. Units: m/s^2. Shape (3,)."""
        return self.K_A @ self.D

    def output(self, f: Float) -> Float:
        """Return the output N, shape (..., 3), at specific force f, shape (..., 3) in m/s^2."""
        return f @ self.K.T + self.D

    def specific_force(self, N: Float) -> Float:
        """Return the specific force in m/s^2, shape (..., 3), of outputs N, shape (..., 3)."""
        # Columns of contiguous memory: ten times as fast as rows of three for a long log.
        centred = np.subtract(N.reshape(-1, 3).T, self.D[:, None], order="C")
        return (self.K_A @ centred).T.reshape(N.shape)

    def in_gauge(self, gauge: str) -> ErrorModel:
        """Return the same sensor in the body frame of another gauge. The bias D_a does not change."""
        return ErrorModel(to_gauge(self.K, gauge), self.D)


AXIS_PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of sensor axes in the order of their misalignments: xy, xz, yz."""


def sensitivity(K: Float) -> Float:
    """Return the scale factor of each sensor axis, shape (..., 3), of K_a, shape (..., 3, 3), in any gauge.

    Definition: the length of row i, the output of axis i for one unit of force along it. Units: as K_a.
    """
    return np.asarray(np.linalg.norm(K, axis=-1))


def scale_error(K: Float, nominal: Float) -> Float:
    """Return the scale-factor errors, shape (..., 3). Definition: sensitivity / nominal - 1. Units: 1."""
    return np.asarray(sensitivity(K) / nominal - 1.0)


def misalignment(K: Float) -> Float:
    """Return the misalignments xy, xz and yz, shape (..., 3), of K_a, shape (..., 3, 3), in any gauge.

    Definition: the angle by which two sensor axes miss 90 degrees, the arc sine of the cosine between rows of K_a;
    positive where the axes are closer. Units: rad.
    """
    rows = K / sensitivity(K)[..., None]
    first, second = np.transpose(AXIS_PAIRS)
    cosine = np.sum(rows[..., first, :] * rows[..., second, :], axis=-1)
    return np.asarray(np.arcsin(np.clip(cosine, -1.0, 1.0)))  # rounding takes two axes that are one beyond 1


def bias_force(K: Float, D: Float) -> Float:
    """Return the bias as specific force along each sensor axis, shape (..., 3), of K_a in any gauge, and D_a.

    Definition: D_i / sensitivity. Units: m/s^2 (units of g when K is per g).
    """
    return np.asarray(D / sensitivity(K))


def check_unit(output: Float, unit: str) -> None:
    """Raise DataError when an output at rest, shape (3,), less its bias, cannot be 1 g in the unit of that name."""
    length = float(np.linalg.norm(output))
    if _reads_1_g(length, unit):
        return
    other = next((name for name in OUTPUT_OF_1_G if _reads_1_g(length, name)), None)
    low, high = OUTPUT_OF_1_G[unit] / AWAY, OUTPUT_OF_1_G[unit] * AWAY
    raise DataError(
        f"the first pose reads {', '.join(f'{v:.6g}' for v in output)}, length {length:.4g}; expected {low:.4g} to "
        f"{high:.4g}, about 1 g with --unit {unit}; "
        + (f"state --unit {other}" if other else "are --unit and --columns right?")
    )


def _reads_1_g(length: float, unit: str) -> bool:
    return OUTPUT_OF_1_G[unit] / AWAY <= length <= OUTPUT_OF_1_G[unit] * AWAY


def check_gravity(g: float) -> float:
    """Return g, in m/s^2 (or 1 for readings in units of g), or raise UsageError when it cannot be one."""
    if not LEAST_GRAVITY <= g <= MOST_GRAVITY:
        raise UsageError(
            f"--g {g:g}: expected gravity in m/s^2 (9.78 to 9.84 on Earth), or 1 for readings in units of g"
        )
    return g


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return the magnitude of WGS84 normal gravity in m/s^2 (Li and Goetze closed form, by boule).

    Args:
        latitude: geodetic latitude, degrees, -90 to 90.
        height: height above the ellipsoid, metres.

    Raises:
        UsageError: latitude or height out of range.
    """
    if not -90 <= latitude <= 90:
        raise UsageError(f"--latitude {latitude:g}: expected degrees from -90 to 90")
    if not -1e4 <= height <= 1e5:
        raise UsageError(f"--height {height:g}: expected metres above the ellipsoid, from -10000 to 100000")
    import warnings

    import boule

    with warnings.catch_warnings():
        # Below the ellipsoid boule warns; the field of the outside, continued, is that in a valley there.
        warnings.simplefilter("ignore", UserWarning)
        milligal = boule.WGS84.normal_gravity((0.0, latitude, height))
    return float(milligal) * 1e-5


def local_gravity(
    unit: str | None = None,
    *,
    g: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
) -> float | None:
    """Return the stated local gravity in the unit of the readings, or None where nothing decides it.

    Readings in units of g or mg have 1 or 1000 where nothing is stated, which is as good as the 9.80665 of others. What
    `g` states is taken as it is: the user knows the unit.

    Args:
        unit: of the readings, as their file states it; None where it does not.
        g: gravity in m/s^2, or in the unit of the readings.
        latitude, height: degrees, and metres above the ellipsoid, in place of g.

    Raises:
        UsageError: out of range, stated twice, or a height without a latitude.

    Examples:
        >>> local_gravity("g")
        1.0
        >>> round(local_gravity(latitude=48.1, height=500), 5)
        9.80746
    """
    if g is not None and latitude is not None:
        raise UsageError("--g and --latitude: expected one of them, not both")
    if height is not None and latitude is None:
        raise UsageError("--height needs --latitude")
    if g is not None:
        return check_gravity(g)
    metres = None if latitude is None else normal_gravity(latitude, height or 0.0)
    if unit not in ("g", "mg"):
        return metres
    size = OUTPUT_OF_1_G[unit]
    return size if metres is None else metres * size / STANDARD_GRAVITY


ASSUMED = "standard gravity, assumed: no local value was stated"
"""Where local gravity comes from when nothing says it."""


def gravity_source(
    unit: str | None = None,
    *,
    g: float | None = None,
    latitude: float | None = None,
    height: float | None = None,
) -> str:
    """Return in words where local gravity comes from; arguments as of `local_gravity`.

    Examples:
        >>> gravity_source(latitude=48.1, height=500)
        'WGS84 normal gravity at latitude 48.1 degrees, height 500 m'
        >>> gravity_source()
        'standard gravity, assumed: no local value was stated'
    """
    if latitude is not None:
        return f"WGS84 normal gravity at latitude {latitude:g} degrees, height {height or 0.0:g} m"
    if g is not None:
        return "stated by the user"
    if unit in ("g", "mg"):
        return "the readings' own unit: 1 g is taken as the local gravity"
    return ASSUMED
