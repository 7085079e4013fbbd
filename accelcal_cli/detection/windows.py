"""Where a raw log is still: windows of little variance, in runs that last [tedaldi2014].

A window is still when the norm of the variances of the three axes is at most a multiple of that of a still period
[tedaldi2014] section IV-B; the still period is stated, or the quietest windows stand for it. With a gyroscope the
window must not turn either: slow rotation moves gravity less than the noise of a cheap accelerometer hides.

A raw log reduced, in one pass, to short tiles of rows: their means and the squares about them.

Everything that comes later (windows, thresholds, intervals) is computed from the tiles, so that a log is read once
whatever is tried. Tiles are counted from the first row of the log and squares are taken about each tile's own mean:
the result does not depend on the blocks that the rows come in, to the last bit, and nothing cancels.

Least and greatest value of each axis in a bounded number of bins, for a picture of a log of any length.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.detection.rawlog import UNITS, Clock, RawLog, RawRows
from accelcal_cli.errors import UsageError
from accelcal_cli.io.stream import RowStore

IN_MEMORY = 1_000_000
"""Tiles kept in memory: a day of 100 Hz with windows of 1 s; more go to a temporary file."""

BLOCK = 65536
"""Tiles worked on at a time."""


@dataclass(frozen=True)
class Limit:
    """What counts as a gap.

    Attributes:
        longest: step that is none, in the unit of the time column; inf where there is no time.
    """

    longest: float = np.inf

    @classmethod
    def of(cls, clock: Clock, rows: Rows) -> Limit:
        """Return the limit of a log: a window, and LATE periods at least."""
        return cls() if clock.period is None else cls(max(rows.window, LATE) * clock.period)

    def late(self, start: Float, end: Float, before: float) -> tuple[Bool, Bool]:
        """Return whether there is a gap before and within each tile, shape (B,) each.

        Several within a tile, a tenth of a window, are one: what counts is that the tile lasts too long.

        Args:
            start, end: time of first and last row of each tile, shape (B,).
            before: time of the row before the first tile.
        """
        return start - np.append(before, end[:-1]) > self.longest, end - start > self.longest

    def spanned(self, start: Float, end: Float, width: int) -> Bool:
        """Return which windows of `width` tiles have a gap in them, shape (B - width + 1,)."""
        before, within = self.late(start, end, start[0])
        count = np.append(0, np.cumsum(before.astype(np.int64) + within))
        found: Bool = count[width:] - count[:-width] > before[: len(start) - width + 1]
        return found


NO_GAP = Limit()


class Tiles:
    """Means and squares of tiles of `size` rows; a rest shorter than a tile is left out.

    Attributes:
        size: rows of a tile.
        gyro, timed: whether the log has a gyroscope and time.
        rows: rows of the log, those left out included.
        gaps: those of the time column.
    """

    def __init__(self, size: int, gyro: bool, timed: bool, limit: Limit = NO_GAP) -> None:
        """Start without tiles; `limit` says what is a gap."""
        self.size, self.gyro, self.timed = size, gyro, timed
        self.gaps = Gaps(limit)
        self.rows = 0
        self._store = RowStore(6 + 6 * gyro + 2 * timed, IN_MEMORY)
        self._rest: Float | None = None

    @property
    def count(self) -> int:
        """Number of tiles."""
        return self._store.rows

    def add(self, raw: RawRows, envelope: Envelope | None = None) -> None:
        """Take in the next rows; an `envelope` sees them too."""
        block = np.ascontiguousarray(raw.numbers.T)  # (k, B): one column after the other
        self.rows += block.shape[1]
        if self._rest is not None and self._rest.shape[1]:
            need = self.size - self._rest.shape[1]
            self._rest = np.concatenate([self._rest, block[:, :need]], axis=1)
            block = block[:, need:]
            if self._rest.shape[1] < self.size:
                return
            self._reduce(self._rest, envelope)
        whole = block.shape[1] // self.size * self.size
        self._reduce(block[:, :whole], envelope)
        self._rest = block[:, whole:].copy()

    def _reduce(self, block: Float, envelope: Envelope | None) -> None:
        """Store the tiles of a block of whole tiles, shape (k, m size)."""
        tiles = block.shape[1] // self.size
        if not tiles:
            return
        sensors = 6 if self.gyro else 3
        out = np.empty((tiles, self._store.width))
        for k in range(sensors):
            part = block[k].reshape(tiles, self.size)
            at = k if k < 3 else k + 3  # mean, squares, mean of the gyroscope, its squares
            mean = np.add.reduce(part, axis=1) / self.size
            off = part - mean[:, None]
            out[:, at] = mean
            out[:, at + 3] = np.einsum("ij,ij->i", off, off)
        if self.timed:
            time = block[-1].reshape(tiles, self.size)
            out[:, -2], out[:, -1] = time[:, 0], time[:, -1]
            self.gaps.see(time)
        self._store.append(out)
        if envelope is not None:
            envelope.add(block[:3].reshape(3, tiles, self.size), block[-1] if self.timed else None)

    def blocks(self, overlap: int = 0) -> Iterator[tuple[int, Float]]:
        """Yield (first tile, block (B, width)); each block begins with the last `overlap` tiles of the one before."""
        tail: Float | None = None
        for first, block in self._store.blocks(BLOCK):
            joined = block if tail is None else np.concatenate([tail, block])
            yield first - (0 if tail is None else len(tail)), joined
            tail = joined[max(0, len(joined) - overlap) :] if overlap else None


def read_tiles(log: RawLog, rows: Rows, envelope: Envelope | None = None) -> Tiles:
    """Read a log to its end and return its tiles."""
    gyro, timed = log.columns.gyro is not None, log.columns.time is not None
    tiles = Tiles(rows.tile, gyro, timed, Limit.of(log.clock, rows))
    for raw in log.blocks():
        tiles.add(raw, envelope)
    return tiles


MOST = 4096
"""Bins kept at most: more than a picture has columns of dots; then two become one."""


class Envelope:
    """Least and greatest value of three axes, bin by bin.

    Attributes:
        per_bin: tiles in a bin, a power of two.
    """

    def __init__(self, size: int) -> None:
        """Start without rows; a tile has `size` rows."""
        self.size = size
        self.per_bin = 1
        self._low: Float = np.empty((0, 3))
        self._high: Float = np.empty((0, 3))
        self._time: Float = np.empty(0)
        self._open: list[tuple[Float, Float, float]] = []  # tiles that do not fill a bin yet

    def add(self, tiles: Float, time: Float | None) -> None:
        """Take in tiles, shape (3, m, size), and the time of each of their rows, shape (m size,)."""
        low, high = tiles.min(axis=2).T, tiles.max(axis=2).T
        start = np.full(len(low), np.nan) if time is None else time[:: self.size]
        if self._open:
            parts = zip(*self._open, strict=True)
            old_low, old_high, old_start = (np.array(part) for part in parts)
            low, high = np.concatenate([old_low, low]), np.concatenate([old_high, high])
            start = np.concatenate([old_start, start])
        whole = len(low) // self.per_bin * self.per_bin
        self._open = list(zip(low[whole:], high[whole:], start[whole:], strict=True))
        self._low = np.concatenate([self._low, _fold(low[:whole], self.per_bin, np.minimum)])
        self._high = np.concatenate([self._high, _fold(high[:whole], self.per_bin, np.maximum)])
        self._time = np.concatenate([self._time, start[: whole : self.per_bin]])
        while len(self._low) > MOST:
            self._halve()

    def _halve(self) -> None:
        """Join bins two by two; a last one without a partner waits among the open tiles."""
        whole = len(self._low) // 2 * 2
        odd = [(self._low[-1], self._high[-1], float(self._time[-1]))] if whole < len(self._low) else []
        if odd:  # as one bin of the old size: its tiles are filled up with its own extent
            self._open = odd * self.per_bin + self._open
        self._low = _fold(self._low[:whole], 2, np.minimum)
        self._high = _fold(self._high[:whole], 2, np.maximum)
        self._time = self._time[:whole:2]
        self.per_bin *= 2

    def bins(self) -> tuple[Float, Float, Float]:
        """Return first row (b,) or time (b,) where there is time, least and greatest output (b, 3) of each bin."""
        low, high, time = self._low, self._high, self._time
        if self._open:
            parts = zip(*self._open, strict=True)
            rest_low, rest_high, rest_time = (np.array(part) for part in parts)
            low = np.concatenate([low, rest_low.min(axis=0, keepdims=True)])
            high = np.concatenate([high, rest_high.max(axis=0, keepdims=True)])
            time = np.concatenate([time, rest_time[:1]])
        if not np.isnan(time).any():
            return time, low, high
        rows = np.arange(len(low), dtype=np.float64) * (self.size * self.per_bin)
        return rows, low, high


def _fold(values: Float, by: int, join: np.ufunc) -> Float:
    folded: Float = join.reduce(values.reshape(-1, by, 3), axis=1)
    return folded


_SPAN = re.compile(r"(.*?)\s*(s|sec|seconds|r|row|rows|samples)?", re.IGNORECASE)


TILES = 10
"""Tiles in a window: it slides by a tenth of its length."""


WINDOW_SECONDS, WINDOW_ROWS = 1.0, 101
"""Default window [tedaldi2014]: one second, or as many rows as that paper's at 100 Hz when nothing tells the rate."""


