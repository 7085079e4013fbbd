"""What is said of a fit: verdict, reasons, poses to add, and warnings of what speaks against the numbers.

Reasons are of the poses: how an error of one reading comes out in the parameters. Warnings are of the readings, the
fit and the search. The verdict is of the calibration, of both together. Arrays tell which sensors need words at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.distributions import chi_square_chance
from accelcal_cli.calibration.fit import Fit
from accelcal_cli.calibration.observability import FEWEST_POSES, SCALE, Geometry, poses_to_add
from accelcal_cli.calibration.result import Verdict
from accelcal_cli.calibration.search import rounding
from accelcal_cli.notices import Notice, Severity, are_serious
from accelcal_cli.sensor.model import OUTPUT_OF_1_G, STANDARD_GRAVITY

FEWEST_KNOWN = 6
"""Poses that a poor set is brought to where the attitudes are known."""

MORE_THAN_NOISE, SURELY = 2.0, 1e-3
"""Residuals this many times their noise, and by chance this rarely, are told of."""

MOST_NAMED = 8
"""Poses that one warning names."""

FEW = 6
"""Degrees of freedom up to which poses stand in for each other: of twelve edges, which leave three, opposite ones."""

LARGE = 0.005
"""A noise of one pose above this part of g is told of. Data sheets of MEMS accelerometers state nonlinearities of up to
0.5 % of full scale, and the real recordings of the tests leave 0.01 to 0.04 %."""

PERPENDICULAR = Notice(
    "perpendicular",
    "note",
    "The axes were taken as perpendicular, so no misalignment was estimated: one of 10 mrad, usual in low-cost "
    "sensors, moves 1 % of the force along one axis to another.",
    "Take twelve poses or more and estimate it, where that is too much.",
)

WALLED = Notice(
    "box",
    "warning",
    "The search may not leave its box, so the parameters are not those that fit the readings best.",
    "Widen the box or state the nominal sensor (--config, keys box and nominal).",
)

Loss = Literal["plain", "robust", "known"]
"""What poses that do not fit were fitted with; see `not_fitting`."""

STOPPED_SHORT = 0.01
"""Part of the cost that one more step would take off, from which on a search is told to be unfinished."""

EARTH = 9.76, 9.84
"""Gravity on Earth, m/s^2, from the top of the Andes to the Arctic Ocean."""

NOISE_BIAS = 3.5
"""Isotropic noise of standard deviation s, in units of g, makes scale factors too large by about 3.5 s^2: of c that
minimises E (1 - c^2 |u + n|^2)^2, c^2 = E |u + n|^2 / E |u + n|^4 = (1 + 3 s^2) / (1 + 10 s^2 + 15 s^4), and the scale
factor is 1 / c."""


@dataclass(frozen=True, eq=False)
class Assessment:
    """What is said of the fit of R sensors.

    Attributes:
        fit: what it is said of.
        verdicts: good, weak, suspect or undetermined, R of them; reasons: what the poses leave open, in sentences.
        suggestions: poses to add, in words.
        warnings: what speaks against the readings, the fit or the search, the gravest first.
        outliers: numbers of the poses beyond chance, from 0.
    """

    fit: Fit
    verdicts: list[Verdict]
    reasons: list[tuple[str, ...]]
    suggestions: list[tuple[str, ...]]
    warnings: list[tuple[Notice, ...]]
    outliers: list[tuple[int, ...]]


def assess(fit: Fit) -> Assessment:
    """Assess a fit."""
    walled: list[bool] = np.asarray(fit.at_wall.any(axis=1)).tolist()
    geometry = [
        _geometry(verdict, wall, freedom)
        for verdict, wall, freedom in zip(
            fit.observability.verdicts, walled, fit.freedom.tolist(), strict=True
        )
    ]
    reasons: list[tuple[str, ...]] = [()] * len(geometry)
    suggestions = list(reasons)
    for at, word in enumerate(geometry):
        if word != "good":
            suggestions[at], reasons[at] = _advice(fit, at)
    pose, outlier = fit.residuals.pose, fit.residuals.outlier
    outliers: list[tuple[int, ...]] = [()] * len(geometry)
    for at in np.flatnonzero(outlier.any(axis=1)).tolist():
        outliers[at] = tuple(pose[at, outlier[at]].tolist())
    warnings: list[tuple[Notice, ...]] = [()] * len(geometry)
    left = _to_gain(fit)
    for at in np.flatnonzero(_may_have_warnings(fit, left)).tolist():
        warnings[at] = _warnings(fit, at, float(left[at]), outliers[at])
    verdicts = [_verdict(word, said) for word, said in zip(geometry, warnings, strict=True)]
    return Assessment(fit, verdicts, reasons, suggestions, warnings, outliers)


def _geometry(poses: Geometry, walled: bool, freedom: int) -> Geometry:
    """Return the word on the poses, lowered where the search or their count does not bear it out."""
    if walled:
        return "undetermined"
    return "weak" if freedom == 0 and poses == "good" else poses


def _verdict(geometry: Geometry, warnings: Sequence[Notice]) -> Verdict:
    """Return the verdict on the calibration: `suspect` iff a warning stands and the poses determine it."""
    return "suspect" if geometry != "undetermined" and are_serious(warnings) else geometry


def _advice(fit: Fit, at: int) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the poses that would bring a sensor to a good verdict, in words, and why it is not, in sentences."""
    known = fit.solution is None
    freedom, poses = int(fit.freedom[at]), int(fit.sample.poses[at])
    view, fewest = fit.view[at], FEWEST_KNOWN if known else FEWEST_POSES
    suggestions: tuple[str, ...] = ()
    if not known and view.verdict != "good":
        suggestions = poses_to_add(fit.information[at], poses, aligned=not fit.settings.misalignment)
    lines = list(view.in_words("The known attitudes" if known else "The poses", suggestions))
    number = {4: "four", 6: "six", 9: "nine"}.get(poses - freedom, str(poses - freedom))
    if freedom < 0:
        lines.insert(0, f"{poses} poses are fewer than the {number} parameters; take at least {fewest}.")
    if freedom == 0:
        number = {4: "Four"}.get(poses, number.capitalize())
        lines.append(
            f"{number} poses leave no degrees of freedom, so no uncertainty can be given. Take at least {fewest}."
        )
    beyond = ", ".join(edge_names(fit.at_wall[at]))
    if beyond and view.verdict != "undetermined":  # of poses that leave a valley, the wall only ends it
        lines.append(f"The least cost lies outside the search box, beyond {beyond}.")
    return suggestions, tuple(lines)


