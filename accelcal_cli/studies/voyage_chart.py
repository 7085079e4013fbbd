"""What a picture of a navigation study shows: the map, run 0's tracks over it, and RMSE against time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.streams import Float
from accelcal_cli.studies.navigation import Navigation
from accelcal_cli.studies.navigation_tables import own
from accelcal_cli.studies.study import Record
from accelcal_cli.studies.voyage_curves import axis_of
from accelcal_cli.table import Table


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
