"""The experiments of the papers: one or several studies each, in configs/studies, with the paper's own numbers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.schema import from_mapping
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.compare import Comparison, PrintedEstimate
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.scenarios import SearchSpace, Simulation
from accelcal_cli.studies.study import (
    Curves,
    Entry,
    Record,
    Row,
    Study,
    Task,
    median_curves,
    records_of_cell,
    spread,
)

STUDIES = "studies"

CHECKPOINTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Parts of the evaluations at which the convergence table reads the curves."""

Show = Literal["summary", "successful", "curves", "parameters", "mean parameters", "coordinates"]


@dataclass(frozen=True)
class Functions:
    """Test functions of a part."""

    names: tuple[str, ...]
    dimensions: int
    evaluations: int | None = None


@dataclass(frozen=True)
class PaperTable:
    """What a paper prints: columns by our keys, rows of their values; a value that does not survive is null."""

    columns: tuple[str, ...]
    rows: tuple[tuple[Any, ...], ...]


@dataclass(frozen=True)
class Part:
    """One study of an experiment, either on test functions or on simulated readings.

    Attributes:
        title: what it repeats.
        optimizers: label, name and parameters of each.
        functions: test functions; simulation, search: sensors, poses and search space of a calibration.
        runs, seed, tolerance, stop: as in `Benchmark` and `Comparison`.
        show: what is printed of it.
        paper: the paper's numbers; printed: the paper's estimates by method.
        varies, value: of a sensitivity table, what varies from part to part, and what it is in this one; the parts
            have one title and follow each other. In a file they are one part, with `variants` for what differs.
        ratio: two optimizers of a sensitivity table whose mean costs are compared.
    """

    title: str
    optimizers: tuple[Entry, ...]
    functions: Functions | None = None
    simulation: Simulation | None = None
    search: SearchSpace | None = None
    runs: int = 20
    seed: int = 0
    tolerance: float = 1e-10
    stop: bool = False
    show: tuple[Show, ...] = ("summary",)
    paper: PaperTable | None = None
    printed: tuple[PrintedEstimate, ...] = ()
    varies: str = ""
    value: str = ""
    ratio: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Its title, and where it is a variant what varies."""
        return f"{self.title}, {self.varies} {self.value}" if self.varies else self.title

    def study(self) -> Benchmark | Comparison:
        """Return the study.

        Raises:
            ConfigError: neither functions nor simulation and search.
        """
        common: dict[str, Any] = {name: getattr(self, name) for name in ("runs", "seed", "tolerance", "stop")}
        if self.functions:
            f = self.functions
            return Benchmark(f.names, self.optimizers, (f.dimensions,), evaluations=f.evaluations, **common)
        if self.simulation and self.search:
            return Comparison(self.simulation, self.search, self.optimizers, **common)
        raise ConfigError(f"{self.title}: expected functions, or simulation and search")


@dataclass(frozen=True)
class Experiment(Study):
    """An experiment of a paper: its parts run, kept and resumed as one study, their cells numbered through.

    Attributes:
        title, source: what it is and where it stands; note: what to know when reading it.
        parts: its studies.
    """

    title: str
    source: str
    parts: tuple[Part, ...]
    note: str = ""
    name: str = field(default="", kw_only=True)

    @property
    def tolerance(self) -> float:
        """Cost that counts as success in the first part."""
        return self.parts[0].tolerance

    def changed(self, runs: int | None, seed: int | None) -> Experiment:
        """Return the experiment with another number of runs or another seed; None leaves it as it is."""
        stated: dict[str, Any] = {k: v for k, v in (("runs", runs), ("seed", seed)) if v is not None}
        return replace(self, parts=tuple(replace(part, **stated) for part in self.parts))

    @cached_property
    def studies(self) -> tuple[Benchmark | Comparison, ...]:
        """The studies of the parts."""
        return tuple(part.study() for part in self.parts)

    @property
    def cells(self) -> int:
        """Cells of all parts."""
        return self._first(len(self.parts))

    @property
    def runs(self) -> int:
        """Runs of the part that has most."""
        return max(part.runs for part in self.parts)

    def names(self, cell: int) -> dict[str, str]:
        """Return part, function and optimizer of a cell; the function of a calibration is its own word."""
        part, own = self._locate(cell)
        names = self.studies[part].names(own)
        return {"part": self.parts[part].label, "function": names.get("function", "calibration")} | names

    def tasks(self) -> list[Task]:
        """Return the tasks of all parts."""
        return [
            replace(task, cell=task.cell + self._first(part))
            for part, study in enumerate(self.studies)
            for task in study.tasks()
        ]

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        part, own = self._locate(task.cell)
        return [replace(r, cell=task.cell) for r in self.studies[part].execute(replace(task, cell=own))]

    def records_of(self, part: int, records: Sequence[Record]) -> list[Record]:
        """Return the records of one part, its cells numbered as in its own study."""
        first, end = self._first(part), self._first(part + 1)
        return [replace(r, cell=r.cell - first) for r in records if first <= r.cell < end]

    def _first(self, part: int) -> int:
        """Return the number of a part's first cell."""
        return sum(study.cells for study in self.studies[:part])

    def _locate(self, cell: int) -> tuple[int, int]:
        """Return the part of a cell, and the cell's number there."""
        part = max(p for p in range(len(self.parts)) if self._first(p) <= cell)
        return part, cell - self._first(part)


def names() -> list[str]:
    """Return the experiments on optimizers by name."""
    others = navigation_names()
    return [name for name in shipped(STUDIES) if name not in others]


