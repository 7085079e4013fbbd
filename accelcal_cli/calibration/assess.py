"""What is said of a fit: verdict, reasons, poses to add, and cautions of what speaks against the readings.

The verdict is of the poses: how an error of one reading comes out in the parameters. Cautions are of the readings and
of the search: they do not change the verdict, and stand beside it. Arrays tell which sensors need words at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.distributions import chi_square_chance
from accelcal_cli.calibration.fit import Fit
from accelcal_cli.calibration.observability import FEWEST_POSES, SCALE, Verdict, poses_to_add
from accelcal_cli.calibration.search import rounding

FEWEST_KNOWN = 6
"""Poses that a poor set is brought to where the attitudes are known."""

MORE_THAN_NOISE, SURELY = 2.0, 1e-3
"""Residuals this many times their noise, and by chance this rarely, are told of."""

MOST_NAMED = 8
"""Poses that one caution names."""

FEW = 6
"""Degrees of freedom up to which poses stand in for each other: of twelve edges, which leave three, opposite ones."""

LARGE = 0.005
"""A noise of one pose above this part of g is told of. Data sheets of MEMS accelerometers state nonlinearities of up to
0.5 % of full scale, and the real recordings of the tests leave 0.01 to 0.04 %."""

PERPENDICULAR = (
    "The axes were taken as perpendicular, so no misalignment was estimated: one of 10 mrad, usual in low-cost "
    "sensors, moves 1 % of the force along one axis to another."
)

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
        verdicts: good, weak or undetermined, R of them; reasons: why one is not good, in sentences.
        suggestions: poses to add, in words.
        cautions: what speaks against the readings or the search, in sentences, the gravest first.
        outliers: numbers of the poses beyond chance, from 0.
    """

    fit: Fit
    verdicts: list[Verdict]
    reasons: list[tuple[str, ...]]
    suggestions: list[tuple[str, ...]]
    cautions: list[tuple[str, ...]]
    outliers: list[tuple[int, ...]]


def assess(fit: Fit) -> Assessment:
    """Assess a fit."""
    walled: list[bool] = np.asarray(fit.at_wall.any(axis=1)).tolist()
    verdicts = [
        _final_verdict(verdict, wall, freedom)
        for verdict, wall, freedom in zip(
            fit.observability.verdicts, walled, fit.freedom.tolist(), strict=True
        )
    ]
    reasons: list[tuple[str, ...]] = [()] * len(verdicts)
    suggestions = list(reasons)
    for at, verdict in enumerate(verdicts):
        if verdict != "good":
            suggestions[at], reasons[at] = _advice(fit, at)
    pose, outlier = fit.residuals.pose, fit.residuals.outlier
    outliers: list[tuple[int, ...]] = [()] * len(verdicts)
    for at in np.flatnonzero(outlier.any(axis=1)).tolist():
        outliers[at] = tuple(pose[at, outlier[at]].tolist())
    cautions: list[tuple[str, ...]] = [()] * len(verdicts)
    left = _to_gain(fit)
    for at in np.flatnonzero(_may_have_cautions(fit, left)).tolist():
        cautions[at] = _cautions(fit, at, float(left[at]), outliers[at])
    return Assessment(fit, verdicts, reasons, suggestions, cautions, outliers)


def _final_verdict(poses: Verdict, walled: bool, freedom: int) -> Verdict:
    """Return the verdict of the poses, lowered where the search or the count of poses does not bear it out."""
    if walled:
        return "undetermined"
    return "weak" if freedom == 0 and poses == "good" else poses


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
        lines.append(
            f"The least cost lies outside the search box, beyond {beyond}: "
            "widen the box or state the nominal sensor (--config, keys box and nominal)."
        )
    return suggestions, tuple(lines)


