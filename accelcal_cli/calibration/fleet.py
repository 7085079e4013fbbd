"""Thousands of sensors at once: the flow of `calibrate` in blocks of sensors, and those that stand out from the others.

Each sensor goes its own way in the same company of arrays, with Levenberg-Marquardt as the optimizer. Where the poses
determine the ellipsoid, the start is the least cost itself, and the solver confirms it with a step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.assess import Assessment
from accelcal_cli.calibration.calibrate import assessed, dated, record
from accelcal_cli.calibration.distributions import chi_square_chance, student_chance
from accelcal_cli.calibration.observability import (
    PARAMETERS,
    SCALE,
    engineering_chain,
    engineering_quantities,
    propagated,
)
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.sample import NO_NOISE, NORMAL_MAD, Sample
from accelcal_cli.calibration.settings import Settings, load_settings
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.io.batches import FleetReadings
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.io.readings import Data, Readings, read_readings
from accelcal_cli.io.stream import Source, is_frame
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor.model import local_gravity

if TYPE_CHECKING:
    import polars

FAILED = "failed"
"""Verdict on a sensor that cannot be calibrated: a single pose, all of them equal, or weights that it does not give."""

UNWEIGHTED = "--weights"
"""Where the reason of a sensor begins that does not give the weights asked for."""

NAMED = 3
"""Outlying poses of a sensor that are named one by one."""

LEVEL = 0.01
"""Chance of naming a sensor where none stands out (Bonferroni over sensors and quantities)."""

NOISE = "noise of one pose, s"
"""Name of the quantity s beside those of the nine parameters."""

FEWEST = 10
"""Sensors that make a fleet to stand out from."""

EFFICIENCY = 0.37
"""A median absolute deviation of R values is worth the standard deviation of so many times R."""

MOST_FREEDOM = 1000
"""From here on Student's distribution is the normal one to any digit that matters."""


