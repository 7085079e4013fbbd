"""A gravity-anomaly map: a grid in latitude and longitude, interpolated bilinearly, generated or from `map_files`.

A value beyond the edge, or beside a cell without one, is NaN: never that of the nearest edge, which would attract
particles.

Generated fields are isotropic and Gaussian with Jordan's third-order Markov covariance [jordan1972],
C(d) = sigma^2 (1 + s + s^2 / 3) exp(-s), s = d / D: differentiable, with an rms slope of sigma / (sqrt(3) D) per axis.
They are drawn by circulant embedding [dietrich1997] on a grid of twice the size, negative eigenvalues set to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.navigation.ins import metres_per_radian
from accelcal_cli.rng import Purpose, Streams


@dataclass(frozen=True)
class GravityMap:
    """A grid of gravity anomalies.

    Attributes:
        south, west: latitude and longitude of the first node, rad.
        step_north, step_east: spacing of the nodes, rad.
        values: mGal, shape (rows, columns), from south to north and west to east; NaN where unknown.
        source: the name of its file, or of the generated field.
    """

    south: float
    west: float
    step_north: float
    step_east: float
    values: Float
    source: str = "map"
    _flat: Float = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the grid, and keep a flat copy for the look-ups."""
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
        """Return the anomaly in mGal, NaN where the map has none; positions in rad, of one shape."""
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
        """Return the slopes to north and to east in mGal/rad, NaN where the map has none; positions in rad."""
        index, a, b, outside = self._cell(latitude, longitude)
        columns = self.values.shape[1]
        g = [self._flat.take(index + k) for k in (0, 1, columns, columns + 1)]
        north = ((1.0 - b) * (g[2] - g[0]) + b * (g[3] - g[1])) / self.step_north
        east = ((1.0 - a) * (g[1] - g[0]) + a * (g[3] - g[2])) / self.step_east
        north[outside], east[outside] = np.nan, np.nan
        return north, east

    def turn_to(self, longitude: float) -> float:
        """Return the whole turns to add to longitudes about one, so that they are about the middle of the map. Rad."""
        return 2.0 * math.pi * round((0.5 * (self.west + self.east) - longitude) / (2.0 * math.pi))

    def facing(self, longitude: float) -> GravityMap:
        """Return a map that goes round the Earth with its seam opposite to a longitude in rad; any other as it is."""
        turn, columns = 2.0 * math.pi / self.step_east, self.values.shape[1]
        if abs(round(turn) - turn) > 0.01 or columns < round(turn):
            return self
        size = round(turn)
        shift = round((longitude - math.pi - self.west) / self.step_east)
        values = np.roll(self.values[:, :size], -shift, axis=1)
        values = np.concatenate([values, values[:, :1]], axis=1)
        return replace(self, west=self.west + shift * self.step_east, values=values)

    def _cell(self, latitude: Float, longitude: Float) -> tuple[Int, Float, Float, Bool]:
        """Return the flat index of the south-west node, the fractions north and east, and what is outside."""
        rows, columns = self.values.shape
        a = (np.atleast_1d(latitude) - self.south) / self.step_north
        b = (np.atleast_1d(longitude) - self.west) / self.step_east
        i, j = np.floor(a), np.floor(b)
        outside: Bool = ~((a >= 0.0) & (a <= rows - 1) & (b >= 0.0) & (b <= columns - 1))
        for node, last in ((i, rows - 2), (j, columns - 2)):
            np.fmax(node, 0.0, out=node)  # ignores NaN: an unknown position has a cell, too
            np.fmin(node, last, out=node)
        a -= i
        b -= j
        i *= columns
        i += j
        return i.astype(np.intp), a, b, outside


@dataclass(frozen=True)
class RandomField:
    """Statistics and extent of a generated gravity field.

    Attributes:
        sigma: standard deviation, mGal.
        distance: correlation length D, km.
        south, north, west, east: edges, degrees.
        step: spacing of the nodes, arc seconds.
    """

    sigma: float
    distance: float
    south: float = 19.5
    north: float = 22.0
    west: float = 114.5
    east: float = 117.5
    step: float = 30.0


PRESETS = {
    "rough": RandomField(60.0, 8.0),
    "moderate": RandomField(30.0, 11.5),
    "constant": RandomField(0.0, 8.0),
}
"""`rough` is about as informative as the paper's results need; `moderate` resembles published statistics."""


def covariance(distance: Float, field: RandomField) -> Float:
    """Return the covariance in mGal^2 at a distance in km, any shape."""
    s = distance / field.distance
    return np.asarray(field.sigma**2 * (1.0 + s + s * s / 3.0) * np.exp(-s))


def generate(field: RandomField, seed: int, source: str = "generated") -> GravityMap:
    """Return a field drawn from a seed; the same seed gives the same field."""
    step = math.radians(field.step / 3600.0)
    south, west = math.radians(field.south), math.radians(field.west)
    rows = round((math.radians(field.north) - south) / step) + 1
    columns = round((math.radians(field.east) - west) / step) + 1
    north_metres, east_metres = metres_per_radian(np.array(south + 0.5 * step * rows))
    dy = np.minimum(np.arange(2 * rows), 2 * rows - np.arange(2 * rows)) * step * north_metres / 1e3
    dx = np.minimum(np.arange(2 * columns), 2 * columns - np.arange(2 * columns)) * step * east_metres / 1e3
    spectrum = np.fft.fft2(covariance(np.hypot(dy[:, None], dx[None, :]), field)).real
    noise = Streams(seed, [0], Purpose.FIELD).normal(2 * rows, 4 * columns)[0]
    white = noise[:, : 2 * columns] + 1j * noise[:, 2 * columns :]
    drawn = np.fft.fft2(np.sqrt(np.maximum(spectrum, 0.0) / spectrum.size) * white).real
    return GravityMap(south, west, step, step, drawn[:rows, :columns], source)