def edge_names(at_wall: Bool) -> tuple[str, ...]:
    """Return the names of the unknowns that are at a wall of the box, of those marked in shape (D,)."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(at_wall) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_wall, strict=True) if at)


def _to_gain(fit: Fit) -> Float:
    """Return the part of the cost that a Gauss-Newton step would take off, shape (R,); 0 after a polish."""
    gain = np.zeros(len(fit.sample))
    solution = fit.solution
    if solution is None or fit.settings.polish:
        return gain
    cost, x = solution.cost, solution.x[:, None]
    residuals, slopes = cost.residuals(x)[:, 0], cost.jacobian(x)[:, 0]
    for at in np.flatnonzero(solution.value > rounding(cost)):
        step = np.linalg.lstsq(slopes[at], residuals[at])[0]
        gain[at] = np.sum((slopes[at] @ step) ** 2) / np.sum(residuals[at] ** 2)
    return gain


def _scale_sigma(fit: Fit) -> Float:
    """Return the largest one-sigma of a scale factor, as a part of it, shape (R,)."""
    return np.asarray(np.sqrt(np.einsum("rpp->rp", fit.covariance)[:, SCALE]).max(axis=1) / fit.settings.g)


def _may_have_warnings(fit: Fit, left: Float) -> Bool:
    """Return which sensors `_warnings` has something to say of, or might have, shape (R,)."""
    g, s, settings = fit.settings.g, fit.s, fit.settings
    noisy = (s > LARGE * g) | (NOISE_BIAS * (s / g) ** 2 > _scale_sigma(fit))
    noisy |= fit.noise[0] >= MORE_THAN_NOISE
    searched = (left > STOPPED_SHORT) | (fit.search.agreeing < fit.search.runs)
    searched |= fit.at_wall.any(axis=1)
    always = bool(odd_gravity(g)) or not settings.misalignment or fit.solution is None
    return np.asarray(noisy | searched | fit.sample.doubtful | fit.residuals.outlier.any(axis=1) | always)


def _warnings(fit: Fit, at: int, left: float, outliers: tuple[int, ...]) -> tuple[Notice, ...]:
    """Return what is said of a sensor, the gravest first."""
    readings, settings = fit.sample.readings(at), fit.settings
    s, freedom = float(fit.s[at]), int(fit.freedom[at])
    where = [readings.where(pose) for pose in outliers]
    loss: Loss = "known" if fit.solution is None else "plain" if settings.robust == "none" else "robust"
    lines = [
        *readings.warnings,
        *not_fitting(where, freedom, loss),
        *large_residuals(s, settings.g, freedom, aligned=not settings.misalignment),
    ]
    if fit.solution is None:
        return (*lines, *_turned_round(fit.K[at]))
    walled = bool(fit.at_wall[at].any()) and fit.view[at].verdict != "undetermined"
    return (
        *lines,
        *((WALLED,) if walled else ()),
        *more_than_noise(*fit.noise[:, at].tolist()),
        *_noise_bias(s, settings.g, float(_scale_sigma(fit)[at])),
        *_unfinished(int(fit.search.agreeing[at]), fit.search.runs, left),
        *(() if settings.misalignment else (PERPENDICULAR,)),
        *odd_gravity(settings.g),
    )


def is_large(s: float, g: float, freedom: int) -> bool:
    """Whether a noise of one pose is beyond LARGE g, and not by the chance of its own estimate (chi-square)."""
    if freedom < 1 or not s > LARGE * g:
        return False
    x = freedom * (s / (LARGE * g)) ** 2
    return bool(chi_square_chance(np.array([x]), np.array([freedom]))[0] < SURELY)


def large_residuals(s: float, g: float, freedom: int, *, aligned: bool = False) -> tuple[Notice, ...]:
    """Return a warning of residuals that are large beside g.

    Args:
        s: standard deviation of one pose's modulus, in the unit of g, NaN where nothing tells it.
        g: local gravity; freedom: degrees of freedom of s.
        aligned: whether the axes were taken as perpendicular, which may be what the residuals say.
    """
    if not is_large(s, g, freedom):
        return ()
    other = ", or the axes are not perpendicular" if aligned else ""
    text = (
        f"Residuals are too large: a typical pose is off by {s / g:.2%} of g (above {LARGE:.1%} is suspicious). Either "
        f"the sensor moved, too few readings were averaged, or the rows are not static poses{other}."
    )
    return (
        Notice("residuals", "warning", text, "Measure each pose again at rest, and average its readings."),
    )


def not_fitting(outliers: Sequence[str], freedom: int, loss: Loss = "known") -> tuple[Notice, ...]:
    """Return a notice that names the poses that do not fit: a warning unless a robust loss has rejected them.

    Args:
        outliers: the poses, by line or label.
        freedom: degrees of freedom: with few, a sound pose can take the blame of another.
        loss: `plain` least squares, to which a robust loss is a way out; a `robust` one; or `known` attitudes or
            parameters, which know no other.
    """
    if not outliers:
        return ()
    named = ", ".join(outliers[:MOST_NAMED])
    if len(outliers) > MOST_NAMED:
        named += f" and {len(outliers) - MOST_NAMED:,} more"
    one = len(outliers) == 1
    subject = f"Outlier: {named} does" if one else f"Outliers: {named} do"
    them = "it" if one else "them"
    severity: Severity = "note" if loss == "robust" else "warning"
    remedy = f"Measure {them} again{' or add --robust huber' if loss == 'plain' else ''}."
    blame = freedom <= FEW and not one
    doubt = " With so few poses one can take the blame of another." if blame else ""
    rejected = f" The robust loss counts {them} little." if loss == "robust" else ""
    text = f"{subject} not fit the other poses (p < 0.01).{doubt}{rejected}"
    return (Notice("outliers", severity, text, remedy),)


def more_than_noise(ratio: float, chance: float) -> tuple[Notice, ...]:
    """Return a warning of residuals of so many times the noise that the scatter predicts, and its p-value."""
    if not (ratio >= MORE_THAN_NOISE and chance <= SURELY):
        return ()
    text = (
        f"The residuals are {ratio_in_words(ratio)} times what the scatter within the poses explains: the sensor "
        "moved in them, changed its temperature or is not linear. Sigma counts that as noise."
    )
    remedy = "Let the sensor warm up, fix it in each pose, or add a column of temperatures."
    return (Notice("residuals", "warning", text, remedy),)


def ratio_in_words(ratio: float) -> str:
    """Return a ratio with two digits, or more where it is large."""
    return f"{ratio:.2g}" if ratio < 100 else f"{ratio:,.0f}"


def _noise_bias(s: float, g: float, sigma_scale: float) -> tuple[Notice, ...]:
    bias = NOISE_BIAS * (s / g) ** 2
    if not bias > sigma_scale:
        return ()
    text = f"The noise of one reading, {s:.3g}, makes the scale factors about {bias:.1%} too large, above their sigma."
    remedy = "Average the readings of each pose first (a column that labels the pose)."
    return (Notice("noise-bias", "warning", text, remedy),)


def _unfinished(agreeing: int, runs: int, left: float) -> tuple[Notice, ...]:
    notices = []
    if left > STOPPED_SHORT:
        short = f"The search stopped short of the minimum: one more step would take {left:.0%} off the cost."
        remedy = "Leave out --no-polish, or search longer."
        notices.append(Notice("unfinished-search", "warning", short, remedy))
    if agreeing < runs:
        text = f"{agreeing} of {runs} searches ended in the best minimum."
        remedy = "Search longer (--population, --iterations), or state the nominal sensor (--config)."
        notices.append(Notice("unfinished-search", "note", text, remedy))
    return tuple(notices)


def odd_gravity(g: float) -> tuple[Notice, ...]:
    """Return a warning of a gravity, in m/s^2, g or mg, that is not found on Earth."""
    if any(EARTH[0] <= g * STANDARD_GRAVITY / size <= EARTH[1] for size in OUTPUT_OF_1_G.values()):
        return ()
    text = (
        f"g = {g:g} is neither gravity on Earth, {EARTH[0]} to {EARTH[1]} m/s^2, nor 1, for readings in units of g: "
        "scale factors are proportional to it."
    )
    return (
        Notice("wrong-gravity", "warning", text, "State yours with --g, or with --latitude and --height."),
    )


def _turned_round(K: Float) -> tuple[Notice, ...]:
    """Return a note of a sensor whose axes all point to the other end of their own, K of shape (3, 3)."""
    sizes = np.sqrt(np.diagonal(K @ K.T))
    if not (np.diagonal(K) < -0.5 * sizes).all():
        return ()
    text = (
        "All scale factors are negative: the reference, or the sensor, counts gravity instead of specific force, which "
        "at rest points up."
    )
    return (Notice("negative-axes", "note", text, "Turn the sign of the reference (columns fx, fy, fz)."),)
