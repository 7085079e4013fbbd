"""An old result against new readings: did this sensor change?

The nine gauge-free parameters of quality.PARAMETERS, as force at 1 g, from the new readings minus those of the
result. Where the new readings do not determine all nine, the directions that they determine are compared.

What new readings say of the nine parameters of an old result.

The tests of a verification: each parameter alone, all determined directions together, and what they come to.

What keeps a verification from telling: noise that hides a change, and readings that are doubtful themselves.

New readings that no ageing of a sensor explains: another unit than those of the result, or another sensor.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration import distributions as chances
from accelcal_cli.calibration.assess import is_large, large_residuals, not_fitting, ratio_in_words
from accelcal_cli.calibration.distributions import Noise, Pair
from accelcal_cli.calibration.fit import beyond_chance, length_error, leverages, room_of, studentise
from accelcal_cli.calibration.observability import (
    PARAMETERS,
    ROWS_COLUMNS,
    UNDETERMINED,
    Observability,
    design,
)
from accelcal_cli.calibration.problem import Box, Loetters, compress, pack
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.minimize import polish
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel

SCHEMA = "accelcal/verification/1"


@dataclass(frozen=True)
class Difference:
    """One of the nine parameters, new minus old, m/s^2 at 1 g; NaN where the new readings do not determine it.

    Attributes:
        name: of quality.PARAMETERS.
        value, sigma: difference and its one-sigma, old and new uncertainty together.
        chance: of a difference as large when nothing changed; adjusted: the same, for nine looks (Holm).
        changed: whether it did, at the level of the test.
    """

    name: str
    value: float
    sigma: float
    chance: float
    adjusted: float
    changed: bool


@dataclass(frozen=True)
class Verification:
    """The outcome of a comparison. Units: m/s^2 (units of g when g = 1).

    Attributes:
        verdict: unchanged, changed or inconclusive; `reasons` says why in sentences.
        cautions: what speaks against the new readings, in sentences.
        chance: that an unchanged sensor looks as different; level: below it the sensor has changed.
        chi_square: d^T C^-1 d of the determined directions; directions: how many, at most nine; chance_together:
            of so large a chi-square when nothing changed.
        differences: parameter by parameter.
        s_old, s_new: noise of one pose in the old and the new readings; noise_chance: of so different a noise.
        rms: of |f| - g of the new readings under the old result; tolerance: what it is held to, or None.
        poses: of the new readings; freedom: their degrees of freedom.
        g: local gravity; unit: of everything above.
        result, data: what was compared: source and sha256 of the old readings and of the new.
    """

    verdict: str
    reasons: tuple[str, ...]
    cautions: tuple[str, ...]
    chance: float
    level: float
    chi_square: float
    directions: int
    chance_together: float
    differences: tuple[Difference, ...]
    s_old: float
    s_new: float
    noise_chance: float
    rms: float
    tolerance: float | None
    poses: int
    freedom: int
    g: float
    unit: str
    result: dict[str, object]
    data: dict[str, object]
    version: str = __version__
    schema: str = SCHEMA

    @property
    def passed(self) -> bool:
        """Whether the sensor is unchanged and within the tolerance."""
        return self.verdict == "unchanged" and self.within

    @property
    def within(self) -> bool:
        """Whether the rms of |f| - g keeps to the tolerance, if there is one."""
        return self.tolerance is None or self.rms <= self.tolerance

    def record(self) -> dict[str, object]:
        """Return plain mappings, lists, numbers and text; NaN becomes None."""
        return to_mapping(self)


def verify(
    old: Calibration, readings: Readings, level: float = 0.05, tolerance: float | None = None
) -> Verification:
    """Compare a result with new readings of the sensor.

    Args:
        old: the result.
        readings: J static poses, in the unit of the readings that the result was made from.
        level: chance of calling an unchanged sensor changed.
        tolerance: largest rms of |f| - g, m/s^2, or None.

    Raises:
        DataError: the result states no uncertainty, so that there is nothing to compare with; or no reading is near g
            under it, as in another unit.
    """
    _check(old)
    readings, warmth = _at_reference(old, readings)
    check_unit(old, readings)
    found = shift(old, readings)
    tests = Tests.of(old, found)
    hidden = doubts(old, tests.pair, readings)
    verdict = _verdict(tests.chance, level, hidden, readings)
    differences = _differences(found, tests, level if verdict == "changed" else 0.0)
    rms = _rms(old, readings)
    return Verification(
        verdict=verdict,
        reasons=(
            *strange(rms, old),
            *_reasons(verdict, differences, found, tests.pair, level),
            *(hidden if verdict == "inconclusive" else ()),
            *warmth,
        ),
        cautions=cautions(old, found, tests.pair, readings, verdict),
        chance=tests.chance,
        level=level,
        chi_square=tests.chi_square,
        directions=found.basis.shape[1],
        chance_together=tests.together,
        differences=differences,
        s_old=old.s,
        s_new=float(np.sqrt(found.noise.variance)) if found.noise.freedom else float("nan"),
        noise_chance=tests.pair.noise_chance(),
        rms=rms,
        tolerance=tolerance,
        poses=readings.poses,
        freedom=found.noise.freedom,
        g=old.g,
        unit=old.unit,
        result=dict(old.data),
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
    )


def _verdict(chance: float, level: float, doubts: tuple[str, ...], readings: Readings) -> str:
    """Return the verdict; where there are doubts a change has to be certain, and of doubtful readings none is.

    A chance that is no number, for readings that no direction is seen of, says nothing.
    """
    if doubts or np.isnan(chance):
        certain = chance < min(level, SURELY) and not readings.cautions
        return "changed" if certain else "inconclusive"
    return "changed" if chance < level else "unchanged"


def _rms(old: Calibration, readings: Readings) -> float:
    """Return the rms of |f| - g of the readings under the old result, in its unit of force."""
    model = old.model.in_gauge("lower")
    squares = sum(float(np.sum(length_error(e, old.g) ** 2)) for _, e, _ in _errors(readings, model, old.g))
    return float(np.sqrt(squares / readings.poses))


def _check(old: Calibration) -> None:
    source = old.data.get("source", "result")
    if old.held.any():
        raise DataError(
            f"the result of {source} took its axes as perpendicular: there is no misalignment to compare; verify "
            "needs a result with misalignments"
        )
    if old.verdict == "undetermined" or not np.isfinite(old.covariance).all():
        raise DataError(
            f"the result of {source} has no uncertainty for all nine parameters (verdict {old.verdict}, "
            f"{old.poses} poses); verify needs one of verdict good or weak with ten poses or more"
        )
    if old.freedom < 1 or not old.s > 0:
        raise DataError(f"the result of {source} states no noise s; verify needs one with ten poses or more")


def _at_reference(old: Calibration, readings: Readings) -> tuple[Readings, tuple[str, ...]]:
    """Return the readings as they would be at the temperature of the result, and what could not be done."""
    if old.temperature is None:
        return readings, ()
    if readings.temperature is None or not np.isfinite(readings.temperature).all():
        held = old.temperature.reference
        return readings, (
            f"The new readings have no temperatures; they are taken to be at {held:.4g} degrees.",
        )
    brought = old.temperature.at_reference(readings.output(), readings.temperature, old.D_a)
    return readings.with_output(brought), ()


def _differences(found: Shift, tests: Tests, level: float) -> tuple[Difference, ...]:
    adjusted = np.full(9, np.nan)
    adjusted[found.known] = chances.holm(tests.single[found.known])
    sigma = np.where(found.known, np.sqrt(np.diagonal(tests.covariance)), np.nan)
    value, alone = np.where(found.known, [found.value, tests.single], np.nan)
    return tuple(
        Difference(
            name,
            float(value[p]),
            float(sigma[p]),
            float(alone[p]),
            float(adjusted[p]),
            bool(adjusted[p] < level),
        )
        for p, name in enumerate(PARAMETERS)
    )


def _reasons(
    verdict: str, differences: tuple[Difference, ...], found: Shift, pair: Pair, level: float
) -> tuple[str, ...]:
    lines = []
    named = [d.name for d in differences if d.changed]
    if named:
        lines.append(f"Changed: {', '.join(named)}.")
    elif verdict == "changed":
        lines.append("No single parameter stands out; together they differ by more than chance allows.")
    lost = [d.name for d in differences if np.isnan(d.value)]
    if lost:
        directions = found.basis.shape[1]
        lines.append(
            f"The new readings determine {directions} of 9 directions; nothing is said of: {', '.join(lost)}."
        )
    if found.noise.freedom < 1:
        lines.append("The new readings say nothing of their noise; it is taken to be that of the result.")
    elif pair.noise_chance() < level:
        times = ratio_in_words(float(np.sqrt(pair.b.variance / pair.a.variance)))
        likely = f"chance {pair.noise_chance():.2g}"
        lines.append(f"The new readings have {times} times the noise of the old ({likely}).")
    return tuple(lines)


FARTHEST = (0.3, 0.3, 1.0)
"""Half-widths of the box for the new parameters: scale factors (part), misalignments (rad), biases (parts of g)."""

TOUCH = 0.1
"""A parameter is known alone when the undetermined directions have at most this part of it: the axes of a poor sensor
are not quite those of the cube that it was turned on."""


@dataclass(frozen=True)
class Shift:
    """What the new readings say of the nine parameters, relative to the old ones.

    Attributes:
        value: difference, m/s^2, shape (9,).
        cofactor: of the new estimate, shape (9, 9).
        basis: directions that the readings determine, shape (9, r).
        known: which parameters they determine one by one, shape (9,).
        noise: variance and degrees of freedom of the new readings.
        model: the sensor that their residuals are seen with, gauge `lower`; step: what the residuals are still to be
            moved by, to first order, m/s^2, shape (9,): none where the model is fitted to them.
    """

    value: Float
    cofactor: Float
    basis: Float
    known: Bool
    noise: Noise
    model: ErrorModel
    step: Float


def shift(old: Calibration, readings: Readings) -> Shift:
    """Return what new readings say of the nine parameters: a fit where they determine all, else one linear step."""
    problem = _problem(old, readings)
    start = np.zeros((1, 9))
    J, e = problem.design(start)[0], problem.residuals(start[:, None])[0, 0] / (2.0 * old.g)
    values, vectors = np.linalg.eigh(J.T @ J)
    # A direction with less information has an error above UNDETERMINED times the noise of a pose.
    seen = values > 1.0 / UNDETERMINED**2
    if not seen.all() or readings.poses < 9:
        basis, values = vectors[:, seen], values[seen]
        inverse = (basis / values) @ basis.T
        value = -inverse @ (J.T @ e)
        rest = float(e @ e - (basis.T @ J.T @ e) ** 2 @ (1.0 / values))
        freedom = readings.poses - int(seen.sum())
        known = np.einsum("pq,pq->p", basis, basis) > 1.0 - TOUCH**2
        noise = Noise(max(rest, 0.0) / max(freedom, 1), freedom)
        return Shift(value, inverse, basis, known, noise, old.model.in_gauge("lower"), value)
    x = polish(problem, start).x
    variance = float(problem.cost(x[:, None])[0, 0]) / (4.0 * old.g**2) / max(readings.poses - 9, 1)
    cofactor = Observability.of(problem.information(x)[0], readings.poses).cofactor
    value = _between(problem, start, x)
    noise = Noise(variance, readings.poses - 9)
    (K,), (D,) = problem.parameters(x)
    return Shift(value, cofactor, np.eye(9), np.ones(9, bool), noise, ErrorModel(K, D), np.zeros(9))


def _problem(old: Calibration, readings: Readings) -> Loetters:
    """Return the least-squares problem of the new readings in a wide box about the old parameters."""
    model = old.model.in_gauge("lower")
    scale = np.diagonal(model.K)
    half = np.concatenate(
        [FARTHEST[0] * scale, np.full(3, FARTHEST[1] * scale.mean()), FARTHEST[2] * old.g * scale]
    )
    blocks = ((block[None], None) for _, block in readings.blocks())
    size = np.array([old.g * float(scale.mean())])
    triangle = compress(blocks, model.D[None], size, np.array([readings.poses]))
    return Loetters(triangle, old.g, Box(pack(model.K, model.D, 9)[None], half[None]))


def _between(problem: Loetters, old: Float, new: Float) -> Float:
    """Return the nine parameters at `new` relative to `old`, both shape (1, 9), m/s^2: K_A = (I + E) K_A0."""
    (K_0,), (D_0,) = problem.parameters(old)
    (K,), (D,) = problem.parameters(new)
    E = np.linalg.solve(K, K_0) - np.eye(3)
    rows, columns = zip(*ROWS_COLUMNS[:6], strict=True)
    return np.concatenate([problem.g * E[rows, columns], (D - D_0) / np.diagonal(K_0)])


ROUNDING = 1e-9
"""Noise below this part of g is rounding: nothing is judged by less."""


@dataclass(frozen=True)
class Tests:
    """Ten questions to the difference of two estimates, and the answer to all of them.

    Attributes:
        pair: noise of both.
        covariance: of the difference, (m/s^2)^2, shape (9, 9).
        chi_square: of the determined directions; together: its chance when nothing changed.
        single: chance of each parameter alone, shape (9,).
        chance: of all of them together.
    """

    pair: Pair
    covariance: Float
    chi_square: float
    together: float
    single: Float
    chance: float

    @classmethod
    def of(cls, old: Calibration, found: Shift) -> Self:
        """Test what the new readings say against the old result; NaN is the chance where they determine nothing."""
        floor = (ROUNDING * old.g) ** 2
        a, b = old.s**2, found.noise.variance
        pair = Pair.of(Noise(max(a, floor), old.freedom), Noise(max(b, floor), found.noise.freedom))
        A, B, basis = old.covariance / old.s**2, found.cofactor, found.basis
        covariance = pair.a.variance * A + pair.b.variance * B
        d = basis.T @ found.value
        chi_square = float(d @ np.linalg.solve(basis.T @ covariance @ basis, d))
        together = pair.chance(d, basis.T @ A @ basis, basis.T @ B @ basis) if len(d) else float("nan")
        single = np.array([pair.chance(found.value[[p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)])
        chance = chances.combined(np.append(single[found.known], together))
        return cls(pair, covariance, chi_square, together, single, chance)


NOISIER, SURELY = 3.0, 1e-4
"""New readings of so many times the noise of the old, and by chance this rarely, hide what the result would show. The
chance is so small that sensors read with equal noise keep their verdict. Where noise hides changes, only one that is
as certain is called a change: the level does not hold between noises that differ much."""

FEW, USUAL = 0.25, 2.0
"""Poses off the result are wrong themselves when they are at most this part of all, and half of all are within so many
sigma of it; else it is rather the sensor, or the noise of all."""


def doubts(old: Calibration, pair: Pair, readings: Readings) -> tuple[str, ...]:
    """Return why new readings that show no change do not show that there is none, in sentences."""
    lines = []
    if readings.cautions:
        lines.append(
            "The new readings are doubtful themselves, as the cautions say: what they differ by says little of the "
            "sensor."
        )
    if is_large(old.s, old.g, old.freedom):
        lines.append(
            f"One pose of the result itself errs by {old.s / old.g:.2%} of g, which hides any ordinary change: "
            "calibrate anew first."
        )
    variance, freedom = pair.b.variance, pair.b.freedom
    noisier = variance > NOISIER**2 * pair.a.variance and pair.noise_chance() < SURELY
    if freedom > 0 and (noisier or is_large(float(np.sqrt(variance)), old.g, freedom)):
        lines.append(
            "A change that the result would show is hidden in the noise of the new readings: measure again with the "
            "care of the calibration, each pose at rest and averaged."
        )
    return tuple(lines)


def cautions(old: Calibration, found: Shift, pair: Pair, readings: Readings, verdict: str) -> tuple[str, ...]:
    """Return what speaks against the new readings, in sentences, as `calibrate` would say it of them.

    Few poses hide the one among them that is wrong: where the verdict is inconclusive the result helps to find it.
    """
    s = float(np.sqrt(pair.b.variance)) if pair.b.freedom > 0 else float("nan")
    off = _outlying(found, pair, readings, old.g)
    if verdict == "inconclusive":
        off = sorted({*off, *_few_off(old, readings)})
    return (
        *readings.cautions,
        *large_residuals(s, old.g, pair.b.freedom),
        *not_fitting([readings.where(j) for j in off], pair.b.freedom),
    )


def _outlying(found: Shift, pair: Pair, readings: Readings, g: float) -> list[int]:
    """Return the numbers of the poses that do not fit what the others say, by Student's t as in a calibration."""
    freedom = pair.b.freedom
    if freedom < 2:
        return []
    numbers: list[int] = []
    for first, e, f in _errors(readings, found.model, g):
        room = room_of(leverages(_rows(f), np.ones(len(e)), found.cofactor))
        left = e + design(f / g) @ found.step
        numbers += _beyond(
            first, studentise(left, room, freedom * pair.b.variance, freedom), readings, freedom
        )
    return numbers


