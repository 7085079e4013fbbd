"""Where a raw log is still: windows of little variance, in runs that last, and what is measured in them.

A window is still when the norm of the variances of the three axes is at most a multiple of that of a still period
[tedaldi2014] section IV-B; the still period is stated, or the quietest windows take its place (`StillLevel`). With a
gyroscope the window must not turn either: slow rotation moves gravity less than the noise of a cheap accelerometer
hides. Runs of still windows, trimmed at both ends, are the `Intervals`, of which mean and scatter are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Self

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.detection.windows import RowLengths, Tiles, Windows, windows
from accelcal_cli.errors import DataError

Moments = tuple[Float, Float, Float]
"""Rows (I,), mean (I, 3) and squares about it (I, 3) of I sets of rows."""

STEADY = 0.04
"""Halves of a pose have means that differ by less than this part of half the range of the readings, about 1 g: 2.3
degrees, or 5 degrees turned from end to end."""

BEYOND_NOISE = 5.0
"""Sigmas by which halves have to differ before it is no longer noise, or the beat of a vibration."""

SAMPLE = 100_000
"""At most about this many windows decide the levels."""

FEWEST_QUIET, MOST_QUIET = 0.002, 0.02
"""Part of the windows that count as the quietest: what STILL_POSES of the least length would fill, in these limits."""

STILL_POSES = 12

ACCELEROMETER_QUIET = 2.0
"""Windows up to this multiple of the quietest variance show what a gyroscope reads at rest."""

MOST_TURNING = 0.75
"""Part of those windows that turn at most as much as the level."""

ROUNDING = 1e-13
"""A standard deviation below this part of the readings is rounding: a sensor without noise, or one that is stuck."""

NOT_STILL = 100.0
"""A stated still period of more than this multiple of the quietest variance is not still."""


@dataclass(frozen=True)
class Intervals:
    """I still intervals, in order.

    Attributes:
        start, end: first and last row, counted from 1, shape (I,).
        n: rows averaged, shape (I,).
        mean: shape (I, 3), sensor units; scatter: standard deviation of one row, shape (I, 3), sensor units.
        time: of first and last row, shape (I, 2), as in the log; None without.
        temperature: mean of each, shape (I,), NaN where no row has one; None without.
    """

    start: Int
    end: Int
    n: Int
    mean: Float
    scatter: Float
    time: Float | None = None
    temperature: Float | None = None

    def __len__(self) -> int:
        """I."""
        return len(self.n)

    def take(self, index: Int) -> Intervals:
        """Return the intervals at `index`."""
        return Intervals(
            self.start[index],
            self.end[index],
            self.n[index],
            self.mean[index],
            self.scatter[index],
            None if self.time is None else self.time[index],
            None if self.temperature is None else self.temperature[index],
        )

    def where(self, i: int) -> str:
        """Return how to name an interval (from 0) to the user: ``rows 888 to 1357``, or by its times."""
        rows = f"rows {self.start[i]} to {self.end[i]}"
        return rows if self.time is None else f"time {self.time[i, 0]:.10g} to {self.time[i, 1]:.10g}"


@dataclass(frozen=True)
class Segmentation:
    """The still intervals of a log at one threshold.

    Attributes:
        multiplier: of the level.
        intervals: the still intervals that are long enough.
        short: rows of those that are not, before trimming, shape (s,).
        turning: rows of those that are, but turn while they last, before trimming, shape (t,).
    """

    multiplier: float
    intervals: Intervals
    short: Int
    turning: Int


@dataclass(frozen=True)
class StillLevel:
    """What counts as still, before it is multiplied.

    Attributes:
        variance: norm of the variances of the three axes, (sensor units)^2.
        quietest: that of the quietest windows; `variance` is the same, or that of a stated still period.
        extent: half the range of the readings, the outermost hundredths left out, sensor units.
        turning: mean square of the turning rate about its bias, (gyroscope units)^2; inf without a gyroscope.
        bias: of the gyroscope, shape (3,).
    """

    variance: float
    quietest: float
    extent: float
    turning: float
    bias: Float


def find_intervals(
    tiles: Tiles, lengths: RowLengths, level: StillLevel, multipliers: Sequence[float]
) -> list[Segmentation]:
    """Return the still intervals of a log for every multiplier of the level."""
    runs = find_runs(tiles, lengths, level, multipliers)
    ends = [_trim(first, last, lengths) for first, last in runs]
    edges = [edge for a, b in ends for edge in (a, (a + b) // 2, b)]
    pieces = Pieces.of(tiles, np.unique(np.concatenate(edges)))
    segmentations = []
    for multiplier, (first, last), (a, b) in zip(multipliers, runs, ends, strict=True):
        enough = (b - a) * tiles.size >= lengths.least
        turning = enough.copy()
        turning[enough] = pieces.turning(a[enough], b[enough], level.extent)
        still, whole = enough & ~turning, (last - first + lengths.width) * tiles.size
        intervals = pieces.intervals(a[still], b[still])
        segmentations.append(Segmentation(multiplier, intervals, whole[~enough], whole[turning]))
    return segmentations


def sample_windows(tiles: Tiles, lengths: RowLengths, name: str) -> list[Windows]:
    """Return about SAMPLE windows of a log, or all; DataError for a log shorter than one."""
    count = tiles.count - lengths.width + 1
    if count < 1:
        raise DataError(
            f"{name}: has {tiles.rows:,} rows, fewer than one window of {lengths.window:,}; "
            "means of poses at rest go to accelcal calibrate as they are"
        )
    return list(windows(tiles, lengths.width, -(-count // SAMPLE)))


def find_level(
    tiles: Tiles, lengths: RowLengths, name: str, sample: Sequence[Windows] | None = None
) -> StillLevel:
    """Return what counts as still.

    Args:
        tiles: the log; name: of it, for messages; sample: its `sample_windows`, if there already.
        lengths: of window, still period and least interval.

    Raises:
        DataError: a log without any noise, a stated still period that is not still.
    """
    sample = sample_windows(tiles, lengths, name) if sample is None else sample
    mean, variance = np.concatenate([w.mean for w in sample]), np.concatenate([w.variance for w in sample])
    noisy = variance > (ROUNDING * float(np.abs(mean).max())) ** 2
    if not noisy.any():
        raise DataError(
            f"{name}: all readings are equal, or change only in steps; the sensor has to be turned"
        )
    part = np.clip(STILL_POSES * lengths.least / tiles.rows, FEWEST_QUIET, MOST_QUIET)
    quietest = float(np.quantile(variance[noisy], part))
    level = quietest if lengths.still is None else _still_period(tiles, lengths, quietest, name)
    extent = 0.5 * float(np.ptp(np.quantile(mean, [0.01, 0.99], axis=0), axis=0).max())
    if not tiles.gyro:
        return StillLevel(level, quietest, extent, np.inf, np.zeros(3))
    return StillLevel(level, quietest, extent, *_turning(sample, variance <= ACCELEROMETER_QUIET * quietest))


def _turning(sample: Sequence[Windows], calm: Bool) -> tuple[float, Float]:
    """Return the level of the gyroscope and its bias, from the windows that the accelerometer calls calm."""
    rate = np.concatenate([w.rate for w in sample])[calm]
    bias: Float = np.median(rate, axis=0)
    square = np.concatenate([w.turning(bias) for w in sample])[calm]
    return float(np.quantile(square, MOST_TURNING)), bias


def _still_period(tiles: Tiles, lengths: RowLengths, quietest: float, name: str) -> float:
    """Return the norm of the variances over the stated still period at the beginning."""
    still = lengths.still or 0
    wanted = still // tiles.size
    if still > tiles.rows:
        raise DataError(
            f"{name}: has {tiles.rows:,} rows, fewer than the still period of {still:,} (--still)"
        )
    begin = takewhile(lambda numbered: numbered[0] < wanted, tiles.blocks())
    block = np.concatenate([block[: wanted - first, :6] for first, block in begin])
    mean = block[:, :3].mean(axis=0)
    square = block[:, 3:6].sum(axis=0) + tiles.size * ((block[:, :3] - mean) ** 2).sum(axis=0)
    level = float(np.linalg.norm(square / (len(block) * tiles.size)))
    if not 0 < level <= NOT_STILL * quietest:
        raise DataError(
            f"{name}: the first {still:,} rows are not still: variance {level:.4g}, {level / quietest:.3g} times "
            f"that of the quietest windows ({quietest:.4g}); state a shorter --still, or leave it out"
        )
    return level


def find_runs(
    tiles: Tiles, lengths: RowLengths, level: StillLevel, multipliers: Sequence[float]
) -> list[tuple[Int, Int]]:
    """Return for every multiplier the first and the last window, shape (I,) each, of every run of still windows."""
    changes: list[list[Int]] = [[] for _ in multipliers]
    still_before = np.zeros(len(multipliers), dtype=bool)
    for block in windows(tiles, lengths.width):
        turning = block.turning(level.bias)
        whole = ~block.broken  # what happened in a gap is unknown
        for k, multiplier in enumerate(multipliers):
            calm = (block.variance <= multiplier * level.variance) & (turning <= multiplier * level.turning)
            still = whole & calm
            changes[k].append(np.flatnonzero(np.diff(still, prepend=still_before[k])) + block.first)
            still_before[k] = still[-1]
    end = np.array([tiles.count - lengths.width + 1])
    edges = [
        np.concatenate([*parts, end[: int(last)]]) for parts, last in zip(changes, still_before, strict=True)
    ]
    return [(edge[::2], edge[1::2] - 1) for edge in edges]


def merge(intervals: Intervals, groups: Sequence[Int]) -> Intervals:
    """Return one interval for each group: it spans them all, and its rows are theirs taken together."""
    first = np.array([group.min() for group in groups], dtype=np.intp)
    last = np.array([group.max() for group in groups], dtype=np.intp)
    n = np.array([intervals.n[group].sum() for group in groups])
    mean, scatter = np.empty((len(groups), 3)), np.empty((len(groups), 3))
    for k, group in enumerate(groups):
        rows = intervals.n[group][:, None]
        mean[k] = (rows * intervals.mean[group]).sum(axis=0) / n[k]
        # Scatter within the intervals: how they differ is the attitude's, not the noise of a reading.
        within = ((rows - 1) * intervals.scatter[group] ** 2).sum(axis=0)
        scatter[k] = np.sqrt(within / max(n[k] - len(group), 1))
    time = intervals.time
    return replace(
        intervals.take(first),
        end=intervals.end[last],
        n=n,
        mean=mean,
        scatter=scatter,
        time=None if time is None else np.stack([time[first, 0], time[last, 1]], axis=1),
        temperature=None if intervals.temperature is None else _merged(intervals, groups, n),
    )


def _merged(intervals: Intervals, groups: Sequence[Int], n: Int) -> Float:
    """Return the mean temperature of each group of intervals, by their rows, shape (I,)."""
    degrees = np.zeros(0) if intervals.temperature is None else intervals.temperature
    return np.array([intervals.n[g] @ degrees[g] for g in groups]) / n


def _trim(first: Int, last: Int, lengths: RowLengths) -> tuple[Int, Int]:
    """Return first tile and end tile of each run of windows, without its edges.

    The windows of two runs may share tiles; the middle of what they share divides them.
    """
    trim = -(-lengths.trim // lengths.tile)
    a, b = first + trim, last + lengths.width - trim
    middle = (a[1:] + b[:-1]) // 2
    overlap = b[:-1] > a[1:]
    b[:-1] = np.where(overlap, middle, b[:-1])
    a[1:] = np.where(overlap, middle, a[1:])
    return a, np.maximum(a, b)


@dataclass(frozen=True)
class Pieces:
    """Runs of tiles between neighbouring ends of the intervals of all multipliers, each measured once.

    Attributes:
        tile: rows of a tile; edge: first tile of each piece, and the end of the last, shape (A + 1,).
        moments: rows, mean and squares about it of each piece, shapes (A,), (A, 3), (A, 3).
        time: of the first and last row of each piece, shape (A, 2), or None.
        warmth: sum of the temperatures of each piece, and how many tiles have one, shape (A, 2), or None.
    """

    tile: int
    edge: Int
    moments: Moments
    time: Float | None
    warmth: Float | None = None

    @classmethod
    def of(cls, tiles: Tiles, edge: Int) -> Self:
        """Read the tiles between the edges, in one pass."""
        a, b = edge[:-1], edge[1:]
        count, mean, square = np.zeros(len(a)), np.zeros((len(a), 3)), np.zeros((len(a), 3))
        time, warmth = np.full((len(a), 2), np.nan), np.zeros((len(a), 2))
        for first, block in tiles.blocks():
            low, high = np.clip(a - first, 0, len(block)), np.clip(b - first, 0, len(block))
            here = np.flatnonzero(high > low)
            if not len(here):
                continue
            rows = np.full(len(block), float(tiles.size))
            part = _pool((rows, block[:, :3], block[:, 3:6]), low[here], high[here])
            count[here], mean[here], square[here] = _pool_two((count[here], mean[here], square[here]), part)
            if tiles.warm:
                degrees = block[:, tiles.warm_at]
                known = np.isfinite(degrees)
                sums = np.cumsum(np.stack([np.where(known, degrees, 0.0), known], axis=1), axis=0)
                sums = np.concatenate([np.zeros((1, 2)), sums])
                warmth[here] += sums[high[here]] - sums[low[here]]
            if tiles.timed:
                begins = here[a[here] >= first]
                time[begins, 0] = block[low[begins], -2]
                time[here, 1] = block[high[here] - 1, -1]
        moments = count, mean, square
        return cls(tiles.size, edge, moments, time if tiles.timed else None, warmth if tiles.warm else None)

    def intervals(self, a: Int, b: Int) -> Intervals:
        """Return the intervals of tiles a to b - 1, each shape (I,); a and b are edges."""
        low, high = np.searchsorted(self.edge, a), np.searchsorted(self.edge, b)
        count, mean, square = _pool(self.moments, low, high)
        scatter = np.sqrt(square / np.maximum(count - 1, 1)[:, None])
        time = None if self.time is None else np.stack([self.time[low, 0], self.time[high - 1, 1]], axis=1)
        temperature = None if self.warmth is None else _mean_warmth(self.warmth, low, high)
        first, last = a * self.tile + 1, b * self.tile
        return Intervals(first, last, count.astype(np.intp), mean, scatter, time, temperature)

    def turning(self, a: Int, b: Int, extent: float) -> Bool:
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


def _mean_warmth(warmth: Float, low: Int, high: Int) -> Float:
    """Return the mean temperature of the pieces low to high - 1, shape (I,), NaN where none has one."""
    sums = np.concatenate([np.zeros((1, 2)), np.cumsum(warmth, axis=0)])
    total, tiles = (sums[high] - sums[low]).T
    return np.asarray(np.divide(total, tiles, out=np.full(len(total), np.nan), where=tiles > 0))


def _pool(items: Moments, low: Int, high: Int) -> Moments:
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


def _pool_two(one: Moments, two: Moments) -> Moments:
    """Return the moments of two sets of rows taken together."""
    n = one[0] + two[0]
    part = (two[0] / n)[:, None]
    step = two[1] - one[1]
    return n, one[1] + step * part, one[2] + two[2] + step**2 * part * one[0][:, None]
