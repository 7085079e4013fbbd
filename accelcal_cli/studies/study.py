"""What a study is: cells (a problem and an optimizer), runs of each, and the records that they leave.

A study is plain data, so that it can be hashed, sent to a worker and repeated. A task is a block of runs of one
cell; its records depend on nothing but the study and the numbers of the runs.

The optimizers of a study are entries: chosen by name with the shipped settings, or from a file.
"""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
import json
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.config import load_mapping
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.minimize import Run, Stopping, minimize
from accelcal_cli.optimization.optimizer import (
    OPTIMIZERS,
    Optimizer,
    State,
    preset_parameters,
    shipped_parameters,
)
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.registry import import_place
from accelcal_cli.schema import from_mapping

ALL = "all"

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]
"""Evaluations and median best cost, by function or problem and by optimizer."""

Row = Mapping[str, Any]
"""A row of statistics: names and numbers by the key of their column."""

NOTES = ("source", "presets")
"""Keys of an optimizer's file that set nothing."""

TRACE_POINTS = 100
"""Points of a record's convergence curve."""

CURVES = 100
"""Runs of a cell that keep their curve, the first ones: the median of so many is smooth."""


@dataclass(frozen=True)
class Entry:
    """An optimizer in a study.

    Attributes:
        label: its name in the tables.
        optimizer: its name; parameters: settings that differ from its defaults.
        preset: of the optimizer, beneath the parameters; "" is none.
        peer: whether it is of another library, or any callable that minimises as SciPy's do; see `peers`.
    """

    label: str = ""
    optimizer: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)
    preset: str = ""
    peer: bool = False

    def build(self) -> Optimizer[State]:
        """Return the optimizer. Raises ConfigError when name or parameters are unknown."""
        more = preset_parameters(self.optimizer, self.preset) if self.preset else {}
        # No file may hold a colon: this was stated on the command line, and a worker has to import it again.
        find = OPTIMIZERS.imported if ":" in self.optimizer else OPTIMIZERS.get
        return from_mapping(find(self.optimizer), {**more, **self.parameters}, self.label)

    @property
    def needs(self) -> tuple[str, ...]:
        """What it needs of a problem, see `Optimizer.needs`."""
        if self.peer:
            return ("residuals",) if self.optimizer == "scipy:least_squares" else ()
        return self.build().needs

    def suits(self, problem: Problem) -> bool:
        """Whether a problem offers what it needs."""
        return all(getattr(problem, f"has_{need}") for need in self.needs)

    def run(
        self,
        problem: Problem,
        runs: Sequence[int],
        *,
        seed: int,
        stopping: Stopping,
        start: Float | None = None,
    ) -> Run:
        """Return its runs on a problem: arguments as `minimize` takes them.

        A peer draws its own starting points and heeds the budget alone.
        """
        if self.peer:
            from accelcal_cli.studies.peers import run_peer

            return run_peer(self.optimizer, problem, runs, seed, stopping.evaluations)
        return minimize(problem, self.build(), runs=runs, seed=seed, stopping=stopping, start=start)


