"""How often 95 % intervals hold the truth, class by class: `python -m benchmarks.truth --coverage`.

A class is a kind of honest readings and of settings. Of the results called good or weak the share of intervals that
hold the truth is counted, of all parameters together and of each; the others are withheld, and their share is stated.
The truth is brought to the gauge of the result. The limits are those of 1 000 draws; with fewer they are wider by what
chance does.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.random import Generator

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import AccelcalError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel
from benchmarks.truth_logs import tremble
from benchmarks.truth_scenes import (
    MILLI_G,
    OPTIMIZER,
    Scene,
    in_processes,
    inside,
    random_sensor,
    readings_of,
    spread,
    stream,
    unit,
)
from benchmarks.truth_traps import cap

POOLED, EACH, WITHHELD = (0.93, 0.97), (0.91, 0.99), 0.05
"""Coverage of all parameters together, of each, and the largest share that may be withheld."""

CHUNK = 25
"""Draws that a process takes at a time."""

NOISE = (0.2, 2.0)
"""Least and largest noise of one row, mg; drawn evenly in its logarithm."""

REFERENCE = 25.0
"""Temperature at which the parameters of a sensor are stated, degrees."""


@dataclass(frozen=True, eq=False)
class Slopes:
    """Relative change of the scale factors and change of the biases, output units, per degree, both shape (3,)."""

    scale: Float
    bias: Float


@dataclass(frozen=True, eq=False)
class Case:
    """Readings, how they are calibrated, and the truth behind."""

    readings: Readings
    settings: Settings
    truth: ErrorModel
    slopes: Slopes | None = None


@dataclass(frozen=True)
class Kind:
    """A class of honest readings.

    Attributes:
        name: of the table; make: a case from a generator.
        each: whether every parameter by itself has to be covered, rather than all together.
        withheld: largest share that may be withheld; 1 for attitudes that a verdict may refuse.
    """

    name: str
    make: Callable[[Generator], Case]
    each: bool = True
    withheld: float = WITHHELD


def settings(g: float, **stated: object) -> Settings:
    return Settings(**{"optimizer": OPTIMIZER, "g": g, **stated})  # type: ignore[arg-type]


def scene_of(rng: Generator, count: int, rows: int = 1) -> Scene:
    return Scene.of(rng, float(np.exp(rng.uniform(*np.log(NOISE)))), count, rows)


def singles(
    count: int,
    choose: Callable[[Generator, int], Float] = spread,
    axes: Sequence[float] = (1.0, 1.0, 1.0),
    **stated: object,
) -> Callable[[Generator], Case]:
    """Return a class of one row per pose, with the noise of the axes in the proportion `axes`."""

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, count)
        f = scene.g * choose(rng, count)
        output = scene.model.output(f + scene.noises(count) * np.array(axes))
        return Case(Readings.from_array(output), settings(scene.g, **stated), scene.model)

    return make


def repeated(
    count: int,
    rows: int,
    noise: Callable[[Scene, Float], Float] | None = None,
    labelled: bool = True,
    **stated: str,
) -> Callable[[Generator], Case]:
    """Return a class of rows that repeat in every pose; `noise` changes the forces, shape (n, 3), from true to read."""

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, count, rows)
        f = scene.g * np.repeat(spread(rng, count), rows, axis=0)
        felt = f + scene.noises(len(f)) if noise is None else noise(scene, f)
        labels = scene.labels() if labelled else None
        recording = scene.recording(scene.model.output(felt), labels, settings=stated)
        return Case(readings_of(recording), recording.settings, scene.model)

    return make


def of_axes(*proportion: float) -> Callable[[Scene, Float], Float]:
    return lambda scene, f: f + scene.noises(len(f)) * np.array(proportion)


def autoregressive(scene: Scene, f: Float) -> Float:
    """Rows with noise of AR(1), coefficient 0.9, through all poses."""
    z = scene.rng.normal(size=f.shape)
    out = np.empty_like(z)
    out[0] = z[0]
    for k in range(1, len(z)):
        out[k] = 0.9 * out[k - 1] + np.sqrt(1 - 0.81) * z[k]
    return f + scene.noise * out


def trembling(scene: Scene, f: Float) -> Float:
    """Rows in a hand that trembles by 20 mrad."""
    return tremble(scene.rng, f, scene.rows, 0.02) + scene.noises(len(f))


def summarised(
    rng: Generator, scene: Scene, low: int, high: int, shared: float = 0.0
) -> tuple[Float, Float, Float]:
    """Return forces of poses with counts of `low` to `high` rows as read, counts and scatter as force.

    `shared` is a further error of every pose, m/s^2.
    """
    n = np.round(np.exp(rng.uniform(np.log(low), np.log(high), scene.count)))
    f = scene.g * spread(rng, scene.count)
    read = f + scene.noises(scene.count) / np.sqrt(n)[:, None] + shared * rng.normal(size=f.shape)
    scatter = scene.noise * np.sqrt(rng.chisquare(n[:, None] - 1, (scene.count, 3)) / (n[:, None] - 1))
    return read, n, scatter


def uneven(weights: str, low: int = 4, high: int = 1000, shared: float = 0.0) -> Callable[[Generator], Case]:
    """Return a class of means of unequal numbers of rows, with their scatter; `shared` in rows' noise."""

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, 24)
        read, n, scatter = summarised(rng, scene, low, high, shared * scene.noise)
        readings = Readings.from_array(scene.model.output(read), count=n, scatter=scene.size * scatter)
        return Case(readings, settings(scene.g, weights=weights), scene.model)

    return make


