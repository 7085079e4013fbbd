"""The experiments of the papers: a study each, in configs/studies, beside the paper's own numbers.

An experiment of a paper: one or several studies, the paper's numbers, and what is shown of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.schema import from_mapping
from accelcal_cli.studies import benchmark, compare
from accelcal_cli.studies import compare as outcome
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.compare import Comparison, Printed, parameters, valley
from accelcal_cli.studies.scenarios import Search, Simulation
from accelcal_cli.studies.study import Entry, Parts, Record
from accelcal_cli.table import Column, Table

STUDY_KIND = "studies"
KEYS = ("function", "optimizer")
"""Columns that say which of our rows a row of the paper stands beside."""

CHECKPOINTS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
"""Parts of the evaluations at which the convergence table reads the curves."""

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]


def names() -> list[str]:
    """Return the experiments on optimizers by name."""
    others = voyages()
    return [name for name in shipped(STUDY_KIND) if name not in others]


def voyages() -> list[str]:
    """Return the experiments on navigation filters by name; studies.navigation runs them."""
    return [name for name, path in shipped(STUDY_KIND).items() if "filters" in load_mapping(path)]


def catalogue() -> Table:
    """Return the experiments and what they repeat."""
    rows = [(name, (found := load(name)).title, found.source) for name in names()]
    files = shipped(STUDY_KIND)
    for name in voyages():
        content = load_mapping(files[name])
        rows.append((name, content["title"], content["source"]))
    return Table("Experiments", (Column("name"), Column("title"), Column("source")), tuple(sorted(rows)))


def load(name: str) -> Experiment:
    """Return an experiment by name.

    Raises:
        ConfigError: no such experiment, or its file says something unknown.
    """
    files = shipped(STUDY_KIND)
    if name not in files:
        raise ConfigError(f'unknown study "{name}"{did_you_mean(name, files)}; known: {", ".join(files)}')
    content = load_mapping(files[name])
    content["parts"] = [_with_sensor(part) for part in content.get("parts", [])]
    return replace(from_mapping(Experiment, content, str(files[name])), name=name)


def _with_sensor(part: dict[str, Any]) -> dict[str, Any]:
    """Return a part with the contents of its sensor's file in place of the sensor's name."""
    simulation = part.get("simulation")
    if not simulation:
        return part
    sensor = load_mapping(shipped("sensors")[simulation["sensor"]])
    return {**part, "simulation": {**simulation, "sensor": sensor}}


def tables(experiment: Experiment, records: Sequence[Record]) -> list[Table]:
    """Return what is to be printed of an experiment's records, part by part."""
    study = experiment.study()
    found = []
    for number, part in enumerate(experiment.parts):
        own = study.records_of(number, records)
        found += [replace(table, title=_title(part, table)).filled() for table in _tables(part, own)]
    return found


def _title(part: Part, table: Table) -> str:
    return f"{part.title}: {table.title}" if table.title else part.title


def _tables(part: Part, records: Sequence[Record]) -> list[Table]:
    study = part.study()
    found = []
    for show in part.show:
        if show == "summary":
            found.append(beside(_summary(study, records), part.paper))
        elif show == "successful" and isinstance(study, Comparison):
            own = outcome.summary(study, records, only_successful=True)
            found.append(replace(own, title="successful runs alone", notes=()))
        elif show == "curves":
            found.append(checkpoints(curves_of(study, records)))
        elif show == "parameters" and isinstance(study, Comparison):
            found += [parameters(study, records, part.printed), valley(study, records, part.printed)]
    return found


def _summary(study: Benchmark | Comparison, records: Sequence[Record]) -> Table:
    module = (
        benchmark.summary(study, records) if isinstance(study, Benchmark) else outcome.summary(study, records)
    )
    return replace(module, title="")


