"""A gravity-anomaly map: a grid in latitude and longitude, interpolated bilinearly, from a file or generated.

A value beyond the edge, or beside a cell without one, is NaN: never that of the nearest edge, which would attract
particles.

Files are NetCDF and GeoTIFF, read by xarray and rioxarray, or XYZ text, which needs neither.

Generated fields are isotropic and Gaussian with Jordan's third-order Markov covariance [jordan1972],
C(d) = sigma^2 (1 + s + s^2 / 3) exp(-s), s = d / D: differentiable, with an rms slope of sigma / (sqrt(3) D) per axis.
They are drawn by circulant embedding [dietrich1997] on a grid of twice the size, negative eigenvalues set to zero.
"""

from __future__ import annotations

import hashlib
import importlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

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


NETCDF, GEOTIFF = (".nc", ".nc4", ".grd", ".cdf"), (".tif", ".tiff")
LATITUDES, LONGITUDES = ("lat", "latitude", "y"), ("lon", "longitude", "x")
EVEN = 1e-3
"""Unevenness of the nodes of a grid that is accepted, as a part of their spacing."""


def load_map(path: str) -> GravityMap:
    """Return the map in a file, whose suffix gives the format.

    XYZ text has three columns: longitude and latitude in degrees, anomaly in mGal, in any order of rows; `#` begins a
    comment, and a first line that does not hold numbers is a header.

    Raises:
        DataError: unreadable, not a regular grid, or the packages for its format are missing.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if not file.is_file():
        raise DataError(f"{path}: no such file; expected a map file, or rough, moderate or constant")
    if suffix in NETCDF + GEOTIFF:
        return _read_grid(path, suffix)
    longitude, latitude, values = _read_xyz(path).T
    return _from_nodes(path, latitude, longitude, values)


def digest(path: str) -> str:
    """Return the SHA-256 of a file."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(f"{path}: {(error.strerror or str(error)).lower()}") from None


def _read_xyz(path: str) -> Float:
    """Return the numbers of an XYZ file, shape (n, 3)."""
    try:
        lines = Path(path).read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DataError(f"{path}: cannot be read as text: {error}") from None
    rows: list[tuple[float, float, float]] = []
    for number, line in enumerate(lines, 1):
        cells = line.split("#")[0].replace(",", " ").split()
        if not cells:
            continue
        try:
            longitude, latitude, value = map(float, cells)
        except ValueError:
            if not rows and number == 1:
                continue
            raise DataError(
                f"{path}, line {number}: expected longitude, latitude and anomaly, not {line[:40]!r}"
            ) from None
        rows.append((longitude, latitude, value))
    if not rows:
        raise DataError(f"{path}: holds no rows of longitude, latitude and anomaly")
    return np.array(rows)


def _from_nodes(path: str, latitude: Float, longitude: Float, values: Float) -> GravityMap:
    """Return the map of scattered nodes that form a grid; a missing node is NaN."""
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
        raise DataError(f"{path}: a latitude or longitude is not a number")
    rows, i = np.unique(np.round(latitude, 8), return_inverse=True)
    columns, j = np.unique(np.round(longitude, 8), return_inverse=True)
    if len(rows) * len(columns) > 4 * len(values) + 4:
        raise DataError(f"{path}: the points are not the nodes of a grid in latitude and longitude")
    grid = np.full((len(rows), len(columns)), np.nan)
    grid[i, j] = values
    return _regular_map(path, rows, columns, grid)


def _regular_map(path: str, latitude: Float, longitude: Float, values: Float) -> GravityMap:
    """Return the map of a grid with ascending or descending axes in degrees."""
    if latitude[0] > latitude[-1]:
        latitude, values = latitude[::-1], values[::-1]
    if longitude[0] > longitude[-1]:
        longitude, values = longitude[::-1], values[:, ::-1]
    steps = []
    for name, axis, limit in (("latitude", latitude, 90.0), ("longitude", longitude, 360.0)):
        if len(axis) < 2:
            raise DataError(f"{path}: expected at least two nodes in {name}")
        if np.abs(axis).max() > limit:
            raise DataError(f"{path}: {name} beyond {limit:g} degrees; expected degrees, not metres")
        step = (axis[-1] - axis[0]) / (len(axis) - 1)
        uneven = np.abs(np.diff(axis) - step).max()
        if not uneven <= max(EVEN * step, 2e-6):
            raise DataError(f"{path}: the nodes are not evenly spaced in {name}")
        steps.append(np.radians(step))
    values = np.where(np.isfinite(values), values, np.nan)
    return GravityMap(np.radians(latitude[0]), np.radians(longitude[0]), steps[0], steps[1], values, path)


def _read_grid(path: str, suffix: str) -> GravityMap:
    """Return the map of a NetCDF or GeoTIFF file."""
    needed = "rioxarray" if suffix in GEOTIFF else "xarray"
    try:
        package: Any = importlib.import_module(needed)
    except ImportError:
        raise DataError(
            f"{path}: needs {needed}: python -m pip install xarray rioxarray netCDF4 (XYZ text needs no package)"
        ) from None
    try:
        if suffix in GEOTIFF:
            with package.open_rasterio(path, masked=True) as raster:
                return _from_xarray(path, raster.squeeze("band", drop=True).load())
        with package.open_dataset(path) as data:
            grids = [v for v in data.data_vars.values() if v.squeeze().ndim == 2]
            if len(grids) != 1:
                raise DataError(f"{path}: expected one variable on a grid, not {len(grids)}")
            return _from_xarray(path, grids[0].squeeze().load())
    except DataError:
        raise
    except Exception as error:  # the readers raise whatever their libraries do
        raise DataError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def _from_xarray(path: str, grid: Any) -> GravityMap:
    """Return the map of a two-dimensional xarray."""
    axes = []
    for known in (LATITUDES, LONGITUDES):
        names = [name for name in grid.dims if str(name).lower() in known]
        if len(names) != 1:
            raise DataError(f"{path}: expected dimensions of latitude and longitude, not {list(grid.dims)}")
        axes += names
    grid = grid.transpose(*axes)
    latitude, longitude = (np.asarray(grid[name].values, dtype=float) for name in axes)
    return _regular_map(path, latitude, longitude, np.asarray(grid.values, dtype=float))


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
