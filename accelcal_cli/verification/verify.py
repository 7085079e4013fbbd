"""Verification: an old result against new readings of the sensor. Has the sensor changed?

The nine gauge-free parameters of `observability.PARAMETERS`, as force at 1 g, from the new readings minus those of
the result. Where the new readings do not determine all nine, the directions that they determine are compared.

In this order: what the result must state and in which unit the readings are; what the readings say of the nine
parameters (`shift.Shift`); each parameter alone, all determined directions together, and the chance of all of that
(`Tests`); and what speaks against the readings: noise that hides a change, and poses that do not fit the others.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration import distributions
from accelcal_cli.calibration.assess import is_large, large_residuals, not_fitting, ratio_in_words
from accelcal_cli.calibration.distributions import Noise, Pair
from accelcal_cli.calibration.observability import PARAMETERS, design, unit
from accelcal_cli.calibration.residuals import beyond_chance, leverages, room_of, studentise
from accelcal_cli.calibration.result import Calibration, load_result
from accelcal_cli.calibration.sample import Sample, length_error
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Data, Readings, read_readings
from accelcal_cli.notices import Notice, are_serious
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel
from accelcal_cli.verification.shift import Shift, at_reference, old_covariance, shift_of, stated_as

SCHEMA = "accelcal/verification/2"

ROUNDING = 1e-9
"""Noise below this part of g is rounding, and no difference is measured against less."""

NOISIER, SURELY = 3.0, 1e-4
"""New readings of so many times the noise of the old, and by chance this rarely, hide what the result would show. The
chance is so small that sensors read with equal noise keep their verdict. Where noise hides changes, only one that is
as certain is called a change: the level does not hold between noises that differ much."""

FEW, USUAL = 0.25, 2.0
"""Poses off the result are wrong themselves when they are at most this part of all, and half of all are within so many
sigma of it; else it is rather the sensor, or the noise of all."""

OF_READINGS = ("noise-bias", "tremor", "correlated", "several-sensors")
"""Keys of what the fit says of the readings: that of a sensor, or of the result's gravity, is not their fault."""

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
        warnings: what speaks against the new readings, and that the result is suspect where it is.
        chance: that an unchanged sensor looks as different; level: below it the sensor has changed.
        chi_square: d^T C^-1 d of the determined directions; directions: how many, at most nine; chance_together:
            of so large a chi-square when nothing changed.
        differences: parameter by parameter.
        s_old, s_new: noise of one pose of weight 1 in the old and the new readings; noise_chance: of noise as far from
            what the result leads to expect of the new.
        rms: of |f| - g of the new readings under the old result; tolerance: what it is held to, or None.
        poses: of the new readings; freedom: degrees of freedom of their estimate, whole or not.
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
    freedom: float
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
    old: Calibration | str | Path,
    readings: Data,
    level: float = 0.05,
    tolerance: float | None = None,
    *,
    columns: Sequence[str] | None = None,
) -> Verification:
    """Compare a result with new readings of the sensor.

    Args:
        old: the result, or its file.
        readings: J static poses, in the unit of the readings that the result was made from; see `read_readings`.
        level: chance of calling an unchanged sensor changed.
        tolerance: largest rms of |f| - g, m/s^2, or None.
        columns: see `read_readings`.

    Raises:
        DataError: the result states no uncertainty, so that there is nothing to compare with; or no reading is near g
            under it, as in another unit.

    Examples:
        >>> from accelcal_cli import calibrate, simulate, verify
        >>> old = calibrate(simulate("mems", positions=24, seed=1).output)
        >>> verify(old, simulate("mems", positions=24, seed=2).output).verdict
        'unchanged'
    """
    old = old if isinstance(old, Calibration) else load_result(old)
    return _verified(old, read_readings(readings, columns), level, tolerance)


