"""Screening of a raw log: stretches that are no rest, holds at the end of the range, logs that show no gravity.

Idle zeros and frozen readings are the stillest rows of a log, so they have to go before still intervals are sought.
They are found on the tiles: `Liveliness` is whether an axis scatters in almost every quiet tile; where it does, a
stretch without any scatter is frozen, where it does not, the readings are coarser than their noise and nothing is said.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import NormalDist
from typing import Self

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.detection.intervals import ROUNDING, Intervals, StillLevel
from accelcal_cli.detection.windows import Tiles, Windows
from accelcal_cli.errors import DataError
from accelcal_cli.io.rows import SHOWN, named
from accelcal_cli.io.ties import bits_of_rail
from accelcal_cli.notices import Notice

LONG = 5
"""Tiles in a row without scatter that may be frozen."""

LEAST_ROWS = 5
"""Rows of a tile that show whether an axis scatters."""

QUIET = 10.0
"""Tiles up to this multiple of the still level are quiet."""

LIVELY, ENOUGH = 0.02, 50
"""Part of the quiet tiles without scatter up to which an axis is finer than its noise, and tiles that show it."""

STILLEST = 100.0
"""Windows up to this multiple of the quietest variance: no threshold finds poses in others."""

ONE_POINT = 0.05
"""Their means are one point where they spread by less than this part of the range of all windows."""

NEVER = 0.03
"""Means of all windows within this part of their size are one attitude."""

ALTERNATE, CYCLE = 0.4, 4
"""Rows alternate between up to CYCLE sensors where each is nearer by this factor to the one a cycle before."""

IN_STEP = (3, 5, 7, 11, 13)
"""Cycles after which sensors in turn are still in step."""

RARE = 1e-6
"""Chance that no reading of an honest hold is further from the mean than the end of the range."""


@dataclass(frozen=True)
class Liveliness:
    """Which axes scatter whenever they live, and the stretches in which they do not.

    Attributes:
        axes: whether each axis is finer than its noise, shape (3,).
        frozen: number of tiles that are frozen; stretches: first and last row of the first of them, from 1.
        low, high: least and greatest reading of each axis, shape (3,), sensor units.
    """

    axes: Bool
    frozen: int
    stretches: tuple[tuple[int, int], ...]
    low: Float
    high: Float

    @classmethod
    def of(cls, tiles: Tiles, level: StillLevel) -> Self:
        """Measure the tiles of a log."""
        quiet, dull, frozen = np.zeros(3), np.zeros(3), np.zeros(3)
        limit = QUIET * level.variance * tiles.size
        parts: list[list[tuple[int, int]]] = [[], [], []]
        for first, block in tiles.blocks():
            still = np.linalg.norm(block[:, 3:6], axis=1) <= limit
            zero = (block[:, :6] == 0).all(axis=1)
            for i in range(3):
                flat = _is_flat(tiles, block, i) & ~zero
                runs = _runs(flat)
                long = np.zeros(len(block), dtype=bool)
                for a, b in runs:
                    long[a:b] = True
                    if len(parts[i]) < SHOWN:
                        parts[i].append(((first + a) * tiles.size + 1, (first + b) * tiles.size))
                rest = still & ~long & ~zero
                quiet[i] += np.count_nonzero(rest)
                dull[i] += np.count_nonzero(rest & flat)
                frozen[i] += np.count_nonzero(long)
        lively = (quiet >= ENOUGH) & (dull <= LIVELY * quiet) & (tiles.size >= LEAST_ROWS)
        worst = int(np.argmax(frozen * lively))
        number = int(frozen[worst]) if lively[worst] else 0
        return cls(lively, number, tuple(parts[worst]) if number else (), tiles.low, tiles.high)

    def unusable(self, tiles: Tiles) -> Callable[[Float], Bool]:
        """Return what tells the tiles of a block that are no readings: zeros, and what is frozen for LONG.

        A few rows may be equal by chance, and must not end a pose.
        """

        def of(block: Float) -> Bool:
            bad = (block[:, :6] == 0).all(axis=1)
            for i in np.flatnonzero(self.axes).tolist():
                for a, b in _runs(_is_flat(tiles, block, i)):
                    bad[a:b] = True
            return np.asarray(bad)

        return of

    def notices(self, size: int) -> tuple[Notice, ...]:
        """Return what to say of frozen stretches, for tiles of `size` rows."""
        if not self.frozen:
            return ()
        shown = [f"rows {a:,} to {b:,}" for a, b in self.stretches]
        text = (
            f"About {self.frozen * size:,} rows are frozen, to the last digit, while the rest scatters "
            f"({', '.join(shown)}{', ...' if len(shown) == SHOWN else ''}); left out."
        )
        return (Notice("frozen", "note", text),)

    def clipped(self, intervals: Intervals, names: Sequence[str]) -> tuple[Notice, ...]:
        """Return what to say of intervals whose axis is at the end of its range.

        In an honest hold some readings are far above the mean, so that the extreme of the log is, too.
        """
        poses = len(intervals.n)
        marks = np.zeros((poses, 3, 2), dtype=bool)
        reach = np.array([_reach(n) for n in intervals.n.tolist()])[:, None]
        rails = [bits_of_rail(float(v)) for v in (*self.low, *self.high)]
        ends = max(np.count_nonzero([bits == n for bits in rails]) for n in rails if n) if any(rails) else 0
        for side, (end, sign) in enumerate(((self.low, -1.0), (self.high, 1.0))):
            room = sign * (end - intervals.mean)
            at_rail = np.array([bits_of_rail(float(v)) is not None for v in end]) & (ends > 1) & (room == 0)
            least = ROUNDING * np.abs(end)
            marks[..., side] = self.axes & (room <= reach * intervals.scatter + least) | at_rail
        if not marks.any():
            return ()
        holds = np.flatnonzero(marks.any(axis=(1, 2)))
        columns = [
            f'"{names[i]}" at {(self.low, self.high)[side][i]:.10g}'
            for i in range(3)
            for side in range(2)
            if marks[:, i, side].any()
        ]
        shown = named([intervals.where(k) for k in holds[:SHOWN].tolist()], len(holds))
        text = (
            f"Clipped readings: column {', '.join(columns)}, an end of the range, in {len(holds)} of "
            f"{poses} poses ({shown})."
        )
        return (
            Notice(
                "clipped",
                "warning",
                text,
                "Set a wider range of the sensor and record again, or leave these poses out.",
            ),
        )


def _reach(rows: int) -> float:
    """Return the standard deviations by which some reading of an honest hold surely exceeds the mean, 1 at most."""
    return min(1.0, max(0.0, NormalDist().inv_cdf(RARE ** (1 / max(rows, 2)))))


def _is_flat(tiles: Tiles, block: Float, axis: int) -> Bool:
    """Return which tiles of a block read one value throughout, other than an extreme of the log: that is clipped."""
    mean, off = block[:, axis], ROUNDING * np.abs(block[:, axis])
    inside = (np.abs(mean - tiles.low[axis]) > off) & (np.abs(mean - tiles.high[axis]) > off)
    return np.asarray((block[:, 3 + axis] <= tiles.size * off * off) & inside)


def _runs(flags: Bool) -> list[tuple[int, int]]:
    """Return first and end of the runs of LONG or more."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= LONG]


