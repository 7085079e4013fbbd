"""Monte Carlo calibration: optimizers side by side on the same readings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.calibration.lotters import Loetters, pack
from accelcal_cli.calibration.search import polish
from accelcal_cli.optimizers.minimize import Run, Stopping, minimize
from accelcal_cli.streams import Float
from accelcal_cli.studies.estimates import MATRIX, errors, in_lower, limit
from accelcal_cli.studies.scene import (
    Recording,
    Scene,
    Search,
    Simulation,
    recorded,
    simulated,
    starting_points,
)
from accelcal_cli.studies.study import Entry, Record, Study, Task, median_curve, records_of


@dataclass(frozen=True)
class Comparison(Study):
    """Every optimizer on the same readings; one cell an optimizer.

    Attributes:
        source: simulated sensors, or a recording on which every run searches anew.
        space: model, box and starting points.
        entries: the optimizers.
        repeats: runs of each; seed: of all of them.
        tolerance: a run succeeds when its cost is at most this above the least cost, (m/s^2)^4, or within 1 % of it.
        stop: whether a run ends when its cost is at or below the tolerance.
        polish: whether Levenberg-Marquardt finishes every search.
    """

    source: Simulation | Recording
    space: Search
    entries: tuple[Entry, ...]
    repeats: int = 20
    seed: int = 0
    tolerance: float = 1e-10
    stop: bool = False
    polish: bool = False

    @property
    def cells(self) -> int:
        """One for each optimizer."""
        return len(self.entries)

    @property
    def runs(self) -> int:
        """Runs of each optimizer."""
        return self.repeats

    @property
    def block(self) -> int:
        """Runs of one task: many runs in one batch cost little more than a few."""
        return max(5, self.repeats // 5)

    def names(self, cell: int) -> dict[str, str]:
        """Return the optimizer of a cell."""
        return {"optimizer": self.entries[cell].label}

    @property
    def noisy(self) -> bool:
        """Whether the least cost is above zero."""
        return isinstance(self.source, Recording) or self.source.noise > 0

    @property
    def subject(self) -> str:
        """Whose readings they are."""
        if isinstance(self.source, Recording):
            return self.source.source
        return f"{'Sensors drawn from' if self.source.drawn else 'Always the same'} {self.source.sensor.name}"

    @property
    def conditions(self) -> str:
        """What is run, in a line."""
        space = f"g = {self.space.g:g}, {self.space.unknowns} unknowns, {self.repeats} runs, seed {self.seed}"
        if isinstance(self.source, Recording):
            return f"{self.source.poses} poses, {space}"
        return f"{self.source.positions} poses, noise {self.source.noise:g} m/s^2, {space}"

    def scene(self, runs: Sequence[int]) -> Scene:
        """Return the calibrations of the runs of these numbers."""
        if isinstance(self.source, Recording):
            return recorded(self.source, self.space, runs, self.seed)
        return simulated(self.source, self.space, runs, self.seed)

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        runs = range(task.first, task.last)
        with np.errstate(all="ignore"):
            scene = self.scene(runs)
            optimizer = self.entries[task.cell].build()
            start = starting_points(scene, self.space, optimizer.population, runs, self.seed)
            begin = time.thread_time()
            stopping = Stopping(self.tolerance if self.stop else None)
            run = minimize(
                scene.problem, optimizer, runs=runs, seed=self.seed, stopping=stopping, start=start
            )
            if self.polish:
                run = _polished(scene.problem, run)
            seconds = time.thread_time() - begin
            return records_of(
                task, run, limit(scene.least, self.tolerance), seconds, self._values(scene, run)
            )

    def _values(self, scene: Scene, run: Run) -> list[dict[str, float | None]]:
        """Return errors, estimates and the least cost of each run."""
        K, D = scene.problem.parameters(run.x)
        noise = self.source.noise if isinstance(self.source, Simulation) else 0.0
        columns = {"least_cost": scene.least, **errors(in_lower(K), D, scene, noise)}
        names = (*MATRIX[: self.space.unknowns - 3], "D_1", "D_2", "D_3")
        columns |= dict(zip(names, pack(K, D, self.space.unknowns).T, strict=True))
        return [
            {name: float(v[i]) if np.isfinite(v[i]) else None for name, v in columns.items()}
            for i in range(len(D))
        ]


def curves(study: Comparison, records: Sequence[Record]) -> Mapping[str, tuple[Float, Float]]:
    """Return the median convergence (evaluations, cost) by optimizer."""
    found = {}
    for cell, entry in enumerate(study.entries):
        curve = median_curve([r for r in records if r.cell == cell])
        if curve is not None:
            found[entry.label] = curve
    return found


def _polished(problem: Loetters, run: Run) -> Run:
    """Return the runs finished by Levenberg-Marquardt from their best points."""
    done = polish(problem, np.clip(np.nan_to_num(run.x), -1.0, 1.0))
    better = ~(run.cost < done.cost)
    return replace(
        run,
        x=np.where(better[:, None], done.x, run.x),
        cost=np.where(better, done.cost, run.cost),
        evaluations=run.evaluations + done.evaluations,
        trace=None,
    )
