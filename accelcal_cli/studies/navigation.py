"""The navigation study: filters on many runs of one voyage, beside the bound and the INS alone."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from accelcal_cli.navigation.error_model import Grade
from accelcal_cli.navigation.filters import Track
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.navigation.scores import Scores, score
from accelcal_cli.streams import Purpose, Streams
from accelcal_cli.studies.study import Record, Study, Task
from accelcal_cli.studies.voyage_curves import curve_of
from accelcal_cli.studies.voyages import FilterEntry, Waters


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
        """Runs of one task: of fewer, what numpy does besides the arithmetic is a third of the time."""
        return 50

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
            track = entry.build().run(scenario, Streams(self.seed, runs, Purpose.FILTER))
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
        curve_of(i, scenario, track, scores),
        seconds,
    )
