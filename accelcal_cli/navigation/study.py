"""The navigation study: filters on many runs of one voyage, beside the bound and the INS alone.

The curves of a navigation study's records: errors, corrected place and claimed sigma of a run against time.

What a navigation study runs on: map, voyage, INS and gravimeter, from names, files and YAML.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, DataError, did_you_mean
from accelcal_cli.navigation.gravity_map import PRESETS, GravityMap, digest, generate, load_map
from accelcal_cli.navigation.ins import MICRO_G, Grade, metres_per_radian
from accelcal_cli.navigation.particle_filter import FILTERS, Filter, Track
from accelcal_cli.navigation.scenario import Scenario, check_coverage, read_voyage, recorded, simulate
from accelcal_cli.navigation.scores import Scores, score
from accelcal_cli.navigation.voyage import Plan, planned
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import check, from_mapping, setting
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.studies.study import Record, Study, Task


@dataclass(frozen=True)
class Navigation(Study):
    """Every filter with every grade of INS; one cell a pair.

    Attributes:
        waters: map, voyage, gravimeter.
        entries: the filters.
        grades: of the INS: one, or without and with a calibration.
        repeats: runs of each; seed: of all of them.
    """

    waters: Waters
    entries: tuple[FilterEntry, ...]
    grades: tuple[Grade, ...]
    repeats: int = 20
    seed: int = 0

    @property
    def cells(self) -> int:
        """Filters times grades."""
        return len(self.entries) * len(self.grades)

    @property
    def runs(self) -> int:
        """Runs of each cell."""
        return self.repeats

    @property
    def block(self) -> int:
        """Runs of one task: of fewer, what numpy does besides the arithmetic is a third of the time."""
        return 50

    def part(self, cell: int) -> tuple[FilterEntry, Grade]:
        """Return filter and grade of a cell."""
        grade, entry = divmod(cell, len(self.entries))
        return self.entries[entry], self.grades[grade]

    def names(self, cell: int) -> dict[str, str]:
        """Return what identifies a cell."""
        entry, grade = self.part(cell)
        return {
            "filter": entry.label,
            "mode": str(entry.parameters.get("mode", "default")),
            "accelerometer_ug": f"{grade.accelerometer:.6g}",
        }

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        runs = range(task.first, task.last)
        entry, grade = self.part(task.cell)
        scenario = self.waters.scenario(grade, runs, self.seed)
        begin = time.perf_counter()
        with np.errstate(all="ignore"):  # a diverging filter overflows; its score says so
            track = entry.build().run(scenario, Streams(self.seed, runs, Purpose.FILTER))
            scores = score(scenario, track)
        seconds = (time.perf_counter() - begin) / len(runs)
        return [_record(task, i, scenario, track, scores, seconds) for i in range(len(runs))]


def _record(task: Task, i: int, scenario: Scenario, track: Track, scores: Scores, seconds: float) -> Record:
    status = "diverged" if scores.diverged[i] else "lost" if scores.lost[i] else "kept"
    values = {
        "mean_square_latitude": scores.north[i],
        "mean_square_longitude": scores.east[i],
        "mean_square_ins": scores.ins[i],
        "nees": scores.nees[i],
        "sigma_m": scores.sigma[i],
        "blind": track.blind[i],
        "lookups": track.lookups,
    }
    return Record(
        task.cell,
        task.first + i,
        float(np.sqrt(scores.north[i] + scores.east[i])),
        round(track.lookups * scenario.epochs),
        scenario.epochs,
        status,
        None,
        {name: float(v) if np.isfinite(v) else None for name, v in values.items()},
        curve_of(i, scenario, track, scores),
        seconds,
    )


EVERY = 300.0
"""Seconds between the points of a record's curves."""

AXES = ("north", "east", "latitude", "longitude", "sigma")
OFFSET = 10_000_000
"""A record's curve holds one block for each of AXES, its seconds moved by so much."""


