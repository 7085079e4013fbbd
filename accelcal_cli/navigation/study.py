"""The navigation study: filters on many runs of one voyage, compared with the bound and the INS alone.

Its settings come from YAML: map, voyage, INS, gravimeter and filters. Its records hold the scores of a run, and errors,
corrected position and claimed sigma against time. Its statistics are one row per filter, and RMSE against time.
"""

from __future__ import annotations

import math
import time
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, DataError, did_you_mean
from accelcal_cli.navigation.filter import FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.gravity_map import PRESETS, GravityMap, generate
from accelcal_cli.navigation.ins import METRES_PER_MICRO_G, InsGrade, metres_per_radian
from accelcal_cli.navigation.map_files import digest, load_map
from accelcal_cli.navigation.noise import Disturbance, noise_models
from accelcal_cli.navigation.recording import from_recording, read_voyage
from accelcal_cli.navigation.scenario import Scenario, check_coverage, simulate
from accelcal_cli.navigation.scores import SETTLED, Scores, bound, counted, judge, nis_band, score
from accelcal_cli.navigation.voyage import PlannedVoyage
from accelcal_cli.notices import Notice, are_serious, in_one
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import check, from_mapping, setting
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.studies.study import Record, Row, Study, Task, records_of_cell


@dataclass(frozen=True)
class FilterEntry:
    """A filter in a study: its name, its label in the tables, and the settings that differ from its defaults.

    Raises:
        ConfigError: an unknown filter or setting, or a value that the filter does not permit.
    """

    filter: str
    label: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Refuse what the filter does not know."""
        self.build()

    def build(self) -> Filter:
        """Return the filter."""
        return from_mapping(FILTERS.get(self.filter), self.parameters, self.name)

    @property
    def name(self) -> str:
        """Its label, or else the name of the filter."""
        return self.label or self.filter

    def with_settings(self, stated: Mapping[str, Any]) -> FilterEntry:
        """Return the filter with settings of the command line; None, and a setting that it lacks, are left out."""
        known = {f.name for f in fields(FILTERS.get(self.filter))}
        own = {name: value for name, value in stated.items() if value is not None and name in known}
        return replace(self, parameters=self.parameters | own)


def filter_names() -> list[str]:
    """Return the names of all filters, in the order of the tables."""
    order = ["pf", "pso-pf", "apo-pf", "de-pf", "mpf", "point-mass", "sitan", "reference"]
    return sorted(FILTERS.names(), key=lambda name: order.index(name) if name in order else len(order))


DEFAULT_SET = ("de-pf", "point-mass")
"""Filters that run when none is named: those whose claims hold on disturbed records."""

Effect = Literal["none", "corrected", "included"]


@dataclass(frozen=True)
class NavigationSettings:
    """Map, voyage, INS, gravimeter and filters of a study; its fields are the keys of its file.

    Attributes:
        plan: the planned voyage; ins: its INS.
        paper: RMSE of the position that a paper reports, m, by filter.
    """

    map: str = setting(
        "rough", "rough, moderate or constant (generated), or a file: NetCDF, GeoTIFF, ICGEM grid, XYZ text"
    )
    variable: str = setting("", "of a NetCDF map with several")
    map_seed: int | None = setting(None, "of a generated map; not set: the study's seed", low=0)
    voyage: str = setting("", "CSV file of a recorded voyage; without one the voyage is planned")
    plan: PlannedVoyage = setting(PlannedVoyage(), "the planned voyage")
    ins: InsGrade = setting(InsGrade(), "the INS")
    period: float = setting(10.0, "between measurements, whole seconds", low=1.0, high=600.0)
    noise: float = setting(1.0, "of the gravimeter, one sigma, mGal", low=1e-3, high=1000.0)
    initial: float = setting(
        2000.0, "sqrt(3) sigma of the position error at the start on either axis, m", above=0.0, high=1e5
    )
    prior: Literal["independent", "tied"] = setting(
        "independent",
        "initial errors: drawn one by one from what the filters are told, or tied by alignment and the hours before",
    )
    bias: float = setting(
        10.0, "sigma of the gravimeter's bias in the disturbed noise models, mGal", low=0.0, high=1000.0
    )
    map_error: float | None = setting(
        None, "sigma of the map's error in them, mGal; not set: a part of the map's own", low=0.0, high=1000.0
    )
    map_length: float | None = setting(
        None, "correlation length of that error, km; not set: the map's own", above=0.0, high=1000.0
    )
    gate: float = setting(5.0, "innovations beyond so many sigma are left out; 0: none", low=0.0, high=1000.0)
    eotvos: Effect = setting(
        "none", "Eotvos effect in the gravity: none, corrected by the velocity of the INS, or included"
    )
    disturbance: Disturbance = setting(Disturbance(), "of simulated gravity, which the filters are not told")
    runs: int = setting(20, "runs of each filter", low=1, high=100_000)
    seed: int = setting(0, "seed of all random numbers", low=0)
    filters: tuple[FilterEntry, ...] = ()
    title: str = ""
    source: str = ""
    note: str = ""
    paper: dict[str, Any] = field(default_factory=dict)
    digests: str = field(default="", metadata={"doc": "SHA-256 of the files"})

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)
        if self.period != round(self.period):
            raise ConfigError(f"period: {self.period:g} s; expected whole seconds")
        if self.voyage and self.prior == "tied":
            raise ConfigError(
                "prior: tied needs the hours before the first row, which a recorded voyage does not hold; leave it out"
            )
        if self.prior != "tied" and self.plan.drift != PlannedVoyage.drift:
            raise ConfigError(
                "plan: drift has no effect with prior independent; set prior: tied or leave it out"
            )
        if not self.voyage and self.plan.seconds < self.period:
            raise ConfigError(
                f"plan: {self.plan.seconds} s from filtered to hours; expected at least one period, {self.period:g} s, "
                "for two measurements"
            )

    def files(self) -> list[str]:
        """Return the files that are read: a map that is not generated, and a recorded voyage."""
        return [path for path in ("" if self.map in PRESETS else self.map, self.voyage) if path]

    def with_digests(self) -> NavigationSettings:
        """Return the settings with the hashes of their files, so that other contents make another study."""
        if self.map not in PRESETS and not Path(self.map).suffix and not Path(self.map).exists():
            raise ConfigError(
                f'unknown map "{self.map}"{did_you_mean(self.map, PRESETS)}; known: {", ".join(PRESETS)}, or the path '
                "of a file"
            )
        return replace(self, digests=" ".join(map(digest, self.files())))

    def gravity_map(self) -> GravityMap:
        """Return the map. Raises DataError when its file cannot be used."""
        if self.map not in PRESETS:
            return load_map(self.map, self.variable)
        return generate(PRESETS[self.map], self.seed if self.map_seed is None else self.map_seed, self.map)

    def scenario(self, grade: InsGrade, runs: range) -> Scenario:
        """Return the scenario of some runs; the map must cover its trajectory.

        Raises:
            DataError: a file that cannot be used, or a map that ends near the trajectory.
        """
        scenario = self._recorded(grade, runs) if self.voyage else self._simulated(grade, runs)
        if not self.voyage:
            check_coverage(scenario.gravity_map, self.plan.trajectory(), self.initial)
        else:
            check_coverage(scenario.gravity_map, scenario.true, self.initial)
        models = noise_models(
            scenario.gravity_map, self.bias, self.map_error, self.map_length, self.gate, self.eotvos != "none"
        )
        return replace(scenario, models=models)

    def _simulated(self, grade: InsGrade, runs: range) -> Scenario:
        return simulate(
            self.gravity_map(),
            self.plan,
            grade,
            runs=runs,
            seed=self.seed,
            period=self.period,
            noise=self.noise,
            initial=self.initial,
            prior=self.prior,
            disturbance=self.disturbance,
            corrected=self.eotvos != "none",
        )

    def _recorded(self, grade: InsGrade, runs: range) -> Scenario:
        return from_recording(
            read_voyage(self.voyage, self.period),
            self.gravity_map(),
            grade,
            runs=runs,
            seed=self.seed,
            noise=self.noise,
            initial=self.initial,
            effect=self.eotvos,
        )


def load_study(path: Path | str | None, stated: Mapping[str, Any]) -> NavigationSettings:
    """Return the settings of a study.

    Args:
        path: YAML file, the name of a shipped study, or None.
        stated: settings on the command line, which replace those of the file; None is not stated.
    """
    files = shipped("studies")
    file = files[path] if isinstance(path, str) and path in files else path
    content = load_mapping(Path(file)) if file else {}
    content |= {key: value for key, value in stated.items() if value is not None}
    return from_mapping(NavigationSettings, content, str(file or "command line"))


def grade_of(calibration: Calibration, grade: InsGrade, where: str) -> InsGrade:
    """Return an INS whose accelerometers are as accurate as a calibration says.

    The sigma of the bias is that of D_a over the diagonal of K_a, root mean square over the axes. In gauge `full` the
    axes may lie anywhere in the body: there it is the diagonal in gauge `lower`.

    Raises:
        DataError: the calibration does not determine the biases.
    """
    K = calibration.model.in_gauge("lower").K if calibration.gauge == "full" else calibration.K_a
    sigma = np.asarray(calibration.sigma.D_a) / np.abs(np.diag(K))
    if calibration.unit != "m/s^2":
        sigma = sigma * STANDARD_GRAVITY
    value = float(np.sqrt(np.mean(np.square(sigma)))) / METRES_PER_MICRO_G
    if not math.isfinite(value) or value <= 0:
        raise DataError(
            f"{where}: the calibration states no sigma of the biases (verdict {calibration.verdict})"
        )
    return replace(grade, accelerometer=value)


@dataclass(frozen=True)
class Navigation(Study):
    """Every filter with every grade of INS; one cell per pair.

    Attributes:
        settings: of the study.
        entries: the filters.
        grades: of the INS: one, or without and with a calibration.
    """

    settings: NavigationSettings
    entries: tuple[FilterEntry, ...]
    grades: tuple[InsGrade, ...]

    @property
    def cells(self) -> int:
        """Filters times grades."""
        return len(self.entries) * len(self.grades)

    @property
    def runs(self) -> int:
        """Runs of each cell."""
        return self.settings.runs

    @property
    def block(self) -> int:
        """Runs per task: with fewer, a third of the time goes into numpy's overhead."""
        return 50

    def part(self, cell: int) -> tuple[FilterEntry, InsGrade]:
        """Return filter and grade of a cell."""
        grade, entry = divmod(cell, len(self.entries))
        return self.entries[entry], self.grades[grade]

    def names(self, cell: int) -> dict[str, str]:
        """Return what identifies a cell."""
        entry, grade = self.part(cell)
        return {
            "filter": entry.name,
            "mode": str(entry.parameters.get("mode", "default")),
            "accelerometer_ug": f"{grade.accelerometer:.6g}",
        }

    def execute(self, task: Task) -> list[Record]:
        """Return the records of a task's runs."""
        runs = range(task.first, task.last)
        entry, grade = self.part(task.cell)
        scenario = self.settings.scenario(grade, runs)
        begin = time.perf_counter()
        with np.errstate(all="ignore"):  # a diverging filter overflows; its score says so
            estimates = entry.build().run(scenario, Streams(self.settings.seed, runs, Purpose.FILTER))
            scores = score(scenario, estimates)
        seconds = (time.perf_counter() - begin) / len(runs)
        return [_record(task, i, scenario, estimates, scores, seconds) for i in range(len(runs))]


