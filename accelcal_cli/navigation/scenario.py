"""What a filter is given: indicated trajectory, measured gravity, map and INS grade, for R runs at K epochs.

A scenario is simulated, or comes from the CSV file of a recorded voyage. Columns by name, in any order: time (s),
latitude, longitude (degrees, indicated by the INS); optional: gravity (mGal), east and north (indicated velocity, m/s),
heading (indicated, degrees clockwise from north; needed for strapped-down sensors), true_latitude, true_longitude
(degrees). An empty gravity cell is an epoch without a measurement.

The map must cover the trajectory: beyond its edge, or beside a hole, a filter could only be confidently wrong.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.ins import (
    STATES,
    InsGrade,
    Motion,
    discretise,
    dynamics,
    metres_per_radian,
    to_metric,
    turn_biases,
)
from accelcal_cli.navigation.voyage import (
    SECONDS_PER_HOUR,
    PlannedVoyage,
    Trajectory,
    aligned_covariance,
    ins_errors,
    wrap_angle,
)
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
        initial: sqrt(3) sigma of the position error at the start on either axis, m; a run further off is astray.
        ins: the indicated trajectory, its fields of shape (R, K).
        measured: gravity anomaly, mGal, shape (R, K); NaN where there is none.
        prior: covariance of the metric states at the start, shape (12, 12): what the filters are told.
        error: true position error of the INS, m north and east, shape (R, K, 2); None when it is not known.
        true: the true trajectory, shape (K,), or the indicated one when the true one is not known.
        turns: changes of the indicated heading between epochs, clockwise, rad, shape (K - 1,). Of the heading, not of
            the course by the indicated velocity: half a metre per second across 8 m/s would turn the biases by 4 deg.
    """

    gravity_map: GravityMap
    grade: InsGrade
    noise: float
    initial: float
    ins: Trajectory
    measured: Float
    prior: Float
    error: Float | None
    true: Trajectory
    turns: Float

    @property
    def seconds(self) -> Float:
        """Times of the epochs since the start of the voyage, shape (K,). Units: s."""
        return self.ins.seconds

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
        return self.ins.step

    @cached_property
    def scale(self) -> tuple[Float, Float]:
        """Metres per radian of latitude and of longitude at the indicated positions, shape (R, K)."""
        return metres_per_radian(self.ins.latitude)

    def transitions(self, first: int, last: int) -> Float:
        """Return the metric transitions from epoch k to k + 1, first <= k < last, shape (R, last - first, 12, 12).

        At the indicated latitude and velocity, which is what a real filter has.
        """
        motion = Motion(*(values[..., first:last] for values in vars(self.ins.motion).values()))
        F = discretise(dynamics(motion), self.period)
        if self.grade.mounting == "strapdown":
            F = turn_biases(F, np.append(self.turns, 0.0)[first:last])
        after = np.minimum(np.arange(first + 1, last + 1), self.epochs - 1)
        return to_metric(F, self.ins.latitude[..., first:last], self.ins.latitude[..., after])

    def part(self, rows: Int, first: int, last: int) -> Scenario:
        """Return epochs `first` to `last` - 1 of some runs."""
        ins = self.ins
        fields = (v[rows, first:last] for v in (ins.latitude, ins.longitude, ins.east, ins.north))
        ins = Trajectory(ins.seconds[first:last], *fields)
        return replace(self, ins=ins, measured=self.measured[rows, first:last], error=None)

    def anomaly(self, k: int, north: Float, east: Float) -> Float:
        """Return the map's anomaly in mGal at epoch k for position errors in m, shape (R, ...); NaN off the map."""
        shape = (self.runs,) + (1,) * (north.ndim - 1)
        latitude, longitude, meridian, parallel = (
            v[:, k].reshape(shape) for v in (self.ins.latitude, self.ins.longitude, *self.scale)
        )
        return self.gravity_map.at(latitude - north / meridian, longitude - east / parallel)


def independent_prior(grade: InsGrade, initial: float) -> Float:
    """Return the covariance of the metric states of which none tells of another, shape (12, 12); initial: m."""
    sigma = np.empty(STATES)
    sigma[:2] = initial / math.sqrt(3.0)
    sigma[2:4], sigma[4:6], sigma[6] = VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA
    sigma[7:] = grade.biases()
    return np.diag(sigma**2)


Prior = Literal["independent", "tied"]


