"""Monte Carlo calibration: optimizers side by side on the same readings.

What a comparison comes to: one row an optimizer.

Estimated sensors beside the true one: every parameter, and what of its error the readings can show.

The cost does not change when K_a is multiplied by a rotation from the right: of an error of the off-diagonals the
antisymmetric part is such a rotation and cannot be observed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.problem import Loetters, pack, unpack
from accelcal_cli.calibration.search import polish
from accelcal_cli.optimization.minimize import Run, Stopping, minimize
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.studies.scenarios import (
    ERRORS,
    MATRIX,
    WITHIN,
    Recording,
    Scene,
    Search,
    Simulation,
    errors,
    in_lower,
    limit,
    recorded,
    simulated,
    starting_points,
)
from accelcal_cli.studies.study import Entry, Record, Study, Task, median_curve, records_of
from accelcal_cli.table import Column, Table


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


ROUNDING = 1e-12
"""An excess of the cost below this part is rounding."""


def summary(study: Comparison, records: Sequence[Record], only_successful: bool = False) -> Table:
    """Return one row an optimizer: success rate, medians of time, evaluations and cost, rms errors over the runs.

    Args:
        study: the comparison; records: of its runs.
        only_successful: leave the runs that failed out of all but the success rate.
    """
    rows = []
    records = judged(study, records)
    for cell, entry in enumerate(study.entries):
        own = [r for r in records if r.cell == cell]
        if own:
            rows.append((entry.label, *_row(study, own, only_successful)))
    return Table("Comparison", COLUMNS, tuple(rows), notes=(*_notes(study), *_missed(rows)))


def judged(study: Comparison, records: Sequence[Record]) -> list[Record]:
    """Return the records with the least cost that anything found on the same readings.

    Levenberg-Marquardt from the truth ends in the nearest minimum; a search may have found a lower one.
    """
    alike = [0 if isinstance(study.source, Recording) else r.run for r in records]
    least: dict[int, float] = {}
    for which, r in zip(alike, records, strict=True):
        found = [cost for cost in (r.values.get("least_cost"), r.cost) if cost is not None and cost >= 0.0]
        least[which] = min((*found, least.get(which, np.inf)))
    return [
        replace(r, values={**r.values, "least_cost": least[which] if np.isfinite(least[which]) else None})
        for which, r in zip(alike, records, strict=True)
    ]


def succeeded(study: Comparison, record: Record) -> bool:
    """Return whether a run came to the least cost."""
    least = record.values.get("least_cost")
    return least is not None and record.cost <= float(limit(np.array(least), study.tolerance))


def _row(study: Comparison, own: Sequence[Record], only_successful: bool) -> tuple[object, ...]:
    good = [succeeded(study, r) for r in own]
    counted = [r for r, g in zip(own, good, strict=True) if g or not only_successful]
    hits = [r.hit for r, g in zip(own, good, strict=True) if g and r.hit is not None]
    return (
        len(own),
        sum(good) / len(own),
        _median([r.seconds for r in counted]),
        _count([r.evaluations for r in counted]),
        _count(hits),
        _median([r.cost for r in counted]),
        _median([_excess(r) for r in counted]) if study.noisy else None,
        *(_total(counted, name) for name in ERRORS),
        _total(counted, "efficiency"),
    )


def _excess(record: Record) -> float:
    """Return the part by which a run's cost is above the least cost; what is only rounding is zero."""
    excess = record.cost / (record.values["least_cost"] or np.nan) - 1.0
    return 0.0 if abs(excess) < ROUNDING else excess


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _count(values: Sequence[int]) -> int | None:
    return int(np.median(values)) if values else None