def _record(
    task: Task, i: int, scenario: Scenario, estimates: PositionEstimates, scores: Scores, seconds: float
) -> Record:
    """Return the record of the i-th run of a task."""
    values = {
        "mean_square_latitude": scores.north[i],
        "mean_square_longitude": scores.east[i],
        "mean_square_ins": scores.ins[i],
        "nees": scores.nees[i],
        "sigma_m": scores.sigma[i],
        "nis": scores.nis[i],
        "rejected": scores.rejected[i],
        "disturbed": scores.disturbed[i],
        "measured": float(np.isfinite(estimates.nis[i]).sum()),
        "blind": estimates.blind[i],
        "lookups": estimates.lookups,
    }
    return Record(
        task.cell,
        task.first + i,
        cost=float(np.sqrt(scores.north[i] + scores.east[i])),
        evaluations=round(estimates.lookups * scenario.epochs),
        iterations=scenario.epochs,
        status="diverged" if scores.diverged[i] else "lost" if scores.lost[i] else "kept",
        hit=None,
        values={name: float(v) if np.isfinite(v) else None for name, v in values.items()},
        curve=_curve(i, scenario, estimates, scores),
        seconds=seconds,
    )


EVERY = 300.0
"""Seconds between the points of a record's curve."""

AXES = ("north", "east", "latitude", "longitude", "sigma")
"""Values of a point after its seconds: errors (m), corrected position (degrees), claimed sigma (m); NaN if unknown."""


