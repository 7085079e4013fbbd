"""The careful parser of table rows: it defines what a table means and names the cell that is wrong."""

from __future__ import annotations

import bisect
import io
import math
from array import array
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.dialect import BOM, Dialect, decode_line, is_blank
from accelcal_cli.streams import Float

LIMIT = 1e100  # larger values cannot be squared safely
SHOWN = 40  # characters of a bad cell that are shown
NO_LABEL = "is empty; every row needs its label"


@dataclass(frozen=True)
class Selection:
    """Columns to read, counted from 0."""

    numbers: tuple[int, ...]
    gaps: frozenset[int] = frozenset()  # columns whose cells may be empty or nan
    texts: tuple[int, ...] = ()  # columns read as text: labels, which no row may lack


@dataclass(frozen=True, eq=False)
class Rows:
    """A block of rows: `numbers` (B, k) and `texts`, each of length B, in the order of the selection."""

    start: int
    numbers: Float
    texts: tuple[Sequence[str], ...] = ()


@dataclass
class LineMap:
    """Line number of every row, kept as the places where lines and rows part (blank lines, comments)."""

    rows: array[int] = field(default_factory=lambda: array("q"))
    lines: array[int] = field(default_factory=lambda: array("q"))

    def add(self, row: int, line: int) -> None:
        """State that `row` (from 0) stands on `line` (from 1); rows after it follow line by line."""
        if not self.rows or line - row != self.lines[-1] - self.rows[-1]:
            self.rows.append(row)
            self.lines.append(line)

    def line(self, row: int) -> int:
        """Line number of a row."""
        k = bisect.bisect_right(self.rows, row) - 1
        return self.lines[k] + row - self.rows[k]

    def where(self, row: int) -> str:
        """How to name a row: ``line 8``."""
        return f"line {self.line(row)}"


class CarefulParser:
    """Parses text blocks row by row, and keeps count of rows and lines across blocks."""

    def __init__(self, source: str, dialect: Dialect, selection: Selection) -> None:
        """Parse tables of one dialect; `source` is named in messages."""
        self.source = source
        self.dialect = dialect
        self.selection = selection
        self.lines = LineMap()
        self.row = 0  # rows so far
        self.line = 0  # lines so far

    def parse(self, block: bytes) -> Rows:
        """Rows of a block of whole lines; the first wrong cell raises DataError."""
        start, values = self.row, array("d")
        texts: tuple[list[str], ...] = tuple([] for _ in self.selection.texts)
        for raw in io.BytesIO(block):
            self.line += 1
            line = decode_line(raw.removeprefix(BOM) if self.line == 1 else raw, self.line, self.source)
            if is_blank(line) or line.lstrip().startswith("#") or self.line == self.dialect.header_line:
                continue
            cells = self._cells(line)
            self.lines.add(self.row, self.line)
            values.extend([self._number(cells[column], column) for column in self.selection.numbers])
            for text, column in zip(texts, self.selection.texts, strict=True):
                text.append(self._label(cells[column], column))
            self.row += 1
        numbers = np.frombuffer(values, dtype=np.float64) if values else np.empty(0)
        return Rows(start, numbers.reshape(-1, len(self.selection.numbers)), texts)

    def skip(self, rows: int) -> int:
        """Note that `rows` rows were read elsewhere, one a line; return the first one's number."""
        start = self.row
        self.lines.add(start, self.line + 1)
        self.row += rows
        self.line += rows
        return start

    def _cells(self, line: str) -> list[str]:
        if line.count('"') % 2:
            raise DataError(f"{self._here()}: a quotation mark is not closed on its line")
        cells = self.dialect.split(line.rstrip("\r\n"))
        width = self.dialect.width
        if len(cells) == width + 1 and not cells[-1]:
            return cells[:-1]  # a separator at the end of the line
        if len(cells) != width:
            whose = "the header has" if self.dialect.header_line else "the first row has"
            plural = "" if len(cells) == 1 else "s"
            raise DataError(f"{self._here()}: has {len(cells)} cell{plural} where {whose} {width}")
        return cells

    def _number(self, cell: str, column: int) -> float:
        value = to_number(cell, self.dialect.decimal_comma)
        if value is not None and -LIMIT <= value <= LIMIT:
            return value
        if column in self.selection.gaps and (not cell or (value is not None and math.isnan(value))):
            return math.nan
        where = f"{self._here()}, column {self._column(column)}"
        raise DataError(f"{where}: {_complaint(cell, value, self.dialect.decimal_comma)}")

    def _label(self, cell: str, column: int) -> str:
        if cell:
            return cell
        raise DataError(f"{self._here()}, column {self._column(column)}: {NO_LABEL}")

    def _here(self) -> str:
        return f"{self.source}, line {self.line}"

    def _column(self, column: int) -> str:
        names = self.dialect.names
        return f'"{names[column]}"' if names is not None and names[column] else str(column + 1)


def to_number(cell: str, decimal_comma: bool) -> float | None:
    """Value of a cell, None where it is not a number. Stricter than float(): no 1_000, no foreign digits."""
    if decimal_comma:
        if "." in cell:
            return None  # 1.234,5 and 1.234 would be thousands here
        cell = cell.replace(",", ".", 1)
    if "_" in cell or not cell.isascii():
        return None
    try:
        return float(cell)
    except ValueError:
        return None


def shorten(text: str) -> str:
    """Text in quotes, cut where it is long."""
    return f'"{text}"' if len(text) <= SHOWN else f'"{text[:SHOWN]}..."'


def _complaint(cell: str, value: float | None, decimal_comma: bool) -> str:
    if not cell:
        return "is empty; a number was expected"
    shown = shorten(cell)
    if value is None:
        if decimal_comma and "." in cell:
            return f"{shown} is not a number here: this file writes fractions with a comma"
        if "," in cell and not decimal_comma:
            return f"{shown} is not a number here: this file writes fractions with a point"
        return f"{shown} is not a number"
    if math.isfinite(value):
        return f"{shown} is too large for a reading (limit {LIMIT:g})"
    return f"{shown} is not a finite number"