def curve_of(i: int, scenario: Scenario, track: Track, scores: Scores) -> tuple[tuple[int, float], ...]:
    """Return errors north and east, corrected place (degrees) and claimed sigma of a run, block by block."""
    stride = stride_of(scenario)
    seconds = scenario.seconds[::stride]
    latitude = scenario.ins.latitude[i, ::stride]
    meridian, parallel = metres_per_radian(latitude)
    blocks = (
        scores.error[i, ::stride, 0],
        scores.error[i, ::stride, 1],
        np.degrees(latitude - track.mean[i, ::stride, 0] / meridian),
        np.degrees(scenario.ins.longitude[i, ::stride] - track.mean[i, ::stride, 1] / parallel),
        np.sqrt(np.einsum("kii->k", track.covariance[i, ::stride])),
    )
    return tuple(
        (round(second) + OFFSET * axis, float(value))
        for axis, block in enumerate(blocks)
        for second, value in zip(seconds, block, strict=True)
        if np.isfinite(value)
    )


def stride_of(scenario: Scenario) -> int:
    """Return the epochs between the points of a curve."""
    return max(1, round(EVERY / scenario.period))


def axis_of(record: Record, axis: str) -> tuple[Float, Float]:
    """Return seconds and one of AXES of a record's curve, both of shape (points,)."""
    first = AXES.index(axis) * OFFSET
    points = [(n - first, value) for n, value in record.curve if first <= n < first + OFFSET]
    seconds, values = np.array(points).T if points else (np.empty(0), np.empty(0))
    return seconds, values


def mean_squares(records: Sequence[Record], axis: str) -> dict[float, float]:
    """Return the mean square over runs at each second."""
    total: dict[float, list[float]] = {}
    for record in records:
        for second, value in zip(*axis_of(record, axis), strict=True):
            total.setdefault(float(second), []).append(float(value) ** 2)
    return {second: float(np.mean(values)) for second, values in total.items()}


@dataclass(frozen=True)
class Waters:
    """Where and with what a study sails.

    Attributes:
        plan: the voyage; ins: its INS.
    """

    map: str = setting(
        "rough", "rough, moderate or constant (generated), or a file: NetCDF, GeoTIFF, XYZ text"
    )
    map_seed: int | None = setting(None, "of a generated map; not set: the study's seed", low=0)
    voyage: str = setting("", "CSV file of a recorded voyage; without one it is planned")
    plan: Plan = field(default_factory=Plan, metadata={"doc": "the planned voyage"})
    ins: Grade = field(default_factory=Grade, metadata={"doc": "the INS"})
    period: float = setting(10.0, "between measurements, whole seconds", low=1.0, high=600.0)
    noise: float = setting(1.0, "of the gravimeter, one sigma, mGal", low=1e-3, high=1000.0)
    initial: float = setting(2000.0, "the position error at the start is within this, m", above=0.0, high=1e5)
    digests: str = field(default="", metadata={"doc": "SHA-256 of the files"})

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)
        if self.period != round(self.period):
            raise ConfigError(f"period: {self.period:g} s; expected whole seconds")
        if not self.voyage and self.plan.seconds < self.period:
            raise ConfigError(
                f"plan: {self.plan.seconds} s from filtered to hours; expected at least one period, {self.period:g} s, "
                "for two measurements"
            )

    def files(self) -> list[str]:
        """Return the files that are read: map and voyage, as far as they are none of ours."""
        return [path for path in (self.map if self.map not in PRESETS else "", self.voyage) if path]

    def hashed(self) -> Waters:
        """Return the same with the hashes of its files, so that other contents are another study."""
        if self.map not in PRESETS and not Path(self.map).suffix and not Path(self.map).exists():
            raise ConfigError(
                f'unknown map "{self.map}"{did_you_mean(self.map, PRESETS)}; known: {", ".join(PRESETS)}, or the path '
                "of a file"
            )
        return replace(self, digests=" ".join(map(digest, self.files())))

    def gravity_map(self, seed: int) -> GravityMap:
        """Return the map. Raises DataError when its file cannot be used."""
        if self.map not in PRESETS:
            return load_map(self.map)
        return generate(PRESETS[self.map], seed if self.map_seed is None else self.map_seed, self.map)

    def scenario(self, grade: Grade, runs: range, seed: int) -> Scenario:
        """Return the scenario of some runs; the map must cover its track.

        Raises:
            DataError: a file that cannot be used, or a map that ends inside the track.
        """
        gravity_map = self.gravity_map(seed)
        if self.voyage:
            found = recorded(
                read_voyage(self.voyage, self.period),
                gravity_map,
                grade,
                self.noise,
                self.initial,
                runs,
                seed,
            )
            check_coverage(gravity_map, found.route, self.initial)
            return found
        check_coverage(gravity_map, planned(self.plan), self.initial)
        return simulate(
            gravity_map, self.plan, grade, runs=runs, seed=seed,
            period=self.period, noise=self.noise, initial=self.initial,
        )  # fmt: skip


