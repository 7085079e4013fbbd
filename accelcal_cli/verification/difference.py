"""The differences between two results of one sensor, before and after, with the interval of the difference."""

from __future__ import annotations

import math

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.distributions import student_quantile
from accelcal_cli.calibration.observability import (
    BIAS,
    SCALE,
    engineering_chain,
    engineering_quantities,
    propagated,
)
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.sensor.model import OUTPUT_OF_1_G


def absolute(result: Calibration) -> tuple[Float, Float]:
    """Return the nine parameters relative to no nominal sensor, and their one-sigma, shape (9,).

    Sensitivities in output units per unit of the force, angles by which axes miss 90 degrees in rad, biases in parts of
    g; NaN for what is not determined or was not estimated, and sigma NaN where there is none.
    """
    values = engineering_quantities(result.K_a, result.D_a)
    chain = engineering_chain(result.model.in_gauge("lower").K, result.D_a, result.g)
    sigma = propagated(chain, result.covariance)
    sigma[SCALE] *= values[SCALE]
    for numbers in (values, sigma):
        numbers[BIAS] /= OUTPUT_OF_1_G[result.unit] if result.unit in ("g", "mg") else result.g
        numbers[result.lost | result.held] = np.nan
    return values, sigma


def difference(first: Calibration, second: Calibration) -> tuple[Float, Float]:
    """Return the nine of `second` less those of `first`, see `absolute`, and the half-widths of their 95 % intervals.

    The errors of the two results are independent. The degrees of freedom of their sum are those of Welch and
    Satterthwaite, (a + b)^2 / (a^2 / n + b^2 / m) for variances a and b with n and m degrees of freedom; without sigma
    there is no interval, NaN.
    """
    (was, before), (now, after) = absolute(first), absolute(second)
    halves = np.full(9, np.nan)
    n, m = first.sigma_freedom, second.sigma_freedom
    if n > 0 and m > 0:
        for p, (a, b) in enumerate(zip((before**2).tolist(), (after**2).tolist(), strict=True)):
            if math.isfinite(a + b) and a + b > 0:
                freedom = (a + b) ** 2 / (a * a / n + b * b / m)
                halves[p] = student_quantile(0.975, max(freedom, 1.0)) * math.sqrt(a + b)
    return now - was, halves
