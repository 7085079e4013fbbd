"""Benchmarks: optimizers on test functions, many runs each."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.optimizers.minimize import Stopping, minimize
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.study import Entry, Record, Study, Task, records_of
from accelcal_cli.table import Column, Table


@dataclass(frozen=True)
class Benchmark(Study):
    """Every optimizer on every function; cells are functions times optimizers, function by function.

    Attributes:
        functions: names of test functions.
        entries: the optimizers.
        dimensions: D.
        repeats: runs of each cell; seed: of all of them.
        tolerance: a run succeeds when its cost is at or below this.
        evaluations: budget of a run; None leaves it to the iterations.
        stop: whether a run ends when it reaches the tolerance.
        shift, rotate: move the optimum, turn the coordinates.
    """

    functions: tuple[str, ...]
    entries: tuple[Entry, ...]
    dimensions: int = 12
    repeats: int = 20
    seed: int = 0
    tolerance: float = 1e-8
    evaluations: int | None = None
    stop: bool = False
    shift: bool = False
    rotate: bool = False

    @property
    def cells(self) -> int:
        """Functions times optimizers."""
        return len(self.functions) * len(self.entries)

    @property
    def runs(self) -> int:
        """Runs of each cell."""
        return self.repeats

    def cell(self, number: int) -> tuple[str, Entry]:
        """Return function name and optimizer of a cell."""
        return self.functions[number // len(self.entries)], self.entries[number % len(self.entries)]

    def names(self, cell: int) -> dict[str, str]:
        """Return function and optimizer of a cell; see `Study.names`."""
        function, entry = self.cell(cell)
        return {"function": function, "optimizer": entry.label}

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        name, entry = self.cell(task.cell)
        problem = TestFunction(name, self.dimensions, shift=self.shift, rotate=self.rotate, seed=self.seed)
        optimizer = entry.build()
        stopping = Stopping(self.tolerance if self.stop else None, self.evaluations)
        start = time.perf_counter()
        run = minimize(
            problem, optimizer, runs=range(task.first, task.last), seed=self.seed, stopping=stopping
        )
        return records_of(task, run, self.tolerance, time.perf_counter() - start)


def summary(study: Benchmark, records: Sequence[Record]) -> Table:
    """Return one row a cell: statistics of the cost over the runs, success rate, evaluations, seconds."""
    rows = []
    for number in range(study.cells):
        name, entry = study.cell(number)
        own = [r for r in records if r.cell == number]
        if not own:
            continue
        cost = np.array([r.cost for r in own])
        hits = [r.hit for r in own if r.hit is not None]
        rows.append(
            (
                name,
                entry.label,
                len(own),
                int(np.median([r.evaluations for r in own])),
                float(cost.min()),
                float(cost.max()),
                float(cost.mean()),
                float(cost.var(ddof=1)) if len(own) > 1 else None,
                float(np.median(cost)),
                len(hits) / len(own),
                int(np.median(hits)) if hits else None,
                float(np.median([r.seconds for r in own])),
            )
        )
    return Table("Benchmark", COLUMNS, tuple(rows))


COLUMNS = (
    Column("function"),
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("evaluations", format=",d"),
    Column("min", format=".3g"),
    Column("max", format=".3g"),
    Column("mean", format=".3g"),
    Column("variance", format=".3g"),
    Column("median", format=".3g"),
    Column("success", format=".0%", key="success_rate"),
    Column("to tolerance", format=",d", key="evaluations_to_tolerance"),
    Column("time", "s", ".3f", key="seconds"),
)
