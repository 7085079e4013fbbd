"""Monte Carlo calibration: optimizers side by side on the same readings, and what a comparison comes to.

Estimated sensors are set beside the true one: every parameter, and the parts of its error. The cost does not change
when K_a is multiplied by a rotation from the right: of an error of the off-diagonals the antisymmetric part is such a
rotation, and cannot be observed.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.problem import Loetters, pack, unpack
from accelcal_cli.optimization.minimize import Run, Stopping, polish
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.studies.scenarios import (
    ERRORS,
    MATRIX,
    CalibrationBlock,
    Recording,
    SearchSpace,
    Simulation,
    in_lower,
    parameter_errors,
    success_limit,
)
from accelcal_cli.studies.study import (
    Entry,
    Record,
    Row,
    Study,
    Task,
    records_of,
    records_of_cell,
    spread,
)


@dataclass(frozen=True)
class Comparison(Study):
    """Every optimizer on the same readings; one cell per optimizer.

    Attributes:
        source: simulated sensors, or a recording on which every run searches anew.
        space: model, box and starting points.
        entries: the optimizers.
        runs: of each optimizer; seed: of all of them.
        tolerance: a run succeeds when its cost is at most this above the least cost, (m/s^2)^4, or within 1 % of it.
        stop: whether a run ends when its cost is at or below the tolerance.
        polish: whether Levenberg-Marquardt finishes every search.
        evaluations: budget per run; None leaves it to the iterations.
    """

    source: Simulation | Recording
    space: SearchSpace
    entries: tuple[Entry, ...]
    runs: int = 20
    seed: int = 0
    tolerance: float = 1e-10
    stop: bool = False
    polish: bool = False
    evaluations: int | None = None

    @property
    def cells(self) -> int:
        """One per optimizer."""
        return len(self.entries)

    @property
    def block(self) -> int:
        """Runs per task: many runs in one batch cost little more than a few."""
        return max(5, self.runs // 5)

    def names(self, cell: int) -> dict[str, str]:
        """Return the optimizer of a cell."""
        return {"optimizer": self.entries[cell].label}

    @property
    def parameters(self) -> tuple[str, ...]:
        """Names of the estimated parameters in the values of a record."""
        return (*MATRIX[: self.space.unknowns - 3], "D_1", "D_2", "D_3")

    @property
    def noisy(self) -> bool:
        """Whether the least cost is above zero."""
        return isinstance(self.source, Recording) or self.source.noise > 0

    def calibrations(self, runs: Sequence[int]) -> CalibrationBlock:
        """Return the calibrations of the runs of these numbers."""
        return self.source.calibrations(self.space, runs, self.seed)

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        runs = range(task.first, task.last)
        with np.errstate(all="ignore"):
            block, entry = self.calibrations(runs), self.entries[task.cell]
            population = 1 if entry.peer else entry.build().population
            start = self.space.starting_points(block.problem.box, population, runs, self.seed)
            begin = time.thread_time()
            stopping = Stopping(self.tolerance if self.stop else None, self.evaluations)
            run = entry.run(block.problem, runs, seed=self.seed, stopping=stopping, start=start)
            if self.polish:
                run = _polish(block.problem, run)
            seconds = time.thread_time() - begin
            limit = success_limit(block.least, self.tolerance)
            return records_of(task, run, limit, seconds, self._values(block, run))

    def _values(self, block: CalibrationBlock, run: Run) -> list[dict[str, float | None]]:
        """Return errors, estimates and the least cost of each run."""
        K, D = block.problem.parameters(run.x)
        noise = self.source.noise if isinstance(self.source, Simulation) else 0.0
        columns = {"least_cost": block.least, **parameter_errors(in_lower(K), D, block, noise)}
        columns |= dict(zip(self.parameters, pack(K, D, self.space.unknowns).T, strict=True))
        return [
            {name: float(v[i]) if np.isfinite(v[i]) else None for name, v in columns.items()}
            for i in range(len(D))
        ]


def _polish(problem: Loetters, run: Run) -> Run:
    """Return the runs finished by Levenberg-Marquardt from their best points."""
    polished = polish(problem, np.clip(np.nan_to_num(run.x), -1.0, 1.0))
    better = ~(run.cost < polished.cost)
    return replace(
        run,
        x=np.where(better[:, None], polished.x, run.x),
        cost=np.where(better, polished.cost, run.cost),
        evaluations=run.evaluations + polished.evaluations,
        trace=None,
    )


ROUNDING = 1e-12
"""An excess of the cost below this part is rounding."""


def statistics(study: Comparison, records: Sequence[Record], only_successful: bool = False) -> list[Row]:
    """Return one row per optimizer: success rate, medians of time, evaluations and cost, rms errors over the runs.

    Definition:
        excess: part by which the cost is above the least cost; None without noise.
        bias_error, scale_error, misalignment_error, efficiency: see `parameter_errors`.

    Args:
        study: the comparison; records: of its runs.
        only_successful: leave the runs that failed out of all but the success rate.
    """
    records = with_least_cost(study, records)
    by_label = [(entry.label, records_of_cell(records, cell)) for cell, entry in enumerate(study.entries)]
    return [
        {"optimizer": label, **_statistics(study, own, only_successful)} for label, own in by_label if own
    ]


def with_least_cost(study: Comparison, records: Sequence[Record]) -> list[Record]:
    """Return the records with the least cost that any run or polish found on the same readings.

    Levenberg-Marquardt from the truth ends in the nearest minimum; a search may have found a lower one.
    """
    alike = [0 if isinstance(study.source, Recording) else r.run for r in records]
    least: dict[int, float] = {}
    for readings, r in zip(alike, records, strict=True):
        costs = [cost for cost in (r.values.get("least_cost"), r.cost) if cost is not None and cost >= 0.0]
        least[readings] = min((*costs, least.get(readings, np.inf)))
    return [
        replace(
            r, values={**r.values, "least_cost": least[readings] if np.isfinite(least[readings]) else None}
        )
        for readings, r in zip(alike, records, strict=True)
    ]


def succeeded(study: Comparison, record: Record) -> bool:
    """Return whether a run reached the least cost."""
    least = record.values.get("least_cost")
    return least is not None and record.cost <= float(success_limit(np.array(least), study.tolerance))


def _statistics(study: Comparison, own: Sequence[Record], only_successful: bool) -> Row:
    good = [r for r in own if succeeded(study, r)]
    hits = [r.hit for r in good if r.hit is not None]
    counted = good if only_successful else own
    evaluations = [r.evaluations for r in counted]
    return {
        "runs": len(own),
        "success_rate": len(good) / len(own),
        "seconds": _median([r.seconds for r in counted]),
        "evaluations": int(np.median(evaluations)) if evaluations else None,
        "evaluations_to_success": int(np.median(hits)) if hits else None,
        "cost": _median([r.cost for r in counted]),
        **_spread([r.cost for r in counted]),
        "excess": _median([_excess(r) for r in counted]) if study.noisy else None,
        **{name: _total(counted, name) for name in (*ERRORS, "efficiency")},
    }


def _spread(costs: Sequence[float]) -> Row:
    """Return least, quartiles and largest of the costs; the median is the column `cost`."""
    row = (
        spread(np.array(costs))
        if costs
        else dict.fromkeys(("min", "lower_quartile", "upper_quartile", "max"))
    )
    return {name: value for name, value in row.items() if name != "median"}


def _excess(record: Record) -> float:
    """Return the part by which a run's cost is above the least cost; what is only rounding is zero."""
    excess = record.cost / (record.values["least_cost"] or np.nan) - 1.0
    return 0.0 if abs(excess) < ROUNDING else excess


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _total(records: Sequence[Record], name: str) -> float | None:
    """Return the rms over the runs of one of their values; None where no run has it."""
    values = [v for r in records if (v := r.values.get(name)) is not None]
    return _rms(np.array(values)) if values else None


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


