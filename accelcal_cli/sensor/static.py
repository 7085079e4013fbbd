"""Where a raw log is still: windows of little variance, in runs that last [tedaldi2014].

A window is still when the norm of the variances of the three axes is at most a multiple of that of a still period
[tedaldi2014] section IV-B; the still period is stated, or the quietest windows stand for it. With a gyroscope the
window must not turn either: slow rotation moves gravity less than the noise of a cheap accelerometer hides.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.tiles import Tiles
from accelcal_cli.streams import Float

Ints = NDArray[np.int64]

SAMPLE = 100_000
"""At most about this many windows decide the levels."""

FEWEST_QUIET, MOST_QUIET = 0.002, 0.02
"""Part of the windows that count as the quietest: what 12 poses of the least length would fill, in these limits."""

STILL_POSES = 12
ACCELEROMETER_QUIET = 2.0
"""Windows up to this multiple of the quietest variance tell how much a gyroscope turns at rest."""

MOST_TURNING = 0.75
"""Part of those windows that turn no more than the level."""

ROUNDING = 1e-13
"""A standard deviation below this part of the readings is rounding: a sensor without noise, or one that is stuck."""

NOT_STILL = 100.0
"""A stated still period of more than this multiple of the quietest variance is not still."""


@dataclass(frozen=True)
class Level:
    """What counts as still, before it is multiplied.

    Attributes:
        variance: norm of the variances of the three axes, (sensor units)^2.
        quietest: the same of the quietest windows, where `variance` is that of a stated still period.
        extent: half the range of the readings, the outermost hundredths left out, sensor units.
        turning: mean square of the turning rate about its bias, (gyroscope units)^2; inf without a gyroscope.
        bias: of the gyroscope, shape (3,).
    """

    variance: float
    quietest: float
    extent: float
    turning: float
    bias: Float


@dataclass(frozen=True)
class Windows:
    """A block of sliding windows, one a tile.

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
    broken: NDArray[np.bool_]

    def turning(self, bias: Float) -> Float:
        """Return the mean square of the turning rate about its bias, shape (B,)."""
        turning: Float = self.spread + ((self.rate - bias) ** 2).sum(axis=1)
        return turning


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
        broken = np.zeros(variance.shape[1], dtype=bool)
        if tiles.timed:
            broken = tiles.gaps.limit.spanned(block[:, -2], block[:, -1], width)[start::step]
        norm = np.sqrt(variance[0] ** 2 + variance[1] ** 2 + variance[2] ** 2)
        yield Windows(first + start, mean.T, norm, rate.T, spread, broken)


def _window(moments: Float, size: int, width: int, take: slice) -> tuple[Float, Float]:
    """Return mean and variance, each (3, windows), of the windows of `width` tiles that begin at `take`."""
    parts = [moments[take.start + k : take.stop + k : take.step].T.copy() for k in range(width)]
    centre: Float = np.add.reduce([part[:3] for part in parts]) / width
    square = np.zeros_like(centre)
    for part in parts:
        off = part[:3] - centre
        square += part[3:] + size * off * off
    return centre, square / (size * width)


def find_level(tiles: Tiles, rows: Rows, name: str) -> Level:
    """Return what counts as still.

    Args:
        tiles: the log; name: of it, for messages.
        rows: lengths of window, still period and least interval.

    Raises:
        DataError: a log shorter than the window or without any noise, a stated still period that is not still.
    """
    count = tiles.count - rows.width + 1
    if count < 1:
        raise DataError(
            f"{name}: has {tiles.rows:,} rows, fewer than one window of {rows.window:,}; "
            "means of poses at rest go to accelcal calibrate as they are"
        )
    sample = list(windows(tiles, rows.width, -(-count // SAMPLE)))
    mean, variance = np.concatenate([w.mean for w in sample]), np.concatenate([w.variance for w in sample])
    noisy = variance > (ROUNDING * float(np.abs(mean).max())) ** 2
    if not noisy.any():
        raise DataError(
            f"{name}: all readings are equal, or change only in steps; the sensor has to be turned"
        )
    part = np.clip(STILL_POSES * rows.least / tiles.rows, FEWEST_QUIET, MOST_QUIET)
    quietest = float(np.quantile(variance[noisy], part))
    level = quietest if rows.still is None else _still_period(tiles, rows, quietest, name)
    extent = 0.5 * float(np.ptp(np.quantile(mean, [0.01, 0.99], axis=0), axis=0).max())
    if not tiles.gyro:
        return Level(level, quietest, extent, np.inf, np.zeros(3))
    return Level(level, quietest, extent, *_turning(sample, variance <= ACCELEROMETER_QUIET * quietest))


def _turning(sample: Sequence[Windows], calm: NDArray[np.bool_]) -> tuple[float, Float]:
    """Return the level of the gyroscope and its bias, from the windows that the accelerometer calls calm."""
    rate = np.concatenate([w.rate for w in sample])[calm]
    bias: Float = np.median(rate, axis=0)
    square = np.concatenate([w.turning(bias) for w in sample])[calm]
    return float(np.quantile(square, MOST_TURNING)), bias


def _still_period(tiles: Tiles, rows: Rows, quietest: float, name: str) -> float:
    """Return the norm of the variances over the stated still period at the beginning."""
    still = rows.still or 0
    wanted = still // tiles.size
    if still > tiles.rows:
        raise DataError(
            f"{name}: has {tiles.rows:,} rows, fewer than the still period of {still:,} (--still)"
        )
    parts, have = [], 0
    for first, block in tiles.blocks():
        if first >= wanted:
            break
        parts.append(block[: wanted - first, :6])
        have += len(parts[-1])
    block = np.concatenate(parts)
    mean = block[:, :3].mean(axis=0)
    square = block[:, 3:6].sum(axis=0) + tiles.size * ((block[:, :3] - mean) ** 2).sum(axis=0)
    level = float(np.linalg.norm(square / (have * tiles.size)))
    if not 0 < level <= NOT_STILL * quietest:
        raise DataError(
            f"{name}: the first {still:,} rows are not still: variance {level:.4g}, {level / quietest:.3g} times "
            f"that of the quietest windows ({quietest:.4g}); state a shorter --still, or leave it out"
        )
    return level


def runs(
    tiles: Tiles, rows: Rows, level: Level, multipliers: Sequence[float]
) -> tuple[list[Ints], list[Ints]]:
    """Return for every multiplier the first and the last window (each (I,)) of every run of still windows."""
    starts: list[list[Ints]] = [[] for _ in multipliers]
    ends: list[list[Ints]] = [[] for _ in multipliers]
    still_before = np.zeros(len(multipliers), dtype=bool)
    for block in windows(tiles, rows.width):
        turning = block.turning(level.bias)
        whole = ~block.broken  # nobody knows what happened in a gap
        for k, multiplier in enumerate(multipliers):
            calm = (block.variance <= multiplier * level.variance) & (turning <= multiplier * level.turning)
            still = whole & calm
            change = np.flatnonzero(np.diff(still, prepend=still_before[k])) + block.first
            starts[k].append(change[int(still_before[k]) :: 2])
            ends[k].append(change[1 - int(still_before[k]) :: 2] - 1)
            still_before[k] = still[-1]
    last = tiles.count - rows.width
    for k, still_at_the_end in enumerate(still_before):
        if still_at_the_end:
            ends[k].append(np.array([last]))
    return [np.concatenate(s) for s in starts], [np.concatenate(e) for e in ends]
