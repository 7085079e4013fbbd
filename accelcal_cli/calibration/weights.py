"""What the scatter within the poses tells: the noise of each pose, weights, and what a trembling hand takes off it.

The mean of n_j readings of pose j has the variance v_j = u^T S_j u / n_j along the force u, with the covariance S_j of
one reading. S_j of few readings is uncertain: the ratio of its part along the force to that of the covariance pooled
over the poses is drawn towards 1, as far as the poses are alike beyond chance [smyth2004].

A hand that trembles by theta rad rms about two axes shortens the mean of a pose by g theta^2, and widens the scatter
across the force by g^2 theta^2, not that along it. The difference gives the length back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.observability import unit
from accelcal_cli.calibration.sample import Sample

FEWEST_ALIKE = 4
"""Poses with scatter from which on it can be told how alike they are; fewer are taken as alike."""

SMALLEST_RATIO = 0.01
"""Least ratio of a pose's variance to the pooled one that is believed: quantised readings may not scatter at all."""

MOST_PRIOR = 1e6
"""Degrees of freedom of the pooled covariance in a pose from which on the poses are alike."""

MOST_TREMOR = 0.3
"""Tremor, rad rms, beyond which a sensor is turned rather than held."""

SURELY_TREMBLES = 4.0
"""Standard deviations of the tangential excess beyond which a hand trembles: by chance 1 in 30 000."""


@dataclass(frozen=True, eq=False)
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


def pose_noise(sample: Sample, K: Float, D: Float, shakes: Tremor | None = None) -> PoseNoise | None:
    """Return the noise of poses whose readings scatter, seen with sensors K, shape (R, 3, 3), and D, shape (R, 3).

    None where no reading tells its scatter. What trembling adds across the force is no noise of the length.
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
    f = (sample.output() - D[:, None]) @ np.linalg.inv(K).swapaxes(1, 2)
    return unit(f)


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


@dataclass(frozen=True, eq=False)
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
    with np.errstate(divide="ignore", invalid="ignore"):
        doubt = np.where(whole | (square <= 0), 0.0, np.sqrt(2.0) * size / np.sqrt(square) / g)
        doubt = doubt + np.einsum("rj,rj->r", own, second) / total / g
    return Tremor(excess, angle, np.nan_to_num(certainty), doubt)
