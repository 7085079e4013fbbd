"""The navigation study: filters on many runs of one voyage, beside the bound and the INS alone."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from accelcal_cli.navigation.bound import bound
from accelcal_cli.navigation.error_model import Grade
from accelcal_cli.navigation.filters import FILTER_PURPOSE, Track
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.navigation.scores import Scores, counted, score
from accelcal_cli.streams import Float, Streams
from accelcal_cli.studies.study import Record, Study, Task
from accelcal_cli.studies.voyages import FilterEntry, Waters
from accelcal_cli.table import Column, Table

EVERY = 300.0
"""Seconds between the points of a record's curves."""

AXES = ("north", "east", "latitude", "longitude", "sigma")
OFFSET = 10_000_000
"""A record's curve holds one block for each of AXES, its seconds moved by so much."""

COLUMNS = (
    Column("filter"),
    Column("mode"),
    Column("runs", format="d"),
    Column("position", "m", ".1f", key="rmse_position_m"),
    Column("latitude", "m", ".1f", key="rmse_latitude_m"),
    Column("longitude", "m", ".1f", key="rmse_longitude_m"),
    Column("95 %", "m", ".0f", key="circular_95_m"),
    Column("bound", "m", ".1f", key="bound_m"),
    Column("ratio", format=".2f", key="bound_ratio"),
    Column("INS alone", "m", ".0f", key="ins_m"),
    Column("lost", format="d"),
    Column("diverged", format="d"),
    Column("NEES", format=".3g", key="nees"),
    Column("look-ups", "1/epoch", ".0f", key="lookups"),
    Column("time", "s", ".1f", key="seconds"),
    Column("epoch", "us", ".0f", key="epoch_us"),
    Column("accelerometer", "micro-g", ".3g", key="accelerometer_ug"),
)


@dataclass(frozen=True)
class Navigation(Study):
    """Every filter with every grade of INS; one cell a pair.

    Attributes:
        waters: map, voyage, gravimeter.
        entries: the filters.
        grades: of the INS: one, or without and with a calibration.
        repeats: runs of each; seed: of all of them.
    """

    waters: Waters
    entries: tuple[FilterEntry, ...]
    grades: tuple[Grade, ...]
    repeats: int = 20
    seed: int = 0

    @property
    def cells(self) -> int:
        """Filters times grades."""
        return len(self.entries) * len(self.grades)

    @property
    def runs(self) -> int:
        """Runs of each cell."""
        return self.repeats

    @property
    def block(self) -> int:
        """Runs of one task."""
        return 25

    def part(self, cell: int) -> tuple[FilterEntry, Grade]:
        """Return filter and grade of a cell."""
        grade, entry = divmod(cell, len(self.entries))
        return self.entries[entry], self.grades[grade]

    def names(self, cell: int) -> dict[str, str]:
        """Return what identifies a cell."""
        entry, grade = self.part(cell)
        return {
            "filter": entry.label,
            "mode": str(entry.parameters.get("mode", "default")),
            "accelerometer_ug": f"{grade.accelerometer:.6g}",
        }

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        runs = range(task.first, task.last)
        entry, grade = self.part(task.cell)
        scenario = self.waters.scenario(grade, runs, self.seed)
        begin = time.perf_counter()
        with np.errstate(all="ignore"):  # a diverging filter overflows; its score says so
            track = entry.build().run(scenario, Streams(self.seed, runs, FILTER_PURPOSE))
            scores = score(scenario, track)
        seconds = (time.perf_counter() - begin) / len(runs)
        return [_record(task, i, scenario, track, scores, seconds) for i in range(len(runs))]


def _record(task: Task, i: int, scenario: Scenario, track: Track, scores: Scores, seconds: float) -> Record:
    status = "diverged" if scores.diverged[i] else "lost" if scores.lost[i] else "kept"
    values = {
        "mean_square_latitude": scores.north[i],
        "mean_square_longitude": scores.east[i],
        "mean_square_ins": scores.ins[i],
        "nees": scores.nees[i],
        "sigma_m": scores.sigma[i],
        "blind": track.blind[i],
        "lookups": track.lookups,
    }
    return Record(
        task.cell,
        task.first + i,
        float(np.sqrt(scores.north[i] + scores.east[i])),
        round(track.lookups * scenario.epochs),
        scenario.epochs,
        status,
        None,
        {name: float(v) if np.isfinite(v) else None for name, v in values.items()},
        _curve(i, scenario, track, scores),
        seconds,
    )


def _curve(i: int, scenario: Scenario, track: Track, scores: Scores) -> tuple[tuple[int, float], ...]:
    """Return errors north and east, corrected place (degrees) and claimed sigma of a run, block by block."""
    from accelcal_cli.navigation.earth import metres_per_radian

    stride = max(1, round(EVERY / scenario.period))
    seconds = scenario.seconds[::stride]
    latitude = scenario.ins.latitude[i, ::stride]
    meridian, parallel = metres_per_radian(latitude)
    blocks = (
        scores.error[i, ::stride, 0],
        scores.error[i, ::stride, 1],
        np.degrees(latitude - track.mean[i, ::stride, 0] / meridian),
        np.degrees(scenario.ins.longitude[i, ::stride] - track.mean[i, ::stride, 1] / parallel),
        np.sqrt(np.einsum("kii->k", track.covariance[i, ::stride])),
    )
    return tuple(
        (round(second) + OFFSET * axis, float(value))
        for axis, block in enumerate(blocks)
        for second, value in zip(seconds, block, strict=True)
        if np.isfinite(value)
    )


def axis_of(record: Record, axis: str) -> tuple[Float, Float]:
    """Return seconds and one of AXES of a record's curve, both of shape (points,)."""
    first = AXES.index(axis) * OFFSET
    points = [(n - first, value) for n, value in record.curve if first <= n < first + OFFSET]
    seconds, values = np.array(points).T if points else (np.empty(0), np.empty(0))
    return seconds, values