@dataclass(frozen=True)
class Repeats:
    """How often a study runs, and by which random numbers."""

    runs: int = setting(20, "runs", low=1, high=100_000)
    seed: int = setting(0, "seed of all random numbers", low=0)

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)


@dataclass(frozen=True)
class FilterEntry:
    """A filter in a study: its label in the tables, its name, and what differs from its defaults."""

    label: str
    filter: str
    parameters: dict[str, Any] = field(default_factory=dict)

    def build(self) -> Filter:
        """Return the filter. Raises ConfigError when name or parameters are unknown."""
        return FILTERS.build(self.filter, self.parameters, self.label)


def filter_names() -> list[str]:
    """Return the names of all filters, in the order in which the tables show them."""
    order = ["pf", "pso-pf", "apo-pf", "de-pf", "reference"]
    return sorted(FILTERS.names(), key=lambda name: order.index(name) if name in order else len(order))


def limited(entry: FilterEntry, stated: Mapping[str, Any]) -> FilterEntry:
    """Return a filter with what the command line states; a setting it does not have is left out.

    Raises:
        ConfigError: an unknown filter, or a value that it does not permit.
    """
    known = {f.name for f in fields(FILTERS.get(entry.filter))}  # type: ignore[arg-type]
    own = {name: value for name, value in stated.items() if value is not None and name in known}
    changed = replace(entry, parameters={**entry.parameters, **own})
    changed.build()
    return changed


def load_waters(
    path: Path | str | None, stated: Mapping[str, Any]
) -> tuple[Waters, list[FilterEntry], dict[str, Any]]:
    """Return waters, filters, and the remaining keys `runs`, `seed`, `title`, ... of a study's file.

    Args:
        path: YAML file, the name of a shipped study, or None.
        stated: what the command line says instead.
    """
    files = shipped("studies")
    file = files[path] if isinstance(path, str) and path in files else path
    content = load_mapping(Path(file)) if file else {}
    where = str(file) if file else "command line"
    listed = content.pop("filters", [])
    further = {key: content.pop(key) for key in FURTHER if key in content}
    waters = from_mapping(Waters, {**content, **{k: v for k, v in stated.items() if v is not None}}, where)
    if not isinstance(listed, list):
        raise ConfigError(f"{where}: filters: expected a list of filters with their parameters")
    entries = [_entry(item, f"{where}: filters[{n}]") for n, item in enumerate(listed, 1)]
    return waters, entries, further


FURTHER = ("title", "source", "note", "runs", "seed", "paper")
"""Keys of a study's file that are not of its waters."""


@dataclass(frozen=True)
class _Stated:
    filter: str
    label: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)


def _entry(item: Any, where: str) -> FilterEntry:
    if not isinstance(item, Mapping) or "filter" not in item:
        raise ConfigError(f'{where}: expected a mapping with the key "filter"')
    stated = from_mapping(_Stated, item, where)
    FILTERS.build(stated.filter, stated.parameters, where)
    return FilterEntry(stated.label or stated.filter, stated.filter, stated.parameters)


def grade_of(calibration: Calibration, grade: Grade, where: str) -> Grade:
    """Return an INS whose accelerometers are as good as a calibration says.

    The sigma of D_a by the diagonal of K_a, root mean square over the axes, is the sigma of the bias. In gauge `full`
    the axes may lie anywhere in the body: there it is the diagonal in gauge `lower`.

    Raises:
        DataError: the calibration does not determine the biases.
    """
    K = calibration.model.in_gauge("lower").K if calibration.gauge == "full" else calibration.K_a
    sigma = np.asarray(calibration.sigma.D_a) / np.abs(np.diag(K))
    if calibration.unit == "g":
        sigma = sigma * STANDARD_GRAVITY
    value = float(np.sqrt(np.mean(np.square(sigma)))) / MICRO_G
    if not math.isfinite(value) or value <= 0:
        raise DataError(
            f"{where}: the calibration states no sigma of the biases (verdict {calibration.verdict})"
        )
    return replace(grade, accelerometer=value)
