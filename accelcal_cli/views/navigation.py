"""The tables of a navigation study: one row a filter, and RMSE against time.

What a picture of a navigation study shows: the map, run 0's tracks over it, and RMSE against time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.ins import Grade
from accelcal_cli.navigation.scores import SETTLED, bound, counted
from accelcal_cli.navigation.study import AXES, Navigation, axis_of, mean_squares, stride_of
from accelcal_cli.navigation.voyage import SECONDS_PER_HOUR
from accelcal_cli.studies.study import Record
from accelcal_cli.table import Column, Table

COLUMNS = (
    Column("filter"),
    Column("mode"),
    Column("accelerometer", "micro-g", ".3g", key="accelerometer_ug"),
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
)


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
        grade.accelerometer,
        len(records),
        *(position, float(np.sqrt(north)), float(np.sqrt(east)), _circular(records)),
        *(least, position / least, float(np.sqrt(ins))),
        sum(record.status != "kept" for record in records),
        sum(record.status == "diverged" for record in records),
        *(nees, lookups, seconds),
        1e6 * seconds / sum(record.iterations for record in records),
    )


def _mean(records: Sequence[Record], name: str) -> float:
    values = [record.values[name] for record in records]
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if len(known) == len(values) else float("nan")


def _circular(records: Sequence[Record]) -> float:
    """Return the radius that holds 95 % of the errors from hour 3 on, of the curves' points, m."""
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
    ins = f", {float(names['accelerometer_ug']):.3g} micro-g" if len(study.grades) > 1 else ""
    runs = f"{len(records)} run{'s' * (len(records) != 1)}"
    return (
        f"{names['filter']} ({names['mode']}{ins}): of {runs} {diverged} diverged and {lost} lost "
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


CURVES = (
    Column("filter"),
    Column("mode"),
    Column("accelerometer_ug"),
    Column("seconds", "s", "d"),
    Column("rmse_latitude_m", "m", ".1f"),
    Column("rmse_longitude_m", "m", ".1f"),
    Column("rmse_position_m", "m", ".1f"),
    Column("latitude", "deg", ".6f"),
    Column("longitude", "deg", ".6f"),
    Column("sigma_m", "m", ".1f"),
)
INS, BOUND = "INS alone", "bound"
"""What stands among the filters in the curves."""


def curves(study: Navigation, records: Sequence[Record]) -> Table:
    """Return RMSE against time of every filter, of the INS alone and the bound, and run 0's corrected track."""
    rows: list[tuple[object, ...]] = []
    for cell in range(study.cells):
        rows += _curves_of(study.names(cell), own(records, cell))
    for grade in study.grades:
        rows += _limits(study, grade)
    return Table("RMSE against time", CURVES, tuple(rows))


def _curves_of(names: Mapping[str, str], records: Sequence[Record]) -> list[tuple[object, ...]]:
    first = {axis: dict(zip(*axis_of(records[0], axis), strict=True)) for axis in AXES}
    squares = [mean_squares(records, axis) for axis in ("north", "east")]
    return [
        (names["filter"], names["mode"], float(names["accelerometer_ug"]), int(second),
         *_roots(*(square.get(second) for square in squares)),
         first["latitude"].get(second), first["longitude"].get(second), sigma)
        for second, sigma in first["sigma"].items()
    ]  # fmt: skip


def _limits(study: Navigation, grade: Grade) -> list[tuple[object, ...]]:
    """Return the rows of the INS alone, of the study's runs, and of the bound."""
    scenario = study.waters.scenario(grade, range(study.repeats), study.seed)
    stride = stride_of(scenario)
    indicated = np.degrees([scenario.ins.latitude[0, ::stride], scenario.ins.longitude[0, ::stride]])
    alone = None if scenario.error is None else np.square(scenario.error[:, ::stride]).mean(axis=0)
    rows: list[tuple[object, ...]] = []
    for name, squares in ((INS, alone), (BOUND, bound(scenario)[::stride])):
        for k, second in enumerate(scenario.seconds[::stride]):
            place = indicated[:, k] if name == INS else (None, None)
            known = (None, None) if squares is None else squares[k]
            rows.append(
                (name, "", float(f"{grade.accelerometer:.6g}"), round(second), *_roots(*known), *place, None)
            )
    return rows


def _roots(north: float | None, east: float | None) -> tuple[float | None, ...]:
    """Return the roots of mean squares north and east, and of their sum."""
    if north is None or east is None:
        return None if north is None else north**0.5, None if east is None else east**0.5, None
    return tuple(float(square**0.5) for square in (north, east, north + east))


@dataclass(frozen=True, eq=False)
class Chart:
    """A picture of a study, in degrees.

    Attributes:
        anomaly: of the map, mGal, rows from south to north; edges: west, east, south, north of it.
        truth, indicated: longitudes and latitudes of the voyage and of run 0's INS, shape (2, T).
        tracks: where each filter puts run 0, by its label in the legend, shape (2, k).
        curves: RMSE against time, see `navigation_tables.curves`.
    """

    anomaly: Float
    edges: Float
    truth: Float
    indicated: Float
    tracks: dict[str, Float]
    curves: Table


def chart_of(study: Navigation, records: Sequence[Record], curves: Table) -> Chart:
    """Return the picture of a study that was run."""
    scenario = study.waters.scenario(study.grades[0], range(1), study.seed)
    grid, route, ins = scenario.gravity_map, scenario.route, scenario.ins
    tracks = {}
    for cell in range(study.cells):
        first = own(records, cell)[0]
        tracks[_label(study, cell)] = np.array(
            [axis_of(first, axis)[1] for axis in ("longitude", "latitude")]
        )
    return Chart(
        grid.values,
        np.degrees([grid.west, grid.east, grid.south, grid.north]),
        np.degrees([route.longitude, route.latitude]),
        np.degrees([ins.longitude[0], ins.latitude[0]]),
        tracks,
        curves,
    )


def _label(study: Navigation, cell: int) -> str:
    names = study.names(cell)
    word = names["filter"] if names["mode"] == "default" else f"{names['filter']} ({names['mode']})"
    return word if len(study.grades) == 1 else f"{word}, {float(names['accelerometer_ug']):.3g} micro-g"
