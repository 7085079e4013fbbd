"""How uncertain the parameters are: the covariance of a fit under what is known of its noise, and the noise bias.

Without more knowledge every pose has the same noise, known from the residuals, and the covariance is s^2 (A^T W A)^-1.

- Scatter within the poses says how the noise differs between them: pose j has the variance m^2 + v_j, v_j by its
  scatter and m^2, the same for all, what the residuals leave beyond that. The covariance is then C A^T W V W A C, its
  degrees of freedom are those of s^2 [satterthwaite1946].
- Rows that follow each other are not independent: their residuals are summed over attitudes or blocks of time, and the
  covariance rests on how these sums scatter (CR2, with the degrees of freedom of [bell2002]).

Squaring noisy readings biases the fit: the noise n of a pose adds |n|^2 to |f|^2 and turns its row of the design.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import f_chance
from accelcal_cli.calibration.observability import ROWS_COLUMNS, design
from accelcal_cli.calibration.weights import PoseNoise

FEWEST_ROWS = 40
"""Rows from which on it can be told that they follow each other."""

SURELY_CORRELATED, LEAST_CORRELATION = 4.0, 0.1
"""Standard deviations of the lag-1 autocorrelation of independent residuals beyond which they are not (1 in 30 000),
and the least autocorrelation that matters: it widens an interval by a tenth."""

JUMP = 5.0
"""Degrees between two rows from which on the second is another attitude."""

MOST_CLUSTERS, FEWEST_CLUSTERS = 2048, 16
"""Clusters that are held, and the fewest that adjacent ones are merged into."""


@dataclass(frozen=True, eq=False)
class NoiseSpread:
    """The noise of a fit and what it does to the parameters, for R sensors.

    Attributes:
        variance: s^2 of weight 1, (m/s^2)^2, shape (R,).
        covariance: of the nine parameters, then of slopes that are fitted beside them, (m/s^2)^2, shape (R, q, q).
        freedom: degrees of freedom of the covariance, shape (R,), 0 where there is none.
        ratio: s over the noise expected from the scatter, NaN where nothing tells, shape (R,).
        p_more, p_less: p-values of so large and of so small a ratio, shape (R,).
        shared: m^2 that poses share beside the noise of their readings, (m/s^2)^2, NaN where nothing tells it, shape
            (R,).
    """

    variance: Float
    covariance: Float
    freedom: Float
    ratio: Float
    p_more: Float
    p_less: Float
    shared: Float


def plain_spread(variance: Float, cofactor: Float, freedom: Int) -> NoiseSpread:
    """Return the spread of poses with the same noise: s^2, shape (R,), and (A^T W A)^-1, shape (R, q, q)."""
    nothing = np.full(len(variance), np.nan)
    covariance = variance[:, None, None] * cofactor
    return NoiseSpread(variance, covariance, np.maximum(freedom, 0).astype(float), *(nothing,) * 4)


def scattered_spread(
    plain: NoiseSpread, rows: Float, w: Float, cofactor: Float, noise: PoseNoise, freedom: Int
) -> NoiseSpread:
    """Return the spread of poses whose noise differs as their scatter says.

    Args:
        plain: as if it were the same.
        rows: the design, shape (R, J, q): of the nine parameters, then of others that do not go together with them.
        w: weights, 0 for repetitions, shape (R, J); cofactor: (A^T W A)^-1, shape (R, q, q).
        noise: of the poses; freedom: J - q, shape (R,).
    """
    leverage = np.minimum(w * np.sum((rows @ cofactor) * rows, axis=2), 1.0)
    room = 1.0 - leverage
    v, total = w * noise.variance, plain.variance * np.maximum(freedom, 1)
    expected = np.sum(v * room, axis=1)
    told = noise.known & (freedom > 0) & (plain.variance > 0) & (expected > 0)
    square = np.where(told, total / np.where(told, expected, 1.0), 1.0)
    denominator = noise.freedom(w * room)
    n1, n2 = (
        np.where(told, np.maximum(n, 1e-3), 1.0)
        for n in (_satterthwaite(v, w, rows, cofactor, leverage), denominator)
    )
    # What the residuals leave beyond the scatter is shared by the poses; what they lack is lacking everywhere.
    shared = np.maximum(total - expected, 0.0) / np.maximum(np.sum(w * room, axis=1), 1e-300)
    V = w * (np.where(told, shared, 0.0)[:, None] + np.minimum(square, 1.0)[:, None] * noise.variance)
    own = np.where(freedom > 0, _satterthwaite(V, w, rows, cofactor, leverage), denominator)
    usable = told | (noise.known & (freedom == 0))
    mean = np.sum(v, axis=1) / np.maximum(np.count_nonzero(w, axis=1), 1)
    return NoiseSpread(
        np.where(usable & (freedom == 0), mean, plain.variance),
        np.where(usable[:, None, None], sandwich(rows, w, V, cofactor), plain.covariance),
        np.where(usable, own, plain.freedom),
        np.where(told, np.sqrt(square), np.nan),
        np.where(told, f_chance(square, n1, n2), np.nan),
        np.where(told, f_chance(1.0 / square, n2, n1), np.nan),
        np.where(told, shared, np.nan),
    )


def sandwich(rows: Float, w: Float, v: Float, cofactor: Float) -> Float:
    """Return the covariance C A^T W V W A C of a fit whose sqrt(w) e have the variances v, shape (R, q, q).

    Args:
        rows: A, shape (R, J, q); w, v: shape (R, J); cofactor: C, shape (R, q, q).
    """
    B = (rows * (w * v)[..., None]).swapaxes(1, 2) @ rows
    return np.asarray(cofactor @ B @ cofactor)


def _satterthwaite(v: Float, w: Float, rows: Float, cofactor: Float, leverage: Float) -> Float:
    """Return the degrees of freedom of sum w e^2 where sqrt(w) e has the variances v, shape (R,) [satterthwaite1946].

    (tr M V)^2 / tr (M V M V) with M = I - H, without a matrix over the poses.
    """
    B = (rows * (w * v)[..., None]).swapaxes(1, 2) @ rows
    CB = cofactor @ B
    square = np.sum(v * v * (1.0 - 2.0 * leverage), axis=1) + np.einsum("rpq,rqp->r", CB, CB)
    return np.asarray(np.sum(v * (1.0 - leverage), axis=1) ** 2 / np.maximum(square, 1e-300))


def noise_bias(u: Float, w: Float, covariance: Float, cofactor: Float, g: float) -> Float:
    """Return what noise adds to the nine parameters, m/s^2, shape (R, 9), to second order.

    With a row a of the design the fit solves sum w a e = 0. Noise n of a pose makes e = -u n - |n|^2 / 2g and turns a,
    whose entries are -u_i u_j and u_k, so that E[a e] = -tr V / 2g a + (u_i (V u)_j + u_j (V u)_i) / g and
    -(V u)_k / g, with the covariance V of n. Noise alike in all directions gives 3.5 (s/g)^2 on each scale factor
    where the directions balance.

    Args:
        u: unit directions, shape (R, J, 3); w: weights, shape (R, J).
        covariance: V, (m/s^2)^2, shape (R, J, 3, 3); cofactor: shape (R, 9, 9); g: m/s^2.
    """
    Vu = (covariance @ u[..., None])[..., 0]
    turned = np.stack(
        [
            *(u[..., i] * Vu[..., j] + u[..., j] * Vu[..., i] for i, j in ROWS_COLUMNS[:6]),
            *(-Vu[..., k] for k in range(3)),
        ],
        axis=-1,
    )
    trace = np.einsum("rjaa->rj", covariance)[..., None]
    expected = (turned - 0.5 * trace * design(u)) / g
    return np.asarray(-np.einsum("rpq,rj,rjq->rp", cofactor, w, expected))


def isotropic_bias(ones: Float, variance: Float, cofactor: Float, g: float) -> Float:
    """Return the bias of noise that is alike in all directions and poses, m/s^2, shape (R, 9).

    Args:
        ones: A^T W 1, shape (R, 9); variance: of one row, (m/s^2)^2, shape (R,); cofactor: shape (R, 9, 9); g: m/s^2.
    """
    factor = np.repeat([3.5, 2.5], [6, 3])
    return np.asarray((variance / g)[:, None] * (cofactor @ (factor * ones)[..., None])[..., 0])


def jumps(u: Float, last: Float | None) -> Bool:
    """Return which rows have another attitude than the one before, shape (B,); `last` came before the first."""
    before = np.concatenate([u[:1] if last is None else last[None], u[:-1]])
    return np.asarray(np.einsum("ja,ja->j", u, before) < np.cos(np.radians(JUMP)))


@dataclass(eq=False)
class Clusters:
    """Sums over the rows of one sensor that belong together, in the order of the rows and in constant memory.

    A cluster ends where the attitude jumps, and after `length` rows; where there are too many, neighbours are merged.

    Attributes:
        length: rows of a cluster at most.
        information: A^T W A of each, shape (C, 9, 9); score: A^T W e of each, and ones: A^T W 1, shape (C, 9).
    """

    length: int
    information: Float = field(default_factory=lambda: np.zeros((0, 9, 9)))
    score: Float = field(default_factory=lambda: np.zeros((0, 9)))
    ones: Float = field(default_factory=lambda: np.zeros((0, 9)))
    _last: Float | None = None
    _open: int = 0

    @classmethod
    def of(cls, rows: int, jumps: int) -> Clusters:
        """Return clusters for so many rows: the attitudes where they jump often enough, else blocks of time."""
        return cls(rows if jumps >= FEWEST_CLUSTERS else -(-2 * rows // MOST_CLUSTERS))

    def add(self, u: Float, scaled: Float, w: Float) -> None:
        """Add rows: unit directions, shape (B, 3), sqrt(w) e and w, shape (B,)."""
        jump = jumps(u, self._last)
        since = np.arange(len(u)) + self._open
        start = np.maximum.accumulate(np.where(jump, since, 0))
        begins = jump | ((since - start) % self.length == 0)
        begins[0] |= self._last is None
        rows = design(u) * np.sqrt(w)[:, None]
        at = np.flatnonzero(begins)
        head = at[0] if len(at) else len(u)
        cuts = np.concatenate([[0] if head else [], at]).astype(np.intp)
        outer = np.add.reduceat((rows[:, :, None] * rows[:, None, :]).reshape(len(u), 81), cuts, axis=0)
        information = outer.reshape(-1, 9, 9)
        score = np.add.reduceat(rows * scaled[:, None], cuts, axis=0)
        ones = np.add.reduceat(rows * np.sqrt(w)[:, None], cuts, axis=0)
        if head and len(self.score):
            self.information[-1] += information[0]
            self.score[-1] += score[0]
            self.ones[-1] += ones[0]
            information, score, ones = information[1:], score[1:], ones[1:]
        self.information = np.concatenate([self.information, information])
        self.score, self.ones = np.concatenate([self.score, score]), np.concatenate([self.ones, ones])
        self._last, self._open = u[-1], int(since[-1] - start[-1]) + 1 if len(at) else self._open + len(u)
        while len(self.score) > MOST_CLUSTERS:
            self._merge()
            self.length *= 2

    def _merge(self) -> None:
        pairs = np.arange(0, len(self.score), 2)
        self.information = np.add.reduceat(self.information, pairs, axis=0)
        self.score, self.ones = (np.add.reduceat(part, pairs, axis=0) for part in (self.score, self.ones))

    def spread(self, cofactor: Float) -> tuple[Float, float, int]:
        """Return the covariance of the parameters, shape (9, 9), its degrees of freedom, and the number of clusters.

        Neighbours are merged until their sums no longer follow each other.

        Args:
            cofactor: (A^T W A)^-1, shape (9, 9).
        """
        while len(self.score) >= 2 * FEWEST_CLUSTERS and self._correlated(cofactor):
            self._merge()
        return *_cr2(self, cofactor), len(self.score)

    def _correlated(self, cofactor: Float) -> bool:
        """Whether the contributions of neighbours to the estimates go together beyond chance."""
        z = self.score @ cofactor
        z = z / np.maximum(np.sqrt(np.mean(z * z, axis=0)), 1e-300)
        lag = np.mean(np.sum(z[1:] * z[:-1], axis=0) / np.sum(z * z, axis=0))
        return bool(lag * np.sqrt(len(z)) > 1.0)


def _cr2(clusters: Clusters, cofactor: Float) -> tuple[Float, float]:
    """Return the bias-reduced sandwich of clusters and its degrees of freedom [bell2002].

    With H_c the part of the hat matrix of cluster c, A_c^T (I - H_c)^-1/2 e_c = (I - G_c C)^-1/2 A_c^T e_c: everything
    happens in the space of the parameters. The degrees of freedom are those under an error that the rows of a cluster
    share, the mean over the parameters.
    """
    free = np.flatnonzero(np.diagonal(cofactor) > 0)
    root = np.linalg.cholesky(cofactor[np.ix_(free, free)])
    # In coordinates where C is the identity G_c C is symmetric.
    G = root.T @ clusters.information[:, free[:, None], free] @ root
    values, vectors = np.linalg.eigh(G)
    inverse = (vectors / np.sqrt(np.maximum(1.0 - values, 1e-3))[:, None, :]) @ vectors.swapaxes(1, 2)
    z = (inverse @ (clusters.score[:, free] @ root)[..., None])[..., 0]
    covariance = np.zeros_like(cofactor)
    covariance[np.ix_(free, free)] = root @ (z.T @ z) @ root.T
    ones, freedoms = clusters.ones[:, free] @ root, []
    for row in root:
        v = inverse @ row  # (C, p)
        felt = -(G @ v[..., None])[..., 0] @ ones.T  # of the error of each cluster in the part of each
        felt[np.diag_indices(len(felt))] += np.sum(ones * v, axis=1)
        B = felt @ felt.T
        freedoms.append(np.trace(B) ** 2 / np.sum(B * B))
    return covariance, float(np.mean(freedoms))


def autocorrelated(lagged: Float, total: Float, rows: Int) -> Bool:
    """Return which sensors have residuals that follow each other beyond chance, shape (R,).

    Args:
        lagged: sum of e_t e_t-1; total: sum of e^2; rows: how many, shape (R,).
    """
    correlation = lagged / np.maximum(total, 1e-300)
    surely = (correlation * np.sqrt(rows) > SURELY_CORRELATED) & (correlation > LEAST_CORRELATION)
    return np.asarray(surely & (rows >= FEWEST_ROWS))
