"""Least and greatest value of each axis in a bounded number of bins, for a picture of a log of any length."""

from __future__ import annotations

import numpy as np

from accelcal_cli.streams import Float

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
