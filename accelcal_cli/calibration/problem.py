"""The calibration problem: Loetters' modulus observation as a least-squares cost over a box.

    L(theta) = sum_j (g^2 - |f_j|^2)^2,   f_j = K_a^-1 (N_j - D_a)          [dpso2014] eq. 15

Everything is done in normalised coordinates x = (N - c) / s and in units of g, where |f| / g = |A (x - d)|
with A = (K_a g / s)^-1 and d = (D_a - c) / s. There |f|^2 / g^2 = h^T Q h with h = (x, 1) and Q = M^T M,
M = [A | -A d]: the residual is linear in the 10 entries of Q, so one QR of the readings' rows leaves an 11 x 11
triangle that holds the cost of 12 readings or of 12 million exactly. QR of stacked blocks composes (TSQR), so readings
of any number pass through in blocks; a weight multiplies its row.

The closed form: readings lie on an ellipsoid, x^T A x + 2 m^T x + d = 0 with trace(A) = 3, nine unknowns by linear
least squares. A free constant term instead of the trace condition would admit the trivial minimum. The centre is the
bias, A's Cholesky factor the matrix.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import ROWS_COLUMNS
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.model import inverse, inverse_triangles, to_gauge

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


@frozen(eq=False)
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

        From dA = -A dK A and dM = [dA | -dA d - A dd]: with W = A^T M, d |M h|^2 is -2 (W_i h) (M_j h) by K_ij, and
        -2 W_i h by d_i.
        """
        A, M = self._matrices(x)
        rows, columns = zip(*ROWS_COLUMNS[: self.unknowns - 3], strict=True)
        H = M.swapaxes(-1, -2)
        q = _products((H @ A).take((*rows, 0, 1, 2), axis=-1), H, columns)
        q *= -self._half[:, None, None]
        jacobian: Float = self._R[:, None] @ q
        return jacobian

    def _matrices(self, x: Float) -> tuple[Float, Float]:
        """Return A and M = [A | -A d], shapes (R, P, 3, 3) and (R, P, 3, 4), at x, shape (R, P, D)."""
        K, d = unpack(self._centre[:, None] + self._half[:, None] * x)
        A = inverse(K)
        return A, np.concatenate([A, -(A @ d[..., None])], axis=-1)

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
        A, M = self._matrices(x)
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

        Of the compressed residuals. K_a = K_a0 (I + E)^-1 makes d (-e) = (M_i h) (M_j h) by g E_ij, and dD_i = K_ii
        times the bias as force -K_ii W_i h, in units of g as in `jacobian`.
        """
        A, M = self._matrices(x[:, None])
        A, H = A[:, 0], M[:, 0].swapaxes(1, 2)
        W = H @ A / (-2.0 * np.einsum("rii->ri", A)[:, None])  # of a triangle, 1 / A_ii is K_ii
        rows, columns = zip(*ROWS_COLUMNS[:6], strict=True)
        q = _products(np.concatenate([0.5 * H.take(rows, axis=-1), W], axis=-1), H, columns)
        design: Float = self.triangle.R[..., :10] @ q
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


def _products(left: Float, right: Float, columns: Sequence[int]) -> Float:
    """Return twice the forms (left_p h) (right_q h), q of `columns`, then (left_p h) 1, p running, with h = (x, 1).

    As coefficients of Q, shape (..., 10, n), for columns of shape (..., 4, n) and (..., 4, 3).
    """
    other = np.zeros(left.shape)
    other[..., : len(columns)] = right.take(columns, axis=-1)
    other[..., 3, len(columns) :] = 1.0
    first, second = PAIRS
    products: Float = left.take(first, axis=-2) * other.take(second, axis=-2)
    products += left.take(second, axis=-2) * other.take(first, axis=-2)
    return products


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


PIECE = 512
"""Rows of one small QR; LAPACK's panel of 512 x 11 stays in the first-level cache."""


@frozen(eq=False)
class Triangle:
    """The compressed readings of R sensors.

    Attributes:
        R: upper triangles, shape (R, 11, 11), of the rows [phi(x), 1].
        centre: c, shape (R, 3), output units.
        scale: s, shape (R,), output units.
        poses: J, the number of readings of each sensor, shape (R,).
    """

    R: Float
    centre: Float
    scale: Float
    poses: Int

    @cached_property
    def nearest(self) -> Nearest:
        """The quadrics that the closed forms start from."""
        return Nearest.of(self.R)

    def take(self, index: Int) -> Triangle:
        """Return the triangles of the sensors at `index`."""
        return Triangle(self.R[index], self.centre[index], self.scale[index], self.poses[index])


