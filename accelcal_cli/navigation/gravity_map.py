"""A gravity-anomaly map: a grid in latitude and longitude, interpolated bilinearly; outside there is no value.

A value beyond the edge, or beside a cell without one, is NaN: never that of the nearest edge, which would draw
particles to it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.streams import Bool, Float, Int

OUTSIDE = -1e6
"""Log-likelihood of a place that the map does not know."""


@dataclass(frozen=True)
class GravityMap:
    """A grid of gravity anomalies.

    Attributes:
        south, west: latitude and longitude of the first node, rad.
        step_north, step_east: between nodes, rad.
        values: mGal, shape (rows, columns), from south to north and west to east; NaN where unknown.
        source: where it comes from.
    """

    south: float
    west: float
    step_north: float
    step_east: float
    values: Float
    source: str = "map"
    _flat: Float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the grid and keep it flat for the look-ups."""
        if self.values.ndim != 2 or min(self.values.shape) < 2:
            raise DataError(f"{self.source}: expected at least 2 x 2 nodes, not {self.values.shape}")
        if np.isnan(self.values).all():
            raise DataError(f"{self.source}: holds no value")
        object.__setattr__(self, "_flat", np.ascontiguousarray(self.values, dtype=float).ravel())

    @property
    def north(self) -> float:
        """Latitude of the last row. Units: rad."""
        return float(self.south + self.step_north * (self.values.shape[0] - 1))

    @property
    def east(self) -> float:
        """Longitude of the last column. Units: rad."""
        return float(self.west + self.step_east * (self.values.shape[1] - 1))

    def at(self, latitude: Float, longitude: Float) -> Float:
        """Return the anomaly in mGal, NaN where the map has none; places in rad, any one shape."""
        index, a, b, outside = self._cell(latitude, longitude)
        columns = self.values.shape[1]
        take = self._flat.take
        below: Float = take(index)
        above: Float = take(index + columns)
        below += b * (take(index + 1) - below)
        above += b * (take(index + columns + 1) - above)
        above -= below
        above *= a
        above += below
        above[outside] = np.nan
        return above

    def slope(self, latitude: Float, longitude: Float) -> tuple[Float, Float]:
        """Return the slopes to north and to east in mGal/rad, NaN where the map has none; places in rad."""
        index, a, b, outside = self._cell(latitude, longitude)
        columns = self.values.shape[1]
        g = [self._flat.take(index + k) for k in (0, 1, columns, columns + 1)]
        north = ((1.0 - b) * (g[2] - g[0]) + b * (g[3] - g[1])) / self.step_north
        east = ((1.0 - a) * (g[1] - g[0]) + a * (g[3] - g[2])) / self.step_east
        north[outside], east[outside] = np.nan, np.nan
        return north, east

    def _cell(self, latitude: Float, longitude: Float) -> tuple[Int, Float, Float, Bool]:
        """Return the flat index of the south-west node, the fractions north and east, and what is outside."""
        rows, columns = self.values.shape
        a = (np.atleast_1d(latitude) - self.south) / self.step_north
        b = (np.atleast_1d(longitude) - self.west) / self.step_east
        i, j = np.floor(a), np.floor(b)
        outside: Bool = ~((a >= 0.0) & (a <= rows - 1) & (b >= 0.0) & (b <= columns - 1))
        for node, last in ((i, rows - 2), (j, columns - 2)):
            np.fmax(node, 0.0, out=node)  # of a number and NaN the number: an unknown place has a cell too
            np.fmin(node, last, out=node)
        a -= i
        b -= j
        i *= columns
        i += j
        return i.astype(np.intp), a, b, outside
