"""Days of wear: the windows in which a worn sensor rests, the poses that they make, and the figures of GGIR.

A window of 10 s is at rest where no axis scatters by more than 13 mg [vanhees2014], or than the sensor itself does.
What is no rest, though still: windows across a gap, and those that repeat one reading, as idle loggers do. Windows that
follow each other in one attitude and at one temperature are one pose: a watch on a table for hours is a few poses and
not thousands. Where the poses of other temperatures than usual are too few to tell slopes, as those of a watch that was
taken off once, they are left out. Poses near in time share what the sensor drifts by: their readings say so.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.observability import (
    APART,
    WEAK,
    Observability,
    attitudes,
    design,
    directions_of,
    unit,
)
from accelcal_cli.calibration.result import Calibration, Worn
from accelcal_cli.calibration.temperature import FEWEST_FOR_SLOPES, SMALLEST_RANGE
from accelcal_cli.detection.detect import readings_of, screen, screened_poses
from accelcal_cli.detection.intervals import ROUNDING, Intervals
from accelcal_cli.detection.rawlog import RawLog
from accelcal_cli.detection.windows import Span, Tiles
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import InputForm, Readings
from accelcal_cli.io.screening import Behind
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.model import OUTPUT_OF_1_G, STANDARD_GRAVITY

WINDOW = 10.0
"""s, of a window."""

STILL, OWN_NOISE = 0.013, 1.2
"""Standard deviation of each axis up to which a window is at rest: in g, or as many times that of the sensor."""

MOST_STILL = 0.05
"""g: what scatters by more is no sensor at rest, however noisy."""

QUIETEST = 0.02
"""Part of the windows whose noise is that of the sensor."""

LARGEST = 2.0
"""g: the mean of an axis at rest is below."""

LATE = 1.1
"""A window that lasts longer than its rows by this factor has a gap in it."""

TILT, WARMTH = 1.0, 1.0
"""Degrees of angle, and degrees Celsius, by which windows of one pose differ from its first: the mean over a cap of
1 degree is shorter than its vectors by 0.04 mg."""

SPHERE = 0.3
"""g: each axis has rested beyond this on both sides where the sphere counts as filled [vanhees2014]."""

CALM = 0.25
"""Part of the windows, the quietest, whose length is that of 1 g where the unit does not say."""


@dataclass(frozen=True)
class WornSettings:
    """How rest is found in days of wear.

    Attributes:
        rate: rows per second, Hz; that of the time column when None.
        least_poses: attitudes that must be found, APART degrees apart; g: local gravity in the unit of the readings.
        slopes: whether slopes with temperature are fitted where the poses determine them.
    """

    rate: float | None = None
    least_poses: int = 12
    g: float = STANDARD_GRAVITY
    slopes: bool = True


@dataclass(frozen=True)
class RestWindows:
    """W windows at rest.

    Attributes:
        number: of each window, from 0, shape (W,); mean, square: of its rows, and their squares about it, shape (W, 3).
        time: of first and last row, shape (W, 2), or None; temperature: shape (W,), or None.
        rows: of a window.
    """

    number: Int
    mean: Float
    square: Float
    time: Float | None
    temperature: Float | None
    rows: int

    def __len__(self) -> int:
        """W."""
        return len(self.number)


@dataclass(frozen=True)
class Wear:
    """What a worn sensor read at rest.

    Attributes:
        source, sha256, columns, notes, form: of the log; warnings: what its rows show that is no rest.
        settings: how it was found; limit: standard deviation of an axis at rest, and size: of 1 g, sensor units.
        windows: at rest; intervals: the poses that they make; hours: that the log lasts, gaps left out.
        behind: the first rows of acceleration and the extremes of all, sensor units.
    """

    source: str
    sha256: str
    columns: tuple[str, str, str]
    notes: tuple[str, ...]
    form: InputForm
    warnings: tuple[Notice, ...]
    settings: WornSettings
    limit: float
    size: float
    windows: RestWindows
    intervals: Intervals
    hours: float
    behind: Behind

    @property
    def rest_hours(self) -> float:
        """Hours at rest."""
        return len(self.windows) * WINDOW / 3600.0

    def readings(self) -> Readings:
        """Return the poses as readings that follow in time and carry the origin of the log."""
        intervals = self.intervals
        readings = replace(readings_of(intervals, self.source), in_time=True)
        said = [notice.key for notice in self.warnings]
        warm = readings.temperature is not None
        found = screened_poses(intervals, self.source, self.columns, self.behind, warm=warm)
        # That a watch on a table is quieter than one on a wrist needs no words.
        more = [notice for notice in found if notice.key not in (*said, "unequal-noise")]
        notes = (*self.notes, self.summary())
        return readings.known_as(
            self.sha256, self.columns, notes, intervals.where, (*self.warnings, *more), self.form
        )

    def summary(self) -> str:
        """Return what was found, in one sentence."""
        return (
            f"{len(self.windows):,} windows of {WINDOW:g} s at rest, "
            f"{self.rest_hours:.3g} of {self.hours:.3g} hours, make {len(self.intervals):,} poses: no axis scatters by "
            f"more than {self.limit:.4g}; a pose lasts while attitude and temperature stay within "
            f"{TILT:g} degree{'s' * (TILT != 1)} each."
        )

    def figures(self, result: Calibration) -> Worn:
        """Return the figures of GGIR for a calibration with these readings.

        The errors are means of | |a| - 1 g | over the windows, after calibration with all that `result` has.
        """
        output, g = self.windows.mean, result.g
        before = np.abs(np.linalg.norm(output, axis=1) / g - 1.0)
        degrees, slopes = self.windows.temperature, result.temperature
        if slopes is not None and degrees is not None:
            output = slopes.at_reference(output, degrees, result.D_a)
        force = result.model.specific_force(output) / g
        after = np.abs(np.linalg.norm(force, axis=1) - 1.0)
        low, high = force.min(axis=0), force.max(axis=0)
        return Worn(
            hours=self.hours,
            rest_hours=self.rest_hours,
            windows=len(output),
            low=low,
            high=high,
            filled=bool((low < -SPHERE).all() and (high > SPHERE).all()),
            error_before=1e3 * float(before.mean()) if self.form.unit in OUTPUT_OF_1_G else math.nan,
            error_after=1e3 * float(after.mean()),
        )


def find_wear(log: RawLog, settings: WornSettings) -> Wear:
    """Find where a worn sensor rests, in one pass over its log.

    Raises:
        UsageError: no rate. DataError: unreadable, no rest, or too few attitudes; the message says what there is.
    """
    rate = settings.rate if settings.rate is not None else log.clock.rate
    rows = max(2, Span(WINDOW).rows(rate, "--worn"))
    head, tiles = log.head()[:, :3], _tiles(log, rows)
    hours = tiles.count * WINDOW / 3600.0
    whole = np.concatenate([block for _, block in tiles.blocks()])
    spread = np.sqrt(whole[:, 3:6].max(axis=1) / rows)
    frozen = spread <= ROUNDING * np.abs(whole[:, :3]).max()
    size = _size_of_1_g(log.columns.unit, whole[:, :3], spread)
    limit = _limit(spread[~frozen], size)
    rest = (spread <= limit) & ~frozen & (np.abs(whole[:, :3]).max(axis=1) < LARGEST * size)
    if tiles.timed:
        rest &= whole[:, -1] - whole[:, -2] <= tiles.gaps.longest
    if not rest.any():
        raise DataError(
            f"{log.name}: no window of {WINDOW:g} s in {hours:.3g} hours is at rest: the quietest scatters by "
            f"{spread.min():.4g}, and {limit:.4g} is the most that counts as rest"
        )
    windows = _windows(tiles, whole, np.flatnonzero(rest))
    intervals, left_out = at_usual_temperature(join(windows, TILT, size), slopes=settings.slopes)
    wear = Wear(
        source=log.name,
        sha256=log.sha256,
        columns=log.columns.names,
        notes=(*log.notes, *tiles.gaps.notes(log.clock.unit), *left_out),
        form=replace(log.form, rows=tiles.rows, rate_hz=rate),
        warnings=(
            *log.zero_rows(tiles.rows),
            *_frozen(int(np.count_nonzero(frozen & whole[:, :3].any(axis=1)))),
        ),
        settings=settings,
        limit=limit,
        size=size,
        windows=windows,
        intervals=intervals,
        hours=hours,
        behind=Behind(head, tiles.low, tiles.high),
    )
    _check_attitudes(wear)
    return wear


def _limit(spread: Float, size: float) -> float:
    """Return the largest standard deviation of an axis at rest, by those of all live windows, shape (T,)."""
    noise = float(np.quantile(spread, QUIETEST)) if len(spread) else 0.0
    return min(max(STILL * size, OWN_NOISE * noise), MOST_STILL * size)


def _windows(tiles: Tiles, whole: Float, at: Int) -> RestWindows:
    """Return the windows numbered in `at`, of all that the tiles hold, shape (T, k)."""
    rest = whole[at]
    return RestWindows(
        number=at,
        mean=rest[:, :3],
        square=rest[:, 3:6],
        time=rest[:, -2:] if tiles.timed else None,
        temperature=_temperature(rest[:, tiles.warm_at]) if tiles.warm else None,
        rows=tiles.size,
    )


def _size_of_1_g(unit: str | None, mean: Float, spread: Float) -> float:
    """Return how many output units are 1 g: by the unit, else by the length of the quietest windows, shape (T, 3)."""
    if unit in OUTPUT_OF_1_G:
        return OUTPUT_OF_1_G[unit]
    quiet = spread <= np.quantile(spread, CALM)
    return float(np.median(np.linalg.norm(mean[quiet], axis=1))) or 1.0


def _temperature(degrees: Float) -> Float | None:
    """Return the temperature of each window, None where one has none."""
    return degrees if np.isfinite(degrees).all() else None


def _frozen(windows: int) -> tuple[Notice, ...]:
    """Return what is said of so many windows that repeat one reading."""
    if not windows:
        return ()
    text = f"{windows:,} windows of {WINDOW:g} s repeat one reading, as an idle logger does: they do not count as rest."
    return (Notice("frozen", "note", text),)


def join(windows: RestWindows, tilt: float, size: float) -> Intervals:
    """Return the poses that windows make.

    Args:
        windows: at rest; tilt: degrees by which those of one pose differ from its first.
        size: of 1 g, sensor units.
    """
    begin = np.array(_begins(windows, math.radians(tilt) * size), dtype=np.intp)
    count = np.diff(begin, append=len(windows))
    mean = np.add.reduceat(windows.mean, begin, axis=0) / count[:, None]
    within = np.add.reduceat(windows.square, begin, axis=0) / (count * (windows.rows - 1))[:, None]
    first, last = begin, begin + count - 1
    time, degrees = windows.time, windows.temperature
    return Intervals(
        start=windows.number[first] * windows.rows + 1,
        end=(windows.number[last] + 1) * windows.rows,
        n=count * windows.rows,
        mean=mean,
        scatter=np.sqrt(within),
        time=None if time is None else np.stack([time[first, 0], time[last, 1]], axis=1),
        temperature=None if degrees is None else np.add.reduceat(degrees, begin) / count,
    )


def _begins(windows: RestWindows, radius: float) -> list[int]:
    """Return the first window of each pose."""
    begins: list[int] = []
    degrees = np.zeros(len(windows)) if windows.temperature is None else windows.temperature
    rows = zip(windows.number.tolist(), windows.mean.tolist(), degrees.tolist(), strict=True)
    last, (x, y, z), warm, limit = -2, (0.0, 0.0, 0.0), 0.0, radius * radius
    for k, (number, (a, b, c), now) in enumerate(rows):
        away = (a - x) ** 2 + (b - y) ** 2 + (c - z) ** 2
        if number != last + 1 or away > limit or abs(now - warm) > WARMTH:
            begins.append(k)
            x, y, z, warm = a, b, c, now
        last = number
    return begins


def at_usual_temperature(intervals: Intervals, *, slopes: bool) -> tuple[Intervals, tuple[str, ...]]:
    """Return the poses near the usual temperature, where they do not determine `slopes` with it, and what is left out.

    Nothing corrects the others then, and they are often of one attitude, which their error would turn the result by.
    """
    degrees = intervals.temperature
    if (
        degrees is None
        or np.ptp(degrees) < SMALLEST_RANGE
        or (slopes and _tell_slopes(intervals.mean, degrees))
    ):
        return intervals, ()
    order = np.argsort(degrees)
    rows = np.cumsum(intervals.n[order])
    usual = float(degrees[order][np.searchsorted(rows, 0.5 * rows[-1])])
    near = np.abs(degrees - usual) <= 0.5 * SMALLEST_RANGE
    left = int(np.count_nonzero(~near))
    note = (
        f"{left:,} poses that are not within {0.5 * SMALLEST_RANGE:g} degrees of the usual {usual:.3g} left out: they "
        "are too few, or in too few attitudes, to tell slopes with temperature"
    )
    return intervals.take(np.flatnonzero(near)), (note,) if left else ()


def _tell_slopes(mean: Float, degrees: Float) -> bool:
    """Return whether poses determine slopes with temperature beside the nine parameters."""
    if len(mean) < FEWEST_FOR_SLOPES:
        return False
    u = unit(mean)
    t = ((degrees - degrees.mean()) / (0.5 * np.ptp(degrees)))[:, None]
    rows = np.hstack([design(u), -u * u * t, u * t])
    observability = Observability.of(rows.T @ rows, len(rows))
    return bool(observability.rank == rows.shape[1] and observability.dop[9:].max() <= WEAK)


def _check_attitudes(wear: Wear) -> None:
    """Refuse a log with too few attitudes at rest."""
    intervals, least = wear.intervals, wear.settings.least_poses
    found = 1
    if len(intervals) > 1 and np.ptp(intervals.mean, axis=0).any():
        model = screen(readings_of(intervals, "log"), wear.settings.g).model
        found = len(attitudes(directions_of(intervals.mean, model), intervals.n, APART))
    if found < least:
        raise DataError(
            f"{wear.source}: rests in {found:,} attitude{'s' * (found != 1)} within {wear.hours:.3g} hours, fewer than "
            f"{least}; a recording of days of wear has more, or accept fewer with --min-poses"
        )


def _tiles(log: RawLog, rows: int) -> Tiles:
    """Read a log to its end, in windows of so many rows."""
    columns, period = log.columns, log.clock.period
    longest = math.inf if period is None else LATE * rows * period + log.clock.pause
    tiles = Tiles(
        rows,
        columns.gyro is not None,
        columns.time is not None,
        longest,
        warm=columns.temperature is not None,
    )
    for block in log.blocks():
        tiles.add(block)
    if not tiles.count:
        raise DataError(f"{log.name}: has {tiles.rows:,} rows, fewer than one window of {rows:,}")
    return tiles