def _curve(
    i: int, scenario: Scenario, estimates: PositionEstimates, scores: Scores
) -> tuple[tuple[float, ...], ...]:
    """Return the curve of the i-th run: seconds and AXES of each point."""
    points = slice(None, None, _stride(scenario))
    latitude, longitude = scenario.ins.latitude[i, points], scenario.ins.longitude[i, points]
    meridian, parallel = metres_per_radian(latitude)
    columns = (
        np.rint(scenario.seconds[points]).astype(int),
        scores.error[i, points, 0],
        scores.error[i, points, 1],
        np.degrees(latitude - estimates.mean[i, points, 0] / meridian),
        np.degrees(longitude - estimates.mean[i, points, 1] / parallel),
        np.sqrt(np.einsum("kii->k", estimates.covariance[i, points])),
    )
    return tuple(zip(*(column.tolist() for column in columns), strict=True))


def _stride(scenario: Scenario) -> int:
    """Return the epochs between the points of a curve."""
    return max(1, round(EVERY / scenario.period))


def axis_of(record: Record, axis: str) -> dict[int, float]:
    """Return one of AXES of a record's curve by second, where it is known."""
    at = AXES.index(axis) + 1
    return {int(point[0]): point[at] for point in record.curve if math.isfinite(point[at])}