@frozen(eq=False)
class Nearest:
    """The quadrics x^T A x + 2 m^T x = 1 of R sensors with the least algebraic residual.

    Of a triangle T, t and rho are the first nine columns, the tenth above its diagonal, and its diagonal there.

    Attributes:
        inverse: T^-1, shape (R, 9, 9); y: T^-1 t, (A_11 A_22 A_33 A_12 A_13 A_23 m), shape (R, 9); rho: shape (R,).
        solvable: whether the readings determine y, shape (R,); else all of this is without meaning.
    """

    inverse: Float
    y: Float
    rho: Float
    solvable: Bool

    @classmethod
    def of(cls, R: Float) -> Nearest:
        """Return the quadrics of triangles, shape (R, 11, 11)."""
        T = R[:, :9, :9]
        pivots = np.abs(np.einsum("rii->ri", T))
        solvable = np.asarray(pivots.min(axis=1) > SMALLEST_PIVOT * pivots.max(axis=1))
        lower = np.where(solvable[:, None, None], T, np.eye(9)).transpose(2, 1, 0)
        inverse = np.ascontiguousarray(inverse_triangles(lower).transpose(2, 1, 0))
        return cls(inverse, _times(inverse, R[:, :9, 9]), R[:, 9, 9], solvable)


def quadric_rows(x: Float) -> Float:
    """Return [phi(x), 1], shape (..., J, 11), for normalised readings x, shape (..., J, 3).

    Written column by column into memory of shape (..., 11, J): products of contiguous columns.
    """
    h = np.ascontiguousarray(x.swapaxes(-1, -2))
    out = np.empty((*x.shape[:-2], 11, x.shape[-2]))
    for k in range(3):
        np.multiply(h[..., k, :], h[..., k, :], out=out[..., k, :])
        np.multiply(h[..., k, :], 2.0, out=out[..., 6 + k, :])
    for k, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        np.multiply(out[..., 6 + i, :], h[..., j, :], out=out[..., 3 + k, :])
    out[..., 9:, :] = 1.0
    return out.swapaxes(-1, -2)


def compress(
    blocks: Iterable[tuple[Float, Float | None]], centre: Float, scale: Float, poses: Int
) -> Triangle:
    """Compress the readings of R sensors, block by block.

    Args:
        blocks: pairs of readings, shape (R, B, 3) in output units, and their weights, shape (R, B), or None; a weight
            of 0 leaves a reading out.
        centre: c, shape (R, 3); scale: s, shape (R,). Any values serve; near the middle and the radius of the readings
            they keep the arithmetic free of cancellation.
        poses: J of each sensor, shape (R,).
    """
    R: Float | None = None
    for block, weight in blocks:
        table = quadric_rows((block - centre[:, None]) / scale[:, None, None])
        if weight is not None:
            table *= np.sqrt(weight)[..., None]
        if R is None and table.shape[1] < 11:
            R = np.zeros((len(scale), 11, 11))
        table = _pieces(table)
        R = _triangle(table if R is None else np.concatenate([R, table], axis=1))
    assert R is not None
    return Triangle(R, centre, scale, poses)


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


def compress_each(readings: Float, weights: Float | None = None) -> Triangle:
    """Compress the readings of R sensors, shape (R, J, 3), with weights, shape (R, J), or None, all at once."""
    low, high = readings.min(axis=1), readings.max(axis=1)
    centre, scale = 0.5 * (low + high), 0.5 * (high - low).max(axis=1)
    return compress([(readings, weights)], centre, scale, np.full(len(readings), readings.shape[1]))


def _pieces(table: Float) -> Float:
    """Return rows with the same R as `table`, shape (R, J, 11), fewer by a factor PIECE / 11 where there are many."""
    whole = table.shape[1] // PIECE * PIECE
    if whole <= PIECE:
        return table
    small = _triangle(table[:, :whole].reshape(-1, PIECE, 11)).reshape(len(table), -1, 11)
    return np.concatenate([_pieces(small), table[:, whole:]], axis=1)


def _triangle(table: Float) -> Float:
    """Return R of the QR of (..., rows >= 11, 11), shape (..., 11, 11)."""
    R: Float = np.linalg.qr(table, mode="r")  # type: ignore[assignment]  # numpy types mode "r" as "reduced"
    return R


LARGEST_CONDITION = 4.0
"""No accelerometer's axes differ by this factor once each has unit extent, or stand as oblique: beyond it the fit
describes the noise, not the sensor."""

FILLED = 1.5
"""Largest factor between the extent of an axis and that of the ellipsoid fitted to it, where axes differ by more than
LARGEST_CONDITION: readings all over the ellipsoid have as much of it in every axis."""

SURELY_FILLED = 0.1
"""Largest standard deviation of the squared extents of such an ellipsoid, as a part of them: noise in an axis that does
not answer fits ellipsoids as flat as it likes, and none so surely."""

