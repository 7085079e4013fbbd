"""Weights, robust losses and verification: `python -m benchmarks.truth --weights`, `--robust`, `--verify`.

`--weights`: residual noise over the noise expected from the readings is 1 on white noise for any spread of the number
of rows, and its p-value uniform. `--robust`: spoiled poses are named and leave the parameters where they would be
without them; clean readings lose little. `--verify`: a sensor that did not change is called changed at the level of the
test.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.random import Generator

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import AccelcalError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.verification.verify import verify
from benchmarks.truth_coverage import Slopes, scene_of, settings
from benchmarks.truth_scenes import (
    MILLI_G,
    Scene,
    deviations,
    in_processes,
    rotation,
    spread,
    stream,
)

Outcomes = list[Any]
"""What the draws of a case came to, one number or tuple each."""


@dataclass(frozen=True)
class Check:
    """A case of a study.

    Attributes:
        name: of the table; draw: makes one draw; cells: of the row, from all draws; passed: whether they are as they
            should be.
    """

    name: str
    draw: Callable[[Generator], Any]
    cells: Callable[[Outcomes], list[str]]
    passed: Callable[[Outcomes], bool]


def _part(part: tuple[str, str, range, int]) -> Outcomes:
    study, name, indices, seed = part
    check = next(check for check in CHECKS[study] if check.name == name)
    return [check.draw(stream(seed, study, name, index)) for index in indices]


def table_of(study: str, heads: Sequence[str], usual: int) -> Callable[..., bool]:
    """Return the function that prints the table of a study and returns whether all of it is as it should be."""

    def show(only: Sequence[str], number: int | None, seed: int, jobs: int, as_json: bool) -> bool:
        number = number or usual
        checks = [check for check in CHECKS[study] if not only or any(part in check.name for part in only)]
        chunks = [range(first, min(first + 20, number)) for first in range(0, number, 20)]
        results = in_processes(
            _part, [(study, c.name, chunk, seed) for c in checks for chunk in chunks], jobs
        )
        if not as_json:
            print(f"| case | draws | {' | '.join(heads)} | |\n| --- | --- | {'--- | ' * len(heads)}--- |")
        records = [_row(check, number, len(chunks), heads, results, as_json) for check in checks]
        if as_json:
            print(json.dumps(records, indent=1))
        return all(record["passed"] for record in records)

    return show


def _row(
    check: Check, number: int, chunks: int, heads: Sequence[str], results: Iterator[Outcomes], as_json: bool
) -> dict[str, object]:
    drawn = [one for _ in range(chunks) for one in next(results)]
    cells, passed = check.cells(drawn), check.passed(drawn)
    if not as_json:
        print(
            f"| {check.name} | {number} | {' | '.join(cells)} | {'' if passed else '**off**'} |", flush=True
        )
    return {"case": check.name, "draws": number, **dict(zip(heads, cells, strict=True)), "passed": passed}


# Weights.

RATIO, UNIFORM, FOR_RATIO = (0.9, 1.1), 0.01, 200
"""Median ratio of the first FOR_RATIO draws, and the least p-value of a Kolmogorov-Smirnov test of all."""

COUNTS: dict[str, Callable[[Generator, int], Float]] = {
    "n 20": lambda _, poses: np.full(poses, 20.0),
    "n 4 and 1 000": lambda _, poses: np.where(np.arange(poses) % 2, 1000.0, 4.0),
    "n 2 to 3 000": lambda rng, poses: np.round(np.exp(rng.uniform(np.log(2), np.log(3000), poses))),
    "one n of 4, others 1 000": lambda _, poses: np.where(np.arange(poses) == 5, 4.0, 1000.0),
}


def white(weights: str, counts: Callable[[Generator, int], Float], rng: Generator) -> tuple[float, float]:
    """Return residual noise over that expected from the readings, and its p-value, on white noise."""
    scene = scene_of(rng, 24)
    n = counts(rng, 24)
    f = scene.g * spread(rng, 24) + scene.noises(24) / np.sqrt(n)[:, None]
    scatter = scene.noise * np.sqrt(rng.chisquare(n[:, None] - 1, (24, 3)) / (n[:, None] - 1))
    readings = Readings.from_array(scene.model.output(f), count=n, scatter=scene.size * scatter)
    result = calibrate(readings, settings(scene.g, weights=weights))
    return ratio_of(result)


def ratio_of(result: Calibration) -> tuple[float, float]:
    """Return ratio and p-value of a result, under the names of this version; NaN where it has none."""
    names = (("residual_noise_ratio", "noise_ratio"), ("residual_noise_p", "noise_chance"))
    found = [next((getattr(result, name) for name in pair if hasattr(result, name)), None) for pair in names]
    ratio, p = (float("nan") if value is None else float(value) for value in found)
    return ratio, p


def _uniform(drawn: Outcomes) -> float:
    from scipy.stats import kstest

    return float(kstest([p for _, p in drawn], "uniform").pvalue)


def _median(drawn: Outcomes) -> float:
    return float(np.median([ratio for ratio, _ in drawn[:FOR_RATIO]]))


def _white_check(weights: str, counts: str) -> Check:
    return Check(
        f"{weights}, {counts}",
        partial(white, weights, COUNTS[counts]),
        lambda drawn: [f"{_median(drawn):.3f}", f"{_uniform(drawn):.2g}"],
        lambda drawn: RATIO[0] <= _median(drawn) <= RATIO[1] and _uniform(drawn) > UNIFORM,
    )


# Robust losses.

NAMED, EFFICIENCY, SIZE = 0.90, 0.90, 10.0
"""Least share of draws within 1 sigma with all spoiled poses named; least efficiency; least error, in noise."""


def spoiled(
    loss: str, count: int, spoil: Callable[[Scene, Float], Int | None], rng: Generator
) -> tuple[float, bool, str]:
    """Return by how many sigma spoiled poses move a parameter, whether all were named, and the verdict.

    `spoil` changes the outputs and returns which, or None where it cannot be seen.
    """
    while True:
        scene = scene_of(rng, count)
        output = scene.model.output(scene.g * spread(rng, count) + scene.noises(count))
        hit = spoil(scene, output)
        if hit is not None:
            break
    chosen = settings(scene.g, robust=loss)
    without = calibrate(Readings.from_array(np.delete(output, hit, axis=0)), chosen)
    result = calibrate(Readings.from_array(output), chosen)
    error, _, _ = deviations(result, without.model)
    _, _, sigma = deviations(without, without.model)
    moved = float(np.max(np.abs(error) / sigma)) if len(error) == len(sigma) else float("inf")
    return moved, _are_named(hit, output, result), result.verdict


def _are_named(hit: Int, output: Float, result: Calibration) -> bool:
    """Whether a result names some poses: as outliers, or as rows of zeros, which are left out before it."""
    if not output[hit].any():
        return any(notice.key == "zero-rows" for notice in result.warnings)
    return set(hit.tolist()) <= set(result.outliers)


def factor(value: float, number: int = 1) -> Callable[[Scene, Float], Int | None]:
    """Return what multiplies some outputs by a value."""

    def spoil(scene: Scene, output: Float) -> Int | None:
        hit = scene.rng.choice(len(output), number, replace=False)
        output[hit] *= value
        return hit if _errors(scene, output)[hit].min() >= SIZE else None

    return spoil


def by_sigma(number: int) -> Callable[[Scene, Float], Int | None]:
    """Return what makes some forces longer or shorter by 10 to 300 sigma."""

    def spoil(scene: Scene, output: Float) -> Int | None:
        hit = scene.rng.choice(len(output), number, replace=False)
        size = np.exp(scene.rng.uniform(np.log(SIZE), np.log(300), (number, 1)))
        change = scene.rng.choice([-1, 1], (number, 1)) * size * scene.noise / scene.g
        output[hit] += change * (output[hit] - scene.model.D)
        return hit if _errors(scene, output)[hit].min() >= SIZE - 3 else None

    return spoil


def _errors(scene: Scene, output: Float) -> Float:
    """Return the residuals under the truth, in noise."""
    f = np.linalg.norm(scene.model.specific_force(output), axis=1)
    return np.asarray(np.abs(f - scene.g) / scene.noise)


def _share_within(drawn: Outcomes) -> float:
    return float(np.mean([moved <= 1 and named for moved, named, _ in drawn]))


def _spoiled_check(name: str, loss: str, count: int, spoil: Callable[[Scene, Float], Int | None]) -> Check:
    return Check(
        f"{loss}, {name}",
        partial(spoiled, loss, count, spoil),
        lambda drawn: [
            f"{np.mean([moved <= 1 for moved, _, _ in drawn]):.0%}",
            f"{np.mean([named for _, named, _ in drawn]):.0%}",
            f"{np.mean([verdict in ('good', 'weak') for _, _, verdict in drawn]):.0%}",
        ],
        lambda drawn: _share_within(drawn) >= NAMED,
    )


def clean(loss: str, count: int, rng: Generator) -> tuple[float, float, str]:
    """Return the mean squares of the errors of a robust and a plain fit, in sigma of the plain one."""
    scene = scene_of(rng, count)
    output = scene.model.output(scene.g * spread(rng, count) + scene.noises(count))
    plain = calibrate(Readings.from_array(output), settings(scene.g))
    robust = calibrate(Readings.from_array(output), settings(scene.g, robust=loss))
    (with_loss, _, _), (without, _, sigma) = (deviations(one, scene.model) for one in (robust, plain))
    noise = sigma * (np.sqrt(3) * scene.noise / plain.s)  # honest sigma but for a constant
    return float(np.mean((with_loss / noise) ** 2)), float(np.mean((without / noise) ** 2)), robust.verdict


def _efficiency(drawn: Outcomes) -> float:
    return float(sum(plain for _, plain, _ in drawn) / sum(robust for robust, _, _ in drawn))


def _clean_check(loss: str, count: int) -> Check:
    return Check(
        f"{loss}, {count} clean poses: efficiency, named in any, good",
        partial(clean, loss, count),
        lambda drawn: [f"{_efficiency(drawn):.0%}", "-", f"{np.mean([v == 'good' for *_, v in drawn]):.0%}"],
        lambda drawn: _efficiency(drawn) >= EFFICIENCY,
    )


# Verification.

SIZE_OF_TEST, INCONCLUSIVE = (0.03, 0.07), 0.05
"""Share of unchanged sensors called changed; largest share of inconclusive answers."""

POWER_NOISE = 0.28
"""Noise of one row of the changed sensors, mg."""


@dataclass(frozen=True)
class Visit:
    """What is read at one of two visits of a sensor, and how it is calibrated; `verify` itself takes no settings.

    Attributes:
        count: attitudes; low, high: rows of each, drawn evenly in the logarithm; None for single readings.
        cold, warm: temperatures; None for no column. scheme: attitudes, drawn anew when None.
    """

    count: int = 24
    low: int | None = None
    high: int | None = None
    cold: float | None = None
    warm: float | None = None
    scheme: Callable[[], Float] | None = None

    def readings(self, scene: Scene, model: ErrorModel, slopes: Slopes) -> Readings:
        """Return readings of the sensor at this visit."""
        rng, count = scene.rng, self.count
        u = spread(rng, count) if self.scheme is None else self.scheme()
        n: Float = np.ones(count)
        if self.low is not None and self.high is not None:
            n = np.round(np.exp(rng.uniform(np.log(self.low), np.log(self.high), count)))
        f = scene.g * u + scene.noises(count) / np.sqrt(n)[:, None]
        output = model.output(f)
        degrees = None
        if self.cold is not None and self.warm is not None:
            degrees = rng.uniform(self.cold, self.warm, count)
            t = (degrees - 25.0)[:, None]
            output = np.asarray((output - model.D) * (1 + slopes.scale * t) + model.D + slopes.bias * t)
        if self.low is None:
            return Readings.from_array(output, temperature=degrees)
        scatter = scene.noise * np.sqrt(rng.chisquare(n[:, None] - 1, (count, 3)) / (n[:, None] - 1))
        return Readings.from_array(output, count=n, scatter=scene.size * scatter, temperature=degrees)


def answer(
    old: Visit,
    new: Visit,
    stated: dict[str, object],
    rng: Generator,
    change: Callable[[ErrorModel, Generator], ErrorModel] = lambda model, _: model,
    noise: float | None = None,
    aligned: bool = False,
) -> str:
    """Return what `verify` says of a sensor between two visits."""
    scene = scene_of(rng, old.count)
    if noise is not None:
        scene = Scene(rng, scene.model, scene.size, scene.g, noise * MILLI_G, old.count, 1)
    model = ErrorModel(np.diag(np.diagonal(scene.model.K)), scene.model.D) if aligned else scene.model
    slopes = Slopes(1e-4 * rng.normal(size=3), 0.2 * MILLI_G * scene.size * rng.normal(size=3))
    try:
        result = calibrate(old.readings(scene, model, slopes), settings(scene.g, **stated))
        return str(verify(result, new.readings(scene, change(model, rng), slopes)).verdict)
    except AccelcalError:
        return "refused"


def remounted(model: ErrorModel, rng: Generator) -> ErrorModel:
    """Return the sensor turned in its housing."""
    return ErrorModel(model.K @ rotation(rng), model.D)


def with_bias(model: ErrorModel, _: Generator) -> ErrorModel:
    """Return the sensor with one bias 0.6 mg higher."""
    return ErrorModel(model.K, model.D + np.array([0, 0, 0.6 * MILLI_G * model.K[2, 2]]))


def with_scale(model: ErrorModel, _: Generator) -> ErrorModel:
    """Return the sensor with one scale factor 1 000 ppm higher."""
    return ErrorModel(np.diag([1, 1, 1.001]) @ model.K, model.D)


def with_misalignment(model: ErrorModel, _: Generator) -> ErrorModel:
    """Return the sensor with an axis turned by 2 mrad towards another."""
    return ErrorModel(np.array([[1, 0, 0], [0.002, 1, 0], [0, 0, 1]]) @ model.K, model.D)


def _share(drawn: Outcomes, verdict: str) -> float:
    return float(np.mean([one == verdict for one in drawn]))


def _verify_check(name: str, passed: Callable[[Outcomes], bool], *visits: object, **more: object) -> Check:
    old, new, stated = (*visits, {})[:3]
    return Check(
        name,
        lambda rng: answer(old, new, stated, rng, **more),  # type: ignore[arg-type]
        lambda drawn: [f"{_share(drawn, word):.1%}" for word in ("changed", "inconclusive", "refused")],
        passed,
    )


def _of_size(drawn: Outcomes) -> bool:
    room = max(0.0, float(3 * np.sqrt(0.05 * 0.95) * (1 / np.sqrt(len(drawn)) - 1 / np.sqrt(1000))))
    sized = SIZE_OF_TEST[0] - room <= _share(drawn, "changed") <= SIZE_OF_TEST[1] + room
    silent = _share(drawn, "inconclusive") + _share(drawn, "refused")
    return bool(sized and silent <= INCONCLUSIVE + room)


def _of_power(least: float) -> Callable[[Outcomes], bool]:
    return lambda drawn: _share(drawn, "changed") >= least - 3 * 0.35 * len(drawn) ** -0.5


AUTO: dict[str, object] = {"weights": "auto"}
TURNS = Visit(scheme=poses.turns)

CHECKS: dict[str, tuple[Check, ...]] = {
    "weights": tuple(_white_check(weights, counts) for weights in ("n", "sd", "auto") for counts in COUNTS),
    "robust": (
        *(
            _spoiled_check(f"one of 24 times {value:g}", loss, 24, factor(value))
            for loss in ("huber", "soft-l1")
            for value in (0.0, 1.1, 1.3, 1.6, 2.0, 10.0, -1.0)
        ),
        *(_spoiled_check("3 of 200 doubled", loss, 200, factor(2.0, 3)) for loss in ("huber", "soft-l1")),
        *(
            _spoiled_check("6 of 24 off by 10 to 300 sigma", loss, 24, by_sigma(6))
            for loss in ("huber", "soft-l1")
        ),
        *(_clean_check(loss, count) for loss in ("huber", "soft-l1") for count in (24, 60)),
    ),
    "verify": (
        _verify_check("equal, 24 then 24", _of_size, Visit(), Visit()),
        _verify_check("equal, 24 then 12", _of_size, Visit(), Visit(12)),
        _verify_check("equal, 12 then 12", _of_size, Visit(12), Visit(12)),
        _verify_check(
            "auto, n 20 to 3 000, 24 then 24", _of_size, Visit(24, 20, 3000), Visit(24, 20, 3000), AUTO
        ),
        _verify_check(
            "auto, n 20 to 3 000, 40 then 12", _of_size, Visit(40, 20, 3000), Visit(12, 20, 3000), AUTO
        ),
        _verify_check(
            "slopes of 15 to 45, new at 45",
            _of_size,
            Visit(36, None, None, 15, 45),
            Visit(24, None, None, 45, 45),
        ),
        _verify_check(
            "slopes of 25 to 35, new at 50",
            _of_size,
            Visit(36, None, None, 25, 35),
            Visit(24, None, None, 50, 50),
        ),
        _verify_check("no misalignment", _of_size, Visit(), Visit(), {"misalignment": False}, aligned=True),
        *(
            _verify_check(f"gauge {gauge}", _of_size, Visit(), Visit(), {"gauge": gauge})
            for gauge in ("symmetric", "upper", "full")
        ),
        _verify_check("turned in its housing", _of_size, Visit(), Visit(), change=remounted),
        *(
            _verify_check(f"robust {loss}", _of_size, Visit(), Visit(), {"robust": loss})
            for loss in ("huber", "soft-l1")
        ),
        _verify_check(
            "bias moved by 0.6 mg", _of_power(0.86), TURNS, TURNS, change=with_bias, noise=POWER_NOISE
        ),
        _verify_check(
            "scale factor by 1 000 ppm", _of_power(0.99), TURNS, TURNS, change=with_scale, noise=POWER_NOISE
        ),
        _verify_check(
            "axis by 2 mrad", _of_power(0.94), TURNS, TURNS, change=with_misalignment, noise=POWER_NOISE
        ),
    ),
}

STUDIES: dict[str, Callable[..., bool]] = {
    "weights": table_of("weights", ("median ratio", "uniform, p"), 500),
    "robust": table_of("robust", ("within 1 sigma", "all named", "good or weak"), 100),
    "verify": table_of("verify", ("changed", "inconclusive", "refused"), 1000),
}
