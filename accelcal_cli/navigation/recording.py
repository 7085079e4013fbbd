"""A recorded voyage: the CSV file of an INS and a gravimeter.

Columns by name, in any order: time (s, or ISO 8601), latitude, longitude (degrees, indicated by the INS); optional:
gravity (mGal), east and north (indicated velocity, m/s), heading (indicated, degrees clockwise from north; needed for
strapped-down sensors), true_latitude, true_longitude (degrees). An empty gravity cell is an epoch without a
measurement.

Times count from the first row, where the filter starts. Longitudes may be of 0 to 360 or of -180 to 180 degrees, and
cross the date line. Rows need not be quite regular; in a gap the INS is interpolated, and nothing is measured.
"""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, did_you_mean
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.ins import InsGrade, metres_per_radian
from accelcal_cli.navigation.noise import NoiseModel, eotvos
from accelcal_cli.navigation.scenario import Scenario, independent_prior, measure
from accelcal_cli.navigation.voyage import Trajectory, wrap_angle
from accelcal_cli.notices import Notice

NEEDED = ("time", "latitude", "longitude")
OPTIONAL = ("gravity", "east", "north", "heading", "true_latitude", "true_longitude")
TRUE = ("true_latitude", "true_longitude")

RANGES = {
    "latitude": (-89.0, 89.0, "degrees"),
    "longitude": (-360.0, 360.0, "degrees"),
    "true_latitude": (-89.0, 89.0, "degrees"),
    "true_longitude": (-360.0, 360.0, "degrees"),
    "gravity": (-1000.0, 1000.0, "mGal, an anomaly; leave the cell empty where there is none"),
    "east": (-1000.0, 1000.0, "m/s"),
    "north": (-1000.0, 1000.0, "m/s"),
    "heading": (-360.0, 360.0, "degrees"),
}
"""What a column may hold. The greatest anomalies on Earth are a few hundred milligal."""

GAP = 1.5
"""Times the usual step between rows from which it is a gap."""

LONGEST = 3600.0
"""Gap over which the INS is interpolated at most: a Schuler period is 84 minutes. Units: s."""

FASTEST = 1000.0
"""Speed between two rows above which a position is wrong. Units: m/s."""


@dataclass(frozen=True)
class RecordedVoyage:
    """A recorded voyage at the epochs of a period.

    Attributes:
        columns: by name, shape (K,), angles in degrees without jumps; `time` counts from the first row, s.
        notices: of gaps.
    """

    columns: dict[str, Float]
    notices: tuple[Notice, ...] = ()


def read_voyage(path: str, period: float) -> RecordedVoyage:
    """Return a recorded voyage at the epochs of a period in s.

    Raises:
        DataError: unreadable, a column missing, a value out of range, time that does not ascend, too long a gap, a
            step between rows that does not divide the period, or less than a period from first to last row.
    """
    table, lines = _read_columns(path)
    seconds = table["time"] - table["time"][0]
    steps = np.diff(seconds)
    if len(seconds) < 3:
        raise DataError(f"{path}: expected at least three rows, not {len(seconds)}")
    back = np.flatnonzero(~(steps > 0))
    if back.size:
        raise DataError(
            f"{path}, line {lines[back[0] + 1]}: time does not ascend; sort the rows, or remove the repeated one"
        )
    for name in table.keys() & {"longitude", "true_longitude", "heading"}:
        table[name] = np.unwrap(table[name], period=360.0)
    _check_speed(path, table, seconds, lines)
    usual = float(np.median(steps))
    usual = float(steps[steps <= GAP * usual].mean())  # where rows jitter the median is off
    notices = _check_gaps(path, steps, usual, lines)
    stride = round(period / usual)
    if stride < 1 or abs(stride * usual - period) > 0.01 * period:
        raise DataError(f"{path}: rows are {usual:g} s apart; --period {period:g} is not a multiple of that")
    epochs = np.arange(0.0, seconds[-1] + 0.5 * usual, stride * usual)
    if len(epochs) < 2:
        raise DataError(
            f"{path}: {len(seconds)} rows, {usual:g} s apart, hold one measurement at --period {period:g}; expected two"
        )
    return RecordedVoyage(_at_epochs(table, seconds, epochs, usual), notices)


def _at_epochs(table: dict[str, Float], seconds: Float, epochs: Float, usual: float) -> dict[str, Float]:
    """Return the columns at the row next to each epoch; in a gap interpolated, and without gravity."""
    after = np.clip(np.searchsorted(seconds, epochs), 1, len(seconds) - 1)
    nearest = after - (epochs - seconds[after - 1] < seconds[after] - epochs)
    near = np.abs(seconds[nearest] - epochs) <= 0.5 * GAP * usual
    columns = {"time": epochs}
    for name, values in table.items():
        if name == "gravity":
            columns[name] = np.where(near, values[nearest], np.nan)
        elif name != "time":
            columns[name] = np.where(near, values[nearest], np.interp(epochs, seconds, values))
    return columns


def _check_gaps(path: str, steps: Float, usual: float, lines: list[int]) -> tuple[Notice, ...]:
    """Refuse gaps over which nothing can be interpolated; say of others."""
    gaps = np.flatnonzero(steps > GAP * usual)
    if not gaps.size:
        return ()
    longest = int(steps.argmax())
    where = f"line {lines[longest + 1]}"
    if steps[longest] > LONGEST:
        raise DataError(
            f"{path}, {where}: a gap of {steps[longest]:g} s in the voyage; the INS is interpolated over at most "
            f"{LONGEST:g} s; cut the file there"
        )
    text = (
        f"{gaps.size} gap{'s' * (gaps.size != 1)} in the record, the longest of {steps[longest]:g} s at {where}: the "
        "INS is interpolated there, and nothing is measured."
    )
    return (Notice("gap", "note", text),)