@dataclass(frozen=True)
class Fleet:
    """R calibrated sensors; units as in `Calibration`, NaN for a sensor that failed.

    Attributes:
        number: the sensors' numbers among the readings, shape (R,); poses: J of each.
        K_a, D_a: in the gauge of the settings, shapes (R, 3, 3) and (R, 3); sigma_k, sigma_d: their one-sigma.
        coverage: factor from a sigma to the half-width of its 95 % interval, shape (R,).
        parameters: the nine as an engineer takes them, see `engineering_quantities`, shape (R, 9): sensitivities in
            output units per m/s^2, misalignments in mrad, biases in micro-g.
        gain: their errors, of sensitivities as a part of themselves and else in rad and m/s^2, over the noise of a pose
            in m/s^2, shape (R, 9).
        dop: dilution of precision of the nine parameters, shape (R, 9).
        cost: L, (m/s^2)^4; s: standard deviation of a pose; rms, rms_before: of |f| - g; m/s^2, shape (R,).
        freedom: degrees of freedom of s, shape (R,).
        verdict: good, weak, suspect, undetermined or failed, shape (R,); reason: what the poses leave open, or why it
            failed, in sentences.
        warnings: what speaks against the readings and the fit, as `calibrate` says it, a tuple of Notice each,
            shape (R,).
        outlying: the poses beyond chance, in words.
        labels: of the sensors, shape (R,); empty where only their numbers are known.
    """

    number: Int
    poses: Int
    K_a: Float
    D_a: Float
    sigma_k: Float
    sigma_d: Float
    gain: Float
    coverage: Float
    parameters: Float
    dop: Float
    cost: Float
    s: Float
    rms: Float
    rms_before: Float
    freedom: Int
    verdict: np.ndarray
    reason: np.ndarray
    warnings: np.ndarray
    outlying: np.ndarray
    labels: np.ndarray = field(default_factory=lambda: np.array([], dtype=object))

    @classmethod
    def of(cls, results: Sequence[Calibration]) -> Fleet:
        """Return the fleet that records of sensors make, at least one, all with forces of one unit."""
        lost = np.array([one.lost for one in results])
        named = [[fit.where for fit in one.poses_fit if fit.pose in one.outliers] for one in results]
        eng = np.array([one.engineering[1] for one in results])
        noise = np.array([one.s for one in results])
        with np.errstate(divide="ignore", invalid="ignore"):
            size = np.array([(one.engineering[0][SCALE] + 1.0) for one in results])
            gain = eng / noise[:, None]
            gain[:, SCALE] /= size
        parameters = np.array([engineering_quantities(one.K_a, one.D_a) * _units(one.g) for one in results])
        return cls(
            number=np.arange(len(results)),
            poses=np.array([one.poses for one in results]),
            K_a=np.array([one.K_a for one in results]),
            D_a=np.array([one.D_a for one in results]),
            sigma_k=np.array([one.sigma.K_a for one in results]),
            sigma_d=np.array([one.sigma.D_a for one in results]),
            gain=gain,
            coverage=np.array([one.coverage_factor or np.nan for one in results]),
            parameters=np.where(lost, np.nan, parameters),
            dop=np.array([[one.dop.parameters[name] for name in PARAMETERS] for one in results]),
            cost=np.array([one.cost for one in results]),
            s=noise,
            rms=np.array([one.rms for one in results]),
            rms_before=np.array([one.rms_before for one in results]),
            freedom=np.array([one.freedom for one in results]),
            verdict=np.array([one.verdict for one in results], dtype=object),
            reason=np.array([" ".join(one.reasons) for one in results], dtype=object),
            warnings=_objects([one.warnings for one in results]),
            outlying=np.array([_in_words(own) for own in named], dtype=object),
        )

    def __str__(self) -> str:
        """How many sensors there are of each verdict."""
        from accelcal_cli.views.fleet import counts

        return counts(self)

    def to_frame(self) -> polars.DataFrame:
        """Return one row per sensor as a frame of polars: verdict, parameters, sigma, fit, and what is wrong."""
        from accelcal_cli.output.machine import frame
        from accelcal_cli.views.fleet import sensors

        labels = self.labels.tolist() or [str(number + 1) for number in self.number]
        return frame(sensors(self, labels, ()))

    @cached_property
    def determined(self) -> Bool:
        """Which sensors the poses determine, the suspect ones too, shape (R,)."""
        return np.asarray((self.verdict != "undetermined") & (self.verdict != FAILED))

    @property
    def warned(self) -> Bool:
        """Of which sensors there is a note or a warning, shape (R,)."""
        return np.array([len(said) > 0 for said in self.warnings], dtype=bool)


def fleet(
    data: Source | Sequence[str] | Mapping[str, Data],
    *,
    sensor: str | None = None,
    columns: Sequence[str] | None = None,
    **keys: Any,
) -> Fleet:
    """Calibrate the sensors of a fleet, each as `calibrate` with Levenberg-Marquardt would by itself.

    Args:
        data: a table, in a file or a frame, with a column that labels the sensor; one file per sensor; or readings by
            label, see `read_readings`.
        sensor: the column that labels the sensor; found by its name when None.
        columns: see `read_readings`.
        keys: fields of `Settings`, or `latitude` with `height` in place of `g`.

    Raises:
        ConfigError: settings that are not for a fleet. DataError: a table that cannot be read.

    Examples:
        >>> from accelcal_cli import fleet, simulate
        >>> poses = {f"S{n}": simulate("mems", positions=24, seed=n).output for n in (1, 2, 3)}
        >>> print(fleet(poses))
        3 sensors: 3 good
    """
    place = {name: keys.pop(name, None) for name in ("g", "latitude", "height")}
    keys = {"optimizer": "levenberg-marquardt", **keys}
    if isinstance(data, Mapping):
        each = [read_readings(one, columns) for one in data.values()]
        g = local_gravity(each[0].form.unit if each else None, **place)
        settings = load_settings(None, keys if g is None else {**keys, "g": g})
        whole = calibrate_each(each, settings)
        return replace(whole, labels=np.array(list(data), dtype=object))
    sources = [data] if isinstance(data, str | Path) or is_frame(data) else list(cast(Sequence[str], data))
    readings = read_fleet(cast(Sequence[Source], sources), columns, sensor)
    g = local_gravity(readings.unit, **place)
    whole = calibrate_fleet(readings, load_settings(None, keys if g is None else {**keys, "g": g}))
    return replace(whole, labels=np.array(readings.sensors, dtype=object)[whole.number])


