"""What a user should know before trusting a calibration whose poses determine it: its residuals and its search.

The verdict is of the poses alone: how an error of one reading comes out in the parameters. Cautions are of the
readings: they do not change the verdict, and stand beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accelcal_cli.calibration.chances import chi_square_chance
from accelcal_cli.calibration.settings import Settings

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
    "The axes were taken as perpendicular, no misalignment was estimated: one of 10 mrad, usual in low-cost sensors, "
    "moves 1 % of the force along one axis to another."
)

STOPPED_SHORT = 0.01
"""Part of the cost that one more step would take off, from which on a search is told to be unfinished."""

EARTH = 9.76, 9.84
"""Gravity on Earth, m/s^2, from the top of the Andes to the Arctic Ocean."""

NOISE_BIAS = 3.5
"""Isotropic noise of standard deviation s, in units of g, makes scale factors too large by about 3.5 s^2: of c that
minimises E (1 - c^2 |u + n|^2)^2, c^2 = E |u + n|^2 / E |u + n|^4 = (1 + 3 s^2) / (1 + 10 s^2 + 15 s^4), and the scale
factor is 1 / c."""


def cautions(
    settings: Settings,
    agreeing: int,
    left: float,
    s: float,
    freedom: int,
    sigma_scale: float,
    noise: tuple[float | None, float | None],
    outlying: Sequence[str],
) -> tuple[str, ...]:
    """Return the cautions of a solution, in sentences, the gravest first.

    Args:
        settings: of the calibration; agreeing: how many of its searches ended in the best minimum.
        left: the part of the cost that one more step would take off.
        s: standard deviation of one pose's modulus, in the unit of g, NaN where nothing tells it; freedom: of it.
        sigma_scale: the largest of a scale factor, as a part of it.
        noise: s over what the scatter within poses predicts, and the chance of so large a ratio; None where nothing
            tells them.
        outlying: the poses that do not fit, by line or label.
    """
    return (
        *not_fitting(outlying, freedom, robust=settings.robust == "none"),
        *large_residuals(s, settings.g, freedom, aligned=not settings.misalignment),
        *_more_than_noise(*noise),
        *_noise_bias(s, settings.g, sigma_scale),
        *_search(agreeing, settings.runs, left),
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
        s, g: as in `cautions`; freedom: degrees of freedom of s.
        aligned: whether the axes were taken as perpendicular, which may be what the residuals say.
    """
    if not is_large(s, g, freedom):
        return ()
    other = ", or its axes are not perpendicular" if aligned else ""
    return (
        f"After calibration one pose errs by {s / g:.2%} of g, where {LARGE:.1%} is much for an accelerometer at rest: "
        f"the sensor moved, the readings are averaged too little, or they are not what they are taken for{other}.",
    )


def not_fitting(outlying: Sequence[str], freedom: int, *, robust: bool = False) -> tuple[str, ...]:
    """Return a caution that names the poses that do not fit, and what to do.

    Args:
        outlying: the poses, by line or label.
        freedom: degrees of freedom: with few, a sound pose can take the blame of another.
        robust: whether a robust loss is a way out.
    """
    if not outlying:
        return ()
    other = ", or use calibrate --robust" if robust else ""
    doubt = (
        " With so few poses one can take the blame of another."
        if freedom <= FEW and len(outlying) > 1
        else ""
    )
    named = ", ".join(outlying[:MOST_NAMED])
    more = f" and {len(outlying) - MOST_NAMED:,} more" if len(outlying) > MOST_NAMED else ""
    again = "it" if len(outlying) == 1 else "them"
    return (f"Beyond chance off the others: {named}{more}. Measure {again} again{other}.{doubt}",)


def _more_than_noise(ratio: float | None, chance: float | None) -> tuple[str, ...]:
    if ratio is None or chance is None or ratio < MORE_THAN_NOISE or chance > SURELY:
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
        f"The noise of one reading, {s:.3g}, is so large that it makes the scale factors about {bias:.1%} too "
        "large, more than their sigma: average the readings of each pose first (a column that labels the pose).",
    )


def _search(agreeing: int, runs: int, left: float) -> tuple[str, ...]:
    lines = []
    if left > STOPPED_SHORT:
        lines.append(
            f"The search stopped short of the minimum: a step more would take {left:.0%} off the cost. "
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
