"""One sensor by itself and as one of a fleet: the same verdict, the same sentences, the same numbers."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from simulated import rotation

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.fleet import calibrate_fleet
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import DataError
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.io.readings import read_readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.simulation import Sensor, Spread, draw

G = 9.80665
SENSORS = 300
WEIGHTS = ("none", "n", "sd")
"""A third of the sensors each."""

SENTENCES = ("verdict", "reasons", "suggestions", "warnings", "outliers", "before", "freedom", "poses")
NUMBERS = ("K_a", "D_a", "rms", "rms_before", "s", "residual_noise_ratio", "residual_noise_p")
RELATIVE = 1e-9
ABSOLUTE = 1e-12
"""In units of g: what two ways of rounding may make of a residual that is 0."""

TYPE = Sensor(K_a=((100.0, 0, 0), (0, 102.0, 0), (0, 0, 98.0)), spread=Spread(0.02, 0.01, 0.3))


@dataclasses.dataclass(frozen=True)
class Device:
    """A simulated sensor: what makes it special, and the table of its readings."""

    kind: str
    table: str


def as_fleet(paths: list[Path], settings: Settings) -> list[Calibration | str]:
    """Calibrate the sensors of these files together: the record of each, or why there is none.

    The only place that knows how many sensors are calibrated at once.
    """
    records: dict[int, Calibration] = {}
    sources = [str(path) for path in paths]
    if len(sources) == 1:  # a fleet of one file needs a label: a sensor of a single pose is no company
        other = paths[0].with_name("other.csv")
        other.write_text("ax,ay,az\n1,2,3\n")
        sources.append(str(other))
    fleet = calibrate_fleet(read_fleet(sources), settings, records.__setitem__)
    return [records.get(r, str(fleet.reason[r])) for r in range(len(paths))]


def by_itself(path: Path, settings: Settings) -> Calibration | str:
    """Calibrate the sensor of one file: its record, or why there is none."""
    try:
        return calibrate(read_readings(path), settings)
    except DataError as error:
        return str(error)


def device(number: int) -> Device:
    """Sensor `number`: random parameters, poses, noise and layout of the table, its kind in turn."""
    rng = np.random.default_rng(np.random.SeedSequence([20, number]))
    kind = list(KINDS)[number % len(KINDS)]
    u, sigma = KINDS[kind](rng)
    model = draw(TYPE, [number], 4)
    samples = int(rng.integers(2, 6)) if kind == "labels" else 1
    u = np.repeat(u, samples, axis=0)
    noise = sigma * Streams(number, [0], purpose=902).normal(len(u), 3)[0]
    if kind == "copies":
        noise[:] = 0.0
    if kind == "outliers":
        wrong = rng.choice(len(u), int(rng.integers(1, 3)), replace=False)
        noise[wrong] += rng.uniform(20.0, 200.0) * sigma * rng.normal(size=(len(wrong), 3))
    output = 10.0 ** int(rng.integers(-2, 5)) * ((G * u + noise) @ model.K[0].T + model.D[0])
    counts = rng.integers(2, 200, len(u))
    scatter = rng.uniform(0.5, 2.0, (len(u), 3)) * max(sigma, 1e-6) * 100.0 * np.sqrt(counts)[:, None]
    if kind == "labels":
        rows = [f"p{j // samples},{_cells(row)}" for j, row in enumerate(output)]
        return Device(kind, "\n".join(["pose,ax,ay,az", *rows, ""]))
    rows = [f"{_cells(row)},{n},{_cells(sd)}" for row, n, sd in zip(output, counts, scatter, strict=True)]
    return Device(kind, "\n".join(["ax,ay,az,n,sx,sy,sz", *rows, ""]))


def _cells(values: np.ndarray) -> str:
    return ",".join(repr(float(value)) for value in values)


def _some(rng: np.random.Generator, least: int, most: int) -> np.ndarray:
    """Evenly spread directions, turned at random, in random order."""
    u = poses.fibonacci(int(rng.integers(least, most)))
    return rng.permutation(u @ rotation(int(rng.integers(1000))).T)


def _flat(rng: np.random.Generator) -> np.ndarray:
    """Poses that leave something open: a plane, two planes, a cap, faces held again and again."""
    angle = rng.uniform(0, 2 * np.pi, 16)
    plane = np.stack([np.cos(angle), np.sin(angle), np.zeros(16)], axis=1)
    tilted = np.concatenate([plane[:8], plane[8:][:, [2, 0, 1]]])
    choices = (plane, tilted, poses.fibonacci(200)[:14], np.repeat(poses.faces(), 3, axis=0))
    return choices[int(rng.integers(4))]


KINDS: dict[str, Callable[[np.random.Generator], tuple[np.ndarray, float]]] = {
    "complete": lambda rng: (_some(rng, 12, 40), 10 ** rng.uniform(-3, -1.5)),
    "degenerate": lambda rng: (_flat(rng), 10 ** rng.uniform(-3, -1.5)),
    "noisy": lambda rng: (_some(rng, 12, 30), rng.uniform(0.05, 0.3)),
    "noise-free": lambda rng: (_some(rng, 12, 30), 0.0),
    "outliers": lambda rng: (_some(rng, 14, 30), 10 ** rng.uniform(-3, -1.5)),
    "labels": lambda rng: (_some(rng, 12, 24), 10 ** rng.uniform(-3, -1.5)),
    "few": lambda rng: (_some(rng, 2, 9), 10 ** rng.uniform(-3, -1.5)),
    "nine": lambda rng: (_some(rng, 9, 11), 10 ** rng.uniform(-3, -1.5)),
    "single": lambda rng: (_some(rng, 9, 10)[:1], 0.01),
    "copies": lambda rng: (np.repeat(_some(rng, 12, 13)[:1], 12, axis=0), 0.01),
}
"""Directions, shape (J, 3), and noise per pose and axis, m/s^2, of each kind of sensor."""


@pytest.fixture(scope="module")
def devices(tmp_path_factory) -> list[tuple[Device, Path]]:
    """All sensors, each in a file of its own."""
    folder = tmp_path_factory.mktemp("fleet")
    made = []
    for number in range(SENSORS):
        one = device(number)
        path = folder / f"{number:03d}-{one.kind}.csv"
        path.write_text(one.table)
        made.append((one, path))
    return made


def differences(fleet: Calibration | str, alone: Calibration | str) -> list[str]:
    """What one sensor's two records differ in."""
    if isinstance(fleet, str) or isinstance(alone, str):
        return [] if isinstance(fleet, str) and isinstance(alone, str) else [f"{fleet!s:.90} / {alone!s:.90}"]
    differ = [
        f"{name}: {a} / {b}"
        for name in SENTENCES
        if (a := _plain(getattr(fleet, name))) != (b := _plain(getattr(alone, name)))
    ]
    if "undetermined" in (fleet.verdict, alone.verdict):
        return differ
    scale = float(np.abs(alone.K_a).max())
    units = {"K_a": scale, "D_a": scale * G, "sigma K_a": scale, "sigma D_a": scale * G}
    exact = max(fleet.s, alone.s) < ABSOLUTE * G  # no noise: its ratio to the expected one is rounding
    for name, (x, y) in _numbers(fleet, alone).items():
        if exact and name.startswith("residual_noise"):
            continue
        # Parameters that are 0 in truth are compared as parts of their matrix.
        part = RELATIVE * units[name] if name in ("K_a", "D_a") else 0.0
        near = np.isclose(x, y, rtol=RELATIVE, atol=max(ABSOLUTE * units.get(name, G), part), equal_nan=True)
        if not near.all():
            differ.append(
                f"{name}: {x[~near][0]!r} / {y[~near][0]!r}, relative {abs(x[~near][0] / y[~near][0] - 1):.1g}"
            )
    return differ