def _few_off(old: Calibration, readings: Readings) -> list[int]:
    """Return the numbers of the poses beyond chance off the result, if the others, most of them, are not."""
    cofactor = old.covariance / old.s**2
    parts = []
    for _, e, f in _errors(readings, old.model.in_gauge("lower"), old.g):
        rows = _rows(f)
        parts.append(e / (old.s * np.sqrt(1.0 + np.sum((rows @ cofactor) * rows, axis=1))))
    t = np.concatenate(parts)
    if np.median(np.abs(t)) > USUAL:
        return []
    numbers = _beyond(0, t, readings, old.freedom + 1)
    return numbers if len(numbers) <= FEW * readings.poses else []


def _errors(readings: Readings, model: ErrorModel, g: float) -> Iterator[tuple[int, Float, Float]]:
    """Yield (first pose, e, f) of one sensor block by block, shapes (B,) and (B, 3); see `Sample.errors`."""
    for first, e, f in Sample.of([readings]).errors(model.K[None], model.D[None], g):
        yield first, e[0], f[0]


def _rows(f: Float) -> Float:
    """Return the design of poses by the directions of their force, shape (B, 9)."""
    return design(f / np.linalg.norm(f, axis=1, keepdims=True))


def _beyond(first: int, t: Float, readings: Readings, freedom: int) -> list[int]:
    """Return the numbers of the poses of a block whose studentised residual, shape (B,), is beyond chance."""
    beyond = beyond_chance(np.abs(t), np.array(readings.poses), np.array(freedom))
    found: list[int] = (first + np.flatnonzero(beyond)).tolist()
    return found


