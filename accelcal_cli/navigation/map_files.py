"""Gravity-anomaly maps from files: NetCDF and GeoTIFF, read by xarray and rioxarray, ICGEM grids, and XYZ text.

Values are in mGal unless the file states another unit. Longitudes may be of 0 to 360 or of -180 to 180 degrees, and
cross the date line. ICGEM grids (.gdf) have a header that ends with `end_of_head` [ince2019].
"""

from __future__ import annotations

import hashlib
import importlib
import math
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.navigation.gravity_map import GravityMap

NETCDF, GEOTIFF = (".nc", ".nc4", ".grd", ".cdf"), (".tif", ".tiff")
LATITUDES, LONGITUDES = ("lat", "latitude", "y"), ("lon", "longitude", "x")
ICGEM = ".gdf"
UNITS = {
    "mgal": 1.0,
    "milligal": 1.0,
    "milligals": 1.0,
    "gal": 1e3,
    "ugal": 1e-3,
    "microgal": 1e-3,
    "m/s2": 1e5,
    "ms-2": 1e5,
    "m.s-2": 1e5,
    "meters/second2": 1e5,
    "um/s2": 0.1,
    "ums-2": 0.1,
    "mm/s2": 100.0,
}
"""Milligal in a unit, by its name without blanks, carets and stars, in lower case."""

LARGEST = 1000.0
"""Anomaly above which a node holds no anomaly: the greatest on Earth are a few hundred. Units: mGal."""

EVEN = 1e-3
"""Unevenness of the nodes of a grid that is accepted, as a part of their spacing."""


def load_map(path: str, variable: str = "") -> GravityMap:
    """Return the map in a file, whose suffix gives the format.

    Args:
        path: of the file.
        variable: of a NetCDF file with several on a grid.

    XYZ text has three columns: longitude and latitude in degrees, anomaly in mGal, in any order of rows; `#` begins a
    comment, and a first line that does not hold numbers is a header.

    Raises:
        DataError: unreadable, not a regular grid, or the packages for its format are missing.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    if not file.is_file():
        raise DataError(f"{path}: no such file; expected a map file, or rough, moderate or constant")
    if variable and suffix not in NETCDF:
        raise DataError(f"{path}: --variable is of NetCDF files, this one has no variables; leave it out")
    if suffix in NETCDF + GEOTIFF:
        return _read_grid(path, suffix, variable)
    longitude, latitude, values = (_read_icgem(path) if suffix == ICGEM else _read_xyz(path)).T
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


def _read_icgem(path: str) -> Float:
    """Return longitude, latitude and anomaly in mGal of an ICGEM grid, shape (n, 3); a gap is NaN."""
    try:
        lines = Path(path).read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error}") from None
    end = next((i for i, line in enumerate(lines) if line.startswith("end_of_head")), None)
    if end is None:
        raise DataError(f'{path}: expected an ICGEM grid, whose header ends with "end_of_head"')
    head = {words[0]: words[1].strip() for line in lines[:end] if len(words := line.split(None, 1)) == 2}
    rows = []
    for number, line in enumerate(lines[end + 1 :], end + 2):
        if not line.strip():
            continue
        try:
            cells = [float(cell) for cell in line.split()]
            rows.append((cells[0], cells[1], cells[-1]))  # a height may stand between
        except (ValueError, IndexError):
            cells = []
        if len(cells) < 3:
            raise DataError(
                f"{path}, line {number}: expected longitude, latitude and anomaly, not {line[:40]!r}"
            )
    if not rows:
        raise DataError(f"{path}: holds no rows of longitude, latitude and anomaly")
    values = np.array(rows)
    try:
        gap = float(head.get("gapvalue", "nan"))
    except ValueError:
        gap = math.nan
    values[np.isclose(values[:, 2], gap), 2] = np.nan
    values[:, 2] *= _factor(path, head.get("unit", ""))
    return values


def _factor(path: str, unit: str) -> float:
    """Return the milligal in a unit; no unit is mGal."""
    plain = unit.strip().lower().translate(str.maketrans(dict.fromkeys(" ^*{}[]()"))).replace("\u00b5", "u")
    plain = plain.replace("**", "").replace("\u03bc", "u")
    if not plain:
        return 1.0
    if plain not in UNITS:
        raise DataError(
            f"{path}: the values are in {unit.strip()!r}; expected a gravity anomaly in mGal or m/s^2"
        )
    return UNITS[plain]


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
    if longitude[0] > longitude[-1] and (np.diff(longitude) < 0).all():
        longitude, values = longitude[::-1], values[:, ::-1]
    longitude, values = _without_seam(longitude, values)
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
    beyond = np.argwhere(np.abs(values) > LARGEST)
    if beyond.size:
        i, j = beyond[0]
        raise DataError(
            f"{path}: {values[i, j]:g} mGal at {latitude[i]:g} N {longitude[j]:g} E is no gravity anomaly (expected at "
            f"most {LARGEST:g}); write nodes without a value as NaN"
        )
    return GravityMap(np.radians(latitude[0]), np.radians(longitude[0]), steps[0], steps[1], values, path)


def _without_seam(longitude: Float, values: Float) -> tuple[Float, Float]:
    """Return columns in the order from west to east, where they cross the date line or Greenwich."""
    ascending = np.unwrap(longitude, period=360.0)  # 179, 180, -179
    if (np.diff(ascending) > 0).all() and ascending[-1] - ascending[0] <= 360.0:
        longitude = ascending
    steps = np.diff(longitude)
    seam = int(steps.argmax()) if len(steps) else 0
    if (
        len(steps) > 1
        and steps[seam] > 1.5 * np.median(steps)
        and np.sum(steps > 1.5 * np.median(steps)) == 1
    ):
        order = np.roll(np.arange(len(longitude)), -seam - 1)  # sorted: -180, -179, 179, 180
        turned = np.where(np.arange(len(longitude)) <= seam, longitude + 360.0, longitude)[order]
        inner = np.delete(steps, seam)
        if np.abs(turned[-seam - 1] - turned[-seam - 2] - inner.mean()) < EVEN * inner.mean() + 2e-6:
            return turned, values[:, order]
    return longitude, values


def _read_grid(path: str, suffix: str, variable: str) -> GravityMap:
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
            grids = {str(name): v for name, v in data.data_vars.items() if v.squeeze().ndim == 2}
            return _from_xarray(path, _chosen(path, grids, variable).squeeze().load())
    except DataError:
        raise
    except Exception as error:  # the readers raise whatever their libraries do
        raise DataError(f"{path}: cannot be read: {str(error).splitlines()[0]}") from None


def _chosen(path: str, grids: dict[str, Any], variable: str) -> Any:
    """Return the variable that is stated, or the only one."""
    names = ", ".join(grids)
    if variable and variable not in grids:
        raise DataError(
            f'{path}: no variable "{variable}" on a grid{did_you_mean(variable, grids)}; it has {names}'
        )
    if not variable and len(grids) != 1:
        raise DataError(
            f"{path}: expected one variable on a grid, not {len(grids)}"
            + (f" ({names}); state it by --variable NAME" if grids else "")
        )
    return grids[variable or names]


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
    values = np.asarray(grid.values, dtype=float) * _factor(path, str(grid.attrs.get("units", "")))
    return _regular_map(path, latitude, longitude, values)
