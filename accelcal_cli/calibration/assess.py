"""What is said of a fit: verdict, reasons, poses to add, and warnings of what speaks against the numbers.

Reasons are of the poses: how an error of one reading comes out in the parameters. Warnings are of the readings, the
fit and the search. The verdict is of the calibration, of both together. Arrays tell which sensors need words at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.distributions import chi_square_chance
from accelcal_cli.calibration.fit import NOTABLE_BIAS, Fit
from accelcal_cli.calibration.observability import (
    ALIGNED,
    FEWEST_POSES,
    SCALE,
    PoseVerdict,
    poses_to_add,
    unit,
)
from accelcal_cli.calibration.residuals import OUTLIER_LEVEL
from accelcal_cli.calibration.result import Verdict
from accelcal_cli.calibration.sample import NO_NOISE, axis_up
from accelcal_cli.calibration.search import edge_names, rounding
from accelcal_cli.notices import Notice, Severity, are_serious
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.model import OUTPUT_OF_1_G, STANDARD_GRAVITY
from accelcal_cli.sensor.poses import AXES

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

MATTERS = 0.3
"""Sigmas of a parameter from which on a bias that may remain is a warning: of 0.3, an interval covers 94 %."""

LESS_THAN_NOISE, SURELY_LESS = 0.5, 1e-4
"""Residuals of at most this part of the noise that the scatter predicts, and by chance this rarely, are told of."""

SURELY_PATTERN, LIKELY_PATTERN = 5e-4, 0.01
"""Chance of a pattern in the residuals below which it is told of, and where they are surely more than noise."""

CHECKABLE, FEW_TO_CHECK = 0.9, 3
"""Leverage up to which a pose is checked by the others, and the degrees of freedom up to which that is asked: beyond
them a pose that is wrong shows in 10 to 12 poses, too."""

TURNED = 0.1
"""A misalignment, rad, beyond which axes are more likely swapped, or a reading wrong, than a sensor made so."""

FEWEST_FREEDOM = 4.0
"""Degrees of freedom, by clusters of rows that follow each other, below which their interval is not to be relied on."""

NEAR_NOMINAL, ALIKE = 0.005, 1.0 / 3.0
"""Scale factors this far from a stated nominal sensor, all by the same within ALIKE of it, are rather a wrong g."""


@frozen(eq=False)
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
    walled, unchecked = np.asarray(fit.at_wall.any(axis=1)), _unchecked(fit)
    poor, geometry = np.asarray(unchecked.any(axis=1)), list(fit.geometry.observability.verdicts)
    for at in np.flatnonzero(walled | poor | (fit.freedom == 0)).tolist():
        geometry[at] = _geometry(geometry[at], bool(walled[at]), int(fit.freedom[at]), bool(poor[at]))
    reasons: list[tuple[str, ...]] = [()] * len(geometry)
    suggestions = list(reasons)
    for at, word in enumerate(geometry):
        if word != "good":
            suggestions[at], reasons[at] = _advice(fit, at, unchecked[at])
    outliers = _outliers(fit)
    warnings: list[tuple[Notice, ...]] = [()] * len(geometry)
    verdicts: list[Verdict] = list(geometry)
    left, (bent, drift) = _to_gain(fit), fit.patterns
    limit = np.where(_are_more_than_noise(fit), LIKELY_PATTERN, SURELY_PATTERN)
    patterned = (bent < limit) | (drift < limit)
    for at in np.flatnonzero(_may_have_warnings(fit, left) | patterned).tolist():
        own = _patterns_in_words(float(bent[at]), float(drift[at]), float(limit[at]))
        warnings[at] = (*_warnings(fit, at, float(left[at]), outliers[at]), *own)
        verdicts[at] = _verdict(geometry[at], warnings[at])
    return Assessment(fit, verdicts, reasons, suggestions, warnings, outliers)


def _unchecked(fit: Fit) -> Bool:
    """Return which of the kept poses no other checks, of few whose scatter does not bear them out, shape (R, k)."""
    asked = (fit.freedom >= 1) & (fit.freedom <= FEW_TO_CHECK) & np.isnan(fit.spread.ratio)
    asked &= fit.solution is not None
    noise = None if fit.solution is None else fit.solution.stated.noise
    if noise is not None:  # a robust loss has no ratio
        expected = noise.variance.sum(axis=1) / fit.sample.poses
        asked &= ~(noise.known & (fit.spread.variance <= MORE_THAN_NOISE**2 * expected))
    return np.asarray((fit.residuals.leverage >= CHECKABLE) & fit.residuals.real & asked[:, None])


def _geometry(poses: PoseVerdict, walled: bool, freedom: int, unchecked: bool) -> PoseVerdict:
    """Return the word on the poses, lowered where the search or their count does not bear it out."""
    if walled:
        return "undetermined"
    return "weak" if (freedom == 0 or unchecked) and poses == "good" else poses


def _verdict(geometry: PoseVerdict, warnings: Sequence[Notice]) -> Verdict:
    """Return the verdict on the calibration: `suspect` iff a warning stands and the poses determine it."""
    return "suspect" if geometry != "undetermined" and are_serious(warnings) else geometry


def _outliers(fit: Fit) -> list[tuple[int, ...]]:
    """Return the poses of each sensor that do not fit.

    Gross errors hide each other, and bend a fit until sound poses look wrong: where the residuals are too large for a
    sensor, those are named that disagree with most others.
    """
    pose, outlier = fit.residuals.pose, fit.residuals.outlier
    outliers: list[tuple[int, ...]] = [()] * len(pose)
    for at in np.flatnonzero(outlier.any(axis=1)).tolist():
        outliers[at] = tuple(pose[at, outlier[at]].tolist())
    if fit.solution is None or fit.settings.robust != "none":
        return outliers
    bent = (fit.s > LARGE * fit.settings.g) | (outlier.sum(axis=1) > 1) | fit.at_wall.any(axis=1)
    bent &= np.array([word != "undetermined" for word in fit.geometry.observability.verdicts])
    if not bent.any():
        return outliers
    from accelcal_cli.calibration.consensus import consensus

    for at in np.flatnonzero(bent).tolist():
        agreeing = consensus(fit.sample.take(np.array([at])), fit.settings)
        if agreeing is not None and not agreeing.all():
            outliers[at] = tuple(np.flatnonzero(~agreeing).tolist())
    return outliers


def _advice(fit: Fit, at: int, unchecked: Bool) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the poses that would bring a sensor to a good verdict, in words, and why it is not, in sentences."""
    known, aligned = fit.solution is None, not fit.settings.misalignment
    freedom, poses = int(fit.freedom[at]), int(fit.sample.poses[at])
    attitudes = int(fit.geometry.attitudes[at])
    view, fewest = fit.geometry.observability[at], FEWEST_KNOWN if known else FEWEST_POSES
    suggestions: tuple[str, ...] = ()
    if not known and view.verdict != "good":
        suggestions = poses_to_add(fit.geometry.information[at], attitudes, aligned=aligned)
    lines = (
        []
        if view.verdict == "good"
        else list(view.in_words("The known attitudes" if known else "The poses", suggestions))
    )
    if not known and attitudes < poses and view.verdict != "good":
        lines.insert(0, f"The {poses:,} poses have {attitudes} different attitudes, and those decide.")
    if unchecked.any():
        which = [fit.sample.where(at, pose) for pose in fit.residuals.pose[at, unchecked].tolist()]
        lines.append(
            f"No other pose checks {_listed(which)}: an error there would not show. Take at least {FEWEST_POSES + 1}."
        )
    number = {4: "four", 6: "six", 9: "nine"}.get(poses - freedom, str(poses - freedom))
    if freedom < 0:
        lines.insert(0, f"{poses} poses are fewer than the {number} parameters; take at least {fewest}.")
    if freedom == 0:
        number = {4: "Four"}.get(poses, number.capitalize())
        left = "nothing checks the fit" if fit.spread.freedom[at] > 0 else "no uncertainty can be given"
        lines.append(f"{number} poses leave no degrees of freedom, so {left}. Take at least {fewest}.")
    beyond = ", ".join(edge_names(fit.at_wall[at]))
    if beyond and view.verdict != "undetermined":  # of poses that leave a valley, the wall only ends it
        lines.append(f"The least cost lies outside the search box, beyond {beyond}.")
    return suggestions, tuple(lines)


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


