"""What a study is: cells (a problem and an optimizer), runs of each, and the records they leave.

A study is plain data, so that it can be hashed, sent to a worker and repeated. A task is a block of runs of one
cell; its records depend on nothing but the study and the numbers of the runs.

Several studies as one: run, kept and resumed together.
"""

from __future__ import annotations

import hashlib
import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.minimize import Run
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State
from accelcal_cli.table import Column, Table

TRACE_POINTS = 100
"""Points of a record's convergence curve."""

CURVES = 100
"""Runs of a cell that keep their curve, the first ones: the median of so many is smooth."""


@dataclass(frozen=True)
class Entry:
    """An optimizer in a study.

    Attributes:
        label: how the tables name it.
        optimizer: its name; parameters: what differs from its defaults.
    """

    label: str
    optimizer: str
    parameters: dict[str, Any]

    def build(self) -> Optimizer[State]:
        """Return the optimizer. Raises ConfigError when name or parameters are unknown."""
        return OPTIMIZERS.build(self.optimizer, self.parameters, f"{self.label}")


@dataclass(frozen=True)
class Task:
    """Runs `first` to `last` - 1 of cell number `cell`."""

    cell: int
    first: int
    last: int

    @property
    def key(self) -> str:
        """Its name in a journal."""
        return f"{self.cell}:{self.first}:{self.last}"


@dataclass(frozen=True)
class Record:
    """One run.

    Attributes:
        cell, run: which.
        cost: best cost; evaluations, iterations: used; status: how it ended.
        hit: evaluations when the cost first was at or below the tolerance, or None.
        values: further results of the kind of study (parameter errors, ...), by name.
        curve: pairs (evaluations, best cost so far), thinned; none beyond the first CURVES runs.
        seconds: time of the run: its share of its block's.
    """

    cell: int
    run: int
    cost: float
    evaluations: int
    iterations: int
    status: str
    hit: int | None
    values: dict[str, float | None]
    curve: tuple[tuple[int, float], ...]
    seconds: float

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Record:
        """Return the record of a journal's line."""
        return cls(**{**record, "curve": tuple((int(n), float(c)) for n, c in record["curve"])})


class Study(ABC):
    """A study; its dataclass fields are all that decides its records."""

    @property
    @abstractmethod
    def cells(self) -> int:
        """How many cells it has."""

    @property
    @abstractmethod
    def runs(self) -> int:
        """Runs of each cell."""

    @property
    def block(self) -> int:
        """Runs of one task: the unit that is kept when a study is interrupted, and that a worker gets."""
        return 5

    @abstractmethod
    def names(self, cell: int) -> dict[str, str]:
        """Return what identifies a cell in the raw results, such as function and optimizer, by column."""

    @abstractmethod
    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""

    @property
    def identity(self) -> str:
        """Hash of everything that decides the records."""
        text = json.dumps([type(self).__name__, asdict(self)], sort_keys=True, default=str)  # type: ignore[call-overload]
        return hashlib.sha256(text.encode()).hexdigest()

    def tasks(self) -> list[Task]:
        """Return all tasks, cell by cell."""
        return [
            Task(cell, first, min(first + self.block, self.runs))
            for cell in range(self.cells)
            for first in range(0, self.runs, self.block)
        ]


def records_of(
    task: Task,
    run: Run,
    tolerance: float | Float | None,
    seconds: float,
    values: Sequence[dict[str, float | None]] | None = None,
) -> list[Record]:
    """Return the records of a block of runs.

    Args:
        task: whose runs they are.
        run: what `minimize` returned, with its trace.
        tolerance: cost that counts as a hit, for all runs or shape (R,); None has no hits.
        seconds: time of the block.
        values: further results of each run.
    """
    limits = np.broadcast_to(np.nan if tolerance is None else tolerance, len(run.runs))
    return [
        Record(
            task.cell,
            int(number),
            float(run.cost[i]),
            int(run.evaluations[i]),
            int(run.iterations[i]),
            run.status[i].name.lower(),
            _hit(run, i, limits[i]),
            dict(values[i]) if values else {},
            _curve(run, i),
            seconds / len(run.runs),
        )
        for i, number in enumerate(run.runs)
    ]


def raw_table(study: Study, records: Sequence[Record]) -> Table:
    """Return one row a run: everything that does not depend on how fast or where it ran.

    Costs and values that are not finite are left for the writer to leave empty.
    """
    labels = list(study.names(0))
    further = list(dict.fromkeys(name for record in records for name in record.values))
    columns = [
        *(Column(label) for label in labels),
        Column("run", format="d"),
        Column("cost", format=".6g"),
        Column("evaluations", format="d"),
        Column("iterations", format="d"),
        Column("status"),
        Column("hit", format="d"),
        *(Column(name, format=".6g") for name in further),
    ]
    rows = [
        (
            *study.names(r.cell).values(),
            *(r.run, r.cost, r.evaluations, r.iterations, r.status, r.hit),
            *(r.values.get(name) for name in further),
        )
        for r in records
    ]
    return Table("Raw results", tuple(columns), tuple(rows))


def _hit(run: Run, i: int, limit: float) -> int | None:
    if run.trace is None or run.trace_evaluations is None:
        return None
    reached = np.flatnonzero(run.trace[i] <= limit)
    return int(run.trace_evaluations[i][reached[0]]) if len(reached) else None


def _curve(run: Run, i: int) -> tuple[tuple[int, float], ...]:
    if run.trace is None or run.trace_evaluations is None or run.runs[i] >= CURVES:
        return ()
    last = int(run.iterations[i]) + 1
    keep = sorted({round(k) for k in np.linspace(0, last - 1, min(last, TRACE_POINTS))})
    counts, costs = run.trace_evaluations[i][keep], run.trace[i][keep]
    return tuple((int(n), float(c)) for n, c in zip(counts, costs, strict=True) if np.isfinite(c))


def median_curve(records: Sequence[Record], points: int = TRACE_POINTS) -> tuple[Float, Float] | None:
    """Return the median best cost of several runs against evaluations, both of shape (points,).

    From where all runs have a cost to the last evaluation of the longest; one that ended keeps its cost. None
    when no run left a curve.
    """
    curves = [np.array(record.curve).T for record in records if record.curve]
    if not curves:
        return None
    grid = np.linspace(max(n[0] for n, _ in curves), max(n[-1] for n, _ in curves), points)
    rows = [cost[np.searchsorted(n, grid, side="right") - 1] for n, cost in curves]
    return grid, np.median(rows, axis=0)


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
