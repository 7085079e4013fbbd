"""The calibration problem: Loetters' modulus observation as a least-squares cost over a box.

    L(theta) = sum_j (g^2 - |f_j|^2)^2,   f_j = K_a^-1 (N_j - D_a)          [dpso2014] eq. 15

Everything is done in normalised coordinates x = (N - c) / s and in units of g, where |f| / g = |A (x - d)|
with A = (K_a g / s)^-1 and d = (D_a - c) / s. There |f|^2 / g^2 = h^T Q h with h = (x, 1) and Q = M^T M,
M = [A | -A d]: the residual is linear in the 10 entries of Q, so one QR of the readings' rows leaves an 11 x 11
triangle that holds the cost of 12 readings or of 12 million exactly (calibration.compress).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.compress import PAIRS, Triangle
from accelcal_cli.calibration.ellipsoid import fit_ellipsoid
from accelcal_cli.problem import Problem
from accelcal_cli.streams import Float, Int

ROWS_COLUMNS = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1), (0, 1), (0, 2), (1, 2))
"""Which K_ij each unknown is: diagonal, below it, above it (the last three in gauge `full` alone)."""


def pack(K: Float, D: Float, unknowns: int) -> Float:
    """Return the unknowns, shape (..., 9 or 12), of K, shape (..., 3, 3), and D, shape (..., 3)."""
    rows, columns = zip(*ROWS_COLUMNS[: unknowns - 3], strict=True)
    return np.concatenate([K[..., rows, columns], D], axis=-1)


def unpack(theta: Float) -> tuple[Float, Float]:
    """Return K, shape (..., 3, 3), and D, shape (..., 3), of the unknowns, shape (..., 9 or 12)."""
    K = np.zeros((*theta.shape[:-1], 3, 3))
    rows, columns = zip(*ROWS_COLUMNS[: theta.shape[-1] - 3], strict=True)
    K[..., rows, columns] = theta[..., :-3]
    return K, theta[..., -3:]


@dataclass(frozen=True)
class Box:
    """The search box in the units of the readings.

    Attributes:
        centre: nominal unknowns (K_11 K_22 K_33 K_21 K_31 K_32 [K_12 K_13 K_23] D_1 D_2 D_3), shape (R, D).
        half: half-widths, same shape.
    """

    centre: Float
    half: Float


class Loetters(Problem):
    """The cost of one sensor, or of R sensors at once, over u in [-1, 1]^D.

    Args:
        triangle: compressed readings, with leading axis R when the runs are different sensors.
        g: local gravity, m/s^2.
        box: centre and half-widths; D = 9 (lower-triangular K_a) or 12 (full).
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
        self._R, self._t = triangle.R[..., :10], triangle.R[..., 10:]

    @property
    def units(self) -> Float:
        """How much of each unknown's own unit one unit of u is, shape (R, D): the half-widths of the box."""
        return self.box.half

    def cost(self, x: Float) -> Float:
        """Return L in (m/s^2)^4, shape (R, P)."""
        r = self._R @ self._quadratic(x)
        r -= self._t
        r *= r
        cost: Float = np.add.reduce(r, axis=1) * self.g**4
        return cost

    def residuals(self, x: Float) -> Float:
        """Return the 11 compressed residuals in (m/s^2)^2, shape (R, P, 11)."""
        r: Float = (self._R @ self._quadratic(x) - self._t) * self.g**2
        return r.transpose(0, 2, 1)

    def jacobian(self, x: Float) -> Float:
        """Return d residual / d u in (m/s^2)^2, shape (R, P, 11, D).

        From dA = -A dK A and dM = [dA | -dA d - A dd], column by column.
        """
        K, d = unpack(self._centre[:, None] + self._half[:, None] * x)
        A = np.linalg.inv(K)
        M = np.concatenate([A, -(A @ d[..., None])], axis=-1)  # dM for dK_ij is -A e_i (row j of M)
        columns = []
        for i, j in ROWS_COLUMNS[: self.unknowns - 3]:
            columns.append(_quadratic_change(M, -A[..., :, i, None] * M[..., j, None, :]))
        for i in range(3):
            change = np.zeros_like(M)
            change[..., 3] = -A[..., :, i]
            columns.append(_quadratic_change(M, change))
        q = np.stack(columns, axis=-1) * self._half[:, None, None]
        jacobian: Float = (self._R[:, None] @ q) * self.g**2
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
        J, r = self.jacobian(x) / self.g**2, self.residuals(x) / self.g**2
        K, d = unpack(self._centre[:, None] + self._half[:, None] * x)
        A = np.linalg.inv(K)
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
        return gradient * self.g**4, hessian * self.g**4

    def closed_form(self) -> Float:
        """Return the ellipsoid fit in box coordinates, shape (R, D); NaN where the readings fix no ellipsoid."""
        K, d = fit_ellipsoid(self.triangle)
        return (pack(K, d, self.unknowns) - self._centre) / self._half

    def take(self, index: Int) -> Loetters:
        """Return the problem of the sensors at `index`; itself when all runs share one sensor."""
        if len(self.triangle.scale) == 1:
            return self
        return Loetters(self.triangle.take(index), self.g, Box(self.box.centre[index], self.box.half[index]))

    def parameters(self, x: Float) -> tuple[Float, Float]:
        """Return K_a, shape (R, 3, 3), and D_a, shape (R, 3), in the readings' units at x, shape (R, D)."""
        return unpack(self.box.centre + self.box.half * x)

    def coordinates(self, K: Float, D: Float) -> Float:
        """Return the point of the box, shape (R, D), at K_a, shape (R, 3, 3), and D_a, shape (R, 3)."""
        return (pack(K, D, self.unknowns) - self.box.centre) / self.box.half

    def _quadratic(self, x: Float) -> Float:
        """Return the ten entries of Q = M^T M, shape (R, 10, P), at x, shape (R, P, D)."""
        theta = self._centre[:, :, None] + self._half[:, :, None] * x.transpose(0, 2, 1)
        M = (_rows_lower if self.unknowns == 9 else _rows_full)(theta)
        first, second = PAIRS
        products = M.take(first, axis=1)
        products *= M.take(second, axis=1)
        q: Float = np.add.reduce(products, axis=2)
        return q


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