def warmed(low: int, high: int, **stated: object) -> Callable[[Generator], Case]:
    """Return a class of 36 poses at 15 to 45 degrees, each the mean of `low` to `high` rows.

    Scale factors and biases of the sensor go with temperature.
    """

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, 36)
        read, n, scatter = summarised(rng, scene, low, high)
        degrees = rng.uniform(15, 45, scene.count)
        slopes = Slopes(1e-4 * rng.normal(size=3), 0.2 * MILLI_G * scene.size * rng.normal(size=3))
        t = (degrees - REFERENCE)[:, None]
        K, D = scene.model.K, scene.model.D
        output = (read @ K.T) * (1 + slopes.scale * t) + D + slopes.bias * t
        readings = Readings.from_array(output, count=n, scatter=scene.size * scatter, temperature=degrees)
        return Case(readings, settings(scene.g, **stated), scene.model, slopes)

    return make


def robust(loss: str, count: int, tail: str) -> Callable[[Generator], Case]:
    """Return a class for a robust loss: Gaussian noise, that of Student's t with 3 degrees, or 10 % outliers."""

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, count)
        f = scene.g * spread(rng, count)
        z = scene.noises(count)
        if tail == "t3":
            z = scene.noise * rng.standard_t(3, (count, 3))
        output = scene.model.output(f + z)
        if tail == "outliers":
            hit = rng.choice(count, round(0.1 * count), replace=False)
            size = np.exp(rng.uniform(np.log(3 * scene.noise), np.log(2 * scene.g), (len(hit), 1)))
            output[hit] += scene.size * size * unit(rng.normal(size=(len(hit), 3)))
        return Case(Readings.from_array(output), settings(scene.g, robust=loss), scene.model)

    return make


def known(axes: Sequence[float] = (1.0, 1.0, 1.0), count: int = 24) -> Callable[[Generator], Case]:
    """Return a class of known attitudes."""

    def make(rng: Generator) -> Case:
        scene = scene_of(rng, count)
        f = scene.g * spread(rng, count)
        output = scene.model.output(f + scene.noises(count) * np.array(axes))
        return Case(
            Readings.from_array(output, reference=f), settings(scene.g, attitudes="known"), scene.model
        )

    return make


