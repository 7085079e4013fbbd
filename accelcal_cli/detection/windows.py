"""A raw log reduced, in one pass, to tiles and the windows that slide over them.

A tile is a short run of rows, of which the means and the squares about them are kept. Everything that comes later
(windows, thresholds, intervals) is computed from the tiles, so that a log is read once whatever is tried. Tiles are
counted from the first row of the log and squares are taken about each tile's own mean: the result does not depend on
the blocks that the rows come in, to the last bit, and nothing cancels.

`Spans` are the lengths as a user states them, `RowLengths` what they are in rows. `Gaps` are those of the time column:
what is before and after one is not the same pose. `Envelope` keeps the extent of the log for a picture.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.detection.rawlog import RawLog
from accelcal_cli.errors import UsageError
from accelcal_cli.io.clock import UNITS, Clock
from accelcal_cli.io.stream import RowStore

IN_MEMORY = 1_000_000
"""Tiles kept in memory: a day of 100 Hz with windows of 1 s; more go to a temporary file."""

BLOCK = 65536
"""Tiles processed at a time."""

TILES = 10
"""Tiles in a window: it slides by a tenth of its length."""

WINDOW_SECONDS, WINDOW_ROWS = 1.0, 101
"""Default window [tedaldi2014]: one second, or as many rows as that paper's at 100 Hz when the rate is unknown."""

LEAST_SECONDS, LEAST_ROWS = 1.0, 100
"""Default least length of a still interval, after its edges are trimmed."""

MOST_ROWS = 10_000_000
"""Rows of a stated length at most."""

LATE = 10
"""Periods that a row may come late, however short the window: a logger pauses when it writes to its card."""

MOST_BINS = 4096
"""Bins of an envelope at most: more than a picture has columns of dots; then two become one."""

_SPAN = re.compile(
    r"(\+?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*(?:(s|sec|seconds)|(r|row|rows|samples))?", re.IGNORECASE
)


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
    value = float(match[1]) if match else math.inf
    if match is None or value == math.inf:
        raise UsageError(f'{option} "{text}": expected seconds, as in 1.5, or rows, as in 150rows')
    in_rows = match[3] is not None
    if in_rows and value != int(value):
        raise UsageError(f'{option} "{text}": expected a whole number of rows')
    return Span(value, in_rows)