def statistics(study: Navigation, records: Sequence[Record]) -> list[Row]:
    """Return one row per cell: errors from an hour after the filter's start in m, bound, lost runs, consistency, time.

    Definition:
        rmse_position_m, rmse_latitude_m, rmse_longitude_m: root mean square errors; ins_m: of the INS alone.
        circular_95_m: radius that holds 95 % of the position errors.
        bound_m: root of the mean bound on the squared position error; bound_ratio: RMSE over it; None without a true
            track.
        claimed_m: root of the mean variance that the filter claims.
        nis: mean normalised innovation squared; nis_band: where chance leaves that of a run.
        warnings: what speaks against it.
        lost, diverged: numbers of runs; nees: mean normalised error squared; lookups: of the map, per run and epoch.
        seconds: time of all runs, s; epoch_us: of one run and epoch, microseconds.
    """
    scenarios = [study.settings.scenario(grade, range(1)) for grade in study.grades]
    return [
        _row(study, cell, records_of_cell(records, cell), scenarios[cell // len(study.entries)])
        for cell in range(study.cells)
    ]


def _bound(scenario: Scenario) -> float | None:
    """Return the bound on the position error of a scenario, m; None where the true track is not known."""
    if scenario.error is None:
        return None
    return float(np.sqrt(bound(scenario)[counted(scenario)].sum(axis=1).mean()))


def _row(study: Navigation, cell: int, records: Sequence[Record], scenario: Scenario) -> Row:
    """Return the statistics of one cell; scenario: of one run."""
    least, known = _bound(scenario), scenario.error is not None
    entry, grade = study.part(cell)
    names = ("mean_square_latitude", "mean_square_longitude", "mean_square_ins", "nees", "lookups", "nis")
    north, east, ins, nees, lookups, nis = (
        _mean(record.values[name] for record in records) for name in names
    )
    position = float(np.sqrt(north + east))
    measured = round(_mean(record.values["measured"] for record in records))
    seconds = sum(record.seconds for record in records)
    return {
        "filter": entry.name,
        "mode": study.names(cell)["mode"],
        "accelerometer_ug": grade.accelerometer,
        "runs": len(records),
        "rmse_position_m": position,
        "rmse_latitude_m": float(np.sqrt(north)),
        "rmse_longitude_m": float(np.sqrt(east)),
        "circular_95_m": _circular_95(records),
        "bound_m": least,
        "bound_ratio": None if least is None else position / least,
        "claimed_m": _claimed(records),
        "nis": nis,
        "nis_band": "{:.2f} to {:.2f}".format(*nis_band(measured)),
        "ins_m": float(np.sqrt(ins)),
        "lost": sum(record.status != "kept" for record in records) if known else None,
        "diverged": sum(record.status == "diverged" for record in records) if known else None,
        "nees": nees,
        "lookups": lookups,
        "seconds": seconds,
        "warnings": in_one([*scenario.notices, *_warnings(study, records)]),
        "epoch_us": 1e6 * seconds / sum(record.iterations for record in records),
    }


def _claimed(records: Sequence[Record]) -> float:
    """Return the root of the mean claimed variance, m."""
    return float(np.sqrt(_mean(None if s is None else s**2 for s in (r.values["sigma_m"] for r in records))))


def _warnings(study: Navigation, records: Sequence[Record]) -> list[Notice]:
    """Return what the innovations of all runs say against a filter."""
    nis, rejected, disturbed, measured = (
        _mean(record.values[name] for record in records)
        for name in ("nis", "rejected", "disturbed", "measured")
    )
    return judge(nis, rejected, disturbed, _claimed(records), study.settings.initial, round(measured))


def are_suspect(study: Navigation, records: Sequence[Record]) -> bool:
    """Whether the innovations of a recorded voyage speak against any of the filters."""
    if not study.settings.voyage:
        return False
    cells = (records_of_cell(records, cell) for cell in range(study.cells))
    return any(are_serious(_warnings(study, own)) for own in cells)


def _mean(values: Iterable[float | None]) -> float:
    """Return the mean, NaN where a value is missing."""
    return float(np.mean([np.nan if value is None else value for value in values]))


def _circular_95(records: Sequence[Record]) -> float:
    """Return the radius that holds 95 % of the errors from an hour after the start, at the points of the curves, m."""
    errors: list[float] = []
    for record in records:
        north, east = axis_of(record, "north"), axis_of(record, "east")
        late = min(min(north, default=0) + SETTLED, max(north, default=0))
        errors += [np.hypot(north[second], east[second]) for second in north if second >= late]
    return float(np.percentile(errors, 95)) if errors else float("nan")


INS, BOUND = "INS alone", "bound"
"""Names of the curves that are not of a filter."""


def rmse_curves(study: Navigation, records: Sequence[Record]) -> list[tuple[Any, ...]]:
    """Return RMSE against time of every filter, then of the INS alone and the bound for each grade of INS.

    A row holds filter, mode, micro-g, seconds; RMSE of latitude, longitude and position, m; latitude and longitude of
    run 0, corrected or of the INS alone, degrees, and its claimed sigma, m. None is unknown.
    """
    rows: list[tuple[Any, ...]] = []
    for cell in range(study.cells):
        names, own = study.names(cell), records_of_cell(records, cell)
        first = {axis: axis_of(own[0], axis) for axis in AXES}
        north, east = (_mean_squares(own, axis) for axis in ("north", "east"))
        for second, sigma in first["sigma"].items():
            place = first["latitude"].get(second), first["longitude"].get(second)
            rmse = _roots(north.get(second), east.get(second))
            label = names["filter"], names["mode"], float(names["accelerometer_ug"])
            rows.append((*label, second, *rmse, *place, sigma))
    for grade in study.grades:
        rows += _limits(study, grade)
    return rows


def _limits(study: Navigation, grade: InsGrade) -> list[tuple[Any, ...]]:
    """Return the rows of the INS alone, over the study's runs, and of the bound."""
    scenario = study.settings.scenario(grade, range(study.runs))
    at = slice(None, None, _stride(scenario))
    indicated = np.degrees([scenario.ins.latitude[0, at], scenario.ins.longitude[0, at]]).T
    nowhere: Any = [(None, None)] * len(indicated)
    alone = nowhere if scenario.error is None else np.square(scenario.error[:, at]).mean(axis=0)
    label = "", float(f"{grade.accelerometer:.6g}")
    limits: list[Any] = [(INS, alone, indicated)]
    if scenario.error is not None:
        limits.append((BOUND, bound(scenario)[at], nowhere))
    return [
        (name, *label, round(second), *_roots(*squares[k]), *places[k], None)
        for name, squares, places in limits
        for k, second in enumerate(scenario.seconds[at])
    ]


def _mean_squares(records: Sequence[Record], axis: str) -> dict[int, float]:
    """Return the mean square over runs at each second."""
    squares: defaultdict[int, list[float]] = defaultdict(list)
    for record in records:
        for second, value in axis_of(record, axis).items():
            squares[second].append(value**2)
    return {second: float(np.mean(values)) for second, values in squares.items()}


def _roots(north: float | None, east: float | None) -> tuple[float | None, float | None, float | None]:
    """Return the roots of mean squares north and east, and of their sum."""
    if north is None or east is None:
        return None if north is None else north**0.5, None if east is None else east**0.5, None
    return float(north**0.5), float(east**0.5), float((north + east) ** 0.5)