def check_settings(settings: Settings, *, each: bool = False) -> None:
    """Refuse what is not done for a fleet; `each` sensor by itself, of a log (`calibrate_each`), has no attitudes.

    Raises:
        ConfigError: another optimizer, gauge `full`, several runs.
    """
    for key, allowed in {
        "optimizer": ("levenberg-marquardt",),
        "attitudes": ("unknown",) if each else ("unknown", "known"),
        "gauge": ("lower", "upper", "symmetric"),
        "runs": (1,),
        "polish": (True,),
    }.items():
        value = getattr(settings, key)
        if value not in allowed:
            words = ", ".join(map(str, allowed))
            raise ConfigError(
                f"{key}: {value}: a fleet goes with {words} only; calibrate this sensor by itself"
            )


def calibrate_fleet(
    readings: FleetReadings,
    settings: Settings,
    keep: Callable[[int, Calibration], None] | None = None,
) -> Fleet:
    """Calibrate every sensor of a fleet.

    Args:
        readings: static poses of R sensors.
        settings: as of one calibration with `levenberg-marquardt`; see `check_settings`.
        keep: takes the number and the whole record of each sensor that did not fail, one by one.

    Raises:
        ConfigError: settings that are not for a fleet.
        DataError: not one sensor gives the weights asked for.
    """
    fleet = calibrate_part(readings, settings, keep)
    if all(reason.startswith(UNWEIGHTED) for reason in fleet.reason):
        label, reason = readings.sensors[fleet.number[0]], fleet.reason[0].rstrip(".")
        raise DataError(f'{readings.source}: sensor "{label}", as all others: {reason}')
    return fleet


def calibrate_part(
    readings: FleetReadings,
    settings: Settings,
    keep: Callable[[int, Calibration], None] | None = None,
) -> Fleet:
    """Calibrate the sensors of a part of a fleet; as `calibrate_fleet`, but no sensor need give the weights."""
    check_settings(settings)
    parts = []
    for batch in readings.batches():
        sample, numbers = Sample.of_batch(readings, batch), batch.sensors
        words = sample.faults(settings.weights)
        if any(words):
            bad = np.array([bool(word) for word in words])
            parts.append(_failed(numbers[bad], sample.poses[bad], [word for word in words if word]))
            sample, numbers = sample.take(np.flatnonzero(~bad)), numbers[~bad]
        if not settings.temperature:
            sample = replace(sample, temperature=None)
        for own, at in _together(sample, settings):
            try:
                assessment = assessed(own, settings, closed=_is_closed(settings))
            except DataError as error:  # of known attitudes, which are one sensor's
                why = str(error).removeprefix(f"{own.readings(0).source}: ")
                parts.append(_failed(numbers[at], own.poses, [why]))
                continue
            parts.append(_part(assessment, numbers[at]))
            if keep is not None:
                for place, number in enumerate(numbers[at].tolist()):
                    keep(number, dated(record(assessment, place)))
    return _joined(parts)


def _is_closed(settings: Settings) -> bool:
    """Whether the least cost is that of the closed form: six unknowns are not those of an ellipsoid, which has nine.

    And the rounds of a robust loss go on from where the search of one sensor ends, to the last digit.
    """
    return settings.misalignment and settings.robust == "none"


def _together(sample: Sample, settings: Settings) -> Iterator[tuple[Sample, slice]]:
    """Yield the sensors that go through the flow together, and their places in the sample.

    A robust loss, weights by an error that poses share, and slopes have rounds of their own for every sensor.
    """
    alone = settings.robust != "none" or settings.weights == "auto" or settings.attitudes == "known"
    if not alone and sample.temperature is None:
        if len(sample):
            yield sample, slice(None)
        return
    for at in range(len(sample)):
        yield sample.alone(at), slice(at, at + 1)


