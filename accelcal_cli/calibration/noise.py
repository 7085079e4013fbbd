"""The noise of poses: what the scatter within them tells, and what noise does to the parameters.

The mean of n_j readings of pose j has the variance v_j = u^T S_j u / n_j along the force u, with the covariance S_j of
one reading. S_j of few readings is uncertain: the ratio of its part along the force to that of the covariance pooled
over the poses is drawn towards 1, as far as the poses are alike beyond chance [smyth2004].

A hand that trembles by theta rad rms about two axes shortens the mean of a pose by g theta^2, and widens the scatter
across the force by g^2 theta^2, not that along it. The difference gives the length back.

Without more knowledge every pose has the same noise, known from the residuals, and the covariance of the parameters is
s^2 (A^T W A)^-1.

- Scatter within the poses says how the noise differs between them: pose j has the variance m^2 + v_j, v_j by its
  scatter and m^2, the same for all, what the residuals leave beyond that. The covariance is then C A^T W V W A C, its
  degrees of freedom are those of s^2 [satterthwaite1946].
- Rows that follow each other are not independent: their residuals are summed over attitudes or blocks of time, and the
  covariance rests on how these sums scatter (CR2, with the degrees of freedom of [bell2002]).

Squaring noisy readings biases the fit: the noise n of a pose adds |n|^2 to |f|^2 and turns its row of the design.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import f_chance, student_quantile
from accelcal_cli.calibration.observability import ROWS_COLUMNS, design, unit
from accelcal_cli.calibration.sample import NO_NOISE, Sample
from accelcal_cli.schema import frozen

COVERAGE = 0.95
"""Part of the intervals that hold the true value."""

FEWEST_ALIKE = 4
"""Poses with scatter from which on it can be told how alike they are; fewer are taken as alike."""

SMALLEST_RATIO = 0.01
"""Least ratio of a pose's variance to the pooled one that is believed: quantised readings may not scatter at all."""

MOST_PRIOR = 1e6
"""Degrees of freedom of the pooled covariance in a pose from which on the poses are alike."""

MOST_TREMOR = 0.3
"""Tremor, rad rms, beyond which a sensor is turned rather than held."""

LEAST_SHORTENING = 0.05
"""Shortening of the mean of a pose, in parts of its noise, that matters among nine poses; among more, less does."""

SURELY_TREMBLES = 4.0
"""Standard deviations of the tangential excess beyond which a hand trembles: by chance 1 in 30 000."""


@frozen(eq=False)
class PoseNoise:
    """The noise of the poses of R sensors, by the scatter of their readings.

    Attributes:
        variance: v_j of the mean of each pose along the force, (m/s^2)^2, shape (R, J); 0 for repetitions.
        covariance: of the mean of each pose as specific force, (m/s^2)^2, shape (R, J, 3, 3).
        own: variance of a pose's own, from how many degrees of freedom, shape (R, J): n_j - 1.
        prior: degrees of freedom that the pooled covariance has in each pose, shape (R,).
        known: which sensors have scatter in every pose that tells something, shape (R,).
    """

    variance: Float
    covariance: Float
    own: Float
    prior: Float
    known: Bool

    def freedom(self, share: Float) -> Float:
        """Return the degrees of freedom of a weighted sum of the variances, shape (R,); shares of shape (R, J)."""
        part = share * self.variance
        own = self.own / (self.own + self.prior[:, None])
        total = np.maximum(self.own.sum(axis=1), 1.0)
        spread = np.sum((part * own) ** 2 / np.maximum(self.own, 1.0), axis=1)
        spread = spread + np.sum(part * (1.0 - own), axis=1) ** 2 / total
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.sum(part, axis=1) ** 2 / spread)