def beside(ours: Table, paper: PaperTable | None) -> Table:
    """Return our table with the paper's rows, each under ours of the same function and optimizer.

    A column `from` says whose row it is; what the paper does not print is empty.
    """
    if paper is None:
        return ours
    keys = [column.key or column.name for column in ours.columns]
    own = [key for key in KEYS if key in keys]
    theirs = [dict(zip(paper.columns, row, strict=True)) for row in paper.rows]
    rows: list[tuple[Any, ...]] = []
    for row in ours.rows:
        mine = dict(zip(keys, row, strict=True))
        rows.append((*row[: len(own)], "here", *row[len(own) :]))
        for printed in theirs:
            if all(printed.get(key) == mine[key] for key in own):
                values = [printed.get(key) for key in keys]
                rows.append((*values[: len(own)], "paper", *values[len(own) :]))
    columns = (*ours.columns[: len(own)], Column("from"), *ours.columns[len(own) :])
    return replace(ours, columns=columns, rows=tuple(rows))


def curves(experiment: Experiment, records: Sequence[Record], shown: bool = False) -> Curves:
    """Return the median convergence by function, or part, and optimizer.

    Args:
        experiment: the experiment; records: of its runs.
        shown: only of the parts that show their curves.
    """
    study = experiment.study()
    found: dict[str, Mapping[str, tuple[Float, Float]]] = {}
    for number, part in enumerate(experiment.parts):
        if shown and "curves" not in part.show:
            continue
        own = study.records_of(number, records)
        for name, panel in curves_of(part.study(), own).items():
            found[name if name else part.title] = panel
    return found


def curves_of(study: Benchmark | Comparison, records: Sequence[Record]) -> Curves:
    """Return the median convergence by function ("" for a calibration) and optimizer."""
    if isinstance(study, Benchmark):
        return benchmark.curves(study, records)
    return {"": compare.curves(study, records)}


def checkpoints(curves: Curves) -> Table:
    """Return the median cost of each optimizer after some parts of the evaluations."""
    panels = [(name, label, curve) for name, panel in curves.items() for label, curve in panel.items()]
    last = max(float(evaluations[-1]) for _, _, (evaluations, _) in panels)
    columns = [Column(f"{part * last:,.0f}", format=".2g") for part in CHECKPOINTS]
    rows = []
    for name, label, (evaluations, cost) in panels:
        index = np.searchsorted(evaluations, [part * last for part in CHECKPOINTS], side="right") - 1
        values = [float(cost[i]) if i >= 0 else None for i in index]
        rows.append((*([name] if name else []), label, *values))
    keys = (Column("function"),) if any(name for name, _, _ in panels) else ()
    return Table("median cost after so many evaluations", (*keys, Column("optimizer"), *columns), tuple(rows))


Show = Literal["summary", "successful", "curves", "parameters"]


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
    """

    title: str
    optimizers: tuple[Entry, ...]
    functions: Functions | None = None
    simulation: Simulation | None = None
    search: Search | None = None
    runs: int = 20
    seed: int = 0
    tolerance: float = 1e-10
    stop: bool = False
    show: tuple[Show, ...] = ("summary",)
    paper: PaperTable | None = None
    printed: tuple[Printed, ...] = ()

    def study(self) -> Benchmark | Comparison:
        """Return the study.

        Raises:
            ConfigError: neither functions nor simulation and search.
        """
        if self.functions:
            f = self.functions
            return Benchmark(
                f.names,
                self.optimizers,
                f.dimensions,
                self.runs,
                self.seed,
                self.tolerance,
                f.evaluations,
                self.stop,
            )
        if self.simulation and self.search:
            return Comparison(
                self.simulation, self.search, self.optimizers, self.runs, self.seed, self.tolerance, self.stop
            )
        raise ConfigError(f"{self.title}: expected functions, or simulation and search")


@dataclass(frozen=True)
class Experiment:
    """An experiment of a paper.

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
        parts = tuple(
            replace(
                part,
                runs=part.runs if runs is None else runs,
                seed=part.seed if seed is None else seed,
            )
            for part in self.parts
        )
        return replace(self, parts=parts)

    def study(self) -> Parts:
        """Return all parts as one study."""
        return Parts(tuple(part.title for part in self.parts), tuple(part.study() for part in self.parts))
