"""How likely a difference of two estimates is by chance, when both noises are known from few residuals.

Two estimates with covariances a^2 A and b^2 B, their variances estimated as s_a^2 and s_b^2 with n_a and n_b degrees
of freedom. Were the ratio b / a known, the difference d would give

    T^2 / k = d^T (A + (b/a)^2 B)^-1 d / (k s^2) ~ F(k, n_a + n_b),   s^2 pooled from s_a^2 and s_b^2 / (b/a)^2,

Hotelling's test, exactly. The ratio is not known, so the chance is averaged over what the two variances say of it
(Behrens and Fisher's problem). Most comparisons repeat a measurement, and that is the prior: the same noise with
probability `EQUAL`, else a ratio that is spread over a factor of e^SPREAD either way.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.schema import frozen

EQUAL, SPREAD = 0.85, 1.0
"""Unchanged sensors are called changed at the 5 % level in 3.8 to 5.3 % of all cases at equal noise, whatever the two
sets of poses (benchmarks/verify_level.py). With less weight on equal noise 12 poses against 12 fall to 1 %."""

STEPS = np.linspace(-6.0, 6.0, 61)
"""Where ratios are looked at, in standard deviations of the logarithm of the estimated one."""

MOST_TERMS = 2000
"""Degrees of freedom up to which Student's distribution is summed term by term; scipy, slow to load, takes the rest."""


@frozen()
class Noise:
    """Variance of one pose's residual, (m/s^2)^2, and the degrees of freedom behind it, whole or not (0: not known)."""

    variance: float
    freedom: float


@frozen(eq=False)
class Pair:
    """Two noises, and what they say of each other: squares of ratios b / a and their weights, both shape (n,)."""

    a: Noise
    b: Noise
    squares: Float
    weights: Float

    @classmethod
    def of(cls, a: Noise, b: Noise) -> Pair:
        """Return the pair; without an own estimate the second noise is taken to be as the first."""
        if b.freedom < 1:
            return cls(a, Noise(a.variance, 0), np.ones(1), np.ones(1))
        n_a, n_b = a.freedom, b.freedom
        spread = np.sqrt(0.5 / n_a + 0.5 / n_b)
        q = np.append(0.5 * np.log(b.variance / a.variance) + spread * STEPS, 0.0)
        slab = (
            spread
            * (STEPS[1] - STEPS[0])
            * np.exp(-0.5 * (q / SPREAD) ** 2)
            / (SPREAD * np.sqrt(2.0 * np.pi))
        )
        prior = np.where(np.arange(len(q)) < len(STEPS), (1.0 - EQUAL) * slab, EQUAL)
        # (s_b / s_a)^2 over its true value is F(n_b, n_a): its density in the logarithm, but for a constant.
        x = b.variance / a.variance * np.exp(-2.0 * q)
        log = 0.5 * n_b * np.log(x) - 0.5 * (n_a + n_b) * np.log(n_a + n_b * x) + np.log(prior + 1e-300)
        weights = np.exp(log - log.max())
        used = weights > 1e-12
        return cls(a, b, np.exp(2.0 * q[used]), weights[used] / weights[used].sum())

    def chance(self, d: Float, A: Float, B: Float) -> float:
        """Return the chance of a difference as large as d, shape (k,), or larger.

        Args:
            d: difference, m/s^2.
            A, B: covariances of both estimates over the variances of their noise, shape (k, k).
        """
        from scipy.special import fdtrc

        freedom = self.a.freedom + self.b.freedom
        pooled = (
            self.a.freedom * self.a.variance + self.b.freedom * self.b.variance / self.squares
        ) / freedom
        solved = np.linalg.solve(A + self.squares[:, None, None] * B, d[None, :, None])[..., 0]
        F = solved @ d / (len(d) * pooled)
        return float(np.minimum(self.weights @ fdtrc(len(d), freedom, F), 1.0))

    def noise_chance(self) -> float:
        """Return the chance that equal noises give estimates as different, two-sided (F test); NaN without b's."""
        if self.b.freedom < 1:
            return float("nan")
        from scipy.special import fdtr, fdtrc

        F = self.b.variance / self.a.variance
        sides = (f(self.b.freedom, self.a.freedom, F) for f in (fdtr, fdtrc))
        return float(min(1.0, 2.0 * min(sides)))


def combined(chances: Float) -> float:
    """Return one chance for several that depend on each other [liu2020]: the mean of their Cauchy quantiles."""
    p = np.clip(chances, 1e-300, 1.0 - 1e-15)
    # For small p, tan((0.5 - p) pi) loses its digits: there it is 1 / (p pi).
    quantiles = np.where(p < 1e-8, 1.0 / (p * np.pi), np.tan((0.5 - p) * np.pi))
    mean = float(quantiles.mean())
    return 1.0 / (mean * np.pi) if mean > 1e8 else 0.5 - float(np.arctan(mean)) / np.pi


