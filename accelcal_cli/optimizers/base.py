"""What every optimizer is: a frozen dataclass of settings with two pure methods, `init` and `step`.

Shapes: R runs, P points of the population, D dimensions. Arrays of shape (R, P, D) keep the population axis
contiguous in memory (see `streams`).
"""

from __future__ import annotations

import dataclasses
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.problem import Bound, Problem, points
from accelcal_cli.registry import Registry, check, setting
from accelcal_cli.streams import Float, Int, Streams

AHEAD = 1600
"""Points whose chances are drawn at once: several iterations of a small batch."""

Chance = tuple[NDArray[Any], ...]
"""What chance decides in one iteration: arrays of shape (R, ...)."""

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


OPTIMIZERS: Registry[Optimizer] = Registry("accelcal_cli.optimizers", "optimizer")


def drawn(rng: Streams, fx: Float, rows: int, columns: int) -> Float:
    """Return uniform numbers for the iterations to come, shape (R, K, rows, columns), population-contiguous.

    K shrinks with the batch fx, shape (R, P). Each run draws in the order of its iterations, so that its numbers
    do not depend on its company.
    """
    steps = max(1, AHEAD // fx.size)
    u = rng.uniform(rows, steps * columns).transpose(0, 2, 1)
    return u.reshape(len(fx), steps, columns, rows).swapaxes(2, 3)


def each(*parts: NDArray[Any]) -> tuple[Chance, ...]:
    """Return arrays of shape (R, K, ...) as the chances of K iterations, one entry an iteration."""
    return tuple(zip(*(part.swapaxes(0, 1) for part in parts), strict=True))


def gather(x: Float, index: Int) -> Float:
    """Return points of each run's population, x (R, P, D) at index (R, Q): shape (R, Q, D)."""
    flat = x.transpose(0, 2, 1)
    if len(flat) == 1:
        only: Float = flat.take(index[0], axis=2).transpose(0, 2, 1)
        return only
    out = np.empty((*flat.shape[:2], index.shape[1]))
    for source, columns, target in zip(flat, index, out, strict=True):
        source.take(columns, axis=1, out=target, mode="clip")  # "raise" would copy once more
    return out.transpose(0, 2, 1)


def press(x: Float, low: Bound, high: Bound) -> None:
    """Press x, shape (R, P, D), between low and high, in place."""
    if isinstance(low, float):
        x.clip(low, high, out=x)
    else:
        np.maximum(x, low, out=x)
        np.minimum(x, high, out=x)


def better_of(x: Float, fx: Float, new: Float, new_cost: Float) -> tuple[Float, Float]:
    """Return x and fx with every point replaced whose new one costs less; x, new (R, P, D), costs (R, P)."""
    better = new_cost < fx
    return np.where(better[..., None], new, x), np.minimum(new_cost, fx)


def best_of(x: Float, fx: Float) -> Float:
    """Return each run's best point, shape (R, D)."""
    return points(x, fx.argmin(axis=1))


def integers(u: Float, *below: int) -> Int:
    """Return integers, shape (..., C, P), from uniform numbers, shape (..., P, C); column c is in 0 .. below[c] - 1."""
    whole: Int = (u.swapaxes(-1, -2) * _column(below)).astype(np.intp)
    return whole


@cache
def _column(values: tuple[int, ...]) -> Float:
    return np.array(values, dtype=float)[:, None]


def partners(picks: Int) -> tuple[Int, Int]:
    """Return two distinct partners, neither of them itself, for every individual.

    Args:
        picks: random integers below P - 1 and below P - 2, shape (..., 2, P), P >= 3; overwritten by the indices.

    Returns:
        Indices, twice (..., P). Drawn without rejection: the first is so many places further among
        the P - 1 others, the second among the P - 2 that remain.
    """
    first, second = picks[..., 0, :], picks[..., 1, :]
    second += second >= first
    size = picks.shape[-1]
    picks += np.arange(1, size + 1)
    picks -= size * (picks >= size)
    return first, second
