"""Gaps in the time column of a raw log: what is before and after one is not the same rest.

They are told from the first and the last time of each tile, which are kept anyway: only the rows of a tile that
lasts too long are looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.sensor.clock import UNITS, Clock
from accelcal_cli.sensor.spans import Rows
from accelcal_cli.streams import Bool, Float

LATE = 10
"""Periods that a row may come late, however short the window: a logger pauses when it writes to its card."""


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