def holm(chances: Float) -> Float:
    """Return chances adjusted for their number by Holm's method, same shape [holm1979]."""
    order = np.argsort(chances, kind="stable")
    factors = np.arange(len(chances), 0, -1)
    adjusted = np.empty_like(chances)
    adjusted[order] = np.minimum(np.maximum.accumulate(chances[order] * factors), 1.0)
    return adjusted


def student_chance(t: Float, freedom: Int) -> Float:
    """Return the chance of an absolute value of t > 0, or infinite, or more under Student's distribution, shape (n,).

    The finite sums in powers of cos^2 a, tan a = t / sqrt(n), that hold for whole degrees of freedom [abramowitz1964]
    eq. 26.7.3 and 26.7.4.
    """
    chance, t = np.empty(len(t)), np.minimum(t, 1e150)  # the square of which is still a number
    for n in set(freedom.tolist()):  # np.unique would import numpy.ma, a tenth of a start
        own = freedom == n
        chance[own] = _student(t[own], n)
    return chance


def _student(t: Float, n: int) -> Float:
    if n > MOST_TERMS:
        from scipy.special import stdtr

        return np.asarray(2.0 * stdtr(n, -t))
    square = n / (n + t * t)
    odd = n % 2
    term, total = np.ones_like(t), np.zeros_like(t)
    for k in range(odd + 1, n, 2):
        total += term
        term = term * square * (k / (k + 1.0))
    sine = t / np.sqrt(n + t * t)
    if odd:
        return np.asarray(1.0 - (np.arctan(t / np.sqrt(n)) + sine * np.sqrt(square) * total) * (2.0 / np.pi))
    return 1.0 - sine * total


def chi_square_chance(x: Float, freedom: Int) -> Float:
    """Return the chance of x > 0 or more under the chi-square distribution, shape (n,), for whole degrees of freedom.

    The finite sums of [abramowitz1964] eq. 26.4.4 and 26.4.5.
    """
    return np.array([_chi_square(float(a), int(n)) for a, n in zip(x, freedom, strict=True)])


def _chi_square(x: float, n: int) -> float:
    if n > MOST_TERMS or x > 1000.0:
        from scipy.special import chdtrc

        return float(chdtrc(n, x))
    half, odd = 0.5 * x, n % 2
    total = math.erfc(math.sqrt(half)) if odd else 0.0
    term = math.exp(-half) * (math.sqrt(half / math.pi) * 2.0 if odd else 1.0)
    for k in range(n // 2):
        total += term
        term *= half / (k + 1.0 + 0.5 * odd)
    return total


def f_chance(x: Float, first: Float, second: Float) -> Float:
    """Return the chance of a ratio of x > 0 or more under the F distribution, shape (n,).

    Args:
        x: ratios of two variances; first, second: their degrees of freedom, above zero, whole or not.
    """
    first, second = np.minimum(first, MOST_FREEDOM), np.minimum(second, MOST_FREEDOM)
    z = second / (second + first * x)
    return _beta(0.5 * second, 0.5 * first, z)


MOST_FREEDOM = 1e5
"""Degrees of freedom that an F distribution has at most: from here on a variance is known to 0.5 %."""

FRACTIONS, SMALLEST = 1000, 1e-30
"""Steps of the continued fraction at most, and what stands for zero in it."""


def _beta(a: Float, b: Float, x: Float) -> Float:
    """Return the regularised incomplete beta function I_x(a, b), shape (n,).

    The continued fraction of [abramowitz1964] eq. 26.5.8 by Lentz's method, on the side of the mean where it converges
    fast.
    """
    other = x > (a + 1.0) / (a + b + 2.0)
    p, q, y = np.where(other, b, a), np.where(other, a, b), np.where(other, 1.0 - x, x)
    value = _beta_fraction(p, q, y)
    return np.where(other, 1.0 - value, value)


def _beta_fraction(a: Float, b: Float, x: Float) -> Float:
    with np.errstate(divide="ignore"):
        log = [math.lgamma(p + q) - math.lgamma(p) - math.lgamma(q) for p, q in zip(a, b, strict=True)]
        front = np.exp(np.array(log) + a * np.log(x) + b * np.log1p(-x)) / a
    c = np.ones_like(x)
    d = 1.0 - (a + b) * x / (a + 1.0)
    d = 1.0 / np.where(np.abs(d) < SMALLEST, SMALLEST, d)
    h, going = d, np.ones(x.shape, dtype=bool)
    for m in range(1, FRACTIONS):
        for term in (
            m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m)),
            -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1)),
        ):
            d = 1.0 + term * d
            d = 1.0 / np.where(np.abs(d) < SMALLEST, SMALLEST, d)
            c = 1.0 + term / c
            c = np.where(np.abs(c) < SMALLEST, SMALLEST, c)
            step = np.where(going, c * d, 1.0)  # each comes to the same value in any company
            h = h * step
        going = np.abs(step - 1.0) >= 1e-15
        if not going.any():
            break
    return np.asarray(front * h)


