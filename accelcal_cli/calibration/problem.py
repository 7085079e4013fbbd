"""The calibration problem: Loetters' modulus observation as a least-squares cost over a box.

    L(theta) = sum_j (g^2 - |f_j|^2)^2,   f_j = K_a^-1 (N_j - D_a)          [dpso2014] eq. 15

Everything is done in normalised coordinates x = (N - c) / s and in units of g, where |f| / g = |A (x - d)|
with A = (K_a g / s)^-1 and d = (D_a - c) / s. There |f|^2 / g^2 = h^T Q h with h = (x, 1) and Q = M^T M,
M = [A | -A d]: the residual is linear in the 10 entries of Q, so one QR of the readings' rows leaves an 11 x 11
triangle that holds the cost of 12 readings or of 12 million exactly (calibration.triangle).
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import ROWS_COLUMNS, Observability
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.calibration.triangle import Triangle, compress, fit_ellipsoid, least_squares
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.model import to_gauge

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""

SPHERE_PRIOR = 1e-3
"""Information a pose lends to the middle of the readings as centre of the sphere, relative to its own: what axes
whose scale factors differ by 3 % pretend to say about an axis that the poses do not turn through."""

PAIRS = (np.array([0, 1, 2, 0, 0, 1, 0, 1, 2, 3]), np.array([0, 1, 2, 1, 2, 2, 3, 3, 3, 3]))
"""Which entries of the symmetric 4 x 4 matrix Q the vector q holds."""

AROUND = {
    n + 1: np.array([positions.get((i % 3, j % 3), n) for i in range(5) for j in range(5)])
    for n in (6, 9, 12)
    for positions in [{place: k for k, place in enumerate(ROWS_COLUMNS[: n - 3])}]
}
"""Which row of n unknowns and a zero each entry of the 5 x 5 table is that holds K going round, by n + 1."""


def pack(K: Float, D: Float, unknowns: int) -> Float:
    """Return the unknowns, shape (..., 6, 9 or 12), of K, shape (..., 3, 3), and D, shape (..., 3)."""
    rows, columns = zip(*ROWS_COLUMNS[: unknowns - 3], strict=True)
    return np.concatenate([K[..., rows, columns], D], axis=-1)


def unpack(theta: Float) -> tuple[Float, Float]:
    """Return K, shape (..., 3, 3), and D, shape (..., 3), of the unknowns, shape (..., 6, 9 or 12)."""
    K = np.zeros((*theta.shape[:-1], 3, 3))
    rows, columns = zip(*ROWS_COLUMNS[: theta.shape[-1] - 3], strict=True)
    K[..., rows, columns] = theta[..., :-3]
    return K, theta[..., -3:]


@dataclass(frozen=True, eq=False)
class Box:
    """The search box in the units of the readings.

    Attributes:
        centre: nominal unknowns (K_11 K_22 K_33 [K_21 K_31 K_32 [K_12 K_13 K_23]] D_1 D_2 D_3), shape (R, D).
        half: half-widths, same shape.
    """

    centre: Float
    half: Float

    def take(self, index: Int) -> Box:
        """Return the boxes of the sensors at `index`."""
        return Box(self.centre[index], self.half[index])


class Loetters(Problem):
    """The cost of one sensor, or of R sensors at once, over u in [-1, 1]^D.

    Args:
        triangle: compressed readings, with leading axis R when the runs are different sensors.
        g: local gravity, m/s^2.
        box: centre and half-widths; D = 6 (diagonal K_a), 9 (lower-triangular) or 12 (full).
    """

    has_residuals = True
    has_closed_form = True
    minimum = None

    def __init__(self, triangle: Triangle, g: float, box: Box) -> None:
        """Bring box and readings to normalised coordinates."""
        self.name = "Loetters"
        self.triangle, self.g, self.box = triangle, g, box
        self.unknowns = box.centre.shape[-1]
        self.lower, self.upper = -np.ones(self.unknowns), np.ones(self.unknowns)
        # Units of the unknowns in one normalised unit: K is per m/s^2, so K g / s; D is D / s, off centre.
        unit = np.concatenate([np.full(self.unknowns - 3, 1.0 / g), np.ones(3)])
        shift = np.zeros((len(triangle.scale), self.unknowns))
        shift[:, -3:] = triangle.centre
        self._centre = (box.centre - shift) / (unit * triangle.scale[:, None])
        self._half = box.half / (unit * triangle.scale[:, None])
        self._triangle = triangle.R * g**2  # residuals in (m/s^2)^2
        self._R = self._triangle[..., :10]

    @property
    def units(self) -> Float:
        """How much of each unknown's own unit one unit of u is, shape (R, D): the half-widths of the box."""
        return self.box.half

    def cost(self, x: Float) -> Float:
        """Return L in (m/s^2)^4, shape (R, P)."""
        r = self._triangle @ self._quadratic(x)
        r *= r
        cost: Float = np.add.reduce(r, axis=1)
        return cost

    def residuals(self, x: Float) -> Float:
        """Return the 11 compressed residuals in (m/s^2)^2, shape (R, P, 11)."""
        r: Float = self._triangle @ self._quadratic(x)
        return r.transpose(0, 2, 1)

    def jacobian(self, x: Float) -> Float:
        """Return d residual / d u in (m/s^2)^2, shape (R, P, 11, D).

        From dA = -A dK A and dM = [dA | -dA d - A dd], column by column.
        """
        K, d = unpack(self._centre[:, None] + self._half[:, None] * x)
        A = _inverse(K)
        M = np.concatenate([A, -(A @ d[..., None])], axis=-1)  # dM for dK_ij is -A e_i (row j of M)
        columns = []
        for i, j in ROWS_COLUMNS[: self.unknowns - 3]:
            columns.append(_quadratic_change(M, -A[..., :, i, None] * M[..., j, None, :]))
        for i in range(3):
            change = np.zeros_like(M)
            change[..., 3] = -A[..., :, i]
            columns.append(_quadratic_change(M, change))
        q = np.stack(columns, axis=-1) * self._half[:, None, None]
        jacobian: Float = self._R[:, None] @ q
        return jacobian

    @property
    def groups(self) -> Int:
        """Scale factors 0, misalignments 1, biases 2."""
        return np.repeat([0, 1, 2], [3, self.unknowns - 6, 3])

    def gradient_hessian(self, x: Float) -> tuple[Float, Float]:
        """Return the gradient, shape (R, P, D), and full Hessian of L, (R, P, D, D), at x, shape (R, P, D).

        grad L = 2 J^T r, H = 2 J^T J + 2 sum_k r_k d2 r_k. The residuals are linear in q = vech(M^T M), so the second
        part is the Hessian of <Y, M^T M> with Y from R^T r. With dM = -A W, W = dK M + (0 | dd), it is
        2 <A W Y, A W> + 4 <M Y, A dK A W> as a quadratic form.
        """
        J, r = self.jacobian(x), self.residuals(x)
        K, d = unpack(self._centre[:, None] + self._half[:, None] * x)
        A = _inverse(K)
        M = np.concatenate([A, -(A @ d[..., None])], axis=-1)
        Y = _symmetric((self._R.swapaxes(1, 2)[:, None] @ r[..., None])[..., 0])
        dK = np.zeros((self.unknowns, 3, 3))
        dd = np.zeros((self.unknowns, 3, 4))
        for p, (i, j) in enumerate(ROWS_COLUMNS[: self.unknowns - 3]):
            dK[p, i, j] = 1.0
        dd[-3:, :, 3] = np.eye(3)
        AW = A[..., None, :, :] @ (dK @ M[..., None, :, :] + dd)  # (R, P, D, 3, 4)
        AdK = A[..., None, :, :] @ dK
        curvature = np.einsum("rpaik,rpkl,rpbil->rpab", AW, Y, AW)
        mixed = np.einsum("rpik,rpaij,rpbjk->rpab", M @ Y, AdK, AW)
        second = 2.0 * curvature + 2.0 * (mixed + mixed.swapaxes(2, 3))
        half = self._half[:, None, :]
        hessian = 2.0 * J.swapaxes(2, 3) @ J + 2.0 * second * half[..., :, None] * half[..., None, :]
        gradient = 2.0 * (J.swapaxes(2, 3) @ r[..., None])[..., 0]
        return gradient, hessian

    def closed_form(self) -> Float:
        """Return the ellipsoid fit in box coordinates, shape (R, D); NaN where the readings fix no ellipsoid."""
        K, d = fit_ellipsoid(self.triangle)
        return (pack(K, d, self.unknowns) - self._centre) / self._half

    def least_cost(self) -> Float:
        """Return the point of least cost, shape (R, D), where the readings give it in closed form; NaN elsewhere."""
        K, d = least_squares(self.triangle)
        scale = self.triangle.scale
        return self.coordinates(K * scale[:, None, None] / self.g, d * scale[:, None] + self.triangle.centre)

    def take(self, index: Int) -> Loetters:
        """Return the problem of the sensors at `index`; itself when all runs share one sensor."""
        if len(self.triangle.scale) == 1:
            return self
        return self.of(index)

    def of(self, index: Int) -> Loetters:
        """Return the problem of the sensors at `index`, which are sensors of their own even where there is one."""
        return Loetters(self.triangle.take(index), self.g, self.box.take(index))

    def parameters(self, x: Float) -> tuple[Float, Float]:
        """Return K_a, shape (R, 3, 3), and D_a, shape (R, 3), in the readings' units at x, shape (R, D)."""
        return unpack(self.box.centre + self.box.half * x)

    def coordinates(self, K: Float, D: Float) -> Float:
        """Return the point of the box, shape (R, D), at K_a, shape (R, 3, 3), and D_a, shape (R, 3)."""
        return (pack(K, D, self.unknowns) - self.box.centre) / self.box.half

    def in_lower(self, K: Float, D: Float) -> tuple[Loetters, Float]:
        """Return the nine-parameter problem of the same readings, and its point, shape (R, 9), for sensors K and D.

        Uncertainty is always computed in gauge `lower`, whatever is searched or printed.
        """
        half = self.box.half
        # Any width: derivatives alone are asked for.
        turned = half[:, 3:6] if self.unknowns > 6 else half[:, :3]
        half = np.concatenate([half[:, :3], turned, half[:, -3:]], axis=1)
        nine = Loetters(self.triangle, self.g, Box(np.zeros((len(K), 9)), half))
        return nine, nine.coordinates(to_gauge(K, "lower"), D)

    def design(self, x: Float) -> Float:
        """Return d (-e) / d (the nine parameters of `observability`), shape (R, 11, 9), at x, shape (R, 9).

        Of the compressed residuals. The chain runs over K_a = K_a0 (I + E)^-1, so dK_a = -K_a0 E, and dD_i = K_ii times
        the bias as force.
        """
        K, _ = self.parameters(x)
        chain = np.zeros((len(K), 9, 9))
        for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
            change = np.zeros_like(K)
            change[:, :, j] = -K[:, :, i] / self.g
            chain[:, :, p] = pack(change, np.zeros((len(K), 3)), 9)
        for i in range(3):
            chain[:, 6 + i, 6 + i] = K[:, i, i]
        design: Float = self.jacobian(x[:, None])[:, 0] / self.units[:, None, :] @ chain / (2.0 * self.g)
        return design

    def information(self, x: Float) -> Float:
        """Return J^T J of the nine parameters, shape (R, 9, 9), at x, shape (R, 9), from the compressed readings."""
        J = self.design(x)
        information: Float = J.swapaxes(1, 2) @ J
        return information

    def _quadratic(self, x: Float) -> Float:
        """Return the ten entries of Q = M^T M and -1, shape (R, 11, P), at x, shape (R, P, D)."""
        # The last row, of zeros, is what is above the diagonal of a lower-triangular K.
        theta = np.zeros((len(x), self.unknowns + 1, x.shape[1]))
        unknowns = theta[:, :-1]
        np.multiply(self._half[..., None], x.transpose(0, 2, 1), out=unknowns)
        unknowns += self._centre[..., None]
        M = _columns(theta)
        first, second = PAIRS
        products = M.take(first, axis=1)
        products *= M.take(second, axis=1)
        q = np.empty((len(x), 11, x.shape[1]))
        np.add.reduce(products, axis=2, out=q[:, :10])
        q[:, 10] = -1.0
        return q


