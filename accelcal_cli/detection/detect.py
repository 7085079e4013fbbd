"""From a raw log to static poses: thresholds are tried, the best one is kept, close poses are merged on request.

Each threshold is judged by a quick calibration with the poses that it finds (`screen`): its verdict, and the sigma of
its worst parameter. Where no threshold finds enough poses, `TooFewPosesError` says what there is and what would help.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.fit import QuickFit, quick_fit
from accelcal_cli.calibration.observability import APART, attitudes, directions_of
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.intervals import (
    Intervals,
    Segmentation,
    StillLevel,
    find_intervals,
    find_level,
    merge,
    sample_windows,
)
from accelcal_cli.detection.log_screening import Liveliness, alternating, check_gravity
from accelcal_cli.detection.rawlog import RawLog, open_raw_log
from accelcal_cli.detection.windows import Envelope, RowLengths, Spans, Tiles, parse_span, read_tiles
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import InputForm, Readings
from accelcal_cli.io.screening import LOOKED_AT, Behind, Screened
from accelcal_cli.io.stream import Source
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.model import STANDARD_GRAVITY, local_gravity

MULTIPLIERS = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0)
"""Tried when none is stated; [tedaldi2014] tries 2 to 10 times the variance of a marked still period."""

TIE = 1.05
"""Sigmas up to this factor apart are the same: the smallest multiplier, the stillest poses, then decides."""

ORDER = ("good", "weak", "undetermined")
"""Verdicts, the best first."""

MOVING = 0.05
"""A quietest window that scatters by more than this part of the range of the readings is not still."""


@dataclass(frozen=True)
class DetectSettings:
    """How the poses of a log are found.

    Attributes:
        spans: window, still period, least length, trim.
        rate: rows per second, Hz; that of the time column when None.
        multipliers: of the still level; the best one is kept.
        merge: poses within this angle become one, degrees; thin: only the longest of them stays, degrees.
        least_poses: attitudes that must be found, APART degrees apart.
        g: local gravity, m/s^2.
    """

    spans: Spans = field(default_factory=Spans)
    rate: float | None = None
    multipliers: tuple[float, ...] = MULTIPLIERS
    merge: float | None = None
    thin: float | None = None
    least_poses: int = 12
    g: float = STANDARD_GRAVITY


@dataclass(frozen=True)
class CandidateThreshold:
    """What a multiplier leads to.

    Attributes:
        multiplier: of the still level; poses: intervals found; attitudes: how many of them differ.
        rms: of |f| - g of a calibration with them, m/s^2; NaN where there are too few.
        sigma: of its worst parameter, as m/s^2 at 1 g, as if each attitude counted once; inf where there are too few.
        verdict: good, weak or undetermined.
    """

    multiplier: float
    poses: int
    attitudes: int
    rms: float = math.nan
    sigma: float = math.inf
    verdict: str = "undetermined"


def screened_poses(
    intervals: Intervals, source: str, columns: tuple[str, str, str], behind: Behind | None, *, warm: bool
) -> tuple[Notice, ...]:
    """Return what the poses of a log show that are no readings of a sensor at rest.

    Args:
        intervals: the poses; source, columns: of the log; behind: the rows behind them; warm: whether they have
            temperatures.
    """
    first = slice(LOOKED_AT)
    screened = Screened(
        intervals.mean[first],
        columns,
        len(intervals),
        intervals.where,
        source,
        single=False,
        warm=warm,
        count=intervals.n[first].astype(float),
        scatter=intervals.scatter[first],
        behind=behind,
    )
    return screened.notices()


@dataclass(frozen=True)
class Detection:
    """Static poses of a raw log and how they were found.

    Attributes:
        source, sha256, columns: of the log; log_rows: its rows; notes: what a user should know of it.
        rate: rows per second, Hz, or None; rows: the lengths used.
        level: what the multipliers apply to; multiplier: the one kept; candidates: all of them.
        intervals: the poses.
        form: of the file.
        envelope: of the log, for a picture; None unless asked for.
        warnings: what the rows show that is no rest.
        behind: the first rows of acceleration and the extremes of all, sensor units; None where they are not known.
        time_unit: of the times of the poses; began: date and time of the first row, None where they are not known.
    """

    source: str
    sha256: str
    columns: tuple[str, str, str]
    log_rows: int
    rate: float | None
    rows: RowLengths
    level: StillLevel
    multiplier: float
    candidates: tuple[CandidateThreshold, ...]
    intervals: Intervals
    settings: DetectSettings
    notes: tuple[str, ...]
    form: InputForm
    envelope: Envelope | None = None
    warnings: tuple[Notice, ...] = ()
    behind: Behind | None = None
    time_unit: str = "s"
    began: np.datetime64 | None = None

    def readings(self) -> Readings:
        """Return the poses as readings that carry the origin of the log."""
        intervals, notes = self.intervals, (*self.notes, self.summary())
        readings = readings_of(intervals, self.source)
        said = {notice.key for notice in self.warnings}
        warm = readings.temperature is not None
        found = screened_poses(intervals, self.source, self.columns, self.behind, warm=warm)
        more = [notice for notice in found if notice.key not in said]
        return readings.known_as(
            self.sha256, self.columns, notes, intervals.where, (*self.warnings, *more), self.form
        )

    def summary(self) -> str:
        """Return what was found, and with which settings, in one sentence."""
        rows = self.rows
        by = "the quietest windows" if rows.still is None else f"the first {rows.still:,} rows"
        tried = f", the best of {len(self.candidates)}" if len(self.candidates) > 1 else ""
        return (
            f"{len(self.intervals)} still intervals found in {self.log_rows:,} rows: variance over {rows.window} rows "
            f"up to {self.multiplier:g} times that of {by} ({self.level.variance:.4g}){tried}; at least {rows.least} "
            f"rows, {rows.trim} trimmed off each end."
        )


class TooFewPosesError(DataError):
    """No multiplier finds enough attitudes; `detection` is that of the multiplier that comes nearest."""

    def __init__(self, message: str, detection: Detection) -> None:
        """Keep the detection, for a picture."""
        super().__init__(message)
        self.detection = detection


def detect(
    log: RawLog | Source,
    settings: DetectSettings | None = None,
    picture: bool = False,
    *,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
    **keys: Any,
) -> Detection:
    """Find the static poses of a raw log in one pass; with `picture` keep its envelope.

    Of several multipliers the one is kept whose calibration has the least sigma in its worst parameter, among those
    of the best verdict with enough attitudes: a longer list of poses counts only as far as the attitudes differ.
    Of those that come within 5 % of it the smallest multiplier is kept.

    Args:
        log: a file, a frame, or an open log.
        settings: how the poses are found; the defaults, with `keys`, when None.
        picture: keep what a picture of the log needs.
        columns: the three columns of acceleration; gyro: of turning rate; time: a column; see `read_log`.
        keys: `window`, `still`, `min_length`, `trim` in seconds or as "150rows"; `min_poses`; `rate`, `multipliers`,
            `merge`, `thin` of `DetectSettings`; `g`, or `latitude` with `height`.

    Raises:
        UsageError: lengths that do not fit the log. DataError: unreadable.
        TooFewPosesError: no multiplier finds enough attitudes; the message says what was found.

    Examples:
        >>> from accelcal_cli import calibrate, detect, simulate
        >>> log = simulate("mems", positions=13, raw=True, seed=2)
        >>> detection = detect(log)
        >>> len(detection.intervals), calibrate(detection).verdict
        (13, 'good')
    """
    if isinstance(log, RawLog):
        return _detected(log, settings or settings_for(log.columns.unit, **keys), picture)
    opened = open_raw_log(log, columns, gyro, time)
    try:
        return detect(opened, settings, picture, **keys)
    finally:
        opened.close()


def settings_for(unit: str | None, **keys: Any) -> DetectSettings:
    """Return the settings of a detection for readings in a unit, see `detect`."""
    spans = {
        name: parse_span(str(keys.pop(key)), key)
        for key, name in (("window",) * 2, ("still",) * 2, ("min_length", "least"), ("trim",) * 2)
        if keys.get(key) is not None
    }
    if "min_poses" in keys:
        keys["least_poses"] = keys.pop("min_poses")
    place = {name: keys.pop(name, None) for name in ("g", "latitude", "height")}
    g = local_gravity(unit, **place)
    return DetectSettings(spans=Spans(**spans), g=STANDARD_GRAVITY if g is None else g, **keys)


def _detected(log: RawLog, settings: DetectSettings, picture: bool) -> Detection:
    rate = settings.rate if settings.rate is not None else log.clock.rate
    lengths = settings.spans.rows(rate)
    envelope = Envelope(lengths.tile) if picture else None
    head, times = _parted(log)
    in_turn = alternating(head, times)
    tiles = read_tiles(log, lengths, envelope)
    level, lively = _screened(tiles, lengths, log)
    segmentations = find_intervals(tiles, lengths, level, settings.multipliers)
    candidates = tuple(evaluate(segmentation, settings.g) for segmentation in segmentations)
    enough = [k for k, c in enumerate(candidates) if c.attitudes >= settings.least_poses]
    kept = best(enough, candidates) if enough else nearest(segmentations, candidates)
    intervals = segmentations[kept].intervals
    gaps = tiles.gaps.notes(log.clock.unit)
    shown = intervals if not enough else _combine(intervals, settings)
    warnings = (
        *in_turn,
        *lively.clipped(shown, log.columns.names),
        *lively.notices(tiles.size),
        *log.zero_rows(tiles.rows),
    )
    detection = Detection(
        source=log.name,
        sha256=log.sha256,
        columns=log.columns.names,
        log_rows=tiles.rows,
        rate=rate,
        rows=lengths,
        level=level,
        multiplier=candidates[kept].multiplier,
        candidates=candidates,
        intervals=shown,
        settings=settings,
        notes=(*log.notes, *gaps),
        form=replace(log.form, rows=tiles.rows, rate_hz=rate),
        warnings=warnings,
        envelope=envelope,
        behind=Behind(head, tiles.low, tiles.high),
        time_unit=log.clock.unit,
        began=log.began,
    )
    if not enough:
        why = explain_too_few(segmentations[kept], candidates[kept], detection)
        seen = [notice.text.rstrip(".") for notice in warnings]
        raise TooFewPosesError("; ".join([f"{log.name}: {why}", *seen, *gaps]), detection)
    return detection


def _parted(log: RawLog) -> tuple[Float, Float | None]:
    """Return acceleration and time of the first rows of a log."""
    head = log.head()
    return head[:, :3], None if log.columns.time is None else head[:, -1]


def _screened(tiles: Tiles, lengths: RowLengths, log: RawLog) -> tuple[StillLevel, Liveliness]:
    """Leave out what is frozen, and return what counts as still in the rest; DataError where no gravity turns."""
    sample = sample_windows(tiles, lengths, log.name)
    level = find_level(tiles, lengths, log.name, sample)
    lively = Liveliness.of(tiles, level)
    tiles.unusable = lively.unusable(tiles)
    if lively.frozen:
        sample = sample_windows(tiles, lengths, log.name)
        level = find_level(tiles, lengths, log.name, sample)
    check_gravity(sample, level, log.name, log.columns.names, log.gyro_names())
    return level, lively


def evaluate(segmentation: Segmentation, g: float) -> CandidateThreshold:
    """Calibrate with the intervals of a threshold, at local gravity g, m/s^2."""
    multiplier, intervals = segmentation.multiplier, segmentation.intervals
    poses = len(intervals)
    if poses < 2 or not np.ptp(intervals.mean, axis=0).any():
        return CandidateThreshold(multiplier, poses, min(poses, 1))
    quick = screen(readings_of(intervals, "log"), g)
    distinct = len(attitudes(directions_of(intervals.mean, quick.model), intervals.n, APART))
    sigma = quick.sigma * math.sqrt(poses / distinct)
    return CandidateThreshold(
        multiplier, poses, distinct, quick.rms, sigma if math.isfinite(sigma) else math.inf, quick.verdict
    )


def best(enough: Sequence[int], candidates: Sequence[CandidateThreshold]) -> int:
    """Return which of the candidates numbered in `enough` to keep: best verdict, then least sigma, then stillest."""
    verdict = min(ORDER.index(candidates[k].verdict) for k in enough)
    enough = [k for k in enough if candidates[k].verdict == ORDER[verdict]]
    least = min(candidates[k].sigma for k in enough)
    return min(
        (k for k in enough if candidates[k].sigma <= TIE * least), key=lambda k: candidates[k].multiplier
    )


def nearest(segmentations: Sequence[Segmentation], candidates: Sequence[CandidateThreshold]) -> int:
    """Return which of several multipliers comes nearest to enough poses."""
    return max(
        range(len(candidates)),
        key=lambda k: (candidates[k].attitudes, candidates[k].poses, len(segmentations[k].turning)),
    )


def _combine(intervals: Intervals, settings: DetectSettings) -> Intervals:
    """Merge or thin poses that are closer than the stated angle."""
    angle = settings.merge if settings.merge is not None else settings.thin
    if angle is None:
        return intervals
    model = screen(readings_of(intervals, "log"), settings.g).model
    groups = attitudes(directions_of(intervals.mean, model), intervals.n, angle)
    if settings.merge is None:
        return intervals.take(np.sort(np.array([group[0] for group in groups])))
    groups.sort(key=lambda group: int(group.min()))
    return merge(intervals, groups)


def readings_of(intervals: Intervals, source: str) -> Readings:
    """Return the intervals as readings, not screened: mean, count, scatter and temperature of each."""
    degrees = intervals.temperature
    return Readings.from_array(
        intervals.mean,
        source=source,
        count=intervals.n,
        scatter=intervals.scatter,
        temperature=None if degrees is None or np.isnan(degrees).all() else degrees,
        warnings=(),
    )


def explain_too_few(segmentation: Segmentation, count: CandidateThreshold, detection: Detection) -> str:
    """Say why no multiplier finds enough attitudes, and what would help, by what the nearest one leads to."""
    level, least, multiplier = detection.level, detection.settings.least_poses, count.multiplier
    poses, alike = _counted(count.poses, "still pose"), _counted(count.attitudes, "attitude")
    return "; ".join(
        [
            f"{poses} in {alike}, fewer than {least}"
            if count.poses
            else f"no still pose, {least} are needed",
            f"quietest variance {level.quietest:.4g}, threshold {multiplier * level.variance:.4g} "
            f"(multiplier {multiplier:g})",
            _describe_lengths(segmentation, detection.rows),
            _advise(segmentation, count, detection),
        ]
    )


def _describe_lengths(segmentation: Segmentation, rows: RowLengths) -> str:
    short, turning = segmentation.short, segmentation.turning
    whole = [n + 2 * rows.trim for n in segmentation.intervals.n.tolist()] + short.tolist()
    if not whole and not len(turning):
        return "no window is below it"
    parts = []
    if whole:
        parts.append(
            f"longest still stretch {max(whole):,} rows, of which {rows.trim:,} are trimmed off each end"
        )
    if len(short):
        parts.append(f"{_stretches(short)} too short for a least length of {rows.least:,}")
    if len(turning):
        parts.append(f"{_stretches(turning)} left out because the sensor turns while they last")
    return "; ".join(parts)


def _advise(segmentation: Segmentation, count: CandidateThreshold, detection: Detection) -> str:
    """Name the setting, or the handling, that most likely helps."""
    level, least = detection.level, detection.settings.least_poses
    short, turning = segmentation.short, segmentation.turning
    restless = math.sqrt(level.quietest) > MOVING * level.extent
    if count.poses >= least and not (restless and len(turning)):
        return "turn the sensor to more attitudes, or accept fewer with --min-poses"
    if restless:
        return (
            "no part of the log is still: even its quietest window scatters by "
            f"{math.sqrt(level.quietest):.3g} where the readings change by {level.extent:.3g}"
        )
    if len(turning) > count.poses:
        return "put the sensor down, or hold it against something, in each pose: it turns slowly all the time"
    if count.poses + np.count_nonzero(short > 1.5 * detection.rows.window) >= least:
        return "hold each pose longer, or lower --min-length or --trim"
    return (
        "record more poses held still; if the log has more, try --multiplier above "
        f"{max(detection.settings.multipliers):g}, a shorter --window or a lower --min-length"
    )


def _counted(number: int, what: str) -> str:
    plural = "" if number == 1 else "es" if what.endswith("ch") else "s"
    return f"{number:,} {what}{plural}"


def _stretches(lengths: Int) -> str:
    low, high = int(lengths.min()), int(lengths.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{_counted(len(lengths), 'stretch')} of {span} rows"


def screen(readings: Readings, g: float) -> QuickFit:
    """Calibrate readings that carry count and scatter, weighted by both and by what the poses share."""
    return quick_fit(readings, Settings("levenberg-marquardt", g=g, weights="auto"))
