"""What a filter is given: indicated track, measured gravity, map and INS grade, for R runs at K epochs.

A recorded voyage from CSV: the indicated track, gravity, and the true track where one was kept.

Columns by name, in any order: time (s), latitude, longitude (degrees, indicated by the INS); and if there, gravity
(mGal), east and north (indicated velocity, m/s), heading (indicated, degrees clockwise from north; needed for sensors
that are strapped down), true_latitude, true_longitude (degrees). An empty gravity cell is an epoch without a
measurement.

Whether a map covers a track: beyond its edge, or beside a hole, a filter could only be confidently wrong.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.ins import STATES, Grade, discretise, dynamics, metres_per_radian, metric, turned
from accelcal_cli.navigation.voyage import SECONDS_PER_HOUR, Plan, Route, ins_errors, planned, wrapped
from accelcal_cli.rng import Purpose, Streams

VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA = 0.6, 1e-4, 1e-3
"""Of the prior, chosen: m/s, rad, rad."""


@dataclass(frozen=True)
class Scenario:
    """R runs of K epochs.

    Attributes:
        gravity_map: the map.
        grade: of the INS.
        noise: sigma of the gravimeter, mGal.
        initial: the position error at the start is within this on either axis, m.
        seconds: of the epochs since the voyage began, shape (K,).
        ins: the indicated track, its fields of shape (R, K).
        measured: gravity anomaly, mGal, shape (R, K); NaN where there is none.
        error: true position error of the INS, m north and east, shape (R, K, 2); None when it is not known.
        route: the true track, shape (K,), or the indicated one when it is not known.
        turns: changes of the indicated heading from epoch to epoch, clockwise, rad, shape (K - 1,). Of the heading, not
            of the course by the indicated velocity: half a metre a second across 8 m/s would turn the biases by 4 deg.
    """

    gravity_map: GravityMap
    grade: Grade
    noise: float
    initial: float
    seconds: Float
    ins: Route
    measured: Float
    error: Float | None
    route: Route
    turns: Float

    @property
    def runs(self) -> int:
        """R."""
        return len(self.measured)

    @property
    def epochs(self) -> int:
        """K."""
        return len(self.seconds)

    @property
    def period(self) -> float:
        """Time between epochs. Units: s."""
        return float(self.seconds[1] - self.seconds[0])

    @cached_property
    def scale(self) -> tuple[Float, Float]:
        """Metres of one radian of latitude and of longitude at the indicated places, shape (R, K)."""
        return metres_per_radian(self.ins.latitude)

    def transitions(self, first: int, last: int) -> Float:
        """Return the metric transitions from epoch k to k + 1, first <= k < last, shape (R, last - first, 12, 12).

        At the indicated latitude and velocity, as a real filter has it.
        """
        return transitions(self.ins, self.turns, (first, last), self.period, self.grade)

    def prior(self) -> Float:
        """Return the variances of the metric states at the start, shape (12,)."""
        sigma = np.empty(STATES)
        sigma[:2] = self.initial / math.sqrt(3.0)
        sigma[2:4], sigma[4:6], sigma[6] = VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA
        sigma[7:] = self.grade.biases()
        return sigma**2

    def instant(self, rows: Int, first: int, last: int) -> Scenario:
        """Return epochs `first` to `last` - 1 of some runs."""
        ins = Route(
            self.seconds[first:last],
            *(
                v[rows, first:last]
                for v in (self.ins.latitude, self.ins.longitude, self.ins.east, self.ins.north)
            ),
        )
        return replace(
            self, seconds=ins.seconds, ins=ins, measured=self.measured[rows, first:last], error=None
        )

    def anomaly(self, k: int, north: Float, east: Float) -> Float:
        """Return the map's anomaly in mGal at epoch k for position errors in m, shape (R, ...); NaN off the map."""
        shape = (self.runs,) + (1,) * (north.ndim - 1)
        latitude, longitude, meridian, parallel = (
            v[:, k].reshape(shape) for v in (self.ins.latitude, self.ins.longitude, *self.scale)
        )
        return self.gravity_map.at(latitude - north / meridian, longitude - east / parallel)


def transitions(route: Route, turns: Float, span: tuple[int, int], period: float, grade: Grade) -> Float:
    """Return the metric transitions along a track with these changes of heading; see `Scenario.transitions`."""
    first, last = span
    motion = route.motion()
    part = {name: getattr(motion, name)[..., first:last] for name in motion.__dataclass_fields__}
    F = discretise(dynamics(type(motion)(**part)), period)
    if grade.mounting == "strapdown":
        F = turned(F, np.append(turns, 0.0)[first:last])
    after = np.minimum(np.arange(first + 1, last + 1), len(route.seconds) - 1)
    return metric(F, route.latitude[..., first:last], route.latitude[..., after])


def simulate(
    gravity_map: GravityMap,
    plan: Plan,
    grade: Grade,
    *,
    runs: range,
    seed: int,
    period: float = 10.0,
    noise: float = 1.0,
    initial: float = 2000.0,
    believed: Grade | None = None,
) -> Scenario:
    """Return simulated runs: each draws its own INS errors and its own gravimeter noise.

    Args:
        gravity_map: true field and map at once, as in [depf2015] section 4.
        plan: the voyage; grade: of the INS; believed: what the filters take it for, the same when None.
        runs: their numbers; seed: of all random numbers.
        period: between measurements, whole seconds; noise: sigma, mGal; initial: see `Scenario`.
    """
    route = planned(plan)
    every = round(period)
    x = ins_errors(plan, route, grade, Streams(seed, runs, Purpose.INS), every)
    start = round(plan.filtered * SECONDS_PER_HOUR)
    keep = start + every * np.arange(x.shape[1])
    true = Route(
        route.seconds[keep], *(v[keep] for v in (route.latitude, route.longitude, route.east, route.north))
    )
    ins = Route(
        true.seconds,
        true.latitude + x[:, :, 0],
        true.longitude + x[:, :, 1],
        true.east + x[:, :, 2],
        true.north + x[:, :, 3],
    )
    meridian, parallel = metres_per_radian(ins.latitude)
    error = np.stack([x[:, :, 0] * meridian, x[:, :, 1] * parallel], axis=-1)
    anomaly = gravity_map.at(true.latitude, true.longitude)
    drawn = Streams(seed, runs, Purpose.GRAVIMETER).normal(1, len(keep))[:, 0]
    return Scenario(
        gravity_map,
        believed or grade,
        noise,
        initial,
        true.seconds,
        ins,
        anomaly + noise * drawn,
        error,
        true,
        true.turns(),  # the INS has its heading to the azimuth error, a milliradian
    )


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