def own(records: Sequence[Record], cell: int) -> list[Record]:
    """Return the records of one cell."""
    return [record for record in records if record.cell == cell]


def summary(study: Navigation, records: Sequence[Record]) -> Table:
    """Return one row a filter: errors over hours 3 to 8, bound, lost runs, consistency, time."""
    bounds = [_bound(study, grade) for grade in study.grades]
    rows = tuple(
        _row(study, cell, own(records, cell), bounds[cell // len(study.entries)])
        for cell in range(study.cells)
    )
    notes = [note for cell in range(study.cells) if (note := _note(study, cell, own(records, cell)))]
    return Table("Navigation", COLUMNS, rows, tuple(notes))


def _bound(study: Navigation, grade: Grade) -> float:
    """Return the root of the mean bound on the squared position error over the counted epochs, m."""
    scenario = study.waters.scenario(grade, range(1), study.seed)
    return float(np.sqrt(bound(scenario)[counted(scenario)].sum(axis=1).mean()))


def _row(study: Navigation, cell: int, records: Sequence[Record], least: float) -> tuple[object, ...]:
    entry, grade = study.part(cell)
    north, east, ins, nees, lookups = (
        _mean(records, name)
        for name in ("mean_square_latitude", "mean_square_longitude", "mean_square_ins", "nees", "lookups")
    )
    position = float(np.sqrt(north + east))
    seconds = sum(record.seconds for record in records)
    return (
        entry.label,
        study.names(cell)["mode"],
        len(records),
        *(position, float(np.sqrt(north)), float(np.sqrt(east)), _circular(records)),
        *(least, position / least, float(np.sqrt(ins))),
        sum(record.status != "kept" for record in records),
        sum(record.status == "diverged" for record in records),
        *(nees, lookups, seconds),
        1e6 * seconds / sum(record.iterations for record in records),
        grade.accelerometer,
    )


def _mean(records: Sequence[Record], name: str) -> float:
    values = [record.values[name] for record in records]
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else float("nan")


def _circular(records: Sequence[Record]) -> float:
    """Return the radius that holds 95 % of the errors from hour 3 on, of the curves' points, m."""
    from accelcal_cli.navigation.scores import SETTLED
    from accelcal_cli.navigation.voyage import SECONDS_PER_HOUR

    found = []
    for record in records:
        seconds, north = axis_of(record, "north")
        if len(seconds):
            late = seconds >= min(SETTLED * SECONDS_PER_HOUR, seconds[-1])
            found.append(np.hypot(north, axis_of(record, "east")[1])[late])
    return float(np.percentile(np.concatenate(found), 95)) if found else float("nan")


def _note(study: Navigation, cell: int, records: Sequence[Record]) -> str:
    lost = sum(record.status == "lost" for record in records)
    diverged = sum(record.status == "diverged" for record in records)
    if not lost + diverged:
        return ""
    names = study.names(cell)
    return (
        f"{names['filter']} ({names['mode']}): of {len(records)} runs {diverged} diverged and {lost} lost "
        "lock; their errors are in the row."
    )


def beside(table: Table, further: Mapping[str, Any]) -> Table:
    """Return a summary with the paper's RMSE of the position beside ours, and the study's title and note."""
    paper = {str(name).lower(): value for name, value in (further.get("paper") or {}).items()}
    at = [column.key for column in table.columns].index("rmse_position_m") + 1
    rows = [(*row[:at], paper.get(str(row[0]).lower()), *row[at:]) for row in table.rows]
    column = Column("paper", "m", ".1f", key="paper_m")
    notes = tuple(filter(None, (*table.notes, further.get("note"))))
    title = str(further.get("title", table.title))
    return Table(title, (*table.columns[:at], column, *table.columns[at:]), tuple(rows), notes)


def curves(study: Navigation, records: Sequence[Record]) -> Table:
    """Return RMSE against time of every filter: the raw curves of the pictures, and run 0's corrected track."""
    rows: list[tuple[object, ...]] = []
    for cell in range(study.cells):
        kept = own(records, cell)
        names = study.names(cell)
        first = {axis: dict(zip(*axis_of(kept[0], axis), strict=True)) for axis in AXES}
        squares = {axis: _by_second(kept, axis) for axis in ("north", "east")}
        for second in first["sigma"]:
            north, east = squares["north"].get(second), squares["east"].get(second)
            rows.append(
                (
                    names["filter"], names["mode"], float(names["accelerometer_ug"]), int(second),
                    None if north is None else north**0.5,
                    None if east is None else east**0.5,
                    None if north is None or east is None else (north + east) ** 0.5,
                    first["latitude"].get(second), first["longitude"].get(second), first["sigma"][second],
                )
            )  # fmt: skip
    columns = (
        Column("filter"), Column("mode"), Column("accelerometer_ug"), Column("seconds", "s", "d"),
        Column("rmse_latitude_m", "m", ".1f"), Column("rmse_longitude_m", "m", ".1f"),
        Column("rmse_position_m", "m", ".1f"),
        Column("latitude", "deg", ".6f"), Column("longitude", "deg", ".6f"), Column("sigma_m", "m", ".1f"),
    )  # fmt: skip
    return Table("RMSE against time", columns, tuple(rows))


def _by_second(records: Sequence[Record], axis: str) -> dict[float, float]:
    """Return the mean square over runs at each second."""
    total: dict[float, list[float]] = {}
    for record in records:
        for second, value in zip(*axis_of(record, axis), strict=True):
            total.setdefault(float(second), []).append(float(value) ** 2)
    return {second: float(np.mean(values)) for second, values in total.items()}
