"""What a user should know before trusting a calibration whose poses determine it: its residuals and its search.

The verdict is of the poses alone: how an error of one reading comes out in the parameters. Cautions are of the
readings: they do not change the verdict, and stand beside it.
"""

from __future__ import annotations

from collections.abc import Sequence

from accelcal_cli.calibration.settings import Settings

MORE_THAN_NOISE, SURELY = 2.0, 1e-3
"""Residuals this many times their noise, and by chance this rarely, are told of."""

MOST_NAMED = 8

LARGE = 0.005
"""A noise of one pose above this part of g is told of. Data sheets of MEMS accelerometers state nonlinearities of up to
0.5 % of full scale, and the real recordings of the tests leave 0.01 to 0.04 %."""

NOISE_BIAS = 3.0
"""Isotropic noise of standard deviation s makes scale factors too large by about 3 (s/g)^2: |f|^2 grows by 3 s^2
on average, and the noise in the products of outputs doubles it. Measured at s/g from 0.02 to 0.1."""


def cautions(
    settings: Settings,
    agreeing: int,
    s: float,
    sigma_scale: float,
    noise: tuple[float | None, float | None],
    outlying: Sequence[str],
) -> tuple[str, ...]:
    """Return the cautions of a solution, in sentences, the gravest first.

    Args:
        settings: of the calibration; agreeing: how many of its searches ended in the best minimum.
        s: standard deviation of one pose's modulus, in the unit of g; NaN where nothing tells it.
        sigma_scale: the largest of a scale factor, as a part of it.
        noise: s over what the scatter within poses predicts, and the chance of so large a ratio; None where nothing
            tells them.
        outlying: the poses that do not fit, by line or label.
    """
    return (
        *large_residuals(s, settings.g),
        *_more_than_noise(*noise),
        *not_fitting(outlying, "or use --robust" if settings.robust == "none" else ""),
        *_noise_bias(s, settings.g, sigma_scale),
        *_search(agreeing, settings.runs),
    )


def large_residuals(s: float, g: float) -> tuple[str, ...]:
    """Return a caution of residuals that are large beside g; `s` as in `cautions`."""
    if not s > LARGE * g:
        return ()
    return (
        f"After calibration one pose errs by {s / g:.2%} of g, where {LARGE:.1%} is much for an accelerometer at rest: "
        "the sensor moved, the readings are averaged too little, or they are not what they are taken for.",
    )


def not_fitting(outlying: Sequence[str], other: str = "") -> tuple[str, ...]:
    """Return a caution that names the poses that do not fit, and what can be done but measuring again."""
    if not outlying:
        return ()
    named = ", ".join(outlying[:MOST_NAMED])
    more = f" and {len(outlying) - MOST_NAMED:,} more" if len(outlying) > MOST_NAMED else ""
    again = "it" if len(outlying) == 1 else "them"
    return (
        f"Beyond chance off the others: {named}{more}. Measure {again} again{', ' if other else ''}{other}.",
    )


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


def _search(agreeing: int, runs: int) -> tuple[str, ...]:
    return (f"{agreeing} of {runs} searches ended in the best minimum.",) if agreeing < runs else ()