def _total(records: Sequence[Record], name: str) -> float | None:
    """Return the rms over the runs of one of their values; None where no run has it."""
    values = [v for r in records if (v := r.values.get(name)) is not None]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _missed(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return a sentence for each optimizer that did not always come to the least cost of noisy readings."""
    rate, excess = (
        next(i for i, c in enumerate(COLUMNS) if c.name == name) for name in ("success", "excess")
    )
    return [
        f"{row[0]} came within 1 % of the least cost in {row[rate]:.0%} of its runs; its median run is "
        f"{'within 1 %' if row[excess] <= WITHIN else f'{1.0 + row[excess]:.3g} times as high'}."
        for row in rows
        if row[excess] is not None and row[rate] < 1.0
    ]


def _notes(study: Comparison) -> tuple[str, ...]:
    reached = f"Success: within {study.tolerance:g} (m/s^2)^4 or 1 % of the least cost of the readings."
    if isinstance(study.source, Recording):
        return (reached, "Errors: distance from the Levenberg-Marquardt solution of the same readings.")
    if study.source.noise > 0:
        return (reached, "Efficiency: error over the Cramer-Rao bound; 1 is as good as the noise allows.")
    return (reached,)


COLUMNS = (
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("success", format=".0%", key="success_rate"),
    Column("time", "s", ".3f", key="seconds"),
    Column("evaluations", format=",d"),
    Column("to success", format=",d", key="evaluations_to_success"),
    Column("cost", "(m/s^2)^4", ".3g"),
    Column("excess", format=".2g"),
    Column("bias error", "micro-g", ".3g", key="bias_error"),
    Column("scale error", "ppm", ".3g", key="scale_error"),
    Column("misalignment", "arcsec", ".3g", key="misalignment_error"),
    Column("efficiency", format=".3g"),
)


ABOVE, BELOW = (np.array([0, 0, 1]), np.array([1, 2, 2])), (np.array([1, 2, 2]), np.array([0, 0, 1]))
ORDER = ("K_11", "K_12", "K_13", "K_21", "K_22", "K_23", "K_31", "K_32", "K_33", "D_1", "D_2", "D_3")


@dataclass(frozen=True)
class Printed:
    """Estimates that a paper prints, in the units of the readings."""

    method: str
    K_a: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    D_a: tuple[float, float, float]


def parameters(study: Comparison, records: Sequence[Record], printed: Sequence[Printed]) -> Table:
    """Return every parameter: truth, the paper's estimates, and those of the median run of each optimizer."""
    found = _estimates(study, records, printed)
    columns = (Column("parameter"), *(Column(name, format=".8g") for name in found))
    rows = []
    for name in ORDER:
        i = int(name[2]) - 1
        values = [K[i, int(name[3]) - 1] if name[0] == "K" else D[i] for K, D in found.values()]
        rows.append((name, *(float(v) for v in values)))
    return Table("estimates", columns, tuple(rows))


def valley(study: Comparison, records: Sequence[Record], printed: Sequence[Printed]) -> Table:
    """Return for each estimate the parts of its error, rms in output units, and its cost on the readings."""
    found = _estimates(study, records, printed)
    true_K, true_D = found["truth"]
    rows = []
    for name, (K, D) in found.items():
        raw = (K - true_K)[ABOVE], (K - true_K)[BELOW]
        seen = to_gauge(K, "lower") - to_gauge(true_K, "lower")
        rows.append(
            (
                name,
                _rms(np.concatenate(raw)),
                _rms(0.5 * (raw[0] - raw[1])),
                _rms(seen[BELOW]),
                _rms(np.diagonal(seen)),
                _rms(D - true_D),
                _cost(study, K, D),
            )
        )
    return Table("what of the error the readings show", VALLEY, tuple(rows), notes=(NOTE,))


VALLEY = (
    Column("estimate"),
    Column("off-diagonals", format=".2g", key="off_diagonals"),
    Column("rotation", format=".2g"),
    Column("misalignments", format=".2g"),
    Column("scale factors", format=".2g", key="scale_factors"),
    Column("bias", format=".2g"),
    Column("cost", "(m/s^2)^4", ".2g"),
)
NOTE = (
    "Errors, rms in output units. Rotation: the antisymmetric part of the off-diagonals, which no readings without "
    "attitudes can show. Misalignments and scale factors: in gauge lower, where no rotation is left."
)


def _estimates(
    study: Comparison, records: Sequence[Record], printed: Sequence[Printed]
) -> dict[str, tuple[Float, Float]]:
    """Return K and D of the truth, of the paper's rows, and of each optimizer's run of median cost."""
    model = study.source.sensor.model  # type: ignore[union-attr]
    found = {"truth": (model.K, model.D)}
    found |= {f"paper {p.method}": (np.array(p.K_a), np.array(p.D_a)) for p in printed}
    for cell, entry in enumerate(study.entries):
        own = sorted((r for r in records if r.cell == cell), key=lambda r: r.cost)
        if own:
            values = own[len(own) // 2].values
            names = (*MATRIX[: study.space.unknowns - 3], "D_1", "D_2", "D_3")
            K, D = unpack(np.array([values[name] for name in names], dtype=float))
            found[entry.label] = K, D
    return found


def _cost(study: Comparison, K: Float, D: Float) -> float:
    """Return the cost of an estimate on the study's readings."""
    problem = study.scene(range(1)).problem
    return float(problem.cost(problem.coordinates(K[None], D[None])[:, None])[0, 0])


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