def _check_speed(path: str, table: dict[str, Float], seconds: Float, lines: list[int]) -> None:
    """Refuse positions that nothing afloat or in the air gets to from those of the row before."""
    for north, east in (("latitude", "longitude"), TRUE):
        if north in table and east in table:
            meridian, parallel = metres_per_radian(np.radians(table[north][1:]))
            away = np.hypot(
                np.radians(np.diff(table[north])) * meridian, np.radians(np.diff(table[east])) * parallel
            )
            fast = np.flatnonzero(away > FASTEST * np.diff(seconds))
            if fast.size:
                raise DataError(
                    f"{path}, line {lines[fast[0] + 1]}: {north} and {east} jump by {away[fast[0]] / 1e3:.1f} km from "
                    "the row before; expected the degrees of one voyage"
                )


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
    if "gravity" not in header and not set(TRUE) <= set(header):
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
            value = _number(f'{where}, column "{name}"', name, cell)
        values.append(value)
    return values


def _number(where: str, name: str, cell: str) -> float:
    """Return the number in a cell, within the range of its column; a date and time is seconds since 1970 UTC."""
    try:
        value = float(cell)
    except ValueError:
        if name != "time":
            raise DataError(f"{where}: {cell!r} is not a number") from None
        return _timestamp(where, cell)
    if name == "gravity" and math.isnan(value):
        return value
    if not math.isfinite(value):
        raise DataError(f"{where}: {cell!r} is not a finite number")
    low, high, expected = RANGES.get(name, (-math.inf, math.inf, ""))
    if not low <= value <= high:
        raise DataError(f"{where}: {cell.strip()} is out of range; expected {low:g} to {high:g} {expected}")
    return value


def _timestamp(where: str, cell: str) -> float:
    """Return an ISO 8601 date and time as seconds since 1970, UTC unless it says otherwise."""
    try:
        moment = datetime.fromisoformat(cell.strip())
    except ValueError:
        raise DataError(
            f"{where}: {cell!r} is neither seconds nor a date and time as 2026-05-01T12:00:00Z"
        ) from None
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def from_recording(
    recording: RecordedVoyage,
    gravity_map: GravityMap,
    grade: InsGrade,
    *,
    runs: range,
    seed: int,
    noise: float,
    initial: float,
    effect: Literal["none", "corrected", "included"] = "none",
) -> Scenario:
    """Return the scenario of a recorded voyage; gravity that was not recorded is simulated on the true trajectory.

    Args:
        recording: the voyage; gravity_map: the map; grade: of the INS.
        runs, seed: of the simulated gravity; noise: of the gravimeter, mGal; initial: see `Scenario`.
        effect: the Eoetvoes effect in recorded gravity: none, corrected by the velocity of the INS, or included.
    """
    columns = recording.columns
    shape = len(runs), len(columns["time"])
    indicated = true = _trajectory(columns, "latitude", "longitude")
    gravity_map = gravity_map.facing(float(indicated.longitude.mean()))
    turn = gravity_map.turn_to(float(indicated.longitude.mean()))
    indicated = true = replace(indicated, longitude=indicated.longitude + turn)
    if "east" in columns and "north" in columns:
        indicated = true = replace(indicated, east=columns["east"], north=columns["north"])
    error = None
    if set(TRUE) <= columns.keys():
        true = _trajectory(columns, *TRUE)
        true = replace(true, longitude=indicated.longitude + wrap_angle(true.longitude - indicated.longitude))
        meridian, parallel = metres_per_radian(indicated.latitude)
        north, east = indicated.latitude - true.latitude, indicated.longitude - true.longitude
        error = np.broadcast_to(np.stack([north * meridian, east * parallel], axis=-1), (*shape, 2))
    if "gravity" in columns:
        gravity = columns["gravity"]
        if effect == "included":
            gravity = gravity + eotvos(indicated.latitude, indicated.east, indicated.north)
        measured = np.broadcast_to(gravity, shape)
    else:
        measured = measure(gravity_map, true, noise, runs, seed)
    turns = wrap_angle(np.diff(np.radians(columns["heading"]))) if "heading" in columns else indicated.turns()
    parts = (indicated.latitude, indicated.longitude, indicated.east, indicated.north)
    ins = Trajectory(columns["time"], *(np.broadcast_to(part, shape) for part in parts))
    prior = independent_prior(grade, initial)
    return Scenario(
        gravity_map, grade, noise, initial, ins, measured, prior, error, true, turns,
        models=(NoiseModel(eotvos=effect != "none"),), notices=recording.notices,
    )  # fmt: skip


def _trajectory(columns: dict[str, Float], north: str, east: str) -> Trajectory:
    """Return the trajectory of two columns, with velocities from the differences of its positions."""
    seconds, latitude, longitude = columns["time"], np.radians(columns[north]), np.radians(columns[east])
    meridian, parallel = metres_per_radian(latitude)
    velocity = np.gradient(longitude, seconds) * parallel, np.gradient(latitude, seconds) * meridian
    return Trajectory(seconds, latitude, longitude, *velocity)
