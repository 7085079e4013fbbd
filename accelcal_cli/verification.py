"""Verification: an old result against new readings of the sensor. Has the sensor changed?

The nine gauge-free parameters of `observability.PARAMETERS`, as force at 1 g, from the new readings minus those of
the result. Where the new readings do not determine all nine, the directions that they determine are compared.

In this order: what the result must state and in which unit the readings are; what the readings say of the nine
parameters (`Shift`); each parameter alone, all determined directions together, and the chance of all of that
(`Tests`); and what speaks against the readings: noise that hides a change, and poses that do not fit the others.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Self

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration import distributions
from accelcal_cli.calibration.assess import is_large, large_residuals, not_fitting, ratio_in_words
from accelcal_cli.calibration.distributions import Noise, Pair
from accelcal_cli.calibration.observability import (
    PARAMETERS,
    ROWS_COLUMNS,
    UNDETERMINED,
    Observability,
    design,
)
from accelcal_cli.calibration.problem import Box, Loetters, pack
from accelcal_cli.calibration.residuals import beyond_chance, length_error, leverages, room_of, studentise
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.triangle import compress
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.notices import Notice, are_serious
from accelcal_cli.optimization.minimize import polish
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel

SCHEMA = "accelcal/verification/2"

FARTHEST = (0.3, 0.3, 1.0)
"""Half-widths of the box for the new parameters: scale factors (part), misalignments (rad), biases (parts of g)."""

TOUCH = 0.1
"""A parameter is known alone when the undetermined directions have at most this part of it: the axes of a poor sensor
are not quite those of the cube that it was turned on."""

ROUNDING = 1e-9
"""Noise below this part of g is rounding, and no difference is measured against less."""

NOISIER, SURELY = 3.0, 1e-4
"""New readings of so many times the noise of the old, and by chance this rarely, hide what the result would show. The
chance is so small that sensors read with equal noise keep their verdict. Where noise hides changes, only one that is
as certain is called a change: the level does not hold between noises that differ much."""

FEW, USUAL = 0.25, 2.0
"""Poses off the result are wrong themselves when they are at most this part of all, and half of all are within so many
sigma of it; else it is rather the sensor, or the noise of all."""

MISMATCH = 0.5
"""Readings off by this part of g are more likely in another unit than from a sensor that changed."""

UNITS = {
    1.0 / STANDARD_GRAVITY: "in g where those of the result are in m/s^2",
    STANDARD_GRAVITY: "in m/s^2 where those of the result are in g",
    1e-3: "in a unit a thousand times as large (g for mg)",
    1e3: "in a unit a thousand times as small (mg for g)",
}
"""What readings of so many times the size usually are."""

NEAR = 0.05
"""How near to one of them the size has to be, in part."""


@dataclass(frozen=True)
class Difference:
    """One of the nine parameters, new minus old, m/s^2 at 1 g; NaN where the new readings do not determine it.

    Attributes:
        name: of observability.PARAMETERS.
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
        warnings: what speaks against the new readings.
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
    warnings: tuple[Notice, ...]
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
    readings, notes = _at_reference(old, readings)
    check_unit(old, readings)
    shift = fit_shift(old, readings)
    tests = Tests.of(old, shift)
    limitations = limitations_of(old, tests.pair, readings)
    verdict = _verdict(tests.chance, level, limitations, readings)
    differences = _differences(shift, tests, level if verdict == "changed" else 0.0)
    rms = _rms(old, readings)
    mismatch = (
        f"Under the result the new readings miss g by {rms:.3g} {old.unit}: are they in another unit than its "
        "readings, or from another sensor?"
    )
    return Verification(
        verdict=verdict,
        reasons=(
            *((mismatch,) if not rms < MISMATCH * old.g else ()),
            *_reasons(verdict, differences, shift, tests.pair, level),
            *(limitations if verdict == "inconclusive" else ()),
            *notes,
        ),
        warnings=_warnings(old, shift, tests.pair, readings, verdict),
        chance=tests.chance,
        level=level,
        chi_square=tests.chi_square,
        directions=shift.basis.shape[1],
        chance_together=tests.together,
        differences=differences,
        s_old=old.s,
        s_new=float(np.sqrt(shift.noise.variance)) if shift.noise.freedom else float("nan"),
        noise_chance=tests.pair.noise_chance(),
        rms=rms,
        tolerance=tolerance,
        poses=readings.poses,
        freedom=shift.noise.freedom,
        g=old.g,
        unit=old.unit,
        result=dict(old.data),
        data={"source": readings.source, "sha256": readings.sha256, "columns": list(readings.columns)},
    )