def pose_noise(
    sample: Sample, K: Float, D: Float, g: float, shakes: Tremor | None = None
) -> PoseNoise | None:
    """Return the noise of poses whose readings scatter, seen with sensors K, shape (R, 3, 3), and D, shape (R, 3).

    None where no reading tells its scatter. What trembling adds across the force is no noise of the length, and a
    scatter below NO_NOISE of g, m/s^2, is rounding.
    """
    if sample.scatter is None or sample.count is None:
        return None
    (S, own), real = _covariances(sample, K), sample.real(0, sample.scatter.shape[1])
    u = directions(sample, K, D)
    if shakes is not None:
        # Noise alike in all directions is left, and where the axes alone are known not even that is certain.
        along = np.einsum("rja,rjab,rjb->rj", u, S, u)
        S = np.where(shakes.sure[:, None, None, None], along[..., None, None] * np.eye(3), S)
    total = np.maximum(own.sum(axis=1), 1.0)
    pooled = np.einsum("rj,rjab->rab", own, S) / total[:, None, None]
    along, expected = np.einsum("rja,rjab,rjb->rj", u, S, u), np.einsum("rja,rab,rjb->rj", u, pooled, u)
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where((own > 0) & (expected > 0), along / expected, 1.0)
    prior, middle = (part[:, None] for part in _prior(np.maximum(ratio, SMALLEST_RATIO), own))
    weight = (prior * middle + own * ratio) / (prior + own)
    count = np.where(real & np.isfinite(sample.count), sample.count, 1.0)
    scale = np.where(real, weight / count, 0.0)
    known: Bool = np.asarray((np.isfinite(sample.count) | ~real).all(axis=1) & (own.sum(axis=1) > 0))
    if shakes is not None:
        known &= _crossed(sample) | ~shakes.sure
    known &= (expected * scale).max(axis=1) > (NO_NOISE * g) ** 2
    return PoseNoise(expected * scale, pooled[:, None] * scale[..., None, None], own, prior[:, 0], known)


def _covariances(sample: Sample, K: Float) -> tuple[Float, Float]:
    """Return the covariance of one reading of each pose as force, shape (R, J, 3, 3), and its degrees of freedom."""
    scatter, own = _scatter(sample)
    S = np.zeros((*scatter.shape, 3))
    S[..., [0, 1, 2], [0, 1, 2]] = scatter**2
    if sample.cross is not None:
        cross = np.where((own > 0)[..., None], np.nan_to_num(sample.cross), 0.0)
        S[..., [0, 0, 1], [1, 2, 2]] = S[..., [1, 2, 2], [0, 0, 1]] = cross
    K_A = np.linalg.inv(K)[:, None]
    return K_A @ S @ K_A.swapaxes(2, 3), own


def _scatter(sample: Sample) -> tuple[Float, Float]:
    """Return standard deviations of one reading, 0 where not known, and their degrees of freedom, (R, J, 3), (R, J)."""
    assert sample.scatter is not None
    assert sample.count is not None
    told = sample.real(0, sample.scatter.shape[1]) & np.isfinite(sample.scatter).all(axis=2)
    own = np.where(told, np.maximum(np.nan_to_num(sample.count) - 1.0, 0.0), 0.0)
    return np.where((own > 0)[..., None], sample.scatter, 0.0), own


def _crossed(sample: Sample) -> Bool:
    """Return which sensors have covariances between the axes, and not their standard deviations alone, shape (R,)."""
    if sample.cross is None:
        return np.zeros(len(sample), dtype=bool)
    return np.asarray(~np.isnan(sample.cross).all(axis=(1, 2)))


def directions(sample: Sample, K: Float, D: Float) -> Float:
    """Return the unit directions of the specific force, shape (R, J, 3), by sensors K and D."""
    return unit(np.concatenate([f for _, _, f in sample.errors(K, D, 1.0)], axis=1))


def _prior(ratio: Float, own: Float) -> tuple[Float, Float]:
    """Return how many degrees of freedom the usual variance has in each pose, and its ratio to the pooled one, (R,).

    [smyth2004] section 6.2: the logarithm of a variance with n degrees of freedom scatters by psi'(n / 2); what it
    scatters beyond that is psi'(prior / 2).
    """
    told = own > 0
    half = np.where(told, 0.5 * own, 1.0)
    centred = np.where(told, np.log(ratio) - _digamma(half) + np.log(half), 0.0)
    poses = np.maximum(told.sum(axis=1), 1)
    middle = centred.sum(axis=1) / poses
    centred = np.where(told, centred - middle[:, None], 0.0)
    excess = np.sum(centred**2, axis=1) / np.maximum(poses - 1, 1)
    excess = excess - np.sum(np.where(told, _trigamma(half), 0.0), axis=1) / poses
    alike = (excess <= 0) | (poses < FEWEST_ALIKE)
    prior = 2.0 * _inverse_trigamma(np.where(alike, 1.0, excess))
    prior = np.where(alike, MOST_PRIOR, np.minimum(prior, MOST_PRIOR))
    middle = np.exp(middle + _digamma(0.5 * prior) - np.log(0.5 * prior))
    return prior, np.where(alike, 1.0, middle)