def _inverse(K: Float) -> Float:
    """Return K^-1, shape (..., 3, 3); NaN where K is singular, so that one run's fate is not that of the batch."""
    with suppress(np.linalg.LinAlgError):
        return np.linalg.inv(K)
    regular = (np.linalg.det(K) != 0)[..., None, None]
    return np.where(regular, np.linalg.inv(np.where(regular, K, np.eye(3))), np.nan)


def _quadratic_change(M: Float, dM: Float) -> Float:
    """Return d vech(M^T M), shape (R, P, 10), for a change dM of M, both (R, P, 3, 4)."""
    change = dM.swapaxes(-1, -2) @ M
    first, second = PAIRS
    return change[..., first, second] + change[..., second, first]


def _symmetric(y: Float) -> Float:
    """Return the symmetric Y, shape (..., 4, 4), with <Y, Q> = y . q for q = vech(Q), shape (..., 10).

    The rows phi carry the factor 2 of the off-diagonals, so Y holds y halved there.
    """
    Y = np.zeros((*y.shape[:-1], 4, 4))
    first, second = PAIRS
    Y[..., first, second] += 0.5 * y
    Y[..., second, first] += 0.5 * y
    return Y


def _columns(theta: Float) -> Float:
    """Return the columns of M = [A | -A d], shape (R, 4, 3, P), by cofactors: A_ji det K = C_ij.

    C_ij = K_i+1,j+1 K_i+2,j+2 - K_i+1,j+2 K_i+2,j+1 with the indices of K going round: C is cut out of a 5 x 5
    table that holds K going round.
    """
    runs, rows, population = theta.shape
    K = theta.take(AROUND[rows], axis=1).reshape(runs, 5, 5, population)
    M = np.empty((runs, 4, 3, population))
    # M[:, j, i] is entry (i, j) of M, so that its first three columns, transposed, are the cofactors over det K.
    A, shift = M[:, :3], M[:, 3]
    np.multiply(K[:, 1:4, 1:4], K[:, 2:, 2:], out=A)
    A -= K[:, 1:4, 2:] * K[:, 2:, 1:4]
    A /= np.add.reduce(K[:, 0, :3] * A[:, 0], axis=1)[:, None, None]
    np.add.reduce(A * theta[:, -4:-1, None], axis=1, out=shift)
    np.negative(shift, out=shift)
    return M