def _check(old: Calibration) -> None:
    result = f"the result of {old.data.get('source', 'result')}"
    if old.held.any():
        raise DataError(
            f"{result} assumes perpendicular axes, so there is no misalignment to compare; verify needs a result "
            "with misalignments"
        )
    if old.verdict == "undetermined" or not np.isfinite(old.covariance).all():
        raise DataError(
            f"{result} has no uncertainty for all nine parameters (verdict {old.verdict}, {old.poses} poses); verify "
            "needs one with verdict good or weak from ten poses or more"
        )
    if old.freedom < 1 or not old.s > 0:
        raise DataError(f"{result} states no noise s; verify needs one from ten poses or more")


def _at_reference(old: Calibration, readings: Readings) -> tuple[Readings, tuple[str, ...]]:
    """Return the readings as they would be at the temperature of the result, and a note where that is not known."""
    if old.temperature is None:
        return readings, ()
    if readings.temperature is None or not np.isfinite(readings.temperature).all():
        reference = old.temperature.reference
        return readings, (
            f"The new readings have no temperatures; they are assumed to be at {reference:.4g} degrees.",
        )
    return readings.with_output(
        old.temperature.at_reference(readings.output(), readings.temperature, old.D_a)
    ), ()


def check_unit(old: Calibration, readings: Readings) -> None:
    """Refuse readings not one of which is near g under the result; a sensor that changed has some that are.

    Raises:
        DataError: each of them misses g by half of it or more; the message says what unit that looks like.
    """
    errors = _errors(readings, old.model.in_gauge("lower"), old.g)
    sizes = np.concatenate([np.linalg.norm(f, axis=1) / old.g for _, f in errors])
    if (np.abs(sizes - 1.0) < MISMATCH).any():
        return
    size = float(np.median(sizes))
    likely = (f"they seem to be {text}" for factor, text in UNITS.items() if abs(size / factor - 1.0) < NEAR)
    words = next(likely, "are they in another unit than its readings, or from another sensor?")
    raise DataError(
        f"{readings.source}: under the result no pose is near g = {old.g:.6g} {old.unit}, most have "
        f"{size * old.g:.3g}; {words}"
    )


def _errors(readings: Readings, model: ErrorModel, g: float) -> Iterator[tuple[Float, Float]]:
    """Yield e and f of one sensor block by block, shapes (B,) and (B, 3); see `Sample.errors`."""
    for _, e, f in Sample.of([readings]).errors(model.K[None], model.D[None], g):
        yield e[0], f[0]


def _rms(old: Calibration, readings: Readings) -> float:
    """Return the rms of |f| - g of the readings under the old result, in its unit of force."""
    errors = _errors(readings, old.model.in_gauge("lower"), old.g)
    squares = sum(float(np.sum(length_error(e, old.g) ** 2)) for e, _ in errors)
    return float(np.sqrt(squares / readings.poses))


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