def calibrate_each(
    readings: Sequence[Readings | str],
    settings: Settings,
    keep: Callable[[int, Calibration], None] | None = None,
) -> Fleet:
    """Calibrate sensors one by one, each as `calibrate` does: with weights by a shared error and temperature slopes.

    Args:
        readings: static poses of R sensors; in place of those that there are not, why, without the stop at the end.
        settings, keep: as in `calibrate_fleet`.

    Raises:
        ConfigError: settings that are not for a fleet.
    """
    check_settings(settings, each=True)
    parts = []
    for number, one in enumerate(readings):
        if isinstance(one, str):
            parts.append(_failed(np.array([number]), np.zeros(1, dtype=np.intp), [one]))
            continue
        sample = Sample.of([one])
        if fault := sample.faults(settings.weights)[0]:
            parts.append(_failed(np.array([number]), sample.poses, [fault]))
            continue
        assessment = assessed(sample, settings)
        parts.append(_part(assessment, np.array([number])))
        if keep is not None:
            keep(number, dated(record(assessment, 0)))
    return _joined(parts)


def _joined(parts: Sequence[Fleet]) -> Fleet:
    """Return the parts as one fleet, in the order of the sensors."""
    order = np.argsort(np.concatenate([part.number for part in parts]))
    names = [f.name for f in fields(Fleet) if f.name != "labels"]
    return Fleet(**{name: np.concatenate([getattr(part, name) for part in parts])[order] for name in names})


def _part(assessment: Assessment, number: Int) -> Fleet:
    """Return the part of a fleet that an assessment tells of."""
    fit, sample, settings = assessment.fit, assessment.fit.sample, assessment.fit.settings

    outlying = np.full(len(sample), "", dtype=object)
    for at, poses in enumerate(assessment.outliers):
        if poses:
            outlying[at] = _in_words([sample.where(at, pose) for pose in poses])
    return Fleet(
        number=number,
        poses=sample.poses,
        K_a=fit.K,
        D_a=fit.D,
        sigma_k=fit.sigma_K,
        sigma_d=fit.sigma_D,
        gain=propagated(engineering_chain(fit.lower, fit.D, fit.settings.g), fit.view.cofactor),
        coverage=fit.coverage,
        parameters=engineering_quantities(fit.lower, fit.D) * _units(settings.g),
        dop=fit.view.dop,
        cost=fit.value,
        s=fit.s,
        rms=fit.rms,
        rms_before=fit.rms_before,
        freedom=np.broadcast_to(fit.freedom, sample.poses.shape),
        verdict=np.array(assessment.verdicts, dtype=object),
        reason=np.array([" ".join(own) for own in assessment.reasons], dtype=object),
        warnings=_objects(assessment.warnings),
        outlying=outlying,
    )


def _in_words(poses: Sequence[str]) -> str:
    """Return outlying poses in words, the first few by name."""
    more = f" and {len(poses) - NAMED} more" if len(poses) > NAMED else ""
    return ", ".join(poses[:NAMED]) + more


def _objects(values: Sequence[object]) -> np.ndarray:
    """Return values, tuples too, as an array of one dimension."""
    return np.fromiter(values, dtype=object, count=len(values))


def _failed(number: Int, poses: Int, words: list[str]) -> Fleet:
    """Return the part of sensors that cannot be calibrated, and why."""

    def nan(*shape: int) -> Float:
        return np.full((len(number), *shape), np.nan)

    nothing = np.full(len(words), "", dtype=object)
    return Fleet(
        number=number,
        poses=poses,
        K_a=nan(3, 3),
        D_a=nan(3),
        sigma_k=nan(3, 3),
        sigma_d=nan(3),
        gain=nan(9),
        coverage=nan(),
        parameters=nan(9),
        dop=nan(9),
        cost=nan(),
        s=nan(),
        rms=nan(),
        rms_before=nan(),
        freedom=np.zeros(len(number), dtype=np.intp),
        verdict=np.full(len(words), FAILED, dtype=object),
        reason=np.array([f"{word[0].upper()}{word[1:]}." for word in words], dtype=object),
        warnings=_objects([()] * len(number)),
        outlying=nothing,
    )