def perpendicular(rng: Generator) -> Case:
    """Return readings of a sensor without misalignment, calibrated so."""
    model, size = random_sensor(rng)
    scene = scene_of(rng, 12)
    model = ErrorModel(np.diag(np.diagonal(model.K)), model.D)
    scene = Scene(rng, model, size, scene.g, scene.noise, 12, 1)
    output = model.output(scene.g * spread(rng, 12) + scene.noises(12))
    return Case(Readings.from_array(output), settings(scene.g, misalignment=False), model)


KINDS: tuple[Kind, ...] = (
    Kind("equal noise, 12 poses", singles(12)),
    Kind("equal noise, 24 poses", singles(24)),
    Kind("equal noise, 300 poses", singles(300)),
    Kind("equal noise, 24 poses of 20 rows", repeated(24, 20)),
    Kind("axes 1:1:2, single rows", singles(24, axes=(1, 1, 2)), each=False),
    Kind("axes 1:1:4, single rows", singles(24, axes=(1, 1, 4)), each=False),
    *(
        Kind(f"axes 1:1:{z}, 20 rows, weights {w}", repeated(24, 20, of_axes(1, 1, z), weights=w))
        for z in (2, 4)
        for w in ("sd", "auto")
    ),
    *(Kind(f"n of 4 to 1 000, weights {w}", uneven(w)) for w in ("n", "sd", "auto")),
    # An error that poses share beside their noise is one that the scatter does not explain: a verdict may withhold it.
    Kind("n of 4 to 1 000, shared error, weights auto", uneven("auto", shared=0.2), each=False, withheld=1),
    *(Kind(f"{n} rows, weights sd", repeated(24, n, weights="sd")) for n in (2, 3)),
    Kind("temperature, n of 20 to 3 000, weights auto", warmed(20, 3000, weights="auto")),
    Kind("temperature, n of 100", warmed(100, 100)),
    *(
        Kind(f"{loss}, {count} poses, {tail}", robust(loss, count, tail))
        for loss, count in (("huber", 24), ("huber", 60), ("soft-l1", 24))
        for tail in ("Gaussian", "t3", "outliers")
    ),
    Kind("known attitudes", known()),
    Kind("known attitudes, axes 1:1:3", known((1, 1, 3))),
    Kind("no misalignment", perpendicular),
    Kind("AR(1) 0.9, 24 labelled poses of 50 rows", repeated(24, 50, autoregressive)),
    Kind("AR(1) 0.9, 24 x 50 rows", repeated(24, 50, autoregressive, labelled=False)),
    Kind("tremor of 20 mrad, 100 rows", repeated(24, 100, trembling)),
    *(Kind(f"cap of {a} degrees, 24 poses", singles(24, cap(a)), withheld=1) for a in (60, 90, 120)),
    *(Kind(f"cap of {a} degrees, 2 000 rows", singles(2000, cap(a)), withheld=1) for a in (60, 90)),
)


@dataclass
class Counts:
    """What came of the draws of a class."""

    verdicts: Counter[str] = field(default_factory=Counter)
    keys: Counter[str] = field(default_factory=Counter)
    hits: list[Float] = field(default_factory=list)

    def add(self, other: Counts) -> None:
        self.verdicts += other.verdicts
        self.keys += other.keys
        self.hits += other.hits

    @property
    def withheld(self) -> float:
        trusted = self.verdicts["good"] + self.verdicts["weak"]
        return 1 - trusted / max(1, sum(self.verdicts.values()))

    @property
    def each(self) -> Float:
        """Return the coverage of each parameter."""
        return np.asarray(np.nanmean(self.hits, axis=0)) if self.hits else np.zeros(0)

    def passed(self, kind: Kind) -> bool:
        if not self.hits:
            return kind.withheld == 1
        each, pooled, room = self.each, float(self.each.mean()), self.chance
        inside_each = not kind.each or (each.min() >= EACH[0] - room and each.max() <= EACH[1] + room)
        inside_all = POOLED[0] - room <= pooled <= POOLED[1] + room
        return bool(inside_all and inside_each and self.withheld <= kind.withheld + room)

    @property
    def chance(self) -> float:
        """Return three standard errors of a coverage of 95 %, less those of 1 000 draws."""
        return max(0.0, float(3 * np.sqrt(0.05 * 0.95) * (1 / np.sqrt(len(self.hits)) - 1 / np.sqrt(1000))))