MOST_UNLIKE = 2000.0
"""Largest factor between the extents of two axes: g beside mg is 1000, and beyond that a column is no axis."""

LEAST_SPREAD = 0.25
"""Least eigenvalue of the correlation of such readings: 1 for a sphere all over, 0 where they lie in a plane."""

SMALLEST_PIVOT = 1e-9
"""A pivot of the triangle below this part of the largest means a direction the poses say nothing of."""

ROUNDS = 3
"""Rounds towards the least cost: noise of 1e-3 g leaves a part of 1e-6 in each."""


def fit_ellipsoid(triangle: Triangle) -> tuple[Float, Float]:
    """Return K g / s in gauge `lower`, shape (R, 3, 3), and (D - c) / s, shape (R, 3).

    NaN for a sensor whose readings do not determine an ellipsoid: fewer than nine poses, poses on a common other
    quadric, or noise that makes the fitted quadric no ellipsoid. Where the axes of the ellipsoid differ too much to be
    those of a sensor, it is fitted anew with every axis brought to unit extent.
    """
    K, centre = _ellipsoid(triangle.nearest)
    refused = np.flatnonzero(np.isnan(K[:, 0, 0]))
    if len(refused):
        K[refused], centre[refused] = _of_unit_extent(triangle.take(refused))
    return K, centre


def _of_unit_extent(triangle: Triangle) -> tuple[Float, Float]:
    """Return what `fit_ellipsoid` does where the axes are of very different scale, NaN elsewhere."""
    covariance = _moments(triangle)
    variance = np.einsum("rii->ri", covariance)
    usable = (variance > 0).all(axis=1) & (triangle.poses > 9)
    extent = np.sqrt(3.0 * np.where(usable[:, None], variance, 1.0))  # of a sphere all over
    usable &= extent.max(axis=1) < MOST_UNLIKE * extent.min(axis=1)
    correlation = 3.0 * covariance / (extent[:, :, None] * extent[:, None, :])
    usable &= np.linalg.eigvalsh(np.where(usable[:, None, None], correlation, 0.0))[:, 0] > LEAST_SPREAD
    factor = quadric_rows(1.0 / extent[:, None])[:, 0, :9]
    factor[:, 3:] *= 0.5  # the rows hold 2 x_i x_j and 2 x_i
    R = triangle.R.copy()
    R[..., :9] *= factor[:, None]
    nearest = Nearest.of(R)
    K, centre = _ellipsoid(nearest)
    size = np.sqrt(np.sum(K**2, axis=2))
    with np.errstate(invalid="ignore"):
        usable &= (size.max(axis=1) < FILLED) & (size.min(axis=1) > 1.0 / FILLED)
        usable &= _uncertain(nearest, triangle.poses) < SURELY_FILLED
    return (
        np.where(usable[:, None, None], K * extent[:, :, None], np.nan),
        np.where(usable[:, None], centre * extent, np.nan),
    )


def _moments(triangle: Triangle) -> Float:
    """Return the covariance of the normalised readings, shape (R, 3, 3): products of the columns of the triangle."""
    sums = np.einsum("rki,rk->ri", triangle.R[..., :9], triangle.R[..., 9])
    sums /= np.sum(triangle.R[..., 9] ** 2, axis=1)[:, None]
    sums[:, 3:] *= 0.5
    mean = sums[:, 6:]
    return np.asarray(_matrix(sums) - mean[:, :, None] * mean[:, None, :])


def _traced(nearest: Nearest) -> tuple[Float, Float]:
    """Return the quadrics y of least F / trace(A)^2, shape (R, 9), and T^-1 T^-T times the gradient of the trace.

    That is the least algebraic residual with trace(A) = 3: y = T^-1 (t + rho^2 / trace(A_t) T^-T (1 1 1 0 ...)), A_t of
    the quadric nearest to t.
    """
    gradient = _times(nearest.inverse, np.sum(nearest.inverse[:, :3], axis=1))
    trace = np.sum(nearest.y[:, :3], axis=1)
    return nearest.y + (nearest.rho**2 / trace)[:, None] * gradient, gradient


def _ellipsoid(nearest: Nearest) -> tuple[Float, Float]:
    """Return K in gauge `lower`, shape (R, 3, 3), and centres, shape (R, 3), by `_traced`; NaN for no ellipsoid."""
    with np.errstate(all="ignore"):
        y, _ = _traced(nearest)
        K, centre, condition = _sensors(y, nearest.solvable)
        refused = np.flatnonzero(~(condition < LARGEST_CONDITION**2))  # a bound: most need no eigenvalues
        values = np.linalg.eigvalsh(np.nan_to_num(_matrix(y[refused]), posinf=0.0, neginf=0.0))
        refused = refused[~((values[:, 0] > 0) & (values[:, 2] < LARGEST_CONDITION**2 * values[:, 0]))]
    K[refused], centre[refused] = np.nan, np.nan
    return K, centre