def _verified(old: Calibration, readings: Readings, level: float, tolerance: float | None) -> Verification:
    _check(old)
    reference = at_reference(old, readings)
    readings = reference.readings
    check_unit(old, readings)
    stated, differing = stated_as(old, readings)
    shift = shift_of(old, stated, reference.felt)
    tests = Tests.of(old, shift)
    doubts = _doubts(shift, readings)
    limitations = limitations_of(old, tests.pair, doubts)
    verdict = _verdict(tests.chance, level, limitations, doubts)
    differences = _differences(shift, tests, level if verdict == "changed" else 0.0)
    rms = _rms(old, readings)
    return Verification(
        verdict=verdict,
        reasons=(
            *_mismatch(old, rms),
            *_reasons(old, verdict, differences, shift, tests.pair, level),
            *(limitations if verdict == "inconclusive" else ()),
            *reference.notes,
            *differing,
        ),
        warnings=(*doubts, *_warnings(old, shift, verdict), *_suspect(old)),
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
    if old.verdict == "undetermined" or not np.isfinite(old.covariance).all():
        raise DataError(
            f"{result} has no uncertainty for all {'six' if old.held.any() else 'nine'} parameters (verdict "
            f"{old.verdict}, {old.poses} poses); verify needs one with verdict good or weak from ten poses or more"
        )
    if old.freedom < 1 or old.coverage_factor is None or not old.s > 0:
        raise DataError(f"{result} states no noise s; verify needs one from ten poses or more")


def _mismatch(old: Calibration, rms: float) -> tuple[str, ...]:
    """Return a question where readings miss g under the result by as much as those in another unit do."""
    if rms < MISMATCH * old.g:
        return ()
    return (
        f"Under the result the new readings miss g by {rms:.3g} {old.unit}: are they in another unit than its "
        "readings, or from another sensor?",
    )


def _suspect(old: Calibration) -> tuple[Notice, ...]:
    """Return a note of a result that is suspect itself."""
    keys = dict.fromkeys(notice.key for notice in old.warnings if notice.severity == "warning")
    if old.verdict != "suspect":
        return ()
    why = f" ({', '.join(keys)})" if keys else ""
    text = f"The result is suspect itself{why}: a difference may be its fault rather than a change of the sensor."
    return (Notice("suspect-result", "note", text, "Calibrate again as its warnings say."),)


def check_unit(old: Calibration, readings: Readings) -> None:
    """Refuse readings not one of which is near g under the result; a sensor that changed has some that are.

    Raises:
        DataError: each of them misses g by half of it or more; the message says what unit that looks like.
    """
    errors = _errors(Sample.of([readings]), old.model.in_gauge("lower"), old.g)
    sizes = np.concatenate([np.linalg.norm(f, axis=1) / old.g for _, _, f in errors])
    if (np.abs(sizes - 1.0) < MISMATCH).any():
        return
    size = float(np.median(sizes))
    likely = (f"they seem to be {text}" for factor, text in UNITS.items() if abs(size / factor - 1.0) < NEAR)
    words = next(likely, "are they in another unit than its readings, or from another sensor?")
    raise DataError(
        f"{readings.source}: under the result no pose is near g = {old.g:.6g} {old.unit}, most have "
        f"{size * old.g:.3g}; {words}"
    )


def _errors(sample: Sample, model: ErrorModel, g: float) -> Iterator[tuple[int, Float, Float]]:
    """Yield the first pose, e and f of one sensor block by block, shapes (B,) and (B, 3); see `Sample.errors`."""
    for first, e, f in sample.errors(model.K[None], model.D[None], g):
        yield first, e[0], f[0]


def _rms(old: Calibration, readings: Readings) -> float:
    """Return the rms of |f| - g of the readings under the old result, in its unit of force."""
    errors = _errors(Sample.of([readings]), old.model.in_gauge("lower"), old.g)
    squares = sum(float(np.sum(length_error(e, old.g) ** 2)) for _, e, _ in errors)
    return float(np.sqrt(squares / readings.poses))


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
        a = max(old.s**2, floor)
        # Noise as the result leads to expect is as its own, whatever one pose of weight 1 is in either.
        b = max(shift.noise.variance * old.s**2 / shift.expected, floor)
        pair = Pair.of(Noise(a, old.sigma_freedom), Noise(b, shift.noise.freedom))
        A, B, basis = old_covariance(old, shift) / old.s**2, shift.covariance / b, shift.basis
        covariance = pair.a.variance * A + pair.b.variance * B
        d = basis.T @ shift.value
        chi_square = float(d @ np.linalg.solve(basis.T @ covariance @ basis, d))
        together = pair.chance(d, basis.T @ A @ basis, basis.T @ B @ basis) if len(d) else float("nan")
        single = np.full(9, np.nan)
        for p in np.flatnonzero(shift.known).tolist():
            single[p] = pair.chance(shift.value[[p]], A[[p]][:, [p]], B[[p]][:, [p]])
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


def _verdict(chance: float, level: float, limitations: tuple[str, ...], doubts: tuple[Notice, ...]) -> str:
    """Return the verdict: what speaks against the readings outweighs a difference unless noise alone explains neither.

    Where doubtful readings are no poses at all, any difference may be theirs.
    """
    if limitations or np.isnan(chance):
        certain = chance < min(level, SURELY) and not are_serious(doubts)
        return "changed" if certain else "inconclusive"
    return "changed" if chance < level else "unchanged"


def _reasons(
    old: Calibration,
    verdict: str,
    differences: tuple[Difference, ...],
    shift: Shift,
    pair: Pair,
    level: float,
) -> tuple[str, ...]:
    lines = []
    if changed := [d.name for d in differences if d.changed]:
        lines.append(f"Changed: {', '.join(changed)}.")
    elif verdict == "changed":
        lines.append("No single parameter stands out, but together they differ by more than chance allows.")
    if old.held.any():
        lines.append("The result takes the axes as perpendicular, so no misalignments are compared.")
    free = np.flatnonzero(~old.held).tolist()
    if unknown := [differences[p].name for p in free if np.isnan(differences[p].value)]:
        directions = shift.basis.shape[1]
        lines.append(
            f"The new readings determine {directions} of {len(free)} directions; they say nothing about: "
            f"{', '.join(unknown)}."
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


def limitations_of(old: Calibration, pair: Pair, doubts: tuple[Notice, ...]) -> tuple[str, ...]:
    """Return why new readings that show no change do not show that there is none, in sentences."""
    variance = pair.b.variance
    noisier = variance > NOISIER**2 * pair.a.variance and pair.noise_chance() < SURELY
    lines = {
        "The new readings themselves are doubtful, as the warnings say, so the differences say little about the "
        "sensor.": are_serious(doubts),
        f"A typical pose of the result itself is off by {old.s / old.g:.2%} of g, which hides any ordinary change. "
        "Calibrate again first.": is_large(old.s, old.g, old.freedom),
        "The noise of the new readings hides changes that the result would show. Measure again as carefully as for "
        "the calibration, each pose at rest and averaged.": noisier
        or is_large(float(np.sqrt(variance)), old.g, int(pair.b.freedom)),
    }
    return tuple(line for line, holds in lines.items() if holds)


def _doubts(shift: Shift, readings: Readings) -> tuple[Notice, ...]:
    """Return what is said of the new readings before they are compared, as `calibrate` would say it of them."""
    if shift.assessment is None:
        return readings.warnings
    said = shift.assessment.warnings[0]
    return (*readings.warnings, *(n for n in said if n.key in OF_READINGS and n not in readings.warnings))


def _warnings(old: Calibration, shift: Shift, verdict: str) -> tuple[Notice, ...]:
    """Return what the residuals say against the new readings, as `calibrate` would say it of them.

    Few poses hide the one among them that is wrong: where the verdict is inconclusive the result helps to find it.
    """
    freedom, s = int(shift.noise.freedom), float(np.sqrt(shift.noise.variance))
    found, readings = _outliers(shift), shift.sample.readings(0)
    if verdict == "inconclusive":
        found |= set(np.flatnonzero(_outliers_of_result(old, shift)).tolist())
    names = [readings.where(j) for j in sorted(found)]
    robust = shift.assessment is not None and shift.assessment.fit.settings.robust != "none"
    return (
        *large_residuals(s, old.g, freedom, aligned=bool(old.held.any())),
        *not_fitting(names, freedom, "robust" if robust else "known"),
    )


def _outliers(shift: Shift) -> set[int]:
    """Return the numbers of the poses that do not fit what the others say."""
    if shift.assessment is not None:
        return set(shift.assessment.outliers[0])
    freedom, parts = int(shift.noise.freedom), []
    total = freedom * shift.noise.variance
    for first, e, f in _errors(shift.sample, shift.model, shift.g):
        w = np.ones(len(e)) if shift.weights is None else shift.weights[first : first + len(e)]
        room = room_of(leverages(_rows(f), w, shift.cofactor))
        scaled = np.sqrt(w) * (e + _rows(f) @ shift.step)
        parts.append(studentise(scaled, room, total, freedom))
    size = np.abs(np.concatenate(parts))
    return set(np.flatnonzero(beyond_chance(size, np.array(len(size)), np.array(freedom))).tolist())


def _outliers_of_result(old: Calibration, shift: Shift) -> Bool:
    """Return which poses are off the result beyond chance, shape (J,); none unless the others, most of them, fit it."""
    parts, variance = [], shift.variance
    for first, e, f in _errors(shift.sample, old.model.in_gauge("lower"), old.g):
        rows = _rows(f)
        own = variance if len(variance) == 1 else variance[first : first + len(e)]
        parts.append(np.abs(e) / np.sqrt(own + np.sum((rows @ old.covariance) * rows, axis=1)))
    t = np.concatenate(parts)
    outlier = beyond_chance(t, np.array(len(t)), np.array(int(old.sigma_freedom) + 1))
    many = np.nanmedian(t) > USUAL or outlier.sum() > FEW * len(t)
    return np.zeros_like(outlier) if many else outlier


def _rows(f: Float) -> Float:
    """Return the design of poses by the directions of their force, shape (B, 9)."""
    return design(unit(f))