def navigation_names() -> list[str]:
    """Return the experiments on navigation filters by name; navigation.study runs them."""
    return [name for name, path in shipped(STUDIES).items() if "filters" in load_mapping(path)]


def catalogue() -> list[tuple[str, str, str]]:
    """Return name, title and source of all experiments, sorted."""
    files = ((name, load_mapping(path)) for name, path in shipped(STUDIES).items())
    return [(name, content["title"], content["source"]) for name, content in sorted(files)]


def load(name: str) -> Experiment:
    """Return an experiment by name.

    Raises:
        ConfigError: no such experiment, or its file says something unknown.
    """
    files = shipped(STUDIES)
    if name not in files:
        raise ConfigError(f'unknown study "{name}"{did_you_mean(name, files)}; known: {", ".join(files)}')
    content = load_mapping(files[name])
    content["parts"] = [variant for part in content.get("parts", []) for variant in _variants(part)]
    for part in content["parts"]:
        if simulation := part.get("simulation"):  # by the name of a sensor, whose file takes its place
            sensor = load_mapping(shipped("sensors")[simulation["sensor"]])
            part["simulation"] = {**simulation, "sensor": sensor}
    return replace(from_mapping(Experiment, content, str(files[name])), name=name)


def _variants(part: dict[str, Any]) -> list[dict[str, Any]]:
    """Return a part, or one for each of its variants: their `parameters` are of all optimizers."""
    own = {key: value for key, value in part.items() if key != "variants"}
    if "variants" not in part:
        return [own]
    varied = []
    for variant in part["variants"]:
        more = {**variant}
        parameters = more.pop("parameters", {})
        optimizers = [
            {**entry, "parameters": {**entry.get("parameters", {}), **parameters}}
            for entry in more.pop("optimizers", own["optimizers"])
        ]
        nested = {
            key: {**own[key], **more[key]} for key in ("search", "simulation", "functions") if key in more
        }
        varied.append({**own, "show": [], **more, **nested, "optimizers": optimizers})
    return varied


def sensitivity(experiment: Experiment, records: Sequence[Record]) -> Mapping[str, list[Row]]:
    """Return the sensitivity tables by title: a row for every value of what varies, function and optimizer.

    Definition:
        success_rate: share of runs that reached the tolerance. min, quartiles, max, mean: of the cost.
        ratio, median_ratio: log10 of the mean, or median, of the second of `Part.ratio` over that of the first.
    """
    tables: dict[str, list[Row]] = {}
    for number, (part, study) in enumerate(zip(experiment.parts, experiment.studies, strict=True)):
        if not part.varies:
            continue
        own = experiment.records_of(number, records)
        rows: list[dict[str, Any]] = []
        for cell in range(study.cells):
            runs = records_of_cell(own, cell)
            cost = np.array([r.cost for r in runs])
            names = {"varies": part.value, "function": "", **study.names(cell)}
            hits = sum(r.hit is not None for r in runs)
            rows.append(
                {
                    **names,
                    "runs": len(runs),
                    "success_rate": hits / len(runs),
                    **spread(cost),
                    "mean": float(cost.mean()),
                }
            )
        for key, name in (("mean", "ratio"), ("median", "median_ratio")):
            of = {row["optimizer"]: row[key] for row in rows}
            for row in rows:
                compared = row["optimizer"] in part.ratio[:1]
                row[name] = math.log10(of[part.ratio[1]] / row[key]) if compared else None
        tables.setdefault(part.title, []).extend(rows)
    return tables


def coordinates(study: Benchmark, records: Sequence[Record]) -> list[Row]:
    """Return mean and root mean square error over the runs of every coordinate of the best point, and of the cost."""
    rows: list[Row] = []
    for cell in range(study.cells):
        own = records_of_cell(records, cell)
        names = study.names(cell)
        optimum = TestFunction(names["function"], study.problems[cell][1]).optimum
        x, cost = np.array([r.point for r in own]), np.array([r.cost for r in own])
        for quantity, values in (("mean", (x, cost)), ("rmse", ((x - optimum) ** 2, cost**2))):
            found = [*values[0].mean(axis=0).tolist(), float(values[1].mean())]
            found = [math.sqrt(v) for v in found] if quantity == "rmse" else found
            keys = [*(f"x{i + 1}" for i in range(x.shape[1])), "cost"]
            rows.append({**names, "quantity": quantity, **dict(zip(keys, found, strict=True))})
    return rows


def curves(experiment: Experiment, records: Sequence[Record], shown: bool = False) -> Curves:
    """Return the median convergence by function, or part, and optimizer.

    Args:
        experiment: the experiment; records: of its runs.
        shown: only of the parts that show their curves.
    """
    panels: dict[str, Mapping[str, tuple[Float, Float]]] = {}
    for number, (part, study) in enumerate(zip(experiment.parts, experiment.studies, strict=True)):
        if not shown or "curves" in part.show:
            own = median_curves(study, experiment.records_of(number, records))
            panels |= {name or part.label: panel for name, panel in own.items()}
    return panels


def checkpoints(curves: Curves) -> tuple[list[float], list[tuple[str, str, list[float | None]]]]:
    """Return evaluations, and for each function and optimizer its median cost after so many; None before the first."""
    panels = [(name, label, curve) for name, panel in curves.items() for label, curve in panel.items()]
    last = max(float(evaluations[-1]) for _, _, (evaluations, _) in panels)
    at = [part * last for part in CHECKPOINTS]
    rows = []
    for name, label, (evaluations, cost) in panels:
        index = np.searchsorted(evaluations, at, side="right") - 1
        rows.append((name, label, [float(cost[i]) if i >= 0 else None for i in index]))
    return at, rows