def check_gravity(
    sample: Sequence[Windows], level: StillLevel, name: str, columns: Sequence[str], gyro: Sequence[str]
) -> None:
    """Raise DataError where the log is one point whenever it is still: it was never turned, or is no acceleration.

    Args:
        sample: windows of the log; level: what counts as still.
        name: of the log; columns: names of the accelerometer; gyro: of the gyroscope, () for none.
    """
    mean = np.concatenate([w.mean for w in sample])
    variance = np.concatenate([w.variance for w in sample])
    broken = np.concatenate([w.broken for w in sample])
    still = (variance <= STILLEST * level.quietest) & ~broken
    if np.count_nonzero(still) < 2 or not level.extent:
        return
    spread = np.quantile(mean[still], [0.02, 0.98], axis=0)
    middle, width = spread.mean(axis=0), float(np.ptp(spread, axis=0).max())
    size, range_ = float(np.linalg.norm(middle)), 2 * level.extent
    if range_ < NEVER * size:
        raise DataError(
            f"{name}: the sensor was never turned: all readings show one attitude, within "
            f"{math.degrees(range_ / size):.1g} degrees; turn it to twelve attitudes or more (accelcal plan)"
        )
    if width > ONE_POINT * range_:
        return
    shown = ", ".join(columns)
    hint = "name the accelerometer with --columns"
    if gyro and _looks_like_gravity(sample, still):
        accelerometer, turning = (shlex.quote(",".join(names)) for names in (gyro, columns))
        hint = f"columns {', '.join(gyro)} look like acceleration: --columns {accelerometer} --gyro {turning}"
    raise DataError(
        f"{name}: gravity does not turn in columns {shown}: whenever they are still they read the same, "
        f"({', '.join(f'{value:.4g}' for value in middle)}). They hold turning rates or linear acceleration, or the "
        f"sensor rested in one attitude only; {hint}"
    )


def _looks_like_gravity(sample: Sequence[Windows], still: Bool) -> bool:
    """Return whether the gyroscope columns keep one size in still windows and change direction."""
    rate = np.concatenate([w.rate for w in sample])[still]
    low, high = np.quantile(rate, [0.02, 0.98], axis=0)
    size = np.linalg.norm(rate - (low + high) / 2, axis=1)
    near, middle, far = np.quantile(size, [0.1, 0.5, 0.9])
    return bool(far - near < 0.5 * middle and np.ptp([low, high], axis=0).min() > middle)


def alternating(rows: Float, time: Float | None) -> tuple[Notice, ...]:
    """Return a warning where rows, shape (n, 3), come from several sensors in turn; `time` of each, shape (n,)."""
    if len(rows) < 20 * CYCLE:
        return ()
    steps = [float(np.median(np.abs(rows[k:] - rows[:-k]), axis=0).sum()) for k in range(1, CYCLE + 1)]
    number = next((k for k in range(2, CYCLE + 1) if steps[k - 1] < ALTERNATE * min(steps[: k - 1])), 0)
    if not number:
        return ()
    # A vibration falls out of step with any number of rows; sensors in turn never do.
    later = [np.abs(rows[m * number :] - rows[: -m * number]) for m in IN_STEP]
    if max(float(np.median(part, axis=0).sum()) for part in later) > ALTERNATE * min(steps[: number - 1]):
        return ()
    stamps = (
        "" if time is None or np.count_nonzero(np.diff(time) == 0) < 0.4 * len(time) else ", with equal times"
    )
    return (
        Notice(
            "several-sensors",
            "warning",
            f"The rows come from {number} sensors in turn{stamps}: each is nearer to the one {number} rows before.",
            "Give each sensor its own file, or a column that labels it for --where COLUMN=VALUE.",
        ),
    )