def _may_have_warnings(fit: Fit, left: Float) -> Bool:
    """Return which sensors `_warnings` has something to say of, or might have, shape (R,)."""
    g, s, settings, spread = fit.settings.g, fit.s, fit.settings, fit.spread
    noisy = (s > LARGE * g) | (fit.bias > 0).any(axis=1) | (fit.clusters > 0)
    noisy |= fit.largest_misalignment > TURNED
    noisy |= (spread.ratio >= MORE_THAN_NOISE) | (spread.ratio <= LESS_THAN_NOISE)
    searched = (left > STOPPED_SHORT) | (fit.search.agreeing < fit.search.runs)
    searched |= fit.at_wall.any(axis=1) | (fit.geometry.attitudes < _fewest_attitudes(fit))
    always = bool(odd_gravity(g)) or not settings.misalignment or fit.solution is None
    always |= settings.nominal is not None or fit.sample.temperature is not None
    always |= fit.solution is not None and fit.solution.stated.tremor is not None
    return np.asarray(noisy | searched | fit.sample.doubtful | fit.residuals.outlier.any(axis=1) | always)


def _are_more_than_noise(fit: Fit) -> Bool:
    """Return whose residuals are surely more than what the scatter within the poses predicts, shape (R,)."""
    return np.asarray((fit.spread.ratio >= MORE_THAN_NOISE) & (fit.spread.p_more <= SURELY))


