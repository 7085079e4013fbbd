"""BBOB's 24 noiseless functions of the COCO platform [hansen2021], through coco-experiment (extra `bbob`).

cocoex evaluates one point at a time and counts for itself; the data that its observer writes are what cocopp reads.
Runs are therefore made one after the other, each on an instance of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.study import Budget, Record, Task

FUNCTIONS = tuple(f"bbob-f{number}" for number in range(1, 25))
DIMENSIONS = (2, 3, 5, 10, 20, 40)
INSTANCES = 15
BUDGET = 1000
"""Evaluations over D when none are stated."""


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of BBOB functions; "bbob" means all 24.

    Raises:
        ConfigError: one that is none, which has nothing to do beside them.
    """
    for name in names:
        if name not in (*FUNCTIONS, "bbob"):
            raise ConfigError(
                f'"{name}" beside functions of BBOB: expected bbob, or bbob-f1 to bbob-f24, alone'
            )
    return FUNCTIONS if "bbob" in names else tuple(names)


def cocoex() -> Any:
    """Return the module, or raise DataError saying how to get it."""
    try:
        import cocoex as module
    except ImportError:
        raise DataError(
            "--func bbob needs the extra bbob: python -m pip install coco-experiment cocopp six"
        ) from None
    module.log_level("warning")
    return module


class BbobFunction(Problem):
    """One function, dimension and instance of BBOB, its least value taken off; R = 1.

    Args:
        number: of the function, 1 to 24.
        dimensions: one of DIMENSIONS.
        instance: from 1.
        observer: of cocoex, which logs every evaluation; None logs nothing.
    """

    minimum = 0.0

    def __init__(self, number: int, dimensions: int, instance: int, observer: Any = None) -> None:
        """Take the problem out of its suite."""
        coco = cocoex()
        self.name = f"bbob-f{number}"
        which = f"dimensions: {dimensions} function_indices: {number}"
        self._suite = coco.Suite(
            "bbob", f"instances: {instance}", which
        )  # a suite's own instances differ by year
        self._problem = self._suite.get_problem(0)
        self.lower, self.upper = (np.array(self._problem.lower_bounds), np.array(self._problem.upper_bounds))
        self.least = float(coco.BareProblem("bbob", number, dimensions, instance).best_value())
        if observer is not None:
            self._problem.observe_with(observer)

    def cost(self, x: Float) -> Float:
        """Return the function above its least value, shape (1, P), at x, shape (1, P, D), point by point."""
        return np.array([[self._problem(point) for point in np.ascontiguousarray(x[0])]]) - self.least

    def close(self) -> None:
        """Give the problem back; its observer writes what is left."""
        self._problem.free()


@dataclass(frozen=True)
class Bbob(Benchmark):
    """A benchmark on functions of BBOB; run r has instance 1 + r modulo the number of instances.

    Attributes:
        folder: where the data for cocopp go, a folder for each optimizer; "" writes none.
    """

    folder: str = ""

    def __post_init__(self) -> None:
        """Refuse a dimension that the suite does not have."""
        for D in self.dimensions:
            if D not in DIMENSIONS:
                raise ConfigError(f"--dim {D}: BBOB has {', '.join(map(str, DIMENSIONS))}")
        object.__setattr__(self, "_observers", {})

    @property
    def block(self) -> int:
        """Runs per task: one, since each run has a problem of its own that can only be observed alone."""
        return 1

    def problem(self, name: str, dimensions: int, runs: Sequence[int] = (0,)) -> Problem:
        """Return the function as a run has it."""
        return self._function(name, dimensions, self.instance(runs[0]), None)

    def _function(self, name: str, D: int, instance: int, observer: Any) -> BbobFunction:
        return BbobFunction(int(name.removeprefix("bbob-f")), D, instance, observer)

    def budget(self, dimensions: int) -> int:
        """Return the evaluations of a run."""
        return self.evaluations or BUDGET * dimensions

    def execute(self, task: Task) -> list[Record]:
        """Return the record of a task's run."""
        name, D, entry = self.problems[task.cell]
        evaluations = self.budget(D)
        limited = Budget(evaluations=evaluations).limit(entry)
        problem = self._function(name, D, self.instance(task.first), self._observer(entry.label))
        try:
            return self.timed(replace(task, last=task.first + 1), problem, limited, evaluations)
        finally:
            problem.close()

    def _observer(self, label: str) -> Any:
        """Return the observer of an optimizer, which goes on in its own folder."""
        observers: dict[str, Any] = self._observers  # type: ignore[attr-defined]
        if self.folder and label not in observers:
            word = "".join(c if c.isalnum() or c in "-_.=" else "_" for c in label)
            options = f'outer_folder: "{Path(self.folder)}" result_folder: "{word}" algorithm_name: "{word}"'
            observers[label] = cocoex().Observer("bbob", options)
        return observers.get(label)