NODES = 96
"""Of the Gauss-Legendre rule for Student's density: with one degree of freedom, too, its error is below rounding."""


def student_quantile(probability: float, freedom: float) -> float:
    """Return the value that Student's t stays below with a probability.

    With t = sqrt(n) tan a its density is c cos(a)^(n - 1), c = Gamma((n + 1) / 2) / (sqrt(pi) Gamma(n / 2)), smooth for
    any n; the distribution function is concave in a, so that Newton's steps from 0 never pass the root.

    Args:
        probability: between 0 and 1, not nearer to either than 1e-4; freedom: 1 or more, whole or not.

    Raises:
        ValueError: degrees of freedom below 1.
    """
    if not freedom >= 1:
        raise ValueError(f"{freedom} degrees of freedom: expected 1 or more")
    if probability < 0.5:
        return -student_quantile(1.0 - probability, freedom)
    nodes, weights = _gauss_legendre()
    factor, angle = _student_factor(freedom), 0.0
    for _ in range(100):
        part = 0.5 * angle * float(weights @ _cosine_power(0.5 * angle * (nodes + 1.0), freedom - 1.0))
        missing = probability - 0.5 - factor * part
        step = missing / (factor * float(_cosine_power(np.array([angle]), freedom - 1.0)[0]))
        angle += step
        if abs(step) <= 1e-13 * angle:
            break
    return math.sqrt(freedom) * math.tan(angle)


MOST_STUDENT = 1e9
"""Degrees of freedom from which on Student's t is the normal distribution to nine digits."""


def student_freedom(probability: float, value: float) -> float:
    """Return the degrees of freedom with which Student's t stays below a value with a probability.

    The inverse of `student_quantile` in its other argument: at least 1, at most MOST_STUDENT.

    Args:
        probability: above 0.5; value: above the quantile of the normal distribution.
    """
    # The quantile is nearly straight in 1 / n: false position, its idle end halved.
    ends = [1.0 / MOST_STUDENT, 1.0]
    miss = [student_quantile(probability, 1.0 / x) - value for x in ends]
    if miss[0] >= 0 or miss[1] <= 0:
        return MOST_STUDENT if miss[0] >= 0 else 1.0
    kept = 2
    for _ in range(60):
        x = ends[0] - miss[0] * (ends[1] - ends[0]) / (miss[1] - miss[0])
        off = student_quantile(probability, 1.0 / x) - value
        if abs(off) <= 1e-12 * value:
            break
        side = int(off > 0)
        ends[side], miss[side] = x, off
        if side == kept:
            miss[1 - side] *= 0.5
        kept = side
    return 1.0 / x


def _cosine_power(angle: Float, power: float) -> Float:
    """Return cos(angle)^power, to all digits for small angles and large powers."""
    return np.asarray(np.exp(0.5 * power * np.log1p(-(np.sin(angle) ** 2))))


def _student_factor(n: float) -> float:
    """Return Gamma((n + 1) / 2) / (sqrt(pi) Gamma(n / 2)), by its asymptotic series where logarithms lose digits."""
    x = 0.5 * n
    if x < 100:
        return math.exp(math.lgamma(x + 0.5) - math.lgamma(x)) / math.sqrt(math.pi)
    series = 1.0 + (-1.0 / 8 + (1.0 / 128 + (5.0 / 1024 - 21.0 / 32768 / x) / x) / x) / x
    return math.sqrt(x / math.pi) * series


@cache
def _gauss_legendre() -> tuple[Float, Float]:
    """Return nodes and weights of the rule on -1 to 1, by Newton's method on the Legendre polynomial.

    numpy.polynomial is slow to load, and eigenvalues of a matrix of this size wake the threads of BLAS.
    """
    x = np.cos(np.pi * (np.arange(NODES // 2) + 0.75) / (NODES + 0.5))
    for _ in range(3):
        value, slope = _legendre(x)
        x = x - value / slope
    weights = 2.0 / ((1.0 - x * x) * _legendre(x)[1] ** 2)
    return np.concatenate([-x, x[::-1]]), np.concatenate([weights, weights[::-1]])


def _legendre(x: Float) -> tuple[Float, Float]:
    """Return the Legendre polynomial of degree NODES and its slope, by its recurrence, same shape."""
    before, value = np.ones_like(x), x
    for k in range(1, NODES):
        before, value = value, ((2 * k + 1) * x * value - k * before) / (k + 1)
    return value, NODES * (x * value - before) / (x * x - 1.0)