def _digamma(x: Float) -> Float:
    """Return psi(x) for x > 0, same shape: raised to x >= 6, then the asymptotic series [abramowitz1964] eq. 6.3.18."""
    total = np.zeros_like(x)
    for _ in range(6):
        total, x = np.where(x < 6, total - 1.0 / x, total), np.where(x < 6, x + 1.0, x)
    y = 1.0 / (x * x)
    return np.asarray(total + np.log(x) - 0.5 / x - y * (1 / 12 - y * (1 / 120 - y / 252)))


def _trigamma(x: Float) -> Float:
    """Return psi'(x) for x > 0, same shape: raised to x >= 6, then the series of [abramowitz1964] eq. 6.4.12."""
    total = np.zeros_like(x)
    for _ in range(6):
        total, x = np.where(x < 6, total + 1.0 / (x * x), total), np.where(x < 6, x + 1.0, x)
    y = 1.0 / (x * x)
    return np.asarray(total + 1.0 / x + 0.5 * y + y / x * (1 / 6 - y * (1 / 30 - y / 42)))


def _inverse_trigamma(value: Float) -> Float:
    """Return x with psi'(x) = value > 0, same shape: Newton on 1 / psi', which is nearly straight."""
    x = 0.5 + 1.0 / value
    for _ in range(12):
        here = _trigamma(x)
        slope = (_trigamma(x * 1.0001) - here) / (0.0001 * x)
        x = np.maximum(x + here * (1.0 - here / value) / slope, 1e-6)
    return np.asarray(x)


def alike_weights(sample: Sample) -> Float:
    """Return weights of the means of poses by the scatter of all axes together, mean 1, shape (R, J).

    Each axis is measured by its own variance over all poses, so that a noisy axis does not decide.
    """
    assert sample.count is not None
    scatter, own = _scatter(sample)
    square = scatter**2
    pooled = np.einsum("rj,rja->ra", own, square) / np.maximum(own.sum(axis=1), 1.0)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(own > 0, np.nanmean(square / pooled[:, None], axis=2), 1.0)
    prior, middle = (part[:, None] for part in _prior(np.maximum(ratio, SMALLEST_RATIO), 3.0 * own))
    return sample.normalised(sample.count * (prior + 3.0 * own) / (prior * middle + 3.0 * own * ratio))


@frozen(eq=False)
class Tremor:
    """What trembling takes off the mean of each pose.

    Attributes:
        excess: g^2 theta^2 of each pose, (m/s^2)^2, shape (R, J): variance across the force beyond that along it.
        angle: theta, rms about each of two axes, rad, shape (R,).
        certainty: standard deviations that the excess is above none, shape (R,).
        doubt: what may remain of the shortening, the same in all poses, m/s^2, shape (R,).
    """

    excess: Float
    angle: Float
    certainty: Float
    doubt: Float

    @property
    def sure(self) -> Bool:
        """Which sensors tremble beyond chance, shape (R,)."""
        return np.asarray(self.certainty > SURELY_TREMBLES)