def simulate(
    gravity_map: GravityMap,
    plan: PlannedVoyage,
    grade: InsGrade,
    *,
    runs: range,
    seed: int,
    period: float = 10.0,
    noise: float = 1.0,
    initial: float = 2000.0,
    prior: Prior = "independent",
) -> Scenario:
    """Return simulated runs: each draws its own INS errors and its own gravimeter noise.

    Args:
        gravity_map: both the true field and the map, as in [depf2015] section 4.
        plan: the voyage; grade: of the INS.
        runs: their numbers; seed: of all random numbers.
        period: between measurements, whole seconds; noise: sigma, mGal; initial: see `Scenario`.
        prior: how the INS errors begin, see `voyage`.
    """
    every = round(period)
    start = plan.trajectory().at(slice(plan.start, plan.start + 1)).latitude
    metres = np.append(np.concatenate(metres_per_radian(start)), np.ones(STATES - 2))
    if prior == "tied":
        radian_prior, told = None, aligned_covariance(plan, grade) * np.outer(metres, metres)
    else:
        told = independent_prior(grade, initial)
        radian_prior = told / np.outer(metres, metres)
    x = ins_errors(plan, grade, radian_prior, Streams(seed, runs, Purpose.INS), every)
    true = plan.trajectory().at(plan.start + every * np.arange(x.shape[1]))
    ins = Trajectory(
        true.seconds,
        true.latitude + x[:, :, 0],
        true.longitude + x[:, :, 1],
        true.east + x[:, :, 2],
        true.north + x[:, :, 3],
    )
    meridian, parallel = metres_per_radian(ins.latitude)
    error = np.stack([x[:, :, 0] * meridian, x[:, :, 1] * parallel], axis=-1)
    measured = _measure(gravity_map, true, noise, runs, seed)
    # The INS knows its heading to within the azimuth error, a milliradian.
    return Scenario(gravity_map, grade, noise, initial, ins, measured, told, error, true, true.turns())


def _measure(gravity_map: GravityMap, true: Trajectory, noise: float, runs: range, seed: int) -> Float:
    """Return measured anomalies, shape (R, K): the map along the true trajectory plus the noise of the gravimeter."""
    drawn = Streams(seed, runs, Purpose.GRAVIMETER).normal(1, len(true.seconds))[:, 0]
    return gravity_map.at(true.latitude, true.longitude) + noise * drawn


NEEDED = ("time", "latitude", "longitude")
OPTIONAL = ("gravity", "east", "north", "heading", "true_latitude", "true_longitude")
GAP = 1.5
"""Times the usual step between rows."""


def read_voyage(path: str, period: float) -> dict[str, Float]:
    """Return the columns of a recorded voyage at the epochs of a period in s: shape (K,), angles in degrees.

    Raises:
        DataError: unreadable, a column missing, a gap in time, a step between rows that does not divide the period, or
            less than a period from first to last row.
    """
    table, lines = _read_columns(path)
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
            "cut the file there, or fill the gap with rows of empty gravity"
        )
    stride = round(period / usual)
    if stride < 1 or abs(stride * usual - period) > 0.01 * period:
        raise DataError(f"{path}: rows are {usual:g} s apart; --period {period:g} is not a multiple of that")
    if len(seconds) <= stride:
        raise DataError(
            f"{path}: {len(seconds)} rows, {usual:g} s apart, hold one measurement at --period {period:g}; expected two"
        )
    return {name: values[::stride] for name, values in table.items()}


def _read_columns(path: str) -> tuple[dict[str, Float], list[int]]:
    """Return the columns of a file and the line of each row."""
    rows, lines = [], []
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file)
            header = [name.strip().lower() for name in next(reader, [])]
            _check_header(path, header)
            for cells in reader:
                if any(cell.strip() for cell in cells):
                    rows.append(_numbers(f"{path}, line {reader.line_num}", header, cells))
                    lines.append(reader.line_num)
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{path}: cannot be read: {error}") from None
    if not rows:
        raise DataError(f"{path}: holds no rows")
    values = np.array(rows)
    return {name: values[:, i] for i, name in enumerate(header) if name in NEEDED + OPTIONAL}, lines


def _check_header(path: str, header: list[str]) -> None:
    for name in NEEDED:
        if name not in header:
            raise DataError(f'{path}, line 1: no column "{name}"{did_you_mean(name, header)}')
    if "gravity" not in header and not {"true_latitude", "true_longitude"} <= set(header):
        raise DataError(
            f'{path}, line 1: expected a column "gravity", or the true trajectory to simulate it from'
        )