ABOVE, BELOW = (np.array([0, 0, 1]), np.array([1, 2, 2])), (np.array([1, 2, 2]), np.array([0, 0, 1]))


@dataclass(frozen=True)
class PrintedEstimate:
    """Parameters that a paper prints, in the units of the readings."""

    method: str
    K_a: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    D_a: tuple[float, float, float]


Estimates = Mapping[str, tuple[Float, Float]]
"""K, shape (3, 3), and D, shape (3,), by name."""


def estimates(
    study: Comparison, records: Sequence[Record], printed: Sequence[PrintedEstimate], mean: bool = False
) -> Estimates:
    """Return the truth, the estimates of the paper, and those of the median run of each optimizer.

    Args:
        study: on simulated readings; records: of its runs.
        printed: what the paper prints.
        mean: take the mean of the successful runs instead of the median run; an optimizer without any is left out.
    """
    model = study.source.sensor.model  # type: ignore[union-attr]
    lower = study.space.unknowns < 12
    named = {"truth": (to_gauge(model.K, "lower") if lower else model.K, model.D)}
    named |= {f"paper {p.method}": (np.array(p.K_a), np.array(p.D_a)) for p in printed}
    for cell, entry in enumerate(study.entries):
        own = sorted(records_of_cell(records, cell), key=lambda r: r.cost)
        chosen = [r for r in own if succeeded(study, r)] if mean else own[len(own) // 2 :][:1]
        if chosen:
            theta = [[r.values[name] for name in study.parameters] for r in chosen]
            named[entry.label] = unpack(np.mean(np.array(theta, dtype=float), axis=0))
    return named


def error_parts(study: Comparison, named: Estimates) -> list[Row]:
    """Return the parts of the error of each estimate against the one called `truth`, rms in output units.

    Definition:
        rotation: the antisymmetric part of the off-diagonals.
        misalignments, scale_factors: in gauge `lower`.
        cost: on the readings of run 0. Units: (m/s^2)^4.
    """
    true_K, true_D = named["truth"]
    problem = study.calibrations(range(1)).problem
    rows: list[Row] = []
    for name, (K, D) in named.items():
        above, below = (K - true_K)[ABOVE], (K - true_K)[BELOW]
        lower = to_gauge(K, "lower") - to_gauge(true_K, "lower")
        row = {
            "off_diagonals": _rms(np.concatenate([above, below])),
            "rotation": _rms(0.5 * (above - below)),
            "misalignments": _rms(lower[BELOW]),
            "scale_factors": _rms(np.diagonal(lower)),
            "bias": _rms(D - true_D),
            "cost": float(problem.cost(problem.coordinates(K[None], D[None])[:, None])[0, 0]),
        }
        rows.append({"estimate": name, **row})
    return rows