def tremor(sample: Sample, K: Float, D: Float, g: float) -> Tremor | None:
    """Return what trembling takes off the poses of sensors K, D; None where no reading tells.

    The covariance of a pose is that of the sensor, the same in all poses, and tau (I - u u^T) of a hand that trembles.
    Regression over the poses says whether there is such a tau. What a pose has of it is the variance across its force
    beyond that along it; where only the standard deviations of the axes are known, all beyond that of the sensor.
    """
    if sample.scatter is None or sample.count is None:
        return None
    S, own = _covariances(sample, K)
    u, whole = directions(sample, K, D), _crossed(sample)
    across = np.eye(3) - u[..., :, None] * u[..., None, :]
    entries = np.where(whole[:, None, None, None], np.ones((3, 3)), np.eye(3))
    total = np.maximum(own.sum(axis=1), 1.0)
    middle_S = np.einsum("rj,rjab->rab", own, S) / total[:, None, None]
    middle = np.einsum("rj,rjab->rab", own, across) / total[:, None, None]
    moved = (across - middle[:, None]) * entries
    square = np.einsum("rj,rjab,rjab->r", own, moved, moved)
    size = np.einsum("raa->r", middle_S) / 3.0
    with np.errstate(divide="ignore", invalid="ignore"):
        tau = np.einsum("rj,rjab,rjab->r", own, S - middle_S[:, None], moved) / square
        # A covariance of n degrees of freedom has entries with a variance of about 2 size^2 / n.
        certainty = np.where(size > 0, tau * np.sqrt(square) / (np.sqrt(2.0) * size), 0.0)
    trace, along = np.einsum("rjaa->rj", S), np.einsum("rja,rjab,rjb->rj", u, S, u)
    sensor = np.einsum("raa->r", middle_S) - tau * np.einsum("raa->r", middle)
    excess = np.where(whole[:, None], 0.5 * (trace - along) - along, 0.5 * (trace - sensor[:, None]))
    # Along the force a tilt adds to the variance in the second order, of a Gaussian tremor by excess^2 / g^2.
    second = np.where(own > 0, excess, 0.0) ** 2 / (g * g)
    excess = np.where(whole[:, None], excess + 1.5 * second, excess)
    # Of these readings, not of all that might have been.
    excess = np.where(own > 0, excess * own / (own + 1.0), 0.0)
    angle = np.sqrt(np.maximum(tau, 0.0)) / g
    # Where it shortens no pose by more than a small part of what noise does, there is nothing to give back.
    count = np.maximum(np.nan_to_num(sample.count), 1.0)
    least = LEAST_SHORTENING * np.sqrt(9.0 / sample.poses)[:, None] * np.sqrt(along / count)
    certainty = np.where((excess / g > least).any(axis=1), certainty, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        doubt = np.where(whole | (square <= 0), 0.0, np.sqrt(2.0) * size / np.sqrt(square) / g)
        doubt = doubt + np.einsum("rj,rj->r", own, second) / total / g
    return Tremor(excess, angle, np.nan_to_num(certainty), doubt)


FEWEST_ROWS = 40
"""Rows from which on it can be told that they follow each other."""

SURELY_CORRELATED, LEAST_CORRELATION = 4.0, 0.1
"""Standard deviations of the lag-1 autocorrelation of independent residuals beyond which they are not (1 in 30 000),
and the least autocorrelation that matters: it widens an interval by a tenth."""

JUMP = 5.0
"""Degrees between two rows from which on the second is another attitude."""

MOST_CLUSTERS, FEWEST_CLUSTERS = 2048, 16
"""Clusters that are held, and the fewest that adjacent ones are merged into."""

FEWEST_IN_TIME = 8
"""The fewest that those of poses in time are merged into."""

BARTLETT = 0.5
"""Weight of the covariance of neighbours."""

FEWEST_JUMPS = 8
"""Jumps of the attitude from which on what is between them is a pose, and rows of one pose are not independent."""


@frozen(eq=False)
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

    def coverage(self) -> Float:
        """Return the coverage factors of 95 % intervals, Student's t [gum2008], shape (R,); NaN below one of freedom.

        Here a sigma and its degrees of freedom meet: whole or not, they are those of the sigma that is stated.
        """
        freedom = self.freedom.tolist()
        factors = {n: student_quantile(0.5 + 0.5 * COVERAGE, n) for n in set(freedom) if n >= 1}
        return np.array([factors.get(n, np.nan) for n in freedom])

    def by_own(self, own: tuple[float, int], freedom: Float) -> NoiseSpread:
        """Return the same with the noise ratio of a fit of one sensor that no shared error is fitted to.

        Args:
            own: its sum e^2 / v and J - p; freedom: of the variances v, shape (1,).
        """
        square, first = own[0] / own[1], np.array([float(own[1])])
        return replace(
            self,
            ratio=np.array([np.sqrt(square)]),
            p_more=f_chance(np.array([square]), first, freedom),
            p_less=f_chance(np.array([1.0 / square]), freedom, first),
        )


def plain_spread(variance: Float, cofactor: Float, freedom: Float | Int) -> NoiseSpread:
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

    (tr M V)^2 / tr (M V M V) with M = I - H, without a matrix over the poses. It is 1 or more but for rounding.
    """
    B = (rows * (w * v)[..., None]).swapaxes(1, 2) @ rows
    CB = cofactor @ B
    square = np.sum(v * v * (1.0 - 2.0 * leverage), axis=1) + np.einsum("rpq,rqp->r", CB, CB)
    return np.asarray(np.maximum(np.sum(v * (1.0 - leverage), axis=1) ** 2 / np.maximum(square, 1e-300), 1.0))


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
        information: A^T W A of each, shape (C, q, q); score: A^T W e of each, and ones: A^T W 1, shape (C, q).
    """

    length: int
    information: Float = field(default_factory=lambda: np.zeros((0, 0, 0)))
    score: Float = field(default_factory=lambda: np.zeros((0, 0)))
    ones: Float = field(default_factory=lambda: np.zeros((0, 0)))
    _last: Float | None = None
    _open: int = 0

    @classmethod
    def of(cls, rows: int, jumps: int) -> Clusters:
        """Return clusters for so many rows: the attitudes where they jump often enough, else blocks of time."""
        return cls(rows if jumps >= FEWEST_JUMPS else -(-2 * rows // MOST_CLUSTERS))

    def add(self, u: Float, design: Float, scaled: Float, w: Float) -> None:
        """Add rows: unit directions, shape (B, 3), A, shape (B, q), sqrt(w) e and w, shape (B,)."""
        jump = jumps(u, self._last)
        since = np.arange(len(u)) + self._open
        start = np.maximum.accumulate(np.where(jump, since, 0))
        begins = jump | ((since - start) % self.length == 0)
        begins[0] |= self._last is None
        rows, q = design * np.sqrt(w)[:, None], design.shape[1]
        at = np.flatnonzero(begins)
        head = at[0] if len(at) else len(u)
        cuts = np.concatenate([[0] if head else [], at]).astype(np.intp)
        outer = np.add.reduceat((rows[:, :, None] * rows[:, None, :]).reshape(len(u), q * q), cuts, axis=0)
        information = outer.reshape(-1, q, q)
        score = np.add.reduceat(rows * scaled[:, None], cuts, axis=0)
        ones = np.add.reduceat(rows * np.sqrt(w)[:, None], cuts, axis=0)
        if head and len(self.score):
            self.information[-1] += information[0]
            self.score[-1] += score[0]
            self.ones[-1] += ones[0]
            information, score, ones = information[1:], score[1:], ones[1:]
        if self._last is None:
            self.information, self.score, self.ones = information, score, ones
        else:
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

    def spread(self, cofactor: Float, *, in_time: bool) -> tuple[Float, float, int]:
        """Return the covariance of the parameters, shape (q, q), its degrees of freedom, and the number of clusters.

        Neighbours are merged until their sums no longer follow each other; poses `in_time`, whose drift shows in three
        of the parameters alone, until there are few: a drift over many poses is within a cluster then.

        Args:
            cofactor: (A^T W A)^-1, shape (q, q).
        """
        many, fewest = 2 * FEWEST_CLUSTERS, FEWEST_IN_TIME if in_time else FEWEST_CLUSTERS
        while in_time and len(self.score) >= many:
            self._merge()
        while len(self.score) >= 2 * fewest and self._correlated(cofactor):
            self._merge()
        return *_cr2(self, cofactor, in_time=in_time), len(self.score)

    def _correlated(self, cofactor: Float) -> bool:
        """Whether the contributions of neighbours to the estimates go together beyond chance."""
        z = self.score @ cofactor
        z = z / np.maximum(np.sqrt(np.mean(z * z, axis=0)), 1e-300)
        lag = np.mean(np.sum(z[1:] * z[:-1], axis=0) / np.sum(z * z, axis=0))
        return bool(lag * np.sqrt(len(z)) > 1.0)


def _cr2(clusters: Clusters, cofactor: Float, *, in_time: bool) -> tuple[Float, float]:
    """Return the bias-reduced sandwich of clusters and its degrees of freedom [bell2002].

    With H_c the part of the hat matrix of cluster c, A_c^T (I - H_c)^-1/2 e_c = (I - G_c C)^-1/2 A_c^T e_c: everything
    happens in the space of the parameters. The degrees of freedom are those under an error that the rows of a cluster
    share, the mean over the parameters. What clusters of poses `in_time` still share with their neighbours is added
    with the weight of Bartlett [newey1987].
    """
    free = np.flatnonzero(np.diagonal(cofactor) > 0)
    root = np.linalg.cholesky(cofactor[np.ix_(free, free)])
    # In coordinates where C is the identity G_c C is symmetric.
    G = root.T @ clusters.information[:, free[:, None], free] @ root
    values, vectors = np.linalg.eigh(G)
    inverse = (vectors / np.sqrt(np.maximum(1.0 - values, 1e-3))[:, None, :]) @ vectors.swapaxes(1, 2)
    z = (inverse @ (clusters.score[:, free] @ root)[..., None])[..., 0]
    covariance = np.zeros_like(cofactor)
    inner = z.T @ z
    if in_time:
        lagged = BARTLETT * (z[1:].T @ z[:-1])
        inner = inner + lagged + lagged.T
    covariance[np.ix_(free, free)] = root @ inner @ root.T
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
