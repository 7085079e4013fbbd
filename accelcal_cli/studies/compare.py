"""Monte Carlo calibration: optimizers side by side on the same readings."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from accelcal_cli.calibration.lotters import Loetters, pack
from accelcal_cli.calibration.search import polish
from accelcal_cli.optimizers.minimize import Run, Stopping, minimize
from accelcal_cli.sensor.units import ARCSEC, MICRO_G, PPM
from accelcal_cli.streams import Float
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
from accelcal_cli.table import Column, Table

WITHIN = 0.01
"""A run has reached the least cost when it is at most this part above it."""

ROUNDING = 1e-12
"""An excess of the cost below this part is rounding."""

ERRORS = ("bias_error", "scale_error", "misalignment_error")


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
            begin = time.perf_counter()
            stopping = Stopping(self.tolerance if self.stop else None)
            run = minimize(
                scene.problem, optimizer, runs=runs, seed=self.seed, stopping=stopping, start=start
            )
            if self.polish:
                run = _polished(scene.problem, run)
            seconds = time.perf_counter() - begin
            return records_of(
                task, run, limit(scene.least, self.tolerance), seconds, self._values(scene, run)
            )

    def _values(self, scene: Scene, run: Run) -> list[dict[str, float | None]]:
        """Return errors, estimates and the least cost of each run."""
        K, D = scene.problem.parameters(run.x)
        noise = self.source.noise if isinstance(self.source, Simulation) else 0.0
        columns = {"least_cost": scene.least, **errors(_lower(K), D, scene, noise)}
        names = (*MATRIX[: self.space.unknowns - 3], "D_1", "D_2", "D_3")
        columns |= dict(zip(names, pack(K, D, self.space.unknowns).T, strict=True))
        return [
            {name: float(v[i]) if np.isfinite(v[i]) else None for name, v in columns.items()}
            for i in range(len(D))
        ]


MATRIX = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")


def limit(least: Float, tolerance: float) -> Float:
    """Return the cost at or below which a run has succeeded, same shape as the least cost."""
    return np.maximum(least + tolerance, (1.0 + WITHIN) * least)


def errors(K: Float, D: Float, scene: Scene, noise: float) -> dict[str, Float]:
    """Return the errors of estimates in gauge `lower` against the truth, each of shape (R,), rms over the axes.

    Definition:
        bias_error: (D_i - truth) / K_ii over g. Units: micro-g. scale_error: K_ii / truth - 1. Units: ppm.
        misalignment_error: K_ij / K_ii less the true one, i > j. Units: arcsec.
        efficiency: sqrt(p^T J^T J p / 9) / noise with p the errors of the nine parameters in m/s^2: 1 for an
        estimator that is as good as the Cramer-Rao bound allows. Units: 1; left out without noise.

    Args:
        K: shape (R, 3, 3); D: shape (R, 3).
        scene: truth and information.
        noise: one sigma of a reading and axis, m/s^2.
    """
    true_K, true_D, g = scene.truth.K, scene.truth.D, scene.problem.g
    axis = np.arange(3)
    scale = K[:, axis, axis] / true_K[:, axis, axis] - 1.0
    turned = _angles(K) - _angles(true_K)
    bias = (D - true_D) / true_K[:, axis, axis]
    found = dict(
        zip(ERRORS, (_rms(bias) / g * MICRO_G, _rms(scale) * PPM, _rms(turned) * ARCSEC), strict=True)
    )
    if noise > 0:
        usable = np.isfinite(K).all(axis=(1, 2)) & (K[:, axis, axis] != 0).all(axis=1)
        E = np.linalg.solve(np.where(usable[:, None, None], K, np.nan_to_num(true_K)), true_K) - np.eye(3)
        p = np.concatenate([g * pack(E, bias, 9)[:, :6], bias], axis=1)
        square = np.einsum("rp,rpq,rq->r", p, scene.information, p) / 9.0
        found["efficiency"] = np.where(usable, np.sqrt(square) / noise, np.nan)
    return found


def _angles(K: Float) -> Float:
    return K[:, [1, 2, 2], [0, 0, 1]] / K[:, [1, 2, 2], [1, 2, 2]]


def _rms(values: Float) -> Float:
    root: Float = np.sqrt(np.mean(values**2, axis=1))
    return root


def _lower(K: Float) -> Float:
    """Return K in gauge `lower` for any K, a search's failure included: K Q with Q from the QR of K^T."""
    finite = np.isfinite(K).all(axis=(1, 2))
    R = np.linalg.qr(np.where(finite[:, None, None], K, np.eye(3)).swapaxes(1, 2), mode="r")
    sign = np.where(np.einsum("rii->ri", R) < 0, -1.0, 1.0)
    lower: Float = np.where(finite[:, None, None], R.swapaxes(1, 2) * sign[:, None], np.nan)
    return lower


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


def summary(study: Comparison, records: Sequence[Record], only_successful: bool = False) -> Table:
    """Return one row an optimizer: success rate, medians of time, evaluations and cost, rms errors over the runs.

    Args:
        study: the comparison; records: of its runs.
        only_successful: leave the runs that failed out of all but the success rate.
    """
    rows = []
    for cell, entry in enumerate(study.entries):
        own = [r for r in records if r.cell == cell]
        if own:
            rows.append((entry.label, *_row(study, own, only_successful)))
    return Table("Comparison", COLUMNS, tuple(rows), notes=(*_notes(study), *_missed(rows)))


def succeeded(study: Comparison, record: Record) -> bool:
    """Return whether a run came to the least cost."""
    least = record.values.get("least_cost")
    return least is not None and record.cost <= float(limit(np.array(least), study.tolerance))


def _row(study: Comparison, own: Sequence[Record], only_successful: bool) -> tuple[object, ...]:
    good = [succeeded(study, r) for r in own]
    judged = [r for r, g in zip(own, good, strict=True) if g or not only_successful]
    hits = [r.hit for r in own if r.hit is not None]
    return (
        len(own),
        sum(good) / len(own),
        _median([r.seconds for r in judged]),
        _count([r.evaluations for r in judged]),
        _count(hits),
        _median([r.cost for r in judged]),
        _median([_excess(r) for r in judged]) if _noisy(study) else None,
        *(_total(judged, name) for name in ERRORS),
        _total(judged, "efficiency"),
    )


def curves(study: Comparison, records: Sequence[Record]) -> Mapping[str, tuple[Float, Float]]:
    """Return the median convergence (evaluations, cost) by optimizer."""
    found = {}
    for cell, entry in enumerate(study.entries):
        curve = median_curve([r for r in records if r.cell == cell])
        if curve is not None:
            found[entry.label] = curve
    return found


def _excess(record: Record) -> float:
    """Return the part by which a run's cost is above the least cost; what is only rounding is zero."""
    excess = record.cost / (record.values["least_cost"] or np.nan) - 1.0
    return 0.0 if abs(excess) < ROUNDING else excess


def _noisy(study: Comparison) -> bool:
    return isinstance(study.source, Recording) or study.source.noise > 0


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
    reached = f"Success: at most {study.tolerance:g} (m/s^2)^4 above the least cost of the readings, or within 1 % of it."
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
