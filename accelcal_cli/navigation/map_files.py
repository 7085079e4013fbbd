"""Gravity maps from files: NetCDF and GeoTIFF through xarray and rioxarray, and XYZ text without them."""

from __future__ import annotations

import hashlib
import importlib
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.streams import Float

NETCDF, GEOTIFF = (".nc", ".nc4", ".grd", ".cdf"), (".tif", ".tiff")
LATITUDES, LONGITUDES = ("lat", "latitude", "y"), ("lon", "longitude", "x")
EVEN = 1e-3
"""Part of a step by which the nodes of a grid may be uneven."""


def load_map(path: str) -> GravityMap:
    """Return the map in a file; its suffix says the format.

    XYZ text has three columns: longitude and latitude in degrees, anomaly in mGal, in any order of rows; `#` begins a
    comment, and a first line that is not numbers is a header.

    Raises:
        DataError: unreadable, not a regular grid, or the packages for its format are missing.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if not file.is_file():
        raise DataError(f"{path}: no such file; expected a map file, or rough, moderate or constant")
    if suffix in NETCDF + GEOTIFF:
        return _gridded(path, suffix)
    longitude, latitude, values = _text(path).T
    return _grid(path, latitude, longitude, values)


def digest(path: str) -> str:
    """Return the SHA-256 of a file."""
    try:
        return hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise DataError(f"{path}: {(error.strerror or str(error)).lower()}") from None


def _text(path: str) -> Float:
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


def _grid(path: str, latitude: Float, longitude: Float, values: Float) -> GravityMap:
    """Return the map of scattered nodes that form a grid; a missing node is NaN."""
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
        raise DataError(f"{path}: a latitude or longitude is not a number")
    rows, i = np.unique(np.round(latitude, 8), return_inverse=True)
    columns, j = np.unique(np.round(longitude, 8), return_inverse=True)
    if len(rows) * len(columns) > 4 * len(values) + 4:
        raise DataError(f"{path}: the points are not the nodes of a grid in latitude and longitude")
    grid = np.full((len(rows), len(columns)), np.nan)
    grid[i, j] = values
    return _regular(path, rows, columns, grid)


def _regular(path: str, latitude: Float, longitude: Float, values: Float) -> GravityMap:
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


def _gridded(path: str, suffix: str) -> GravityMap:
    """Return the map of a NetCDF or GeoTIFF file."""
    needed = "rioxarray" if suffix in GEOTIFF else "xarray"
    try:
        package: Any = importlib.import_module(needed)
    except ImportError:
        raise DataError(
            f"{path}: needs {needed}: pip install 'accelcal[maps]' (XYZ text is read without)"
        ) from None
    try:
        if suffix in GEOTIFF:
            with package.open_rasterio(path, masked=True) as raster:
                return _array(path, raster.squeeze("band", drop=True).load())
        with package.open_dataset(path) as data:
            grids = [v for v in data.data_vars.values() if v.squeeze().ndim == 2]
            if len(grids) != 1:
                raise DataError(f"{path}: expected one variable on a grid, not {len(grids)}")
            return _array(path, grids[0].squeeze().load())
    except DataError:
        raise
    except Exception as error:  # the readers raise whatever their libraries do
        raise DataError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def _array(path: str, grid: Any) -> GravityMap:
    """Return the map of a two-dimensional xarray."""
    axes = []
    for known in (LATITUDES, LONGITUDES):
        names = [name for name in grid.dims if str(name).lower() in known]
        if len(names) != 1:
            raise DataError(f"{path}: expected dimensions of latitude and longitude, not {list(grid.dims)}")
        axes += names
    grid = grid.transpose(*axes)
    latitude, longitude = (np.asarray(grid[name].values, dtype=float) for name in axes)
    return _regular(path, latitude, longitude, np.asarray(grid.values, dtype=float))