@dataclass(frozen=True)
class Standout:
    """A sensor that stands out.

    Attributes:
        at: its place in the fleet; name: of the quantity, of `PARAMETERS` or `NOISE`.
        value, middle: its own and the fleet's, in the unit of `Fleet`; z: robust, None for s.
    """

    at: int
    name: str
    value: float
    middle: float
    z: float | None


def _units(g: float) -> Float:
    """Return the sizes of the units of `Fleet.parameters`, shape (9,): 1, mrad and micro-g."""
    return np.repeat([1.0, units.MRAD, units.MICRO_G / g], 3)


def parameter_gains(fleet: Fleet, g: float) -> Float:
    """Return the errors of `Fleet.parameters` over the noise of a pose in m/s^2, shape (R, 9)."""
    gains = fleet.gain * _units(g)
    gains[:, SCALE] *= fleet.parameters[:, SCALE]
    return gains


def standouts(fleet: Fleet, g: float) -> list[Standout]:
    """Return the sensors that stand out from those that their poses determine, farthest first, the noisy ones last.

    Parameters by their distance from the median over 1.4826 times the median absolute deviation, under Student's
    distribution; s by chi-square against the noise that the fleet shares. A sensor whose poses tell less of a parameter
    than most others' do may be farther off.
    """
    known = np.flatnonzero(fleet.determined)
    if len(known) < FEWEST:
        return []
    tests = len(known) * (len(PARAMETERS) + 1)
    found = []
    shared = _shared_variance(fleet)
    pose = np.fmax(fleet.s[known], np.sqrt(shared))  # few poses estimate it too small at times
    for p, name in enumerate(PARAMETERS):
        values = fleet.parameters[known, p]
        middle = float(np.median(values))
        spread = NORMAL_MAD * float(np.median(np.abs(values - middle)))
        if spread <= 1e-9 * float(np.abs(values).max()):
            continue  # all alike, but for rounding
        gain = fleet.gain[known, p] * _units(g)[p] * (values if name in PARAMETERS[SCALE] else 1.0)
        own = (pose * gain) ** 2
        z = (values - middle) / np.sqrt(spread**2 + np.maximum(own - np.median(own), 0.0))
        far = np.flatnonzero(np.abs(z) > 3.0)
        freedom = np.full(len(far), min(MOST_FREEDOM, int(EFFICIENCY * len(known))))
        far = far[student_chance(np.abs(z[far]), freedom) * tests < LEVEL]
        found += [Standout(int(known[k]), name, float(values[k]), middle, float(z[k])) for k in far]
    found.sort(key=lambda one: -abs(one.z or 0.0))
    return found + _noisy(fleet, shared, g, tests)


def _shared_variance(fleet: Fleet) -> float:
    """Return the variance of a pose that the sensors share, (m/s^2)^2, by the median; 0 of too few sensors."""
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    if len(known) < FEWEST:
        return 0.0
    # The median of chi-square with n degrees of freedom is n (1 - 2 / 9n)^3.
    middle = (1.0 - 2.0 / (9.0 * fleet.freedom[known])) ** 3
    return float(np.median(fleet.s[known] ** 2 / middle))


def _noisy(fleet: Fleet, shared: float, g: float, tests: int) -> list[Standout]:
    """Return the sensors whose s is beyond chance above the variance that the fleet shares, worst first."""
    if shared <= (NO_NOISE * g) ** 2:
        return []
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    freedom = fleet.freedom[known]
    x = freedom * fleet.s[known] ** 2 / shared
    far = np.flatnonzero(x > freedom + 3.0 * np.sqrt(2.0 * freedom))
    far = far[chi_square_chance(x[far], freedom[far]) * tests < LEVEL]
    far = known[far[np.argsort(-x[far])]]
    middle = float(np.sqrt(shared))
    return [Standout(int(at), NOISE, float(fleet.s[at]), middle, None) for at in far]