@dataclass(frozen=True)
class RowLengths:
    """Lengths in rows.

    Attributes:
        tile: rows of a tile; width: tiles of a window.
        still: still period at the beginning, None when the quietest windows take its place.
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

    def rows(self, rate: float | None) -> RowLengths:
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
        return RowLengths(tile, width, still, max(least, 1), trim)

    @staticmethod
    def _of(span: Span | None, rate: float | None, option: str, seconds: float, rows: int) -> int:
        if span is not None:
            return span.rows(rate, option)
        return max(2, rows if rate is None else Span(seconds).rows(rate, option))


def longest_step(clock: Clock, lengths: RowLengths) -> float:
    """Return the longest step of the time column that is no gap, in its unit: a window, and LATE periods at least.

    Where rows come in bursts, or times are rounded, a pause of the usual length comes on top.
    """
    return math.inf if clock.period is None else max(lengths.window, LATE) * clock.period + clock.pause


class Gaps:
    """The gaps of a log, in constant memory.

    They show in the first and the last time of each tile: only the rows of a tile that lasts too long are looked at.

    Attributes:
        longest: step that is no gap, in the unit of the time column; inf where there is no time.
        count: gaps so far; largest: step among them; after: time before it, to a tile; in the same unit.
    """

    def __init__(self, longest: float = math.inf) -> None:
        """Start without any."""
        self.longest = longest
        self.count, self.largest, self.after = 0, 0.0, 0.0
        self._last: float | None = None

    def add(self, time: Float) -> None:
        """Add the times of the next tiles, shape (B, rows of a tile)."""
        start, end = time[:, 0], time[:, -1]
        last = float(start[0]) if self._last is None else self._last
        self._last = float(end[-1])
        before, within = self.late(start, end, last)
        if before.any():
            ends = np.append(last, end[:-1])[before]
            self._count(start[before] - ends, ends)
        if within.any():
            self._count(np.diff(time[within], axis=1).max(axis=1), start[within])

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
        return np.asarray(count[width:] - count[:-width] > before[: len(start) - width + 1])

    def notes(self, unit: str) -> list[str]:
        """Say what gaps there are, if any, in one sentence; `unit` is that of the time column."""
        where = f"{self.largest * UNITS[unit]:.4g} s after time {self.after:.10g}; no pose goes across"
        if self.count < 2:
            return [f"the time column has a gap of {where} it"] * self.count
        return [f"the time column has {self.count:,} gaps, the largest of {where} them"]

    def _count(self, steps: Float, after: Float) -> None:
        """Count gaps, each with its step and the time before it, shape (k,)."""
        k = int(np.argmax(steps))
        self.count += len(steps)
        if steps[k] > self.largest:
            self.largest, self.after = float(steps[k]), float(after[k])


class Tiles:
    """Means and squares of tiles of `size` rows; a rest shorter than a tile is left out.

    Attributes:
        size: rows of a tile.
        gyro, timed, warm: whether the log has a gyroscope, time and temperature.
        rows: rows of the log, those left out included.
        low, high: least and greatest reading of each axis, shape (3,), sensor units.
        unusable: which tiles of a block are no readings, shape (B,); None for those of zeros alone.
        gaps: those of the time column.
    """

    def __init__(
        self, size: int, gyro: bool, timed: bool, longest: float = math.inf, *, warm: bool = False
    ) -> None:
        """Start without tiles; a step of the time column that is longer than `longest` is a gap."""
        self.size, self.gyro, self.timed, self.warm = size, gyro, timed, warm
        self.gaps = Gaps(longest)
        self.rows = 0
        self.warm_at = 6 + 6 * gyro
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.unusable: Callable[[Float], Bool] = _are_zero
        self._store = RowStore(6 + 6 * gyro + warm + 2 * timed, IN_MEMORY)
        self._rest: Float | None = None

    @property
    def count(self) -> int:
        """Number of tiles."""
        return self._store.rows

    def add(self, rows: Float, envelope: Envelope | None = None) -> None:
        """Add the next rows, shape (B, k) as those of a RawLog; an `envelope` gets them, too."""
        block = np.ascontiguousarray(rows.T)  # (k, B): one column after the other
        self.rows += block.shape[1]
        if block.shape[1]:
            self.low = np.minimum(self.low, block[:3].min(axis=1))
            self.high = np.maximum(self.high, block[:3].max(axis=1))
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
        out = np.empty((tiles, self._store.width))
        for k in range(6 if self.gyro else 3):
            part = block[k].reshape(tiles, self.size)
            at = k if k < 3 else k + 3  # mean, squares, mean of the gyroscope, its squares
            mean = np.add.reduce(part, axis=1) / self.size
            off = part - mean[:, None]
            out[:, at] = mean
            out[:, at + 3] = np.einsum("ij,ij->i", off, off)
        if self.warm:
            out[:, self.warm_at] = _known_mean(block[6 if self.gyro else 3].reshape(tiles, self.size))
        if self.timed:
            time = block[-1].reshape(tiles, self.size)
            out[:, -2], out[:, -1] = time[:, 0], time[:, -1]
            self.gaps.add(time)
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


def read_tiles(log: RawLog, lengths: RowLengths, envelope: Envelope | None = None) -> Tiles:
    """Read a log to its end and return its tiles."""
    gyro, timed = log.columns.gyro is not None, log.columns.time is not None
    warm = log.columns.temperature is not None
    tiles = Tiles(lengths.tile, gyro, timed, longest_step(log.clock, lengths), warm=warm)
    for rows in log.blocks():
        tiles.add(rows, envelope)
    return tiles


def _known_mean(rows: Float) -> Float:
    """Return the mean of each row without its NaN, shape (B,); NaN where there is nothing else."""
    mean: Float = np.add.reduce(rows, axis=1) / rows.shape[1]
    gappy = np.isnan(mean)
    if gappy.any():
        known = np.isfinite(rows[gappy])
        total, count = np.where(known, rows[gappy], 0.0).sum(axis=1), known.sum(axis=1)
        mean[gappy] = np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0)
    return mean


@dataclass(frozen=True)
class Windows:
    """A block of sliding windows, one per tile.

    Attributes:
        first: number of the first window, that of its first tile.
        mean: shape (B, 3); variance: norm of the variances, shape (B,).
        rate: mean of the gyroscope, shape (B, 3); spread: sum of its variances, shape (B,).
        broken: whether there is a gap in time in it, shape (B,).
    """

    first: int
    mean: Float
    variance: Float
    rate: Float
    spread: Float
    broken: Bool

    def turning(self, bias: Float) -> Float:
        """Return the mean square of the turning rate about its bias, shape (B,)."""
        return np.asarray(self.spread + ((self.rate - bias) ** 2).sum(axis=1))


def windows(tiles: Tiles, width: int, step: int = 1) -> Iterator[Windows]:
    """Yield every `step`-th window of `width` tiles, block by block."""
    for first, block in tiles.blocks(overlap=width - 1):
        if len(block) < width:
            continue
        start = (-first) % step
        take = slice(start, len(block) - width + 1, step)
        mean, variance = _window(block[:, :6], tiles.size, width, take)
        rate, spread = np.zeros_like(variance), np.zeros(variance.shape[1])
        if tiles.gyro:
            rate, turned = _window(block[:, 6:12], tiles.size, width, take)
            spread = turned.sum(axis=0)
        gaps = tiles.gaps.spanned(block[:, -2], block[:, -1], width) if tiles.timed else None
        broken = _any_of(tiles.unusable(block), width)[start::step]
        if gaps is not None:
            broken |= gaps[start::step]
        norm = np.sqrt(variance[0] ** 2 + variance[1] ** 2 + variance[2] ** 2)
        yield Windows(first + start, mean.T, norm, rate.T, spread, broken)


def _are_zero(block: Float) -> Bool:
    """Return which tiles are zero in all axes and rows: an idle logger, not a sensor at rest."""
    return np.asarray((block[:, :6] == 0).all(axis=1))


def _any_of(tiles: Bool, width: int) -> Bool:
    """Return which windows of `width` tiles have any of these, shape (B - width + 1,)."""
    count = np.append(0, np.cumsum(tiles))
    return np.asarray(count[width:] > count[:-width])


def _window(moments: Float, size: int, width: int, take: slice) -> tuple[Float, Float]:
    """Return mean and variance, each (3, windows), of the windows of `width` tiles that begin at `take`."""
    parts = [moments[take.start + k : take.stop + k : take.step].T.copy() for k in range(width)]
    centre: Float = np.add.reduce([part[:3] for part in parts]) / width
    square = np.zeros_like(centre)
    for part in parts:
        off = part[:3] - centre
        square += part[3:] + size * off * off
    return centre, square / (size * width)


class Envelope:
    """Least and greatest value of three axes in a bounded number of bins, for a picture of a log of any length.

    Attributes:
        per_bin: tiles in a bin, a power of two.
    """

    def __init__(self, size: int) -> None:
        """Start without rows; a tile has `size` rows."""
        self.size, self.per_bin = size, 1
        # Least output, negative greatest output and first time of each bin, (b, 7): bins are joined by the minimum.
        self._bins: Float = np.empty((0, 7))
        self._open = self._bins  # tiles that do not fill a bin yet

    def add(self, tiles: Float, time: Float | None) -> None:
        """Add tiles, shape (3, m, size), and the time of each of their rows, shape (m size,)."""
        start = np.full(tiles.shape[1], np.nan) if time is None else time[:: self.size]
        least = np.column_stack([tiles.min(axis=2).T, -tiles.max(axis=2).T, start])
        self._open = np.concatenate([self._open, least])
        whole = len(self._open) // self.per_bin * self.per_bin
        full, self._open = self._open[:whole], self._open[whole:]
        self._bins = np.concatenate([self._bins, _fold(full, self.per_bin)])
        while len(self._bins) > MOST_BINS:
            self._halve()

    def bins(self) -> tuple[Float, Float, Float]:
        """Return first row (b,) or time (b,) where there is time, least and greatest output (b, 3) of each bin."""
        bins = np.concatenate([self._bins, _fold(self._open, max(len(self._open), 1))])
        low, high, time = bins[:, :3], -bins[:, 3:6], bins[:, 6]
        first = np.arange(len(bins), dtype=np.float64) * (self.size * self.per_bin)
        return first if np.isnan(time).any() else time, low, high

    def _halve(self) -> None:
        """Join bins two by two; a last one without a partner waits among the open tiles."""
        whole = len(self._bins) // 2 * 2
        # As a bin of the old size it fills up its tiles with its own extent.
        self._open = np.concatenate([np.repeat(self._bins[whole:], self.per_bin, axis=0), self._open])
        self._bins = _fold(self._bins[:whole], 2)
        self.per_bin *= 2


def _fold(bins: Float, by: int) -> Float:
    return np.asarray(bins.reshape(-1, by, 7).min(axis=1))