def fit_shift(old: Calibration, readings: Readings) -> Shift:
    """Return what new readings say of the nine parameters: a fit where they determine all, else one linear step."""
    problem = _problem(old, readings)
    start = np.zeros((1, 9))
    J, e = problem.design(start)[0], problem.residuals(start[:, None])[0, 0] / (2.0 * old.g)
    values, vectors = np.linalg.eigh(J.T @ J)
    # A direction with less information has an error above UNDETERMINED times the noise of a pose.
    determined = values > 1.0 / UNDETERMINED**2
    if determined.all() and readings.poses >= 9:
        return _fitted(problem, start, readings.poses)
    basis, values = vectors[:, determined], values[determined]
    inverse = (basis / values) @ basis.T
    value = -inverse @ (J.T @ e)
    rest = float(e @ e - (basis.T @ J.T @ e) ** 2 @ (1.0 / values))
    freedom = readings.poses - int(determined.sum())
    known = np.einsum("pq,pq->p", basis, basis) > 1.0 - TOUCH**2
    noise = Noise(max(rest, 0.0) / max(freedom, 1), freedom)
    return Shift(value, inverse, basis, known, noise, old.model.in_gauge("lower"), value)


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


def _fitted(problem: Loetters, start: Float, poses: int) -> Shift:
    """Return the shift of a fit of all nine parameters from those of the result: K_A = (I + E) K_A0."""
    x = polish(problem, start).x
    (K_0,), (D_0,) = problem.parameters(start)
    (K,), (D,) = problem.parameters(x)
    E = np.linalg.solve(K, K_0) - np.eye(3)
    rows, columns = zip(*ROWS_COLUMNS[:6], strict=True)
    value = np.concatenate([problem.g * E[rows, columns], (D - D_0) / np.diagonal(K_0)])
    cofactor = Observability.of(problem.information(x)[0], poses).cofactor
    variance = float(problem.cost(x[:, None])[0, 0]) / (4.0 * problem.g**2) / max(poses - 9, 1)
    noise = Noise(variance, poses - 9)
    return Shift(value, cofactor, np.eye(9), np.ones(9, bool), noise, ErrorModel(K, D), np.zeros(9))


