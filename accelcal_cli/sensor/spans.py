"""Lengths of time in a raw log: stated in seconds or in rows, used in rows."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from accelcal_cli.errors import UsageError

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