def packed(sample: Sample, weights: Float | None, within: Sample | None = None) -> Triangle:
    """Return weighted readings compressed, centred and scaled by their own extent or by that of other readings."""
    extent = within or sample
    centre = 0.5 * (extent.lower + extent.upper)
    scale = 0.5 * (extent.upper - extent.lower).max(axis=1)
    blocks = (
        (block, None if weights is None else weights[:, first : first + block.shape[1]])
        for first, block in sample.blocks()
    )
    return compress(blocks, centre, scale, sample.poses)


def search_box(triangle: Triangle, settings: Settings) -> tuple[Box, tuple[str, ...]]:
    """Return the search box of each sensor, and where it comes from: "stated", "closed form" or "sphere".

    The same in any company.

    Args:
        triangle: the compressed readings of R sensors.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 6 if not settings.misalignment else 12 if settings.gauge == "full" else 9
    sensors = len(triangle.scale)
    if settings.nominal is not None:
        K = np.broadcast_to(np.diag(settings.nominal.scale), (sensors, 3, 3))
        D = np.broadcast_to(settings.nominal.bias, (sensors, 3))
        return _box(K, D, settings, unknowns), ("stated",) * sensors
    K, D = _closed_form(triangle, settings.g)
    index = np.flatnonzero(np.isfinite(K).all(axis=(1, 2)))
    index = index[_trustworthy(triangle.take(index), K[index], D[index], settings)]
    closed = np.zeros(sensors, dtype=bool)
    closed[index] = True
    sphere_K, sphere_D = _sphere(triangle, settings.g)
    if unknowns == 12:
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K[index] = to_gauge(K[index], "symmetric")
    K, D = np.where(closed[:, None, None], K, sphere_K), np.where(closed[:, None], D, sphere_D)
    box = _box(K, D, settings, unknowns)
    u = Streams(settings.seed, [0], Purpose.BOX).uniform(1, unknowns)[0, 0]
    moved = box.centre + SHIFT * (2.0 * u - 1.0) * box.half
    return Box(np.where(closed[:, None], moved, box.centre), box.half), tuple(
        "closed form" if c else "sphere" for c in closed
    )


def _box(K: Float, D: Float, settings: Settings, unknowns: int) -> Box:
    half = half_widths(np.einsum("rii->ri", K), settings.box, settings.g, unknowns)
    return Box(pack(K, D, unknowns), half)


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    K, d = fit_ellipsoid(triangle)
    return K * triangle.scale[:, None, None] / g, d * triangle.scale[:, None] + triangle.centre


def _trustworthy(triangle: Triangle, K: Float, D: Float, settings: Settings) -> Bool:
    """Whether the poses determine what the closed form says, shape (R,); where they do not, noise has decided it."""
    problem = Loetters(triangle, settings.g, _box(K, D, settings, 9))
    seen = Observability.of(problem.information(np.zeros((len(K), 9))), triangle.poses)
    return np.array([verdict != "undetermined" for verdict in seen.verdicts], dtype=bool)


def _sphere(triangle: Triangle, g: float) -> tuple[Float, Float]:
    """Return K, shape (R, 3, 3), and D, shape (R, 3), of the spheres nearest to readings that fix no ellipsoid.

    |x|^2 = 2 c x + (r^2 - |c|^2) is linear in c and the constant. A direction that the poses do not turn through
    is held at the middle of the readings by the prior.
    """
    left, right = triangle.R[..., 6:10], triangle.R[..., :3].sum(axis=2)
    transposed = left.swapaxes(1, 2)
    prior = SPHERE_PRIOR * triangle.poses[:, None, None] * np.diag([1.0, 1.0, 1.0, 0.0])
    c = np.linalg.solve(transposed @ left + prior, transposed @ right[..., None])[..., 0]
    radius = np.sqrt(np.maximum(c[:, 3] + np.sum(c[:, :3] ** 2, axis=1), 0.0))
    # Far from the readings' own extent, which is 1, it is noise.
    radius = np.where((radius > 0.3) & (radius < 3.0), radius, 1.0)
    K = (radius * triangle.scale / g)[:, None, None] * np.eye(3)
    return K, c[:, :3] * triangle.scale[:, None] + triangle.centre


ALIKE = 2.0
"""Largest factor between scale factors that count as alike."""


def half_widths(scale: Float, box: BoxSettings, g: float, unknowns: int) -> Float:
    """Return the half-widths in the units of the unknowns, shape (..., unknowns), for scale factors (..., 3)."""
    mean = scale.mean(axis=-1, keepdims=True)
    turned = np.repeat(box.misalignment * mean, unknowns - 6, axis=-1)
    # An angle is a part of the scale factor of its own axis; of the mean where they are alike.
    own = box.misalignment * scale[..., [i for i, _ in ROWS_COLUMNS[3 : unknowns - 3]]]
    alike = scale.max(axis=-1, keepdims=True) <= ALIKE * scale.min(axis=-1, keepdims=True)
    turned = np.where(alike, turned, own)
    return np.concatenate([box.scale * scale, turned, box.bias * g * scale], axis=-1)


def opened(sample: Sample, settings: Settings, weights: Float | None) -> tuple[Loetters, tuple[str, ...]]:
    """Return the cost of weighted readings in its box, and where the box of each sensor comes from."""
    triangle = packed(sample, weights)
    box, sources = search_box(triangle, settings)
    return Loetters(triangle, settings.g, box), sources
