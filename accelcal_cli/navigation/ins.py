"""The error model of an inertial navigation system (INS) in twelve states, continuous and discrete, and its Earth.

State [depf2015] section 1: latitude and longitude error (rad), east and north velocity error (m/s), tilt about east and
north and azimuth error (rad), accelerometer bias east and north (m/s^2), gyro drift about east, north and up (rad/s);
error = indicated - true. The matrix is the standard two-channel ENU model: the paper's own is lost.

The filters use metric states: latitude and longitude error as metres north and east, all else as above.

The Earth is WGS84: radii, normal gravity and rotation [nima2000].
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.schema import Checked, setting

STATES = 12
MINUTE, TAYLOR_TERMS, LONG_TERMS = 60.0, 9, 16
"""Terms of the matrix exponential, for steps up to a minute and up to ten: the next one is below rounding."""

EQUATORIAL_RADIUS = 6378137.0
"""Semi-major axis a. Units: m."""

FLATTENING = 1.0 / 298.257223563
"""Definition: (a - b) / a. Units: 1."""

ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
EARTH_RATE = 7.292115e-5
"""Units: rad/s."""

EQUATORIAL_GRAVITY, SOMIGLIANA = 9.7803253359, 1.931852652458e-3
METRES_PER_MICRO_G = 9.80665e-6
"""One micro-g. Units: m/s^2."""

DEGREE_PER_HOUR = np.deg2rad(1.0) / 3600.0
"""Units: rad/s."""


def radii(latitude: Float) -> tuple[Float, Float]:
    """Return the meridian and the prime-vertical radius of curvature, R_M and R_N, in m.

    Args:
        latitude: rad, any shape.
    """
    root = 1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2
    prime = EQUATORIAL_RADIUS / np.sqrt(root)
    return prime * (1.0 - ECCENTRICITY_SQUARED) / root, prime


def metres_per_radian(latitude: Float) -> tuple[Float, Float]:
    """Return the metres per radian of latitude and of longitude, R_M and R_N cos L.

    Args:
        latitude: rad, any shape.
    """
    meridian, prime = radii(latitude)
    return meridian, prime * np.cos(latitude)


def somigliana_gravity(latitude: Float) -> Float:
    """Return normal gravity on the ellipsoid in m/s^2, by Somigliana's formula; latitude in rad, any shape."""
    sine = np.sin(latitude) ** 2
    return np.asarray(
        EQUATORIAL_GRAVITY * (1.0 + SOMIGLIANA * sine) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine)
    )


@dataclass(frozen=True)
class Motion:
    """Latitude and motion of a vehicle; all fields have the same shape.

    Attributes:
        latitude: rad.
        east, north: velocity, m/s.
        force_east, force_north: acceleration over ground, m/s^2, without Coriolis terms.
    """

    latitude: Float
    east: Float
    north: Float
    force_east: Float
    force_north: Float


def specific_force(motion: Motion) -> tuple[Float, Float, Float]:
    """Return the specific force east, north and up at height 0. Units: m/s^2."""
    meridian, prime = radii(motion.latitude)
    tangent, sine, cosine = np.tan(motion.latitude), np.sin(motion.latitude), np.cos(motion.latitude)
    turn = 2.0 * EARTH_RATE * sine + motion.east * tangent / prime
    up = (
        somigliana_gravity(motion.latitude)
        - (2.0 * EARTH_RATE * cosine + motion.east / prime) * motion.east
        - motion.north**2 / meridian
    )
    return motion.force_east - turn * motion.north, motion.force_north + turn * motion.east, up


def dynamics(motion: Motion) -> Float:
    """Return the matrix A of x' = A x, shape (..., 12, 12), for motions of shape (...). [depf2015] eq. 1."""
    meridian, prime = radii(motion.latitude)
    sine, cosine, tangent = np.sin(motion.latitude), np.cos(motion.latitude), np.tan(motion.latitude)
    east, north = motion.east, motion.north
    force_east, force_north, force_up = specific_force(motion)
    up_rate = EARTH_RATE * sine + east * tangent / prime
    north_rate = EARTH_RATE * cosine + east / prime
    curved = east / (prime * cosine**2)
    A = np.zeros((*np.shape(motion.latitude), STATES, STATES))
    A[..., 0, 3] = 1.0 / meridian
    A[..., 1, 0] = east * tangent / (prime * cosine)
    A[..., 1, 2] = 1.0 / (prime * cosine)
    A[..., 2, 0] = (2.0 * EARTH_RATE * cosine + curved) * north
    A[..., 2, 2] = north * tangent / prime
    A[..., 2, 3] = EARTH_RATE * sine + up_rate
    A[..., 2, 5], A[..., 2, 6] = -force_up, force_north
    A[..., 3, 0] = -(2.0 * EARTH_RATE * cosine + curved) * east
    A[..., 3, 2] = -2.0 * up_rate
    A[..., 3, 4], A[..., 3, 6] = force_up, -force_east
    A[..., 4, 3] = -1.0 / meridian
    A[..., 4, 5], A[..., 4, 6] = up_rate, -north_rate
    A[..., 5, 0], A[..., 5, 2] = -EARTH_RATE * sine, 1.0 / prime
    A[..., 5, 4], A[..., 5, 6] = -up_rate, -north / meridian
    A[..., 6, 0], A[..., 6, 2] = EARTH_RATE * cosine + curved, tangent / prime
    A[..., 6, 4], A[..., 6, 5] = north_rate, north / meridian
    for row in range(2, 7):
        A[..., row, row + 5] = 1.0
    return A