def _numbers(fleet: Calibration, alone: Calibration) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """The numbers of two records by name."""

    def of(record: Calibration) -> dict[str, np.ndarray]:
        values = {name: getattr(record, name) for name in NUMBERS}
        values |= {f"sigma {name}": getattr(record.sigma, name) for name in ("K_a", "D_a")}
        values["dop"] = list(record.dop.parameters.values())
        return {
            name: np.atleast_1d(np.array(np.nan if value is None else value, dtype=float))
            for name, value in values.items()
        }

    ours, theirs = of(fleet), of(alone)
    return {name: (ours[name], theirs[name]) for name in ours}


def _plain(value: object) -> object:
    """Sentences without the name of the file in front of a line, which only a fleet needs."""
    if isinstance(value, tuple):
        return tuple(_plain(part) for part in value)
    return re.sub(r"[\w./-]+\.csv,? line", "line", value) if isinstance(value, str) else value


MORE = (
    {"robust": "huber"},
    {"robust": "soft-l1", "weights": "n"},
    {"weights": "auto"},
    {"misalignment": False},
)
"""What a fleet does beside weights, of every tenth sensor."""


@pytest.mark.parametrize("more", MORE, ids=str)
def test_a_fleet_does_what_one_sensor_is_asked_for(devices, more):
    settings = Settings(**{"optimizer": "levenberg-marquardt", "g": G, **more})
    part = [path for one, path in devices if one.kind != "labels"][MORE.index(more) :: 7]
    wrong = [
        f"{path.stem}: {difference}"
        for path, record in zip(part, as_fleet(part, settings), strict=True)
        for difference in differences(record, by_itself(path, settings))
    ]
    assert not wrong, "\n".join([f"{len(wrong)} differences", *wrong])


@pytest.mark.parametrize("weights", WEIGHTS)
def test_a_fleet_is_calibrated_as_its_sensors_one_by_one(devices, weights):
    settings = Settings(optimizer="levenberg-marquardt", g=G, weights=weights)
    part = [path for _, path in devices[WEIGHTS.index(weights) :: len(WEIGHTS)]]
    wrong = [
        f"{path.stem}: {difference}"
        for path, record in zip(part, as_fleet(part, settings), strict=True)
        for difference in differences(record, by_itself(path, settings))
    ]
    assert not wrong, "\n".join([f"{len(wrong)} differences", *wrong])