@dataclass(frozen=True)
class Budget:
    """What a study sets for all its optimizers; None leaves each its own.

    Attributes:
        population: points that are evaluated together.
        iterations: steps at most.
        evaluations: per run. Without `iterations`, an optimizer gets as many as this budget allows.
    """

    population: int | None = None
    iterations: int | None = None
    evaluations: int | None = None

    def limit(self, entry: Entry) -> Entry:
        """Return an optimizer with the population, iterations and evaluations of the study.

        A setting that can have one value only, such as the population of a closed form, stays.

        Raises:
            ConfigError: a value that the optimizer does not permit.
        """
        if entry.peer:
            return entry
        limits = {f.name: f.metadata for f in dataclasses.fields(OPTIMIZERS.get(entry.optimizer))}
        stated = {"population": self.population, "iterations": self.iterations}
        stated = {k: v for k, v in stated.items() if v is not None and limits[k]["low"] != limits[k]["high"]}
        entry = replace(entry, parameters={**entry.parameters, **stated})
        population = entry.build().population
        if self.evaluations is None:
            return entry
        more = {}
        if "evaluations" in limits:
            more["evaluations"] = max(self.evaluations, int(limits["evaluations"]["low"]))
        elif self.iterations is None and limits["iterations"]["high"] != 1:
            more["iterations"] = max(1, -(-self.evaluations // population) - 1)
        entry = replace(entry, parameters={**entry.parameters, **more})
        entry.build()
        return entry


def words(values: Iterable[str]) -> list[str]:
    """Return the names in repeated and comma-separated options, each once, in order."""
    parts = [part.strip() for value in values for part in value.split(",")]
    return list(dict.fromkeys(part for part in parts if part))


def choose(
    names: Sequence[str],
    config: Path | None,
    default: Sequence[str],
    budget: Budget,
    preset: str | None = None,
) -> list[Entry]:
    """Return the optimizers that a command line names, with their settings.

    Args:
        names: labels of the file, names of optimizers, or "all"; none means those of the file, or else `default`.
        config: YAML file with optimizers and parameters.
        default: names to take when nothing is stated.
        budget: replaces the settings of all.
        preset: of every optimizer, beneath the parameters that a file states.

    Raises:
        ConfigError: an unknown name, preset or setting, or a value out of range.
    """
    stated = load_entries(config, preset) if config else {}
    chosen = list(names) or list(stated) or list(default)
    if ALL in chosen:
        others = [name for name in chosen if name != ALL]
        chosen = list(dict.fromkeys([*stated, *OPTIMIZERS.names(), *others]))
    return [
        budget.limit(stated[name] if name in stated else _shipped(name, stated, preset)) for name in chosen
    ]


def _shipped(name: str, labels: Iterable[str], preset: str | None) -> Entry:
    """Return an optimizer with its shipped settings and a preset, or one stated as package.module:name.

    When it is unknown the labels of a file are named.
    """
    if ":" in name:
        found = import_place(name, "optimizer")
        if not inspect.isclass(found) and callable(found):
            return Entry(name, name, peer=True)
        OPTIMIZERS.imported(name)
    try:
        OPTIMIZERS.get(name)
    except ConfigError as error:
        further = f"; labels of the file: {', '.join(labels)}" if labels else ""
        raise ConfigError(f"{error}{further}") from None
    more = preset_parameters(name, preset) if preset else {}
    return Entry(name, name, {**shipped_parameters(name), **more})


def load_entries(path: Path, preset: str | None = None) -> dict[str, Entry]:
    """Return the optimizers of a file by label.

    The file holds `optimizers:`, a list of mappings with `optimizer` and optionally `label`, `preset`, `parameters` and
    `source`; or just one such mapping, as the shipped files do. A preset that is given takes the place of the file's.

    Raises:
        ConfigError: the file cannot be read, or holds an unknown key or name, or a label twice.
    """
    content = load_mapping(path)
    listed = content["optimizers"] if set(content) == {"optimizers"} else [content]
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{path}: optimizers: expected a list of optimizers with their parameters")
    entries: dict[str, Entry] = {}
    for number, item in enumerate(listed, 1):
        where = f"{path}: optimizers[{number}]" if "optimizers" in content else str(path)
        entry = _entry(item, where, preset)
        if entry.label in entries:
            raise ConfigError(f'{where}: label "{entry.label}" is given twice')
        entries[entry.label] = entry
    return entries


def _entry(item: Any, where: str, preset: str | None) -> Entry:
    if not isinstance(item, Mapping) or "optimizer" not in item:
        raise ConfigError(f'{where}: expected a mapping with the key "optimizer"')
    entry = from_mapping(Entry, {key: value for key, value in item.items() if key not in NOTES}, where)
    if entry.peer or ":" in entry.optimizer:
        raise ConfigError(
            f"{where}: optimizer {entry.optimizer}: a file imports no code; state it by --optimizer or --peer"
        )
    label = entry.label or entry.optimizer
    if "," in label or label == ALL:
        raise ConfigError(f'{where}: label "{label}": expected no comma, and not "{ALL}"')
    chosen = preset or entry.preset
    more = preset_parameters(entry.optimizer, chosen) if chosen else {}
    parameters = {**shipped_parameters(entry.optimizer), **more, **entry.parameters}
    from_mapping(OPTIMIZERS.get(entry.optimizer), parameters, where)
    return Entry(label, entry.optimizer, parameters)


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
        curve: points of evaluations and best cost so far, thinned; none beyond the first CURVES runs.
        seconds: time of the run: its share of the time of its block.
        point: best point of a test function; hits: evaluations to each of its targets, or None; reductions: likewise to
            each part of the first cost; instance: which place and rotation of the function, 0 is the plain one.
    """

    cell: int
    run: int
    cost: float
    evaluations: int
    iterations: int
    status: str
    hit: int | None
    values: dict[str, float | None]
    curve: tuple[tuple[float, ...], ...]
    seconds: float
    point: tuple[float, ...] = ()
    hits: tuple[int | None, ...] = ()
    reductions: tuple[int | None, ...] = ()
    instance: int = 0

    @classmethod
    def from_json(cls, record: dict[str, Any]) -> Record:
        """Return the record of a journal's line."""
        listed = {name: tuple(record.get(name, ())) for name in ("point", "hits", "reductions")}
        return cls(**{**record, **listed, "curve": tuple(map(tuple, record["curve"]))})


def spread(cost: Float) -> Row:
    """Return least, quartiles and largest of costs, shape (R,); infinite ones are quantiles as they stand."""
    method: Any = "linear" if np.isfinite(cost).all() else "inverted_cdf"
    values = np.quantile(cost, SPREAD, method=method)
    return dict(
        zip(("min", "lower_quartile", "median", "upper_quartile", "max"), map(float, values), strict=True)
    )


SPREAD = (0.0, 0.25, 0.5, 0.75, 1.0)


def records_of_cell(records: Iterable[Record], cell: int) -> list[Record]:
    """Return the records of one cell."""
    return [record for record in records if record.cell == cell]


class Study(ABC):
    """A study; its dataclass fields determine its records."""

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
        """Runs per task: what a worker gets, and what is kept when a study is interrupted."""
        return 5

    @abstractmethod
    def names(self, cell: int) -> dict[str, str]:
        """Return what identifies a cell in the raw results, such as function and optimizer, by column."""

    def panel(self, cell: int) -> str:
        """Return what the curves of a cell belong to: its function, "" for a study without."""
        return self.names(cell).get("function", "")

    @abstractmethod
    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""

    @property
    def identity(self) -> str:
        """Hash of everything that determines the records."""
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
    tolerance: float | Float,
    seconds: float,
    values: Sequence[dict[str, float | None]] = (),
) -> list[Record]:
    """Return the records of a block of runs.

    Args:
        task: that the runs belong to.
        run: what `minimize` returned, with its trace.
        tolerance: cost that counts as a hit, for all runs or shape (R,).
        seconds: time of the block.
        values: further results of each run.
    """
    limits = np.broadcast_to(tolerance, len(run.runs))
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


def _hit(run: Run, i: int, limit: float) -> int | None:
    """Return the evaluations when the cost of the i-th run first was at or below a limit, or None."""
    if run.trace is None or run.trace_evaluations is None:
        return None
    reached = np.flatnonzero(run.trace[i] <= limit)
    return int(run.trace_evaluations[i][reached[0]]) if len(reached) else None


def _curve(run: Run, i: int) -> tuple[tuple[float, ...], ...]:
    """Return the thinned trace of the i-th run."""
    if run.trace is None or run.trace_evaluations is None or run.runs[i] >= CURVES:
        return ()
    last = int(run.iterations[i]) + 1
    points = sorted({round(k) for k in np.linspace(0, last - 1, min(last, TRACE_POINTS))})
    counts, costs = run.trace_evaluations[i][points], run.trace[i][points]
    return tuple((int(n), float(c)) for n, c in zip(counts, costs, strict=True) if np.isfinite(c))


def median_curve(
    records: Sequence[Record], points: int = TRACE_POINTS, quantile: float = 0.5
) -> tuple[Float, Float] | None:
    """Return the median, or another quantile, of the best cost of several runs against evaluations, shape (points,).

    From where all runs have a cost to the last evaluation of the longest; a run that ended keeps its cost. None
    when no run left a curve.
    """
    curves = [np.array(record.curve).T for record in records if record.curve]
    if not curves:
        return None
    grid = np.linspace(max(n[0] for n, _ in curves), max(n[-1] for n, _ in curves), points)
    rows = [cost[np.searchsorted(n, grid, side="right") - 1] for n, cost in curves]
    return grid, np.median(rows, axis=0) if quantile == 0.5 else np.quantile(rows, quantile, axis=0)


def median_curves(study: Study, records: Sequence[Record]) -> Curves:
    """Return the median curve of each cell that left one, by function ("" for a study without) and optimizer."""
    return quantile_curves(study, records, 0.5)


def quantile_curves(study: Study, records: Sequence[Record], quantile: float) -> Curves:
    """Return as `median_curves` does a quantile of the best costs."""
    panels: dict[str, dict[str, tuple[Float, Float]]] = {}
    for cell in range(study.cells):
        curve = median_curve(records_of_cell(records, cell), quantile=quantile)
        panel = panels.setdefault(study.panel(cell), {})
        if curve is not None:
            panel[study.names(cell)["optimizer"]] = curve
    return panels
