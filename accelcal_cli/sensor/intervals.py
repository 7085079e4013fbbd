"""Still intervals of a raw log: where they are, and mean and scatter of their readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.static import Level, runs
from accelcal_cli.sensor.tiles import Tiles
from accelcal_cli.streams import Float

Ints = NDArray[np.int64]
Moments = tuple[Float, Float, Float]

STEADY = 0.04
"""Halves of a pose have means that differ by less than this part of half the range of the readings, about 1 g: 2.3
degrees, or 5 degrees turned from end to end."""

BEYOND_NOISE = 5.0
"""Sigmas that halves have to differ by before it is no longer noise, or the beat of a vibration."""


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
    mean: Float
    scatter: Float
    time: Float | None = None

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
        short: rows of those that are not, before trimming, shape (s,).
        turning: rows of those that are, but turn while they last, before trimming, shape (t,).
    """

    multiplier: float
    intervals: Intervals
    short: Ints
    turning: Ints


def find_intervals(tiles: Tiles, rows: Rows, level: Level, multipliers: Sequence[float]) -> list[Found]:
    """Return the still intervals of a log for every multiplier of the level."""
    firsts, lasts = runs(tiles, rows, level, multipliers)
    ends = [_trimmed(first, last, rows) for first, last in zip(firsts, lasts, strict=True)]
    edges = [edge for a, b in ends for edge in (a, (a + b) // 2, b)]
    measured = Atoms.of(tiles, np.unique(np.concatenate(edges)))
    found = []
    for k, (a, b) in enumerate(ends):
        enough = (b - a) * tiles.size >= rows.least
        turning = enough.copy()
        turning[enough] = measured.turning(a[enough], b[enough], level.extent)
        still, whole = enough & ~turning, (lasts[k] - firsts[k] + rows.width) * tiles.size
        intervals = measured.intervals(a[still], b[still])
        found.append(Found(multipliers[k], intervals, whole[~enough], whole[turning]))
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


@dataclass(frozen=True)
class Atoms:
    """Stretches of tiles between all ends of intervals that any multiplier gives, each measured once.

    Attributes:
        tile: rows of a tile; edge: first tile of each atom, and the end of the last, shape (A + 1,).
        moments: rows, mean and squares about it of each atom, shapes (A,), (A, 3), (A, 3).
        time: of the first and last row of each atom, shape (A, 2), or None.
    """

    tile: int
    edge: Ints
    moments: Moments
    time: Float | None

    @classmethod
    def of(cls, tiles: Tiles, edge: Ints) -> Self:
        """Read the tiles between the edges, in one pass."""
        a, b = edge[:-1], edge[1:]
        count, mean, square = np.zeros(len(a)), np.zeros((len(a), 3)), np.zeros((len(a), 3))
        time = np.full((len(a), 2), np.nan)
        for first, block in tiles.blocks():
            low, high = np.clip(a - first, 0, len(block)), np.clip(b - first, 0, len(block))
            here = np.flatnonzero(high > low)
            if not len(here):
                continue
            rows = np.full(len(block), float(tiles.size))
            part = _together((rows, block[:, :3], block[:, 3:6]), low[here], high[here])
            count[here], mean[here], square[here] = _joined((count[here], mean[here], square[here]), part)
            if tiles.timed:
                begins = here[a[here] >= first]
                time[begins, 0] = block[low[begins], -2]
                time[here, 1] = block[high[here] - 1, -1]
        return cls(tiles.size, edge, (count, mean, square), time if tiles.timed else None)

    def intervals(self, a: Ints, b: Ints) -> Intervals:
        """Return the intervals of tiles a to b - 1, each shape (I,); a and b are edges."""
        low, high = np.searchsorted(self.edge, a), np.searchsorted(self.edge, b)
        count, mean, square = _together(self.moments, low, high)
        scatter = np.sqrt(square / np.maximum(count - 1, 1)[:, None])
        time = None if self.time is None else np.stack([self.time[low, 0], self.time[high - 1, 1]], axis=1)
        return Intervals(a * self.tile + 1, b * self.tile, count.astype(np.int64), mean, scatter, time)

    def turning(self, a: Ints, b: Ints, extent: float) -> NDArray[np.bool_]:
        """Return which of the intervals of tiles a to b - 1, each shape (I,), turn while they last.

        Args:
            a, b: edges, with those halfway between them.
            extent: half the range of the readings, sensor units.
        """
        middle, turning = (a + b) // 2, np.zeros(len(a), dtype=bool)
        two = middle > a
        one, other = self.intervals(a[two], middle[two]), self.intervals(middle[two], b[two])
        apart = np.linalg.norm(other.mean - one.mean, axis=1)
        noise = (one.scatter**2).sum(axis=1) / one.n + (other.scatter**2).sum(axis=1) / other.n
        turning[two] = (apart > STEADY * extent) & (apart > BEYOND_NOISE * np.sqrt(noise))
        return turning


def _together(items: Moments, low: Ints, high: Ints) -> Moments:
    """Return rows (I,), mean (I, 3) and squares about it (I, 3) of the items low to high - 1 taken together."""
    number = high - low
    if not len(number):
        return np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3))
    begin = np.cumsum(number) - number
    owner = np.repeat(np.arange(len(low)), number)
    inside = np.arange(len(owner)) + (low - begin)[owner]
    rows, square = items[0][inside], items[2][inside]
    centre = items[1][low]  # about an item of the interval itself the sums stay small
    off = items[1][inside] - centre[owner]
    total: Float = np.add.reduceat(rows, begin)
    shift: Float = np.add.reduceat(rows[:, None] * off, begin) / total[:, None]
    off -= shift[owner]
    return total, centre + shift, np.add.reduceat(square + rows[:, None] * off * off, begin)


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