def _uncertain(nearest: Nearest, poses: Int) -> Float:
    """Return how uncertain the diagonal of A is, as a part of it, shape (R,)."""
    with np.errstate(all="ignore"):
        y, gradient = _traced(nearest)
        part = (nearest.rho / nearest.y[:, :3].sum(axis=1)) ** 2 * gradient[:, :3].sum(axis=1)
        square = nearest.rho**2 * (1.0 + part)
        # Of y over its trace: what T^-1 does to the errors of the rows, less what the trace takes of it.
        errors, share = nearest.inverse[:, :3], y[:, :3] / y[:, :3].sum(axis=1, keepdims=True)
        errors = errors - share[..., None] * errors.sum(axis=1, keepdims=True)
        own = np.sqrt((square / np.maximum(poses - 9, 1))[:, None] * np.sum(errors**2, axis=2))
        return np.asarray(np.max(own / np.abs(y[:, :3]), axis=1))


def least_squares(triangle: Triangle) -> tuple[Float, Float]:
    """Return K g / s in gauge `lower`, shape (R, 3, 3), and (D - c) / s, shape (R, 3), at the least cost.

    The rows' last two columns are both ones. With y the quadric x^T A x + 2 m^T x = 1 (A as it comes, not scaled to
    the trace) the cost is L = F / (1 + e)^2, F = |T y - t|^2 + rho^2 and e = m^T A^-1 m, where T, t and rho are
    the triangle's first nine columns, the tenth above its diagonal, and its diagonal there. Where its gradient
    vanishes,

        y = T^-1 t - F / (1 + e) (T^T T)^-1 phi(d),   d = -A^-1 m,

    phi(d) the row of a reading at the centre d. F is the noise squared, so each round gains as many digits. NaN for
    a sensor whose readings determine no ellipsoid; after much noise the rounds end before the last digits.
    """
    nearest = triangle.nearest
    inverse, y = nearest.inverse, nearest.y
    F = nearest.rho**2
    with np.errstate(all="ignore"):
        for _ in range(ROUNDS):
            d, e = _centre(y)
            back = (
                _times(inverse.swapaxes(1, 2), quadric_rows(d[:, None])[:, 0, :9]) * (F / (1.0 + e))[:, None]
            )
            # T y - t is -back: the next F.
            y, F = nearest.y - _times(inverse, back), nearest.rho**2 + np.sum(back * back, axis=1)
        K, d, condition = _sensors(y, nearest.solvable)
    lost = ~(condition < 1.0 / SMALLEST_PIVOT)
    K[lost], d[lost] = np.nan, np.nan
    return K, d


def _times(matrix: Float, vector: Float) -> Float:
    product: Float = (matrix @ vector[..., None])[..., 0]
    return product


def _matrix(y: Float) -> Float:
    """Return A, shape (R, 3, 3), of the quadrics y, shape (R, 9)."""
    return y.take([0, 3, 4, 3, 1, 5, 4, 5, 2], axis=1).reshape(-1, 3, 3)


def _centre(y: Float) -> tuple[Float, Float]:
    """Return d = -A^-1 m, shape (R, 3), and m^T A^-1 m, shape (R,): a singular A gives inf or NaN."""
    d: Float = -_times(inverse(_matrix(y)), y[:, 6:])
    return d, -np.sum(y[:, 6:] * d, axis=1)


def _sensors(y: Float, solvable: Bool) -> tuple[Float, Float, Float]:
    """Return K in gauge `lower`, shape (R, 3, 3), and centres, shape (R, 3), of quadrics; NaN for those without.

    And a bound on the condition of A, trace(A) trace(A^-1), shape (R,).
    """
    A = _matrix(y)
    d, e = _centre(y)
    shape = inverse(A)
    condition = np.einsum("rii->r", A) * np.einsum("rii->r", shape)
    K = _root(shape * (1.0 + e)[:, None, None])
    sound = solvable & np.isfinite(d).all(axis=1) & np.isfinite(K).all(axis=(1, 2))
    K[~sound], d[~sound], condition[~sound] = np.nan, np.nan, np.nan
    return K, d, condition


def _root(S: Float) -> Float:
    """Return the Cholesky factors of symmetric matrices, shape (R, 3, 3); NaN where they are not positive definite."""
    L = np.zeros(S.shape)
    for j in range(3):
        column = S[:, j:, j] - np.sum(L[:, j:, :j] * L[:, j : j + 1, :j], axis=2)
        L[:, j:, j] = column / np.sqrt(column[:, :1])
    return L