STRANGE = 0.5
"""Readings off by this part of g are rather in another unit than of a sensor that changed."""

LIKELY = {
    1.0 / STANDARD_GRAVITY: "in g where those of the result are in m/s^2",
    STANDARD_GRAVITY: "in m/s^2 where those of the result are in g",
    1e-3: "in a unit a thousand times as large (g for mg)",
    1e3: "in a unit a thousand times as small (mg for g)",
}
"""What readings of so many times the size are, as a rule."""

NEAR = 0.05
"""How near to one of them the size has to be, in part."""


def check_unit(old: Calibration, readings: Readings) -> None:
    """Refuse readings not one of which is near g under the result; a sensor that changed has some that are.

    Raises:
        DataError: each of them misses g by half of it or more; the message says what unit that looks like.
    """
    model = old.model.in_gauge("lower")
    sizes = np.concatenate([np.linalg.norm(f, axis=1) / old.g for _, _, f in _errors(readings, model, old.g)])
    if (np.abs(sizes - 1.0) < STRANGE).any():
        return
    size = float(np.median(sizes))
    likely = next((text for factor, text in LIKELY.items() if abs(size / factor - 1.0) < NEAR), None)
    words = (
        f"they seem to be {likely}"
        if likely
        else "are they in another unit than its readings, or of another sensor?"
    )
    raise DataError(
        f"{readings.source}: under the result no pose is near g = {old.g:.6g} {old.unit}, most have "
        f"{size * old.g:.3g}; {words}"
    )


def strange(rms: float, old: Calibration) -> tuple[str, ...]:
    """Return a warning of readings some of which are far off, by the rms of |f| - g in the unit of the result."""
    if rms < STRANGE * old.g:
        return ()
    return (
        f"Under the result they miss g by {rms:.3g} {old.unit}: another unit than its readings, or another sensor?",
    )