LEAST_SECONDS, LEAST_ROWS = 1.0, 100
"""Default least length of a still interval, after its edges are trimmed."""


MOST_ROWS = 10_000_000


@dataclass(frozen=True)
class Span:
    """A length of time: `value` seconds, or rows."""

    value: float
    in_rows: bool = False

    def rows(self, rate: float | None, option: str) -> int:
        """Return the number of rows, at least 0; UsageError for seconds without a rate in Hz."""
        if not self.in_rows and rate is None:
            raise UsageError(
                f"{option} {self.value:g}: the log has no time column to count seconds by; state --rate, or rows "
                f'as in "{option} 100rows"'
            )
        count = self.value if self.in_rows else self.value * (rate or 0.0)
        if not count <= MOST_ROWS:
            raise UsageError(f"{option} {self.value:g}: at most {MOST_ROWS:,} rows are possible")
        return round(count)


def parse_span(text: str | None, option: str) -> Span | None:
    """Read "1.5", "1.5s" (seconds) or "150rows"; UsageError names the `option`."""
    if text is None:
        return None
    match = _SPAN.fullmatch(text.strip())
    try:
        value = float(match[1]) if match else math.nan
    except ValueError:
        value = math.nan
    if match is None or not (math.isfinite(value) and value >= 0):
        raise UsageError(f'{option} "{text}": expected seconds, as in 1.5, or rows, as in 150rows')
    in_rows = (match[2] or "s").lower()[0] == "r" or (match[2] or "").lower() == "samples"
    if in_rows and value != int(value):
        raise UsageError(f'{option} "{text}": expected a whole number of rows')
    return Span(value, in_rows)


