"""The Earth of the navigation filters: WGS84 radii, normal gravity and rotation [nima2000]."""

from __future__ import annotations

import numpy as np

from accelcal_cli.streams import Float

EQUATORIAL_RADIUS = 6378137.0
"""Semi-major axis a. Units: m."""

FLATTENING = 1.0 / 298.257223563
"""Definition: (a - b) / a. Units: 1."""

ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
EARTH_RATE = 7.292115e-5
"""Units: rad/s."""

EQUATORIAL_GRAVITY, SOMIGLIANA = 9.7803253359, 1.931852652458e-3
MICRO_G = 9.80665e-6
"""Units: m/s^2."""

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
    """Return the metres of one radian of latitude and of longitude, R_M and R_N cos L.

    Args:
        latitude: rad, any shape.
    """
    meridian, prime = radii(latitude)
    return meridian, prime * np.cos(latitude)


def normal_gravity(latitude: Float) -> Float:
    """Return normal gravity on the ellipsoid in m/s^2, by Somigliana's formula; latitude in rad, any shape."""
    sine = np.sin(latitude) ** 2
    gravity: Float = (
        EQUATORIAL_GRAVITY * (1.0 + SOMIGLIANA * sine) / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine)
    )
    return gravity
