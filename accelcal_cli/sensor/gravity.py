"""Local gravity: stated, or the normal gravity of WGS84 at a latitude and height."""

from __future__ import annotations

from accelcal_cli.errors import UsageError

SMALLEST, LARGEST = 1e-3, 1e6
"""Gravity in any unit of acceleration that a sensor is calibrated in: 1 for g, 9.8 for m/s^2, 1000 for mg."""


def check_gravity(g: float) -> float:
    """Return g, in m/s^2 (or 1 for readings in units of g), or raise UsageError when it cannot be one."""
    if not SMALLEST <= g <= LARGEST:
        raise UsageError(
            f"--g {g:g}: expected gravity in m/s^2 (9.78 to 9.84 on Earth), or 1 for readings in units of g"
        )
    return g


def normal_gravity(latitude: float, height: float = 0.0) -> float:
    """Return the magnitude of WGS84 normal gravity in m/s^2 (Li and Goetze closed form, by boule).

    Args:
        latitude: geodetic latitude, degrees, -90 to 90.
        height: height above the ellipsoid, metres.

    Raises:
        UsageError: latitude or height out of range.
    """
    if not -90 <= latitude <= 90:
        raise UsageError(f"--latitude {latitude:g}: expected degrees from -90 to 90")
    if not -1e4 <= height <= 1e5:
        raise UsageError(f"--height {height:g}: expected metres above the ellipsoid, from -10000 to 100000")
    import warnings

    import boule

    with warnings.catch_warnings():
        # Below the ellipsoid boule warns; the field of the outside, continued, is that in a valley there.
        warnings.simplefilter("ignore", UserWarning)
        milligal = boule.WGS84.normal_gravity((0.0, latitude, height))
    return float(milligal) * 1e-5
