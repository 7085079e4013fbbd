"""An old result against new readings: did this sensor change?

The nine gauge-free parameters of quality.PARAMETERS, as force at 1 g, from the new readings minus those of the
result. Where the new readings do not determine all nine, the directions that they determine are compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.calibration import chances
from accelcal_cli.calibration import doubts as hidden
from accelcal_cli.calibration import record as records
from accelcal_cli.calibration.cautions import ratio_in_words
from accelcal_cli.calibration.chances import Pair
from accelcal_cli.calibration.foreign import check_unit, strange
from accelcal_cli.calibration.quality import PARAMETERS
from accelcal_cli.calibration.residuals import modulus_errors, square_error
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.shift import Shift, shift
from accelcal_cli.calibration.temperature import at
from accelcal_cli.calibration.tested import Tests
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.readings import Readings

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
        plain: dict[str, object] = records.plain(self)
        return plain


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
    doubts = hidden.doubts(old, tests.pair, readings)
    verdict = _verdict(tests.chance, level, doubts, readings)
    differences = _differences(found, tests, level if verdict == "changed" else 0.0)
    rms = _rms(old, readings)
    return Verification(
        verdict=verdict,
        reasons=(
            *strange(rms, old),
            *_reasons(verdict, differences, found, tests.pair, level),
            *(doubts if verdict == "inconclusive" else ()),
            *warmth,
        ),
        cautions=hidden.cautions(old, found, tests.pair, readings, verdict),
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
        certain = chance < min(level, hidden.SURELY) and not readings.cautions
        return "changed" if certain else "inconclusive"
    return "changed" if chance < level else "unchanged"


def _rms(old: Calibration, readings: Readings) -> float:
    """Return the rms of |f| - g of the readings under the old result, in its unit of force."""
    model = old.model.in_gauge("lower")
    squares = sum(square_error(e, old.g) for _, e, _ in modulus_errors(readings, model, old.g))
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
    return at(readings, brought), ()


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
