"""What every optimizer is: a frozen dataclass of settings with two pure methods, `init` and `step`.

Shapes: R runs, P points of the population, D dimensions. Arrays of shape (R, P, D) keep the population axis
contiguous in memory (see `streams`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float, Int
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.registry import Registry
from accelcal_cli.rng import Streams
from accelcal_cli.schema import check, setting

RUNNING, CONVERGED, FAILED = 0, 1, 2
"""Values of `State.status`: go on, nothing left to gain, numerical failure."""


@dataclass(frozen=True, eq=False)
class State:
    """What an optimizer carries from step to step; each algorithm adds its own fields.

    Attributes:
        x: the population, shape (R, P, D).
        fx: its cost, shape (R, P).
        status: None, or RUNNING, CONVERGED or FAILED for each run, shape (R,).
    """

    x: Float
    fx: Float
    status: NDArray[np.int8] | None = dataclasses.field(default=None, kw_only=True)


S = TypeVar("S", bound=State)


def take(state: S, index: Int) -> S:
    """Return the state of the runs at `index`; every array in it and its parts has the runs as its first axis."""
    parts = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    return dataclasses.replace(state, **{k: _taken(v, index) for k, v in parts.items()})


def _taken(part: Any, index: Int) -> Any:
    if isinstance(part, np.ndarray):
        return part[index]
    if isinstance(part, tuple):
        return tuple(_taken(one, index) for one in part)
    held: Any = part if dataclasses.is_dataclass(part) else None
    return part if held is None else take(held, index)


@dataclass(frozen=True)
class Optimizer(ABC):
    """Base of all optimizers; the fields of a subclass are its YAML keys."""

    name: ClassVar[str]
    family: ClassVar[str]
    paper: ClassVar[str]
    """Key of docs/bibliography.md."""
    needs: ClassVar[tuple[str, ...]] = ()
    """What the problem must offer: "residuals", "closed_form"."""

    population: int = setting(100, "points that are evaluated together (N)", low=4, high=1_000_000)
    iterations: int = setting(500, "steps at most (k_max)", low=1, high=100_000_000)

    def __post_init__(self) -> None:
        """Refuse a setting outside its range."""
        check(self)

    @property
    def crowd(self) -> int:
        """Points of one run that pass through the memory in a step: how many runs make a block that fits the cache."""
        return self.population

    def suits(self, problem: Problem) -> bool:
        """Whether `problem` offers what this optimizer needs."""
        return all(getattr(problem, f"has_{need}") for need in self.needs)

    @abstractmethod
    def init(self, problem: Problem, x: Float, rng: Streams) -> Any:
        """Return the first State from a starting population x, shape (R, P, D)."""

    @abstractmethod
    def step(self, problem: Problem, state: Any, rng: Streams) -> Any:
        """Return the State after one iteration of all R runs."""


OPTIMIZERS: Registry[Optimizer] = Registry(
    Optimizer, "accelcal_cli.optimization.algorithms", "optimizer", "accelcal.optimizers"
)


def shipped_parameters(optimizer: Any) -> dict[str, Any]:
    """Return the settings that an optimizer's YAML file states; none for an unknown optimizer.

    The file is `configs/optimizers/<name>.yaml`, or `<name>.yaml` beside the module of an installed optimizer.
    """
    if not isinstance(optimizer, str):
        return {}
    path = shipped("optimizers").get(optimizer) or OPTIMIZERS.beside(optimizer, ".yaml")
    parameters: dict[str, Any] = (load_mapping(path).get("parameters") or {}) if path else {}
    return parameters
