"""From a raw log to static poses: thresholds tried, the best one kept, close poses merged."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.calibration.attitudes import attitudes, directions_of
from accelcal_cli.calibration.candidates import Candidate, best, judge, readings_of
from accelcal_cli.calibration.complaint import nearest, too_few
from accelcal_cli.calibration.screening import screen
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.envelope import Envelope
from accelcal_cli.sensor.intervals import Intervals, find_intervals, merge
from accelcal_cli.sensor.rawlog import RawLog
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.sensor.spans import Rows, Spans
from accelcal_cli.sensor.static import Level, find_level
from accelcal_cli.sensor.tiles import read_tiles
from accelcal_cli.sensor.units import STANDARD_GRAVITY

MULTIPLIERS = (2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, 50.0, 100.0)
"""Tried when none is stated; [tedaldi2014] tries 2 to 10 times the variance of a marked still period."""


@dataclass(frozen=True)
class DetectSettings:
    """How poses are found.

    Attributes:
        spans: window, still period, least length, trim.
        rate: rows a second, Hz; that of the time column when None.
        multipliers: of the level; the best one is kept.
        merge: poses within this angle become one, degrees; thin: only the longest of them stays, degrees.
        least_poses: attitudes that must be found, candidates.DISTINCT degrees apart.
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
class Detection:
    """Static poses of a raw log and how they were found.

    Attributes:
        source, sha256, columns: of the log; log_rows: its rows; notes: what a user should know of it.
        rate: rows a second, Hz, or None; rows: the lengths used.
        level: what the multipliers multiply; multiplier: the one kept; candidates: all of them.
        intervals: the poses.
        envelope: of the log, for a picture; None unless asked for.
    """

    source: str
    sha256: str
    columns: tuple[str, str, str]
    log_rows: int
    rate: float | None
    rows: Rows
    level: Level
    multiplier: float
    candidates: tuple[Candidate, ...]
    intervals: Intervals
    settings: DetectSettings
    notes: tuple[str, ...]
    envelope: Envelope | None = None

    def readings(self) -> Readings:
        """Return the poses as readings that carry the origin of the log."""
        notes = (*self.notes, self.summary())
        return readings_of(self.intervals, self.source).known_as(
            self.sha256, self.columns, notes, self.intervals.where
        )

    def summary(self) -> str:
        """Say what was found, and with which settings, in one sentence."""
        rows = self.rows
        by = "the quietest windows" if rows.still is None else f"the first {rows.still:,} rows"
        tried = f", the best of {len(self.candidates)}" if len(self.candidates) > 1 else ""
        return (
            f"{len(self.intervals)} still intervals found in {self.log_rows:,} rows: variance over {rows.window} rows "
            f"up to {self.multiplier:g} times that of {by} ({self.level.variance:.4g}){tried}; at least {rows.least} "
            f"rows, {rows.trim} trimmed off each end."
        )


class TooFewPosesError(DataError):
    """No multiplier finds attitudes enough; `found` is what the one that comes nearest finds."""

    def __init__(self, message: str, found: Detection) -> None:
        """Keep what was found, for a picture."""
        super().__init__(message)
        self.found = found


def detect(log: RawLog, settings: DetectSettings, picture: bool = False) -> Detection:
    """Find the static poses of a raw log in one pass.

    Of several multipliers the one is kept whose calibration has the least sigma in its worst parameter, among those
    of the best verdict with enough attitudes: a longer list of poses counts only as far as the attitudes differ.
    Of those that come within 5 % of it the smallest multiplier is kept.

    Raises:
        UsageError: lengths that do not fit the log. DataError: unreadable.
        TooFewPosesError: it says what was seen.
    """
    rate = settings.rate if settings.rate is not None else log.clock.rate
    rows = settings.spans.rows(rate)
    envelope = Envelope(rows.tile) if picture else None
    tiles = read_tiles(log, rows, envelope)
    level = find_level(tiles, rows, log.name)
    found = find_intervals(tiles, rows, level, settings.multipliers)
    candidates = tuple(judge(f, settings.g) for f in found)
    enough = [k for k, c in enumerate(candidates) if c.attitudes >= settings.least_poses]
    kept = best(enough, candidates) if enough else nearest(found, candidates)
    intervals = found[kept].intervals
    gaps = tiles.gaps.notes(log.clock.unit)
    detection = Detection(
        source=log.name,
        sha256=log.sha256,
        columns=log.columns.names,
        log_rows=tiles.rows,
        rate=rate,
        rows=rows,
        level=level,
        multiplier=candidates[kept].multiplier,
        candidates=candidates,
        intervals=_thinned(intervals, settings) if enough else intervals,
        settings=settings,
        notes=(*log.notes, *gaps),
        envelope=envelope,
    )
    if not enough:
        why = too_few(found, candidates, level, rows, settings.least_poses)
        raise TooFewPosesError("; ".join([f"{log.name}: {why}", *gaps]), detection)
    return detection


def _thinned(intervals: Intervals, settings: DetectSettings) -> Intervals:
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