def discretise(A: Float, step: float) -> Float:
    """Return exp(A step), shape (..., 12, 12), by its Taylor series; step in s, to 600."""
    scaled = A * step
    total = np.eye(A.shape[-1]) + scaled
    term = scaled
    for n in range(2, (TAYLOR_TERMS if step <= MINUTE else LONG_TERMS) + 1):
        term = term @ scaled / n
        total += term
    return total


def turn_biases(F: Float, heading: Float) -> Float:
    """Return transitions after which the level biases turn with the vehicle.

    Args:
        F: shape (..., 12, 12); heading: change of heading in the step, clockwise, rad, shape (...).
    """
    turn = np.zeros((*heading.shape, STATES, STATES))
    turn[..., range(STATES), range(STATES)] = 1.0
    for first in (7, 9):
        turn[..., first, first] = turn[..., first + 1, first + 1] = np.cos(heading)
        turn[..., first, first + 1], turn[..., first + 1, first] = np.sin(heading), -np.sin(heading)
    return np.asarray(turn @ F)


def to_metric(F: Float, before: Float, after: Float) -> Float:
    """Return the transition of metric states, whose position errors are in metres north and east.

    Args:
        F: transition of the states in rad, shape (..., 12, 12).
        before, after: latitude at either end of the step, rad, shape (...).
    """
    changed = F.copy()
    for axis, (low, high) in enumerate(zip(metres_per_radian(before), metres_per_radian(after), strict=True)):
        changed[..., :, axis] /= low[..., None]
        changed[..., axis, :] *= high[..., None]
    return changed


@dataclass(frozen=True)
class InsGrade(Checked):
    """How accurate an inertial navigation system is [depf2015] Table 1.

    Attributes:
        accelerometer: sigma of the constant bias, micro-g.
        gyro: sigma of the constant drift, deg/h.
        walk: random walk of the gyros, deg/sqrt(h): the other reading of Table 1, whose label says random walk, while
            its unit says drift.
        noise: white noise of a 10 s step, as a fraction of the effect of bias and drift in that step.
        mounting: `platform`: level biases stay fixed to east and north, as in [depf2015]; `strapdown`: they turn with
            the vehicle.
    """

    accelerometer: float = setting(50.0, "sigma of the constant bias, micro-g", low=0.0, high=1e6)
    gyro: float = setting(0.01, "sigma of the constant drift, deg/h", low=0.0, high=1e4)
    walk: float = setting(0.0, "random walk of the gyros, deg/sqrt(h)", low=0.0, high=1e4)
    noise: float = setting(
        0.1, "white noise of 10 s, as a fraction of the effect of the biases in 10 s", low=0.0, high=100.0
    )
    mounting: Literal["platform", "strapdown"] = setting(
        "platform",
        "level biases stay fixed to east and north (platform) or turn with the vehicle (strapdown)",
    )

    def biases(self) -> Float:
        """Return sigma of the five biases: m/s^2 (2), rad/s (3)."""
        return np.array([self.accelerometer * METRES_PER_MICRO_G] * 2 + [self.gyro * DEGREE_PER_HOUR] * 3)

    def white(self) -> Float:
        """Return the noise densities of velocity and attitude: m/s (2) and rad (3) per root second."""
        densities = self.noise * math.sqrt(10.0) * self.biases()
        densities[2:] = np.hypot(densities[2:], math.radians(self.walk) / 60.0)  # sqrt(3600 s) are 60
        return densities


def process_noise(grade: InsGrade, step: float, position: float = 0.0) -> Float:
    """Return the variances of the process noise of one step in metric states, shape (12,).

    Args:
        grade: of the INS.
        step: s.
        position: noise added to the position error per step, m.
    """
    variances = np.zeros(STATES)
    variances[:2] = position**2
    variances[2:7] = grade.white() ** 2 * step
    return variances


TINY = 1e-12
"""Variance that is added to each state of a correlation matrix, so that it has a root."""


def cholesky(P: Float) -> Float:
    """Return lower triangular roots of covariances of very different scales, shape (..., n, n); zero variances stay."""
    sigma = np.sqrt(np.einsum("...ii->...i", P))
    size = np.where(sigma > 0.0, sigma, 1.0)
    correlation = P / (size[..., :, None] * size[..., None, :])
    correlation = 0.5 * (correlation + correlation.swapaxes(-1, -2)) + TINY * np.eye(P.shape[-1])
    return np.asarray(np.linalg.cholesky(correlation) * sigma[..., :, None])
