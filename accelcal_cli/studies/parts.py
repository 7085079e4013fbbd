"""Several studies as one: run, kept and resumed together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from accelcal_cli.studies.study import Record, Study, Task


@dataclass(frozen=True)
class Parts(Study):
    """Studies one after the other; their cells are numbered through.

    Attributes:
        titles: of the studies; studies: themselves.
    """

    titles: tuple[str, ...]
    studies: tuple[Study, ...]

    @property
    def cells(self) -> int:
        """Cells of all studies."""
        return sum(study.cells for study in self.studies)

    @property
    def runs(self) -> int:
        """Runs of the study that has most."""
        return max(study.runs for study in self.studies)

    def names(self, cell: int) -> dict[str, str]:
        """Return study, function and optimizer of a cell; the function of a calibration is its own word."""
        part, own = self._locate(cell)
        names = self.studies[part].names(own)
        return {"part": self.titles[part], "function": names.get("function", "calibration")} | names

    def tasks(self) -> list[Task]:
        """Return the tasks of all studies."""
        return [
            replace(task, cell=task.cell + first)
            for study, first in zip(self.studies, self._first(), strict=True)
            for task in study.tasks()
        ]

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        part, own = self._locate(task.cell)
        return [
            replace(record, cell=task.cell) for record in self.studies[part].execute(replace(task, cell=own))
        ]

    def records_of(self, part: int, records: Sequence[Record]) -> list[Record]:
        """Return the records of one study, its cells numbered as it numbers them."""
        first, cells = self._first()[part], self.studies[part].cells
        return [replace(r, cell=r.cell - first) for r in records if first <= r.cell < first + cells]

    def _first(self) -> list[int]:
        """Return the number of each study's first cell."""
        return [sum(study.cells for study in self.studies[:part]) for part in range(len(self.studies))]

    def _locate(self, cell: int) -> tuple[int, int]:
        part = max(p for p, first in enumerate(self._first()) if first <= cell)
        return part, cell - self._first()[part]