def test_the_sensors_are_of_all_verdicts(devices):
    settings = Settings(optimizer="levenberg-marquardt", g=G)
    fleet = as_fleet([path for _, path in devices], settings)
    verdicts = {record if isinstance(record, str) else record.verdict for record in fleet}
    assert {"good", "weak", "undetermined"} <= verdicts
    assert any(isinstance(record, str) for record in fleet)
    assert any(record.outliers for record in fleet if not isinstance(record, str))


@pytest.mark.parametrize("weights", WEIGHTS)
def test_a_sensor_alone_has_the_bits_of_a_sensor_in_a_block(devices, weights):
    settings = Settings(optimizer="levenberg-marquardt", g=G, weights=weights)
    by_poses: dict[int, list[Path]] = {}
    for one, path in devices:
        if one.kind not in ("single", "copies"):
            by_poses.setdefault(len(one.table.splitlines()), []).append(path)
    block = max(by_poses.values(), key=len)
    assert len(block) > 10
    for path, record in zip(block, as_fleet(block, settings), strict=True):
        (alone,) = as_fleet([path], settings)
        assert isinstance(record, Calibration)
        assert isinstance(alone, Calibration)
        ours, theirs = record.record(), alone.record()
        assert {key for key in ours if repr(ours[key]) != repr(theirs[key])} <= {"data"}, path.stem


@pytest.mark.parametrize("weights", WEIGHTS)
def test_no_pose_without_noise_is_an_outlier(devices, weights):
    """Residuals that are rounding errors say nothing about a pose."""
    settings = Settings(optimizer="levenberg-marquardt", g=G, weights=weights)
    paths = [path for one, path in devices if one.kind == "noise-free"]
    records = [*as_fleet(paths, settings), *(by_itself(path, settings) for path in paths)]
    named = {
        path.stem: record.outliers
        for path, record in zip(paths * 2, records, strict=True)
        if not isinstance(record, str) and record.outliers
    }
    assert not named


@pytest.mark.parametrize("kind", ["temperature", "attitudes"])
def test_temperatures_and_known_attitudes_are_those_of_each_sensor(tmp_path, kind):
    """Sensors of 24 poses that warm up, one of which has none of the temperatures, or attitudes in one plane."""
    paths = []
    for number in range(4):
        rng = np.random.default_rng(number)
        u = _some(rng, 24, 25)
        if kind == "attitudes" and number == 2:
            u[:, 2] = 0.0
            u /= np.linalg.norm(u, axis=1, keepdims=True)
        model = draw(TYPE, [number], 4)
        output = (G * u + 0.01 * rng.normal(size=u.shape)) @ model.K[0].T + model.D[0]
        warmth = rng.permutation(np.linspace(10.0, 40.0, len(u)))
        output += 0.2 * (warmth[:, None] - 25.0) * (kind == "temperature")
        more = warmth[:, None] if kind == "temperature" else G * u
        rows = [f"{_cells(row)},{_cells(own)}" for row, own in zip(output, more, strict=True)]
        if kind == "temperature" and number == 2:
            rows = [row.rpartition(",")[0] + "," for row in rows]
        names = "temperature" if kind == "temperature" else "fx,fy,fz"
        path = tmp_path / f"{number}.csv"
        path.write_text("\n".join([f"ax,ay,az,{names}", *rows, ""]))
        paths.append(path)
    known = {"attitudes": "known"} if kind == "attitudes" else {}
    settings = Settings(**{"optimizer": "levenberg-marquardt", "g": G, **known})
    records = as_fleet(paths, settings)
    for path, record in zip(paths, records, strict=True):
        alone = by_itself(path, settings)
        assert not differences(record, alone), path.stem
        if isinstance(record, Calibration) and isinstance(alone, Calibration):
            assert (record.temperature is None) == (alone.temperature is None)
    if kind == "temperature":
        found = [record.temperature for record in records if isinstance(record, Calibration)]
        assert [slopes is None for slopes in found] == [False, False, True, False]
    else:
        assert [isinstance(record, str) for record in records] == [False, False, True, False]


def test_one_sensor_without_scatter_fails_alone(tmp_path):
    rng = np.random.default_rng(3)
    paths = []
    for number, counted in enumerate((True, False, True)):
        u = _some(rng, 12, 13)
        model = draw(TYPE, [number], 4)
        samples = np.repeat(u, 4, axis=0) if counted else u
        noise = 0.01 * Streams(number, [0], purpose=903).normal(len(samples), 3)[0]
        output = (G * samples + noise) @ model.K[0].T + model.D[0]
        rows = [f"p{j // 4 if counted else j},{_cells(row)}" for j, row in enumerate(output)]
        path = tmp_path / f"{number}.csv"
        path.write_text("\n".join(["pose,ax,ay,az", *rows, ""]))
        paths.append(path)
    first, second, third = as_fleet(paths, Settings(optimizer="levenberg-marquardt", g=G, weights="sd"))
    assert isinstance(first, Calibration)
    assert isinstance(third, Calibration)
    assert isinstance(second, str)
    assert "scatter" in second or "sd" in second
