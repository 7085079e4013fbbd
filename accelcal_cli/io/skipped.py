"""The lines of a text that are no rows, and on which line each row is."""

from __future__ import annotations

import bisect
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.arrays import Int

NAMED = 8
"""Lines that a note names at most."""


@dataclass
class LineMap:
    """Line number of every row, kept as the places where lines and rows diverge (blank lines, comments)."""

    rows: array[int] = field(default_factory=lambda: array("q"))
    lines: array[int] = field(default_factory=lambda: array("q"))

    def add(self, row: int, line: int) -> None:
        """Note that `row` (from 0) is on `line` (from 1); the rows after it follow line by line."""
        if not self.rows or line - row != self.lines[-1] - self.rows[-1]:
            self.rows.append(row)
            self.lines.append(line)

    def add_many(self, rows: Int, lines: Int) -> None:
        """Note that each of some rows, ascending, is on its line."""
        if not len(rows):
            return
        self.add(int(rows[0]), int(lines[0]))
        breaks = np.flatnonzero(np.diff(lines - rows)) + 1
        self.rows.frombytes(rows[breaks].astype(np.int64).tobytes())
        self.lines.frombytes(lines[breaks].astype(np.int64).tobytes())

    def line(self, row: int) -> int:
        """Return the line number of a row."""
        k = bisect.bisect_right(self.rows, row) - 1
        return self.lines[k] + row - self.rows[k]

    def where(self, row: int) -> str:
        """Return how to name a row: ``line 8``."""
        return f"line {self.line(row)}"


@dataclass(eq=False)
class PassedLines:
    """Lines below the header that are no rows: broken, cut off, headers again, of other sensors.

    Attributes:
        bad: numbers of broken lines; headers: of repeated headers; merged: how many lines are of other sensors.
        cut: number of the last line, if it was cut off.
        kept: where the lines come from, if only some of the input were looked at; the numbers above count these.
    """

    bad: array[int] = field(default_factory=lambda: array("q"))
    headers: array[int] = field(default_factory=lambda: array("q"))
    merged: int = 0
    cut: int | None = None
    kept: LineMap | None = None

    def lines(self) -> list[int]:
        """Return the numbers of lines that are broken, cut off, or headers again."""
        return [*self.bad, *self.headers, *(() if self.cut is None else (self.cut,))]

    def notes(self) -> list[str]:
        """Say what was left out."""
        notes = []
        if self.bad:
            plural = "s" * (len(self.bad) != 1)
            notes.append(
                f"{len(self.bad):,} broken row{plural} left out (--skip-bad): {self.named(self.bad)}"
            )
        if self.cut is not None:
            notes.append(f"the last line, {self._line(self.cut):,}, left out: it is cut off")
        if self.headers:
            notes.append(f"the header is repeated and left out: {self.named(self.headers)}")
        if self.merged:
            notes.append(f"{self.merged:,} rows left out: their cells of the readings are empty")
        return notes

    def named(self, numbers: Sequence[int]) -> str:
        """Return how a message names lines of the input: ``lines 5, 9 and 3 more``."""
        shown = ", ".join(str(self._line(number)) for number in numbers[:NAMED])
        more = f" and {len(numbers) - NAMED:,} more" if len(numbers) > NAMED else ""
        return f"line{'s' * (len(numbers) != 1)} {shown}{more}"

    def _line(self, number: int) -> int:
        return number if self.kept is None else self.kept.line(number)