@dataclass(frozen=True)
class Rows:
    """The lengths in rows.

    Attributes:
        tile: rows of a tile; width: tiles of a window.
        still: still period at the beginning, None when the quietest windows stand for it.
        least: of an interval after trimming; trim: taken off each of its ends.
    """

    tile: int
    width: int
    still: int | None
    least: int
    trim: int

    @property
    def window(self) -> int:
        """Rows of a window."""
        return self.tile * self.width


@dataclass(frozen=True)
class Spans:
    """The lengths as stated; None for the default. By default half a window is trimmed off each end."""

    window: Span | None = None
    still: Span | None = None
    least: Span | None = None
    trim: Span | None = None

    def rows(self, rate: float | None) -> Rows:
        """Return the lengths in rows of a log of `rate` Hz, None when it is not known.

        Raises:
            UsageError: seconds without a rate, a window of fewer than 2 rows, a still period below a window.
        """
        window = self._of(self.window, rate, "--window", WINDOW_SECONDS, WINDOW_ROWS)
        if window < 2:
            raise UsageError(f"--window: {window} rows are too few to have a variance; expected 2 or more")
        tile = max(1, window // TILES)
        width = max(2, round(window / tile))
        still = None if self.still is None else self.still.rows(rate, "--still")
        if still is not None and still < tile * width:
            raise UsageError(
                f"--still: {still} rows are fewer than the {tile * width} of a window (--window)"
            )
        least = self._of(self.least, rate, "--min-length", LEAST_SECONDS, LEAST_ROWS)
        trim = tile * width // 2 if self.trim is None else self.trim.rows(rate, "--trim")
        return Rows(tile, width, still, max(least, 1), trim)

    @staticmethod
    def _of(span: Span | None, rate: float | None, option: str, seconds: float, rows: int) -> int:
        if span is None:
            span = Span(rows, True) if rate is None else Span(seconds)
            return max(2, span.rows(rate, option))
        return span.rows(rate, option)


LATE = 10
"""Periods that a row may come late, however short the window: a logger pauses when it writes to its card."""


class Gaps:
    """The gaps of a log, in constant memory.

    Attributes:
        count: gaps seen; largest: step among them; after: time before it, to a tile; in the unit of the time column.
    """

    def __init__(self, limit: Limit) -> None:
        """Start without any."""
        self.limit = limit
        self.count, self.largest, self.after = 0, 0.0, 0.0
        self._last: float | None = None

    def see(self, time: Float) -> None:
        """Take in the times of the next tiles, shape (B, rows of a tile)."""
        start, end = time[:, 0], time[:, -1]
        last = float(start[0]) if self._last is None else self._last
        self._last = float(end[-1])
        before, within = self.limit.late(start, end, last)
        if before.any():
            ends = np.append(last, end[:-1])[before]
            self._count(start[before] - ends, ends)
        if within.any():
            self._count(np.diff(time[within], axis=1).max(axis=1), start[within])

    def _count(self, steps: Float, after: Float) -> None:
        """Count gaps, each with its step and the time before it, shape (k,)."""
        k = int(np.argmax(steps))
        self.count += len(steps)
        if steps[k] > self.largest:
            self.largest, self.after = float(steps[k]), float(after[k])

    def notes(self, unit: str) -> list[str]:
        """Say what was seen, if anything, in one sentence; `unit` is that of the time column."""
        where = f"{self.largest * UNITS[unit]:.4g} s after time {self.after:.10g}; no pose goes across"
        if self.count < 2:
            return [f"the time column has a gap of {where} it"] * self.count
        return [f"the time column has {self.count:,} gaps, the largest of {where} them"]
