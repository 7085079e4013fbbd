"""A recorded voyage from CSV: the indicated track, gravity, and the true track where one was kept.

Columns by name, in any order: time (s), latitude, longitude (degrees, indicated by the INS); and if there, gravity
(mGal), east and north (indicated velocity, m/s), heading (indicated, degrees clockwise from north; needed for sensors
that are strapped down), true_latitude, true_longitude (degrees). An empty gravity cell is an epoch without a
measurement.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.error_model import Grade
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.navigation.voyage import Route, wrapped
from accelcal_cli.streams import Float, Purpose, Streams

NEEDED = ("time", "latitude", "longitude")
FURTHER = ("gravity", "east", "north", "heading", "true_latitude", "true_longitude")
GAP = 1.5
"""Times the usual step between rows."""


@dataclass(frozen=True)
class Recorded:
    """A recorded voyage: columns of shape (K,) by name, angles in degrees; `path` is the file."""

    path: str
    columns: dict[str, Float]

    def has(self, *names: str) -> bool:
        """Whether all of these columns are there."""
        return all(name in self.columns for name in names)


def read_voyage(path: str, period: float) -> Recorded:
    """Return a recorded voyage at the epochs of a period in s.

    Raises:
        DataError: unreadable, a column missing, a gap in time, rows that are no multiple of the period apart, or less
            than a period from first to last.
    """
    table, lines = _rows(path)
    seconds = table["time"]
    steps = np.diff(seconds)
    if len(seconds) < 3 or not (steps > 0).all():
        raise DataError(f"{path}: expected at least three rows with ascending time")
    usual = float(np.median(steps))
    late = np.flatnonzero(steps > GAP * usual)
    if late.size:
        first = int(late[0])
        raise DataError(
            f"{path}, line {lines[first + 1]}: a gap of {steps[first]:g} s in the voyage (rows are {usual:g} s apart); "
            "cut the file there, or give the rows with empty gravity"
        )
    stride = round(period / usual)
    if stride < 1 or abs(stride * usual - period) > 0.01 * period:
        raise DataError(f"{path}: rows are {usual:g} s apart; --period {period:g} is no multiple of that")
    if len(seconds) <= stride:
        raise DataError(
            f"{path}: {len(seconds)} rows, {usual:g} s apart, hold one measurement at --period {period:g}; expected two"
        )
    return Recorded(path, {name: values[::stride] for name, values in table.items()})


def _rows(path: str) -> tuple[dict[str, Float], list[int]]:
    """Return the columns of the file and the line of each row."""
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [name.strip().lower() for name in next(reader, [])]
            _check_header(path, header)
            rows, lines = [], []
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    rows.append(_numbers(path, reader.line_num, header, cells))
                    lines.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read: {error}") from None
    if not rows:
        raise DataError(f"{path}: holds no rows")
    values = np.array(rows)
    return {name: values[:, i] for i, name in enumerate(header) if name in NEEDED + FURTHER}, lines


def _check_header(path: str, header: list[str]) -> None:
    for name in NEEDED:
        if name not in header:
            raise DataError(f'{path}, line 1: no column "{name}"{did_you_mean(name, header)}')
    if "gravity" not in header and not {"true_latitude", "true_longitude"} <= set(header):
        raise DataError(f'{path}, line 1: expected a column "gravity", or the true track to simulate it from')


def _numbers(path: str, line: int, header: list[str], cells: list[str]) -> list[float]:
    if len(cells) != len(header):
        raise DataError(f"{path}, line {line}: expected {len(header)} cells, not {len(cells)}")
    found = []
    for name, cell in zip(header, cells, strict=True):
        try:
            value = float(cell) if cell.strip() or name != "gravity" else math.nan
        except ValueError:
            if name in NEEDED + FURTHER:
                raise DataError(f'{path}, line {line}, column "{name}": {cell!r} is not a number') from None
            value = math.nan
        missing = name == "gravity" and math.isnan(value)
        if name in NEEDED + FURTHER and not (missing or math.isfinite(value)):
            raise DataError(f'{path}, line {line}, column "{name}": {cell!r} is not a finite number')
        found.append(value)
    return found


def recorded(
    voyage: Recorded,
    gravity_map: GravityMap,
    grade: Grade,
    noise: float,
    initial: float,
    runs: range,
    seed: int,
) -> Scenario:
    """Return the scenario of a recorded voyage; without gravity it is the map at the true track plus noise."""
    own = voyage.columns
    shape = len(runs), len(own["time"])
    indicated = _route(own, "latitude", "longitude")
    ins = Route(
        own["time"], *(np.broadcast_to(v, shape) for v in (indicated.latitude, indicated.longitude)),
        *(np.broadcast_to(v, shape) for v in (indicated.east, indicated.north)),
    )  # fmt: skip
    route, error = indicated, None
    if voyage.has("true_latitude", "true_longitude"):
        route = _route(own, "true_latitude", "true_longitude")
        meridian, parallel = metres_per_radian(indicated.latitude)
        away = (
            (indicated.latitude - route.latitude) * meridian,
            (indicated.longitude - route.longitude) * parallel,
        )
        error = np.broadcast_to(np.stack(away, axis=-1), (*shape, 2))
    if voyage.has("gravity"):
        measured = np.broadcast_to(own["gravity"], shape)
    else:
        drawn = Streams(seed, runs, Purpose.GRAVIMETER).normal(1, shape[1])[:, 0]
        measured = gravity_map.at(route.latitude, route.longitude) + noise * drawn
    turns = wrapped(np.diff(np.radians(own["heading"]))) if voyage.has("heading") else indicated.turns()
    return Scenario(gravity_map, grade, noise, initial, own["time"], ins, measured, error, route, turns)


def _route(own: dict[str, Float], north: str, east: str) -> Route:
    """Return a track with its velocities: the recorded ones, or the differences of its positions."""
    latitude, longitude = np.radians(own[north]), np.radians(own[east])
    meridian, parallel = metres_per_radian(latitude)
    if north == "latitude" and "east" in own and "north" in own:
        return Route(own["time"], latitude, longitude, own["east"], own["north"])
    return Route(
        own["time"],
        latitude,
        longitude,
        np.gradient(longitude, own["time"]) * parallel,
        np.gradient(latitude, own["time"]) * meridian,
    )
