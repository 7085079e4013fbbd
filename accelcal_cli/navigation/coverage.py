"""Whether a map covers a track: beyond its edge, or beside a hole, a filter could only be confidently wrong."""

from __future__ import annotations

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.voyage import SECONDS_PER_HOUR, Route

DIRECTIONS = 8


def check_coverage(gravity_map: GravityMap, route: Route, initial: float) -> None:
    """Refuse a map that ends, or has cells without a value, within the initial error of a track.

    Args:
        gravity_map: the map; route: the track, fields of shape (K,).
        initial: m.

    Raises:
        DataError: with the place and the time where the map ends.
    """
    meridian, parallel = metres_per_radian(route.latitude)
    for turn in np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS:
        for reach in (0.0, 0.5 * initial, initial):
            latitude = route.latitude + reach * np.cos(turn) / meridian
            longitude = route.longitude + reach * np.sin(turn) / parallel
            unknown = np.isnan(gravity_map.at(latitude, longitude))
            if unknown.any():
                k = int(np.argmax(unknown))
                _refuse(gravity_map, latitude[k], longitude[k], route.seconds[k])


def _refuse(gravity_map: GravityMap, latitude: float, longitude: float, seconds: float) -> None:
    south, north, west, east = np.degrees(
        [gravity_map.south, gravity_map.north, gravity_map.west, gravity_map.east]
    )
    inside = south <= np.degrees(latitude) <= north and west <= np.degrees(longitude) <= east
    what = "has a cell without a value" if inside else "ends"
    raise DataError(
        f"{gravity_map.source}: the map {what} at {np.degrees(latitude):.4f} N {np.degrees(longitude):.4f} E, "
        f"within the position error of the track at hour {seconds / SECONDS_PER_HOUR:.2f}; it covers {south:.3f} to "
        f"{north:.3f} N and {west:.3f} to {east:.3f} E"
    )
