"""An experiment of a paper: one or several studies, the paper's numbers, and what is shown of them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from accelcal_cli.errors import ConfigError
from accelcal_cli.studies.benchmark import Benchmark
from accelcal_cli.studies.compare import Comparison
from accelcal_cli.studies.devices import Printed
from accelcal_cli.studies.parts import Parts
from accelcal_cli.studies.scene import Search, Simulation
from accelcal_cli.studies.study import Entry

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