def _numbers(where: str, header: list[str], cells: list[str]) -> list[float]:
    """Return the numbers of one row; NaN for empty gravity and in columns that are not used."""
    if len(cells) != len(header):
        raise DataError(f"{where}: expected {len(header)} cells, not {len(cells)}")
    values = []
    for name, cell in zip(header, cells, strict=True):
        value, empty = math.nan, name == "gravity" and not cell.strip()
        if name in NEEDED + OPTIONAL and not empty:
            try:
                value = float(cell)
            except ValueError:
                raise DataError(f'{where}, column "{name}": {cell!r} is not a number') from None
            if not (math.isfinite(value) or (name == "gravity" and math.isnan(value))):
                raise DataError(f'{where}, column "{name}": {cell!r} is not a finite number')
        values.append(value)
    return values


def from_recording(
    columns: dict[str, Float],
    gravity_map: GravityMap,
    grade: InsGrade,
    *,
    runs: range,
    seed: int,
    noise: float,
    initial: float,
) -> Scenario:
    """Return the scenario of a recorded voyage; gravity that was not recorded is simulated on the true trajectory."""
    shape = len(runs), len(columns["time"])
    indicated = true = _trajectory(columns, "latitude", "longitude")
    if "east" in columns and "north" in columns:
        indicated = true = replace(indicated, east=columns["east"], north=columns["north"])
    error = None
    if "true_latitude" in columns and "true_longitude" in columns:
        true = _trajectory(columns, "true_latitude", "true_longitude")
        meridian, parallel = metres_per_radian(indicated.latitude)
        north, east = indicated.latitude - true.latitude, indicated.longitude - true.longitude
        error = np.broadcast_to(np.stack([north * meridian, east * parallel], axis=-1), (*shape, 2))
    measured = (
        np.broadcast_to(columns["gravity"], shape)
        if "gravity" in columns
        else _measure(gravity_map, true, noise, runs, seed)
    )
    turns = wrap_angle(np.diff(np.radians(columns["heading"]))) if "heading" in columns else indicated.turns()
    parts = (indicated.latitude, indicated.longitude, indicated.east, indicated.north)
    ins = Trajectory(columns["time"], *(np.broadcast_to(part, shape) for part in parts))
    prior = independent_prior(grade, initial)
    return Scenario(gravity_map, grade, noise, initial, ins, measured, prior, error, true, turns)


def _trajectory(columns: dict[str, Float], north: str, east: str) -> Trajectory:
    """Return the trajectory of two columns, with velocities from the differences of its positions."""
    seconds, latitude, longitude = columns["time"], np.radians(columns[north]), np.radians(columns[east])
    meridian, parallel = metres_per_radian(latitude)
    velocity = np.gradient(longitude, seconds) * parallel, np.gradient(latitude, seconds) * meridian
    return Trajectory(seconds, latitude, longitude, *velocity)


DIRECTIONS = 8


def check_coverage(gravity_map: GravityMap, trajectory: Trajectory, initial: float) -> None:
    """Refuse a map that ends, or has cells without a value, within the initial error of a trajectory.

    Args:
        gravity_map: the map; trajectory: fields of shape (K,).
        initial: m.

    Raises:
        DataError: with the place and the time where the map ends.
    """
    meridian, parallel = metres_per_radian(trajectory.latitude)
    for turn in np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS:
        for reach in (0.0, 0.5 * initial, initial):
            latitude = trajectory.latitude + reach * np.cos(turn) / meridian
            longitude = trajectory.longitude + reach * np.sin(turn) / parallel
            unknown = np.isnan(gravity_map.at(latitude, longitude))
            if unknown.any():
                k = int(np.argmax(unknown))
                raise DataError(_uncovered(gravity_map, latitude[k], longitude[k], trajectory.seconds[k]))


def _uncovered(gravity_map: GravityMap, latitude: float, longitude: float, seconds: float) -> str:
    """Return the message for a map without a value at a place in rad, some seconds into the voyage."""
    edges = (gravity_map.south, gravity_map.north, gravity_map.west, gravity_map.east)
    south, north, west, east, latitude, longitude = np.degrees([*edges, latitude, longitude])
    inside = south <= latitude <= north and west <= longitude <= east
    return (
        f"{gravity_map.source}: the map {'has a cell without a value' if inside else 'ends'} at {latitude:.4f} N "
        f"{longitude:.4f} E, within the position error of the track at hour {seconds / SECONDS_PER_HOUR:.2f}; it "
        f"covers {south:.3f} to {north:.3f} N and {west:.3f} to {east:.3f} E"
    )