def _patterns_in_words(bent: float, drift: float, limit: float) -> tuple[Notice, ...]:
    """Return warnings of patterns in the residuals, by their p-values and the limit of these."""
    drifts = (
        f"The residuals drift from the first pose to the last (p = {drift:.1g}): the bias changed meanwhile."
    )
    bends = (
        f"The residuals bend with the direction (p = {bent:.1g}), as those of a sensor that is not linear."
    )
    warm_up = "Let the sensor warm up first, or add a column of temperatures."
    again = "Measure again to be sure; scale factors and biases then hold for these attitudes alone."
    found = ((drift, drifts, warm_up), (bent, bends, again))
    return tuple(
        Notice("residuals", "warning", text, remedy) for chance, text, remedy in found if chance < limit
    )


def _drift(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return a warning of temperatures that are not used although a drift with them may bias the parameters."""
    degrees, residuals, solution = fit.sample.temperature, fit.residuals, fit.solution
    if degrees is None or solution is None or solution.slopes is not None or not fit.settings.temperature:
        return ()
    warmth, weight = degrees[at, residuals.pose[at]], residuals.weight[at]
    if not np.isfinite(warmth).all() or residuals.pose.shape[1] < int(fit.sample.poses[at]):
        return ()
    from accelcal_cli.calibration.temperature import drift_unseen

    more = bool(_are_more_than_noise(fit)[at])
    return drift_unseen(
        unit(residuals.force[at]), weight, warmth, float(fit.s[at]), fit.settings.g, shown=more
    )


def _fewest_attitudes(fit: Fit) -> int:
    """Return how many attitudes the parameters need at least."""
    return 4 if fit.solution is None else 9 if fit.settings.misalignment else int((~ALIGNED).sum())


def _warnings(fit: Fit, at: int, left: float, outliers: tuple[int, ...]) -> tuple[Notice, ...]:
    """Return what is said of a sensor, the gravest first."""
    settings, s, freedom = fit.settings, float(fit.s[at]), int(fit.freedom[at])
    where = [fit.sample.where(at, pose) for pose in outliers]
    loss: Loss = "known" if fit.solution is None else "plain" if settings.robust == "none" else "robust"
    lines = [
        *fit.sample.warnings(at),
        *_few_attitudes(fit, at),
        *not_fitting(where, freedom, loss),
        *large_residuals(s, settings.g, freedom, aligned=not settings.misalignment),
        *_large_misalignment(float(fit.largest_misalignment[at])),
    ]
    if fit.solution is None:
        return (*lines, *_turned_round(fit.K[at]))
    walled = bool(fit.at_wall[at].any()) and fit.geometry.observability[at].verdict != "undetermined"
    spread = fit.spread
    return (
        *((WALLED,) if walled else ()),
        *lines,
        *_against_labels(fit, at),
        *more_than_noise(float(spread.ratio[at]), float(spread.p_more[at]), freedom),
        *_less_than_noise(fit, at),
        *_noise_bias(fit, at),
        *_tremor(fit, at),
        *_correlated(fit, at),
        *_drift(fit, at),
        *_unfinished(int(fit.search.agreeing[at]), fit.search.runs, left),
        *(() if settings.misalignment else (PERPENDICULAR,)),
        *odd_gravity(settings.g),
        *_off_nominal(fit, at),
    )


def _few_attitudes(fit: Fit, at: int) -> tuple[Notice, ...]:
    attitudes, fewest = int(fit.geometry.attitudes[at]), _fewest_attitudes(fit)
    if attitudes >= fewest or fit.solution is None:
        return ()
    text = f"The readings have {attitudes} different attitudes, fewer than the {fewest} parameters."
    faces = fit.settings.misalignment and attitudes >= int((~ALIGNED).sum())
    remedy = f"Take {FEWEST_POSES} poses or more" + (
        ", or add --no-misalignment for scale and bias alone" if faces else ""
    )
    return (Notice("few-attitudes", "warning", text, remedy + "."),)


def _large_misalignment(angle: float) -> tuple[Notice, ...]:
    if not angle > TURNED:
        return ()
    text = (
        f"Two axes miss 90 degrees by {angle * 1e3:,.0f} mrad: axes are swapped in some poses, a reading is wrong, or "
        "the poses turn about too few axes."
    )
    return (Notice("large-misalignment", "warning", text, "Look at the worst poses, or add --robust huber."),)


def _less_than_noise(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return a warning of residuals far below the noise that the scatter within the poses predicts."""
    ratio, chance = float(fit.spread.ratio[at]), float(fit.spread.p_less[at])
    # Rows of labelled poses, and no rounding.
    told = fit.sample.labelled[at] and fit.s[at] > NO_NOISE * fit.settings.g
    if not (told and ratio <= LESS_THAN_NOISE and chance <= SURELY_LESS) or _shakes(fit, at):
        return ()
    text = (
        f"The residuals are {ratio:.2g} times what the scatter within the poses predicts: readings of two sensors are "
        "mixed in each pose, or readings are copies."
    )
    remedy = "Choose one sensor with --where COLUMN=VALUE, and leave copies out."
    return (Notice("several-sensors", "warning", text, remedy),)


def _noise_bias(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return what was done about the noise bias, and a warning where too much of it may remain."""
    bias, sigma = fit.bias[at], fit.sigma[at]
    if not (bias > 0).any() or not np.isfinite(sigma).any():
        return ()
    noise, left = fit.s[at] / fit.settings.g, float(np.nanmax(bias / np.where(sigma > 0, sigma, np.inf)))
    if left > MATTERS:
        text = (
            f"Noise of {noise:.2%} of g in each reading biases the parameters; that is taken off, but "
            f"{left:.1f} sigma may remain."
        )
        remedy = "Average the readings of each pose first (a column that labels the pose)."
        return (Notice("noise-bias", "warning", text, remedy),)
    text = f"Noise biases a parameter by over {NOTABLE_BIAS:g} sigma; that is taken off."
    return (Notice("noise-bias", "note", text),)


def _shakes(fit: Fit, at: int) -> bool:
    """Whether the readings of a sensor tremble in their poses."""
    tremor = None if fit.solution is None else fit.solution.stated.tremor
    return tremor is not None and bool(tremor.sure[at])


def _tremor(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return what was done about a trembling hand, and a warning where too much of it may remain."""
    tremor = None if fit.solution is None else fit.solution.stated.tremor
    if tremor is None or not _shakes(fit, at):
        return ()
    angle, g = float(tremor.angle[at]), fit.settings.g
    counted = tremor.excess[at, : int(fit.sample.poses[at])]
    short = float(np.mean(counted)) / g**2
    least = np.nan_to_num(fit.sigma[at, SCALE], nan=np.inf).min()
    left = float(tremor.doubt[at] / least)
    text = (
        f"The sensor trembled by {angle * 1e3:.2g} mrad within the poses, which shortens their mean by "
        f"{short * 1e6:,.0f} ppm; that is given back"
    )
    if not left > MATTERS:
        return (Notice("tremor", "note", text + "."),)
    remedy = "Put the sensor down in each pose, or hold it against something."
    return (Notice("tremor", "warning", f"{text}, but {left:.1f} sigma may remain.", remedy),)


def _correlated(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return what was done about rows that follow each other, and a warning where they are too few for an interval."""
    clusters, own = int(fit.clusters[at]), float(fit.spread.freedom[at])
    if not clusters:
        return ()
    text = (
        f"The rows follow each other and are not independent: sigma is by {clusters:,} groups of them, with {own:.1f} "
        "degrees of freedom"
    )
    if own >= FEWEST_FREEDOM:
        return (Notice("correlated", "note", text + "."),)
    remedy = "Turn the sensor to more attitudes, or label the poses in a column."
    return (Notice("correlated", "warning", text + ", too few to rely on.", remedy),)


def _off_nominal(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return a warning of scale factors that are all off a stated nominal sensor by the same."""
    if fit.settings.nominal is None:
        return ()
    off = np.linalg.norm(fit.lower[at], axis=1) / np.array(fit.settings.nominal.scale) - 1.0
    if not (abs(off.mean()) > NEAR_NOMINAL and np.ptp(off) < ALIKE * abs(off.mean())):
        return ()
    text = (
        f"All scale factors are {off.mean():+.2%} off the stated nominal sensor, as they would be if g were "
        f"{fit.settings.g * (1.0 + off.mean()):.6g} rather than {fit.settings.g:.6g}."
    )
    return (
        Notice("wrong-gravity", "warning", text, "State yours with --g, or with --latitude and --height."),
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
    named = _listed(outliers)
    one = len(outliers) == 1
    subject = f"Outlier: {named} does" if one else f"Outliers: {named} do"
    them = "it" if one else "them"
    severity: Severity = "note" if loss == "robust" else "warning"
    remedy = f"Measure {them} again{' or add --robust huber' if loss == 'plain' else ''}."
    blame = freedom <= FEW and not one
    doubt = " With so few poses one can take the blame of another." if blame else ""
    rejected = f" The robust loss counts {them} little." if loss == "robust" else ""
    text = f"{subject} not fit the other poses (p < {OUTLIER_LEVEL}).{doubt}{rejected}"
    return (Notice("outliers", severity, text, remedy),)


def _listed(poses: Sequence[str]) -> str:
    """Return the names of poses, MOST_NAMED of them at most."""
    more = f" and {len(poses) - MOST_NAMED:,} more" if len(poses) > MOST_NAMED else ""
    return ", ".join(poses[:MOST_NAMED]) + more


def more_than_noise(ratio: float, chance: float, freedom: int) -> tuple[Notice, ...]:
    """Return what is said of residuals of so many times the noise that the scatter predicts, and its p-value.

    Sigma counts them: what moves the poses at random is in the intervals. With few degrees of freedom nothing tells
    that from an error that goes with the direction, which biases the parameters.
    """
    if not (ratio >= MORE_THAN_NOISE and chance <= SURELY):
        return ()
    text = (
        f"The residuals are {ratio_in_words(ratio)} times what the scatter within the poses explains: the sensor "
        "moved in them, changed its temperature or is not linear."
    )
    if freedom <= FEW_TO_CHECK and chance <= SURELY / 100:
        text += (
            f" Sigma counts that as noise, but {freedom} degrees of freedom do not tell whether it is random."
        )
        remedy = "Take 18 poses or more, faces among them, and let the sensor warm up first."
        return (Notice("residuals", "warning", text, remedy),)
    text += " Sigma counts that as noise."
    remedy = "Let the sensor warm up, fix it in each pose, or add a column of temperatures."
    return (Notice("residuals", "note", text, remedy),)


def ratio_in_words(ratio: float) -> str:
    """Return a ratio with two digits, or more where it is large."""
    return f"{ratio:.2g}" if ratio < 100 else f"{ratio:,.0f}"


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


SAID = 0.5
"""Least part of the force along an axis at which a label that calls this axis up or down can be contradicted."""


def _against_labels(fit: Fit, at: int) -> tuple[Notice, ...]:
    """Return a note of axes that the fit has the other way round than most labels that say which way is up."""
    if fit.view[at].verdict == "undetermined":
        return ()
    residuals, real = fit.residuals, fit.residuals.real[at]
    votes = np.zeros((3, 2), dtype=int)  # of each axis: labels that the fit bears out, and others
    for pose, force in zip(residuals.pose[at, real].tolist(), residuals.force[at, real], strict=True):
        said = axis_up(fit.sample.where(at, pose))
        if said is not None:
            axis, up = said
            part = up * float(force[axis]) / fit.settings.g
            votes[axis] += (part > SAID, part < -SAID)
    turned = votes[:, 1] > votes[:, 0]
    if not turned.any():
        return ()
    names = " and ".join(axis for axis, other in zip(AXES, turned, strict=True) if other)
    if (turned | (votes.sum(axis=1) == 0)).all():
        text = (
            f"By the labels of the poses every axis that they name ({names}) points the other way than in the fit, "
            "which cannot tell f from -f: the sensor may count gravity instead of specific force, and f comes out "
            "with the other sign."
        )
        remedy = "If the labels are right, turn the sign of all three columns."
    else:
        text = (
            f"By the labels of the poses axis {names} points the other way than in the fit, which cannot tell a sensor "
            "from its mirror image."
        )
        remedy = f"If the labels are right, turn the sign of column {names}."
    return (Notice("negative-axes", "note", text, remedy),)