def _rows_lower(theta: Float) -> Float:
    """Return M^T, shape (R, 4, 3, P), for lower-triangular K by forward substitution."""
    k21, k31, k32 = theta[:, 3], theta[:, 4], theta[:, 5]
    d1, d2, d3 = theta[:, 6], theta[:, 7], theta[:, 8]
    inverse = 1.0 / theta[:, :3]
    a11, a22, a33 = inverse[:, 0], inverse[:, 1], inverse[:, 2]
    M = np.zeros((len(theta), 4, 3, theta.shape[2]))
    M[:, 0, 0], M[:, 1, 1], M[:, 2, 2] = a11, a22, a33
    a21 = -k21 * a11 * a22
    a32 = -k32 * a22 * a33
    a31 = -(k31 * a11 + k32 * a21) * a33
    M[:, 0, 1], M[:, 0, 2], M[:, 1, 2] = a21, a31, a32
    M[:, 3, 0] = -a11 * d1
    M[:, 3, 1] = -(a21 * d1 + a22 * d2)
    M[:, 3, 2] = -(a31 * d1 + a32 * d2 + a33 * d3)
    return M


def _rows_full(theta: Float) -> Float:
    """Return M^T, shape (R, 4, 3, P), for any K by the adjugate: A's columns are cross products of K's rows."""
    k11, k22, k33, k21, k31, k32, k12, k13, k23 = (theta[:, i] for i in range(9))
    rows = np.stack(
        [np.stack(r, axis=1) for r in ((k11, k12, k13), (k21, k22, k23), (k31, k32, k33))], axis=1
    )
    M = np.empty((len(theta), 4, 3, theta.shape[2]))
    A = M[:, :3].transpose(0, 2, 1, 3)  # A[:, i, j] is entry (i, j); M holds the transpose
    for j in range(3):
        u, v = rows[:, (j + 1) % 3], rows[:, (j + 2) % 3]
        A[:, :, j] = u[:, [1, 2, 0]] * v[:, [2, 0, 1]] - u[:, [2, 0, 1]] * v[:, [1, 2, 0]]
    determinant = np.add.reduce(rows[:, 0] * A[:, :, 0], axis=1)
    M[:, :3] /= determinant[:, None, None]
    M[:, 3] = -np.add.reduce(A * theta[:, None, 9:], axis=2)
    return M