def covered(result: Calibration, case: Case) -> Float:
    """Return which intervals hold the truth, of matrix, bias and slopes with temperature, as `inside`, shape (p,)."""
    temperature, slopes = result.temperature, case.slopes
    if temperature is None or slopes is None:
        return inside(result, case.truth)
    by = temperature.reference - REFERENCE
    factor = 1 + slopes.scale * by
    truth = ErrorModel(factor[:, None] * case.truth.K, case.truth.D + slopes.bias * by)
    half_scale, half_bias = (
        getattr(temperature, f"interval_{what}", 1.96 * getattr(temperature, f"sigma_{what}"))
        for what in ("scale", "bias")
    )
    scale = np.abs(temperature.scale - slopes.scale / factor) <= half_scale
    bias = np.abs(temperature.bias - slopes.bias) <= half_bias
    return np.concatenate([inside(result, truth), scale, bias])


Part = tuple[str, range, int]


def count(part: Part) -> Counts:
    """Make draws of a class: its name, their numbers, the seed."""
    name, indices, seed = part
    kind = next(kind for kind in KINDS if kind.name == name)
    counts = Counts()
    for index in indices:
        case = kind.make(stream(seed, name, index))
        try:
            result = calibrate(case.readings, case.settings)
        except AccelcalError:
            counts.verdicts["refused"] += 1
            continue
        counts.verdicts[result.verdict] += 1
        counts.keys.update(
            notice.key for notice in getattr(result, "warnings", ()) if notice.severity == "warning"
        )
        if result.verdict in ("good", "weak"):
            counts.hits.append(covered(result, case))
    return counts


DRAWS = 1000


def table_of_coverage(only: Sequence[str], number: int | None, seed: int, jobs: int, as_json: bool) -> bool:
    """Print the coverage of every class whose name contains one of `only`; return whether all is as it should be."""
    number = number or DRAWS
    kinds = [kind for kind in KINDS if not only or any(part in kind.name for part in only)]
    chunks = [range(first, min(first + CHUNK, number)) for first in range(0, number, CHUNK)]
    parts = [(kind.name, chunk, seed) for kind in kinds for chunk in chunks]
    results = in_processes(count, parts, jobs)
    if not as_json:
        print("| class | draws | withheld | all parameters | least of one | largest of one | |")
        print("| --- | --- | --- | --- | --- | --- | --- |")
    passed, records = True, []
    for kind in kinds:
        counts = Counts()
        for _ in chunks:
            counts.add(next(results))
        good = counts.passed(kind)
        passed &= good
        each = counts.each
        records.append(
            {
                "class": kind.name,
                "draws": number,
                "withheld": counts.withheld,
                "each": each.tolist(),
                "verdicts": counts.verdicts,
                "warnings": counts.keys,
                "passed": good,
            }
        )
        if not as_json:
            shares = [f"{v:.1%}" for v in (each.mean(), each.min(), each.max())] if len(each) else ["-"] * 3
            said = ", ".join(f"{key} {times}" for key, times in counts.keys.most_common(3))
            mark = "" if good else f"**off** {said}".rstrip()
            print(
                f"| {kind.name} | {number} | {counts.withheld:.1%} | {' | '.join(shares)} | {mark} |",
                flush=True,
            )
    if as_json:
        print(json.dumps({"classes": records, "passed": passed}, indent=1))
    return passed
