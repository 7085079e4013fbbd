"""What every optimizer is: a frozen dataclass of settings with two pure methods, `init` and `step`.

Shapes: R runs, P points of the population, D dimensions. Arrays of shape (R, P, D) keep the population axis
contiguous in memory (see `rng`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any, ClassVar, Generic, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float, Int
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.registry import Registry
from accelcal_cli.rng import Streams
from accelcal_cli.schema import Checked, from_mapping, setting

Randoms = Literal["coordinate", "particle"]
"""Of which the random numbers of a swarm are its own: of every coordinate, or of a particle for all its coordinates."""

RANDOMS = "random numbers of each pull: one per coordinate, or one per particle"
"""Meaning of the setting `randoms`, which several swarms have."""

PRESETS = ("printed", "tuned")
"""printed: as the source prints it, as far as it does; tuned: what we would take. The names are a contract."""


class Status(IntEnum):
    """How a run stands, or how it ended; `message` says it to a reader.

    An optimizer states the first three in `State.status`; the others are `minimize`'s.
    """

    RUNNING = 0, "The run goes on."
    CONVERGED = 1, "The algorithm converged: it has nothing left to gain."
    FAILED = 2, "Numerical failure: no finite cost, or no step that can be computed."
    ITERATIONS = 3, "All iterations were used."
    EVALUATIONS = 4, "The budget of evaluations was used."
    TOLERANCE = 5, "The cost reached the tolerance."

    message: str

    def __new__(cls, value: int, message: str) -> Status:
        """Return the number with its message."""
        member = int.__new__(cls, value)
        member._value_, member.message = value, message
        return member


@dataclass(frozen=True, eq=False)
class State:
    """What an optimizer carries from step to step; each algorithm adds its own fields.

    Every array has the runs as its first axis; what is not an array is common to all runs.

    Attributes:
        x: the population, shape (R, P, D).
        fx: its cost, shape (R, P).
        status: None while all runs go on, or RUNNING, CONVERGED or FAILED for each run, shape (R,).
    """

    x: Float
    fx: Float
    status: NDArray[np.int8] | None = dataclasses.field(default=None, kw_only=True)


S = TypeVar("S", bound=State)


def take(state: S, index: Int) -> S:
    """Return the state of the runs at `index`."""
    parts = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    return dataclasses.replace(state, **{k: v[index] for k, v in parts.items() if isinstance(v, np.ndarray)})


@dataclass(frozen=True)
class Optimizer(Checked, ABC, Generic[S]):
    """Base of all optimizers, generic in their State; the fields of a subclass are its YAML keys."""

    name: ClassVar[str]
    family: ClassVar[str]
    """What kind of algorithm it is, in a word or two."""
    paper: ClassVar[str]
    """Key of docs/bibliography.md."""
    needs: ClassVar[tuple[str, ...]] = ()
    """What the problem must offer: "residuals", "closed_form"."""
    converges: ClassVar[bool] = True
    """False for a search whose radius or noise never shrinks, so that the cost stays on a floor."""

    population: int = setting(100, "points that are evaluated together (N)", low=4, high=1_000_000)
    iterations: int = setting(500, "steps at most (k_max)", low=1, high=100_000_000)

    def __init_subclass__(cls) -> None:
        """Refuse a class that does not say what it is and where it comes from."""
        super().__init_subclass__()
        for attribute in ("family", "paper", "__doc__"):
            if not getattr(cls, attribute, None):
                raise TypeError(f"optimizer class {cls.__name__} lacks {attribute}")

    @property
    def points_per_run(self) -> int:
        """Points of one run that a step evaluates, which decides how many runs make a block that fits the cache."""
        return self.population

    def suits(self, problem: Problem) -> bool:
        """Whether `problem` offers what this optimizer needs."""
        return all(getattr(problem, f"has_{need}") for need in self.needs)

    @abstractmethod
    def init(self, problem: Problem, x: Float, rng: Streams) -> S:
        """Return the first State from a starting population x, shape (R, P, D)."""

    @abstractmethod
    def step(self, problem: Problem, state: S, rng: Streams) -> S:
        """Return the State after one iteration of all R runs."""


class PopulationAlone:
    """Mixin of an optimizer that carries nothing but the population from step to step."""

    def init(self, problem: Problem, x: Float, rng: Streams) -> State:  # noqa: ARG002
        """Evaluate the starting population."""
        return State(x, problem.cost(x))


OPTIMIZERS: Registry[Optimizer[State]] = Registry(
    Optimizer, "accelcal_cli.optimization.algorithms", "optimizer", "accelcal.optimizers"
)
"""All optimizers by name. One that comes from here takes the States that it returned, and no others."""


def optimizer_file(name: str) -> Path | None:
    """Return the YAML file of an optimizer, None where there is none.

    That is `configs/optimizers/<name>.yaml`, or `<name>.yaml` beside the module of an installed optimizer.
    """
    return shipped("optimizers").get(name) or OPTIMIZERS.beside(name, ".yaml")


def built(name: str, parameters: Mapping[str, Any]) -> Optimizer[State]:
    """Return the optimizer of a name with these parameters, and its defaults for the others.

    Raises:
        ConfigError: unknown optimizer or parameter, or one out of range.
    """
    return from_mapping(OPTIMIZERS.get(name), parameters, f"optimizer {name}")


def preset_parameters(optimizer: str, preset: str) -> dict[str, Any]:
    """Return the settings of a preset that differ from the defaults, from the optimizer's file.

    Raises:
        ConfigError: no such preset, or an optimizer whose file has none of that name.
    """
    OPTIMIZERS.get(optimizer)
    if preset not in PRESETS:
        raise ConfigError(
            f'preset "{preset}": unknown{did_you_mean(preset, PRESETS)}; known: {", ".join(PRESETS)}'
        )
    path = optimizer_file(optimizer)
    presets = load_mapping(path).get("presets", {}) if path else {}
    if preset not in presets:
        raise ConfigError(
            f'optimizer "{optimizer}" has no preset "{preset}": leave it out, or state its parameters'
        )
    return dict(presets[preset] or {})


def shipped_parameters(optimizer: object) -> dict[str, Any]:
    """Return the settings that an optimizer has when none are stated; none for an unknown one.

    Those of an installed optimizer are in its file. Those of a built-in one are the defaults of its class, which its
    file states with their source (the contract compares them): a run need not read it.
    """
    if not isinstance(optimizer, str) or (cls := OPTIMIZERS.find(optimizer)) is None:
        return {}
    if OPTIMIZERS.is_built_in(cls):
        return {field.name: field.default for field in dataclasses.fields(cls)}
    path = optimizer_file(optimizer)
    return dict(load_mapping(path).get("parameters") or {}) if path else {}