@dataclass(frozen=True)
class Tests:
    """Ten tests of the difference of two estimates, and the chance of all of them together.

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
    def of(cls, old: Calibration, shift: Shift) -> Self:
        """Test what the new readings say against the old result; NaN is the chance where they determine nothing."""
        floor = (ROUNDING * old.g) ** 2
        a, b = (max(variance, floor) for variance in (old.s**2, shift.noise.variance))
        pair = Pair.of(Noise(a, old.freedom), Noise(b, shift.noise.freedom))
        A, B, basis = old.covariance / old.s**2, shift.cofactor, shift.basis
        covariance = pair.a.variance * A + pair.b.variance * B
        d = basis.T @ shift.value
        chi_square = float(d @ np.linalg.solve(basis.T @ covariance @ basis, d))
        together = pair.chance(d, basis.T @ A @ basis, basis.T @ B @ basis) if len(d) else float("nan")
        single = np.array([pair.chance(shift.value[[p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)])
        chance = distributions.combined(np.append(single[shift.known], together))
        return cls(pair, covariance, chi_square, together, single, chance)


def _differences(shift: Shift, tests: Tests, level: float) -> tuple[Difference, ...]:
    adjusted = np.full(9, np.nan)
    adjusted[shift.known] = distributions.holm(tests.single[shift.known])
    rows = [shift.value, np.sqrt(np.diagonal(tests.covariance)), tests.single, adjusted]
    columns = np.where(shift.known, rows, np.nan).T.tolist()
    return tuple(
        Difference(name, value, sigma, chance, least, changed=least < level)
        for name, (value, sigma, chance, least) in zip(PARAMETERS, columns, strict=True)
    )


def _verdict(chance: float, level: float, limitations: tuple[str, ...], readings: Readings) -> str:
    """Return the verdict; with limitations a change has to be certain, and from doubtful readings none is.

    A chance that is no number, for readings that determine no direction, says nothing.
    """
    if limitations or np.isnan(chance):
        certain = chance < min(level, SURELY) and not are_serious(readings.warnings)
        return "changed" if certain else "inconclusive"
    return "changed" if chance < level else "unchanged"


def _reasons(
    verdict: str, differences: tuple[Difference, ...], shift: Shift, pair: Pair, level: float
) -> tuple[str, ...]:
    lines = []
    if changed := [d.name for d in differences if d.changed]:
        lines.append(f"Changed: {', '.join(changed)}.")
    elif verdict == "changed":
        lines.append("No single parameter stands out, but together they differ by more than chance allows.")
    if unknown := [d.name for d in differences if np.isnan(d.value)]:
        directions = shift.basis.shape[1]
        lines.append(
            f"The new readings determine {directions} of 9 directions; they say nothing about: {', '.join(unknown)}."
        )
    if shift.noise.freedom < 1:
        lines.append(
            "The new readings leave no degrees of freedom, so their noise is assumed to be that of the result."
        )
    elif pair.noise_chance() < level:
        times = ratio_in_words(float(np.sqrt(pair.b.variance / pair.a.variance)))
        p = f"p-value {pair.noise_chance():.2g}"
        lines.append(f"The new readings have {times} times the noise of the old ones ({p}).")
    return tuple(lines)


def limitations_of(old: Calibration, pair: Pair, readings: Readings) -> tuple[str, ...]:
    """Return why new readings that show no change do not show that there is none, in sentences."""
    variance = pair.b.variance
    noisier = variance > NOISIER**2 * pair.a.variance and pair.noise_chance() < SURELY
    lines = {
        "The new readings themselves are doubtful, as the warnings say, so the differences say little about the "
        "sensor.": are_serious(readings.warnings),
        f"A typical pose of the result itself is off by {old.s / old.g:.2%} of g, which hides any ordinary change. "
        "Calibrate again first.": is_large(old.s, old.g, old.freedom),
        "The noise of the new readings hides changes that the result would show. Measure again as carefully as for "
        "the calibration, each pose at rest and averaged.": noisier
        or is_large(float(np.sqrt(variance)), old.g, pair.b.freedom),
    }
    return tuple(line for line, holds in lines.items() if holds)


def _warnings(
    old: Calibration, shift: Shift, pair: Pair, readings: Readings, verdict: str
) -> tuple[Notice, ...]:
    """Return what speaks against the new readings, as `calibrate` would say it of them.

    Few poses hide the one among them that is wrong: where the verdict is inconclusive the result helps to find it.
    """
    freedom, s = pair.b.freedom, float(np.sqrt(pair.b.variance))
    outlier = _outliers(shift, pair, readings, old.g)
    if verdict == "inconclusive":
        outlier |= _outliers_of_result(old, readings)
    names = [readings.where(j) for j in np.flatnonzero(outlier).tolist()]
    return (*readings.warnings, *large_residuals(s, old.g, freedom), *not_fitting(names, freedom))


def _outliers(shift: Shift, pair: Pair, readings: Readings, g: float) -> Bool:
    """Return which poses do not fit what the others say, by Student's t as in a calibration, shape (J,)."""
    freedom, parts = pair.b.freedom, []
    for e, f in _errors(readings, shift.model, g):
        room = room_of(leverages(_rows(f), np.ones(len(e)), shift.cofactor))
        parts.append(studentise(e + design(f / g) @ shift.step, room, freedom * pair.b.variance, freedom))
    return beyond_chance(np.abs(np.concatenate(parts)), np.array(readings.poses), np.array(freedom))


def _outliers_of_result(old: Calibration, readings: Readings) -> Bool:
    """Return which poses are off the result beyond chance, shape (J,); none unless the others, most of them, fit it."""
    cofactor, parts = old.covariance / old.s**2, []
    for e, f in _errors(readings, old.model.in_gauge("lower"), old.g):
        rows = _rows(f)
        parts.append(np.abs(e / (old.s * np.sqrt(1.0 + np.sum((rows @ cofactor) * rows, axis=1)))))
    t = np.concatenate(parts)
    outlier = beyond_chance(t, np.array(readings.poses), np.array(old.freedom + 1))
    many = np.median(t) > USUAL or outlier.sum() > FEW * readings.poses
    return np.zeros_like(outlier) if many else outlier


def _rows(f: Float) -> Float:
    """Return the design of poses by the directions of their force, shape (B, 9)."""
    return design(f / np.linalg.norm(f, axis=1, keepdims=True))
