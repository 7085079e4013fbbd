"""Still intervals of a raw log: where they are, and mean and scatter of their readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.static import Level, runs
from accelcal_cli.sensor.tiles import Tiles

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Intervals:
    """I still intervals, in order.

    Attributes:
        start, end: first and last row, counted from 1, shape (I,).
        n: rows averaged, shape (I,).
        mean: shape (I, 3), sensor units; scatter: standard deviation of one row, shape (I, 3), sensor units.
        time: of first and last row, shape (I, 2), as in the log; None without.
    """

    start: Ints
    end: Ints
    n: Ints
    mean: Floats
    scatter: Floats
    time: Floats | None = None

    def __len__(self) -> int:
        """I."""
        return len(self.n)

    def take(self, index: NDArray[np.intp]) -> Intervals:
        """Return the intervals at `index`."""
        return Intervals(
            self.start[index],
            self.end[index],
            self.n[index],
            self.mean[index],
            self.scatter[index],
            None if self.time is None else self.time[index],
        )

    def where(self, i: int) -> str:
        """How to name an interval (from 0) to the user: ``rows 888 to 1357``, or by its times."""
        if self.time is not None:
            return f"time {self.time[i, 0]:.10g} to {self.time[i, 1]:.10g}"
        return f"rows {self.start[i]} to {self.end[i]}"


@dataclass(frozen=True)
class Found:
    """What one multiplier finds.

    Attributes:
        multiplier: of the level.
        intervals: the still intervals that are long enough.
        short: rows of those that are not, after trimming, shape (s,).
    """

    multiplier: float
    intervals: Intervals
    short: Ints


def find_intervals(tiles: Tiles, rows: Rows, level: Level, multipliers: Sequence[float]) -> list[Found]:
    """Return the still intervals of a log for every multiplier of the level."""
    found = []
    firsts, lasts = runs(tiles, rows, level, multipliers)
    for multiplier, first, last in zip(multipliers, firsts, lasts, strict=True):
        a, b = _trimmed(first, last, rows)
        length = (b - a) * tiles.size
        enough = length >= rows.least
        intervals = _measure(tiles, a[enough], b[enough])
        found.append(Found(multiplier, intervals, length[~enough]))
    return found


def _trimmed(first: Ints, last: Ints, rows: Rows) -> tuple[Ints, Ints]:
    """Return first tile and end tile of each run of windows, without its edges.

    The windows of two runs may share tiles; the middle of what they share parts them.
    """
    trim = -(-rows.trim // rows.tile)
    a, b = first + trim, last + rows.width - trim
    middle = (a[1:] + b[:-1]) // 2
    overlap = b[:-1] > a[1:]
    b[:-1] = np.where(overlap, middle, b[:-1])
    a[1:] = np.where(overlap, middle, a[1:])
    return a, np.maximum(a, b)


def _measure(tiles: Tiles, a: Ints, b: Ints) -> Intervals:
    """Return the intervals of tiles a to b - 1, each shape (I,), read from the tiles in one pass."""
    count, mean, square = np.zeros(len(a)), np.zeros((len(a), 3)), np.zeros((len(a), 3))
    time = np.full((len(a), 2), np.nan)
    for first, block in tiles.blocks():
        low, high = np.clip(a - first, 0, len(block)), np.clip(b - first, 0, len(block))
        here = np.flatnonzero(high > low)
        if not len(here):
            continue
        part = _sums(block[:, :6], low[here], high[here], tiles.size)
        count[here], mean[here], square[here] = _joined((count[here], mean[here], square[here]), part)
        if tiles.timed:
            begins = a[here] >= first
            time[here[begins], 0] = block[low[here[begins]], -2]
            time[here, 1] = block[high[here] - 1, -1]
    n = count.astype(np.int64)
    scatter = np.sqrt(square / np.maximum(n - 1, 1)[:, None])
    return Intervals(a * tiles.size + 1, b * tiles.size, n, mean, scatter, time if tiles.timed else None)


Moments = tuple[Floats, Floats, Floats]


def _sums(block: Floats, low: Ints, high: Ints, size: int) -> Moments:
    """Return rows (I,), mean (I, 3) and squares about it (I, 3) of the tiles low to high - 1 of a block."""
    tiles = high - low
    begin = np.cumsum(tiles) - tiles
    owner = np.repeat(np.arange(len(low)), tiles)
    inside = block[np.arange(len(owner)) + (low - begin)[owner]]
    centre: Floats = block[low, :3]  # about a tile of the interval itself the sums stay small
    off = inside[:, :3] - centre[owner]
    shift: Floats = np.add.reduceat(off, begin) / tiles[:, None]
    between = np.add.reduceat((off - shift[owner]) ** 2, begin)
    within: Floats = np.add.reduceat(inside[:, 3:], begin)
    count: Floats = (tiles * size).astype(np.float64)
    square: Floats = within + size * between
    return count, centre + shift, square


def _joined(one: Moments, two: Moments) -> Moments:
    """Return the moments of two sets of rows taken together."""
    n = one[0] + two[0]
    part = (two[0] / n)[:, None]
    step = two[1] - one[1]
    return n, one[1] + step * part, one[2] + two[2] + step**2 * part * one[0][:, None]


def merge(intervals: Intervals, groups: Sequence[Ints]) -> Intervals:
    """Return one interval for each group: it spans them all, and its rows are theirs taken together."""
    first = np.array([group.min() for group in groups], dtype=np.intp)
    last = np.array([group.max() for group in groups], dtype=np.intp)
    n, mean, square = [], [], []
    for group in groups:
        rows, centre = intervals.n[group], intervals.mean[group]
        total = rows.sum()
        middle = (rows[:, None] * centre).sum(axis=0) / total
        within = ((rows - 1)[:, None] * intervals.scatter[group] ** 2).sum(axis=0)
        n.append(total)
        mean.append(middle)
        # Scatter within the intervals: how they differ is the attitude's, not the noise of a reading.
        square.append(np.sqrt(within / max(total - len(group), 1)))
    time = intervals.time
    spans = None if time is None else np.stack([time[first, 0], time[last, 1]], axis=1)
    joined = replace(intervals.take(first), end=intervals.end[last], time=spans)
    return replace(joined, n=np.array(n), mean=np.array(mean), scatter=np.array(square))
