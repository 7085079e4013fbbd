"""The tables of a navigation study, and what its picture shows: the map, the tracks of run 0, and RMSE against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.study import Navigation, NavigationSettings, axis_of, rmse_curves, statistics
from accelcal_cli.studies.study import Record, Row, records_of_cell
from accelcal_cli.views.blocks import Column, Table
from accelcal_cli.views.studies import table_of

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
    Column("claimed", "m", ".1f", key="claimed_m"),
    Column("INS alone", "m", ".0f", key="ins_m"),
    Column("lost", format="d"),
    Column("diverged", format="d"),
    Column("NEES", format=".3g", key="nees"),
    Column("NIS", format=".3g", key="nis"),
    Column("NIS band", key="nis_band"),
    Column("look-ups", "1/epoch", ".0f", key="lookups"),
    Column("time", "s", ".1f", key="seconds"),
    Column("epoch", "us", ".0f", key="epoch_us"),
    Column("warnings"),
)

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


def summary(study: Navigation, records: Sequence[Record]) -> Table:
    """Return one row per filter: errors from an hour after its start, bound, lost runs, consistency, time."""
    rows = statistics(study, records)
    return table_of("Navigation", COLUMNS, rows, [_note(study, row) for row in rows if row["lost"]])


def shown(table: Table) -> Table:
    """Return a summary for people: without columns that nothing is known of, and its warnings as notes below."""
    at = [column.key or column.name for column in table.columns]
    warnings = at.index("warnings")
    keep = [i for i in range(len(at)) if i != warnings and any(row[i] is not None for row in table.rows)]
    said: dict[str, list[str]] = {}
    for row in table.rows:
        if row[warnings]:
            said.setdefault(str(row[warnings]), []).append(str(row[0]))
    notes = (*table.notes, *(f"{', '.join(dict.fromkeys(names))}: {text}" for text, names in said.items()))
    columns = tuple(table.columns[i] for i in keep)
    return Table(table.title, columns, tuple(tuple(row[i] for i in keep) for row in table.rows), notes)


def _note(study: Navigation, row: Row) -> str:
    """Return what to say of lost and diverged runs, which count separately here."""
    ins = f", {row['accelerometer_ug']:.3g} micro-g" if len(study.grades) > 1 else ""
    runs = f"{row['runs']} run{'s' * (row['runs'] != 1)}"
    return (
        f"{row['filter']} ({row['mode']}{ins}): of {runs} {row['diverged']} diverged and "
        f"{row['lost'] - row['diverged']} lost lock; their errors are included in the row."
    )


def with_paper(table: Table, settings: NavigationSettings) -> Table:
    """Return a summary with the paper's RMSE of the position next to ours, and the title and note of the study."""
    paper = {str(name).lower(): value for name, value in settings.paper.items()}
    at = [column.key for column in table.columns].index("rmse_position_m") + 1
    rows = [(*row[:at], paper.get(str(row[0]).lower()), *row[at:]) for row in table.rows]
    column = Column("paper", "m", ".1f", key="paper_m")
    notes = tuple(filter(None, (*table.notes, settings.note)))
    return Table(
        settings.title or table.title, (*table.columns[:at], column, *table.columns[at:]), tuple(rows), notes
    )


def curves(study: Navigation, records: Sequence[Record]) -> Table:
    """Return RMSE against time of every filter, of the INS alone and the bound, and the corrected track of run 0."""
    return Table("RMSE against time", CURVES, tuple(rmse_curves(study, records)))


@dataclass(frozen=True, eq=False)
class Chart:
    """A picture of a study, in degrees.

    Attributes:
        anomaly: of the map, mGal, rows from south to north; edges: west, east, south, north of it.
        truth, indicated: longitudes and latitudes of the voyage and of the INS of run 0, shape (2, T); truth is None
            where it is not known.
        tracks: corrected track of run 0 by each filter, by its label in the legend, shape (2, k).
        curves: RMSE against time, see `curves`.
    """

    anomaly: Float
    edges: Float
    truth: Float | None
    indicated: Float
    tracks: dict[str, Float]
    curves: Table


def chart_of(study: Navigation, records: Sequence[Record], curves: Table) -> Chart:
    """Return the picture of a study that was run."""
    scenario = study.settings.scenario(study.grades[0], range(1))
    grid, true, ins = scenario.gravity_map, scenario.true, scenario.ins
    tracks = {}
    for cell in range(study.cells):
        first = records_of_cell(records, cell)[0]
        axes = (axis_of(first, axis) for axis in ("longitude", "latitude"))
        tracks[_label(study, cell)] = np.array([list(axis.values()) for axis in axes])
    return Chart(
        grid.values,
        np.degrees([grid.west, grid.east, grid.south, grid.north]),
        None if scenario.error is None else np.degrees([true.longitude, true.latitude]),
        np.degrees([ins.longitude[0], ins.latitude[0]]),
        tracks,
        curves,
    )


def _label(study: Navigation, cell: int) -> str:
    names = study.names(cell)
    label = names["filter"] if names["mode"] == "default" else f"{names['filter']} ({names['mode']})"
    return label if len(study.grades) == 1 else f"{label}, {float(names['accelerometer_ug']):.3g} micro-g"