def edge_names(at_wall: Bool) -> tuple[str, ...]:
    """Return the names of the unknowns that are at a wall of the box, of those marked in shape (D,)."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(at_wall) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_wall, strict=True) if at)


def _to_gain(fit: Fit) -> Float:
    """Return the part of the cost that a Gauss-Newton step would take off, shape (R,); 0 after a polish."""
    gain = np.zeros(len(fit.K))
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


def _may_have_cautions(fit: Fit, left: Float) -> Bool:
    """Return which sensors `_cautions` has something to say of, or might have, shape (R,)."""
    g, s, settings = fit.settings.g, fit.s, fit.settings
    noisy = (s > LARGE * g) | (NOISE_BIAS * (s / g) ** 2 > _scale_sigma(fit))
    noisy |= fit.noise[0] >= MORE_THAN_NOISE
    searched = (left > STOPPED_SHORT) | (fit.search.agreeing < fit.search.runs)
    always = bool(odd_gravity(g)) or not settings.misalignment or fit.solution is None
    return np.asarray(noisy | searched | fit.sample.doubtful | fit.residuals.outlier.any(axis=1) | always)


def _cautions(fit: Fit, at: int, left: float, outliers: tuple[int, ...]) -> tuple[str, ...]:
    """Return the cautions of a sensor, in sentences, the gravest first."""
    readings, settings = fit.sample.readings(at), fit.settings
    s, freedom = float(fit.s[at]), int(fit.freedom[at])
    where = [readings.where(pose) for pose in outliers]
    least_squares = settings.robust == "none" and fit.solution is not None
    lines = [
        *readings.cautions,
        *not_fitting(where, freedom, robust=least_squares),
        *large_residuals(s, settings.g, freedom, aligned=not settings.misalignment),
    ]
    if fit.solution is None:
        return (*lines, *_turned_round(fit.K[at]))
    return (
        *lines,
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


def large_residuals(s: float, g: float, freedom: int, *, aligned: bool = False) -> tuple[str, ...]:
    """Return a caution of residuals that are large beside g.

    Args:
        s: standard deviation of one pose's modulus, in the unit of g, NaN where nothing tells it.
        g: local gravity; freedom: degrees of freedom of s.
        aligned: whether the axes were taken as perpendicular, which may be what the residuals say.
    """
    if not is_large(s, g, freedom):
        return ()
    other = ", or the axes are not perpendicular" if aligned else ""
    return (
        f"Residuals are too large: a typical pose is off by {s / g:.2%} of g (above {LARGE:.1%} is suspicious). Either "
        "the sensor moved, too few readings were averaged, or the rows are not static poses" + other + ".",
    )


def not_fitting(outliers: Sequence[str], freedom: int, *, robust: bool = False) -> tuple[str, ...]:
    """Return a caution that names the poses that do not fit, and what to do.

    Args:
        outliers: the poses, by line or label.
        freedom: degrees of freedom: with few, a sound pose can take the blame of another.
        robust: whether a robust loss is a way out.
    """
    if not outliers:
        return ()
    named = ", ".join(outliers[:MOST_NAMED])
    if len(outliers) > MOST_NAMED:
        named += f" and {len(outliers) - MOST_NAMED:,} more"
    one = len(outliers) == 1
    subject = f"Outlier: {named} does" if one else f"Outliers: {named} do"
    again = f"Measure {'it' if one else 'them'} again" + (" or add --robust huber" if robust else "")
    blame = freedom <= FEW and not one
    doubt = " With so few poses one can take the blame of another." if blame else ""
    return (f"{subject} not fit the other poses (p < 0.01). {again}.{doubt}",)


def more_than_noise(ratio: float, chance: float) -> tuple[str, ...]:
    """Return a caution of residuals of so many times the noise that the scatter predicts, and its p-value."""
    if not (ratio >= MORE_THAN_NOISE and chance <= SURELY):
        return ()
    return (
        f"The residuals are {ratio_in_words(ratio)} times what the scatter within the poses explains: the sensor "
        "moved in them, changed its temperature or is not linear. Sigma counts that as noise; the verdict is of the "
        "poses alone.",
    )


def ratio_in_words(ratio: float) -> str:
    """Return a ratio with two digits, or more where it is large."""
    return f"{ratio:.2g}" if ratio < 100 else f"{ratio:,.0f}"


def _noise_bias(s: float, g: float, sigma_scale: float) -> tuple[str, ...]:
    bias = NOISE_BIAS * (s / g) ** 2
    if not bias > sigma_scale:
        return ()
    return (
        f"The noise of one reading, {s:.3g}, makes the scale factors about {bias:.1%} too large, more than their "
        "sigma. Average the readings of each pose first (a column that labels the pose).",
    )


def _unfinished(agreeing: int, runs: int, left: float) -> tuple[str, ...]:
    lines = []
    if left > STOPPED_SHORT:
        lines.append(
            f"The search stopped short of the minimum: one more step would take {left:.0%} off the cost. "
            "Leave out --no-polish, or search longer."
        )
    if agreeing < runs:
        lines.append(f"{agreeing} of {runs} searches ended in the best minimum.")
    return tuple(lines)


def odd_gravity(g: float) -> tuple[str, ...]:
    """Return a caution of a gravity, m/s^2 or 1 for units of g, that is not found on Earth."""
    if g == 1.0 or EARTH[0] <= g <= EARTH[1]:
        return ()
    return (
        f"g = {g:g} is neither gravity on Earth, {EARTH[0]} to {EARTH[1]} m/s^2, nor 1, for readings in units of g: "
        "scale factors are proportional to it.",
    )


def _turned_round(K: Float) -> tuple[str, ...]:
    """Return a caution of a sensor whose axes all point to the other end of their own, K of shape (3, 3)."""
    sizes = np.sqrt(np.diagonal(K @ K.T))
    if not (np.diagonal(K) < -0.5 * sizes).all():
        return ()
    return (
        "All scale factors are negative: the reference, or the sensor, counts gravity instead of specific force, which "
        "at rest points up.",
    )
