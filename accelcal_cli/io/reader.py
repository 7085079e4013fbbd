"""Numeric tables as streams of row blocks: one interface for text of any dialect and for Parquet.

`open_table` gives a `Table`. A `TextTable` is read by two parsers: `CarefulParser` goes line by line in Python, defines
what a table means and names the cell that is wrong; `FastParser` lets polars read whole blocks wherever that is sure to
mean the same. Short inputs never import polars. Parquet has its own file, which is nothing without polars.
"""

from __future__ import annotations

import bisect
import io
import math
from array import array
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import BOM, Dialect, decode_line, is_blank, looks_numeric, sniff, split_cells
from accelcal_cli.io.stream import ByteSource, open_source

if TYPE_CHECKING:
    import polars as pl

    from accelcal_cli.io.rows import RowFilter

LIMIT = 1e100
"""Largest reading: greater values cannot be squared safely."""

SHOWN = 40
"""Characters of a bad cell that a message shows."""

NO_LABEL = "is empty; every row needs its label"


@dataclass(frozen=True)
class Selection:
    """Columns to read, counted from 0."""

    numbers: tuple[int, ...]
    gaps: frozenset[int] = frozenset()  # columns whose cells may be empty or nan
    texts: tuple[int, ...] = ()  # columns read as text: labels, which no row may lack


@dataclass(frozen=True, eq=False)
class RowBlock:
    """Rows of a table: `numbers` (B, k) and `texts`, each of length B, in the order of the selection.

    `start` is the number of the first row in the table, from 0.
    """

    start: int
    numbers: Float
    texts: tuple[Sequence[str], ...] = ()


class InputTable(Protocol):
    """A table that can be read once, from top to bottom."""

    filter: RowFilter | None
    """Which rows are read; all when None."""

    @property
    def name(self) -> str:
        """The path as given, or ``<stdin>``."""

    @property
    def names(self) -> tuple[str, ...] | None:
        """Column names, None where the table has no header."""

    @property
    def numeric(self) -> tuple[bool, ...]:
        """Whether each column holds numbers, judged by type or by the first row."""

    @property
    def has_rows(self) -> bool:
        """Whether there is anything below the header."""

    @property
    def sha256(self) -> str:
        """SHA-256 of the input, once all blocks have been read."""

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns, block after block, in constant memory."""

    @property
    def where(self) -> Callable[[int], str]:
        """How to name a row (from 0) that has been read, such as ``line 8``; usable after the table is closed."""

    def close(self) -> None:
        """Release the file."""


def open_table(source: str | Path, stdin: BinaryIO | None = None, *, hashed: bool = True) -> InputTable:
    """Open a table of any supported form; ``-`` is standard input. Without the hash it is read a little faster."""
    stream, path = open_source(source, stdin, hashed=hashed), None if str(source) == "-" else Path(source)
    try:
        if stream.head.startswith(b"PAR1") or (path and path.suffix.lower() in {".parquet", ".pq"}):
            from accelcal_cli.io.parquet import ParquetTable

            return ParquetTable(stream, path)
        return TextTable(stream)
    except BaseException:
        stream.close()
        raise


class TextTable:
    """A table in text form."""

    def __init__(self, source: ByteSource) -> None:
        """Find the dialect of `source` from its head."""
        self.name = source.name
        self.dialect = sniff(source.head, source.name)
        self.names = self.dialect.names
        cells = self.dialect.first + ("",) * (self.dialect.width - len(self.dialect.first))
        self.numeric = tuple(looks_numeric(cell) for cell in cells[: self.dialect.width])
        self.has_rows = bool(self.dialect.first)
        self.filter: RowFilter | None = None
        self._source = source
        self._lines = LineMap()

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes read so far."""
        return self._source.sha256

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns; short inputs never import polars."""
        return (rows for _, rows in self.pairs(selection))

    def pairs(self, selection: Selection) -> Iterator[tuple[bytes, RowBlock]]:
        """Read blocks of whole lines, each with the selected columns of its rows."""
        careful = CarefulParser(self.name, self.dialect, selection, self.filter)
        self._lines = careful.lines
        parse = careful.parse if self._source.whole else FastParser(careful).parse
        for block in self._source.blocks():
            top = _top(block, self.dialect.header_line) if careful.line == 0 else 0
            if top and (kept := self._filtered(block[:top], top=self.dialect.header_line > 0)):
                yield kept, careful.parse(kept)
            if top < len(block) and (kept := self._filtered(block[top:])):
                yield kept, parse(kept)
        if self.filter is not None:
            self.filter.check()

    def _filtered(self, block: bytes, *, top: bool = False) -> bytes:
        if self.filter is None:
            return block
        return self.filter.keep_all(block) if top else self.filter.keep(block, self.dialect)

    @property
    def where(self) -> Callable[[int], str]:
        """Line of a row that has been read."""
        if self.filter is None:
            return self._lines.where
        lines, kept = self._lines, self.filter.lines
        return lambda row: f"line {kept.line(lines.line(row))}"

    def close(self) -> None:
        """Release the file."""
        self._source.close()


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
class CarefulParser:
    """Parses text blocks of one dialect row by row, and keeps count of rows and lines across blocks."""

    source: str  # named in messages
    dialect: Dialect
    selection: Selection
    filter: RowFilter | None = None  # that the lines have passed
    lines: LineMap = field(default_factory=LineMap)
    row: int = 0  # rows so far
    line: int = 0  # lines so far

    def parse(self, block: bytes) -> RowBlock:
        """Return the rows of a block of whole lines; the first wrong cell raises DataError."""
        start, values = self.row, array("d")
        texts: tuple[list[str], ...] = tuple([] for _ in self.selection.texts)
        for raw in io.BytesIO(block):
            self.line += 1
            line = decode_line(raw.removeprefix(BOM) if self.line == 1 else raw, self._line(), self.source)
            if is_blank(line) or line.lstrip().startswith("#") or self.line == self.dialect.header_line:
                continue
            cells = self._cells(line)
            self.lines.add(self.row, self.line)
            values.extend([self._number(cells[column], column) for column in self.selection.numbers])
            for text, column in zip(texts, self.selection.texts, strict=True):
                text.append(self._label(cells[column], column))
            self.row += 1
        numbers = np.frombuffer(values, dtype=np.float64) if values else np.empty(0)
        return RowBlock(start, numbers.reshape(-1, len(self.selection.numbers)), texts)

    def skip(self, rows: int) -> int:
        """Note that `rows` rows were read elsewhere, one per line; return the number of the first."""
        start = self.row
        self.lines.add(start, self.line + 1)
        self.row += rows
        self.line += rows
        return start

    def _line(self) -> int:
        """Return the number of the line in the input."""
        return self.line if self.filter is None else self.filter.lines.line(self.line)

    def _cells(self, line: str) -> list[str]:
        if line.count('"') % 2:
            raise DataError(f"{self._place()}: a quotation mark is not closed on its line")
        cells = split_cells(line.rstrip("\r\n"), self.dialect.separator)
        width = self.dialect.width
        if len(cells) == width + 1 and not cells[-1]:
            return cells[:-1]  # a separator at the end of the line
        if len(cells) != width:
            whose = "the header has" if self.dialect.header_line else "the first row has"
            plural = "" if len(cells) == 1 else "s"
            raise DataError(f"{self._place()}: has {len(cells)} cell{plural} where {whose} {width}")
        return cells

    def _number(self, cell: str, column: int) -> float:
        value = to_number(cell, self.dialect.decimal_comma)
        if value is not None and -LIMIT <= value <= LIMIT:
            return value
        if column in self.selection.gaps and (not cell or (value is not None and math.isnan(value))):
            return math.nan
        raise DataError(f"{self._place(column)}: {_describe_cell(cell, value, self.dialect.decimal_comma)}")

    def _label(self, cell: str, column: int) -> str:
        if cell:
            return cell
        raise DataError(f"{self._place(column)}: {NO_LABEL}")

    def _place(self, column: int | None = None) -> str:
        """Return where the parser is, for a message."""
        here, names = f"{self.source}, line {self._line()}", self.dialect.names
        if column is None:
            return here
        name = f'"{names[column]}"' if names is not None and names[column] else column + 1
        return f"{here}, column {name}"


@dataclass(eq=False)
class FastParser:
    """Parses what polars reads beyond doubt, and hands every other block to the careful parser.

    Beyond doubt: no quotes, comments or blank lines, every row as wide as the first, every number finite.
    So the careful parser alone defines what a table means, and words every error.
    """

    careful: CarefulParser  # whose rows, lines and selection it shares

    def parse(self, block: bytes) -> RowBlock:
        """Return the rows of a block of whole lines."""
        for prepare in (self._bare, self._plain):
            plain = prepare(block)
            rows = None if plain is None else self._rows(plain)
            if rows is not None:
                return rows
        return self.careful.parse(block)

    def _bare(self, block: bytes) -> bytes | None:
        """Return the block as it is, where every column is read as a number, so that nothing odd can hide."""
        dialect, selection = self.careful.dialect, self.careful.selection
        partial = len(set(selection.numbers)) < dialect.width or selection.texts
        doubtful = dialect.decimal_comma or not block.endswith(b"\n") or has_outer_blank_line(block)
        return None if partial or doubtful else block

    def _plain(self, block: bytes) -> bytes | None:
        """Return the block with one-byte separators only, None if it needs care."""
        dialect, selection = self.careful.dialect, self.careful.selection
        twice = not set(selection.texts).isdisjoint(selection.numbers)
        comma = dialect.decimal_comma and (b"." in block or dialect.separator == ",")
        odd = b"#" in block or b"\0" in block or not block.endswith(b"\n")
        if twice or comma or odd or not (block.isascii() or _is_utf8(block)):
            return None
        block = block.replace(b"\r\n", b"\n")
        squeezed = _squeeze(block, dialect.separator)
        if b'"' in block and (dialect.separator == " " or squeezed != block):
            return None  # blanks within quotes belong to the cell
        return None if b"\r" in squeezed or has_outer_blank_line(squeezed) else squeezed

    def _rows(self, block: bytes) -> RowBlock | None:
        """Return the rows of a block that polars can read, None where a cell is missing or out of range."""
        frame, selection = self._frame(block), self.careful.selection
        series = [] if frame is None else [frame[str(column)] for column in selection.numbers]
        if frame is None or any(column.null_count() for column in series):
            return None
        numbers = np.array(
            [column.to_numpy() for column in series]
        ).T  # column after column: faster to reduce
        if not (numbers.min() >= -LIMIT and numbers.max() <= LIMIT):  # nan fails both
            return None
        texts = tuple([(cell or "").strip() for cell in frame[str(k)].to_list()] for k in selection.texts)
        return RowBlock(self.careful.skip(len(frame)), numbers, texts) if all(map(all, texts)) else None

    def _frame(self, block: bytes) -> pl.DataFrame | None:
        import polars as pl

        dialect, selection, quoted = self.careful.dialect, self.careful.selection, b'"' in block
        schema = {str(k): pl.Float64 if k in selection.numbers else pl.String for k in range(dialect.width)}
        try:
            frame = pl.read_csv(
                block,
                has_header=False,
                schema=schema,
                separator=dialect.separator,
                quote_char='"' if quoted else None,
                decimal_comma=dialect.decimal_comma,
            )
        except pl.exceptions.PolarsError:
            return None
        # More line ends than rows: a cell goes on over the end of its line.
        broken = quoted and _count(block, "\n") != len(frame)
        # A null in the last column is an empty cell, or a row that is short.
        short = frame[str(dialect.width - 1)].null_count() and (
            quoted or _count(block, dialect.separator) != (dialect.width - 1) * len(frame)
        )
        return None if broken or short else frame


def to_number(cell: str, decimal_comma: bool) -> float | None:
    """Return the value of a cell, None where it is not a number. Stricter than float(): no 1_000, no foreign digits."""
    thousands = decimal_comma and "." in cell  # 1.234,5 and 1.234
    if thousands or "_" in cell or not cell.isascii():
        return None
    try:
        return float(cell.replace(",", ".", 1) if decimal_comma else cell)
    except ValueError:
        return None


def shorten(text: str) -> str:
    """Return a text in quotes, cut where it is long."""
    return f'"{text}"' if len(text) <= SHOWN else f'"{text[:SHOWN]}..."'


def _describe_cell(cell: str, value: float | None, decimal_comma: bool) -> str:
    """Say what is wrong with a cell that has no number, or has one that is no reading."""
    if not cell:
        return "is empty; a number was expected"
    shown = shorten(cell)
    if value is not None:
        too_large = f"too large for a reading (limit {LIMIT:g})"
        return f"{shown} is {too_large if math.isfinite(value) else 'not a finite number'}"
    foreign, mark = (".", "comma") if decimal_comma else (",", "point")
    here = f" here: this file writes fractions with a {mark}" if foreign in cell else ""
    return f"{shown} is not a number{here}"


def has_outer_blank_line(block: bytes) -> bool:
    """Return whether a block begins or ends with a blank line; polars passes over these without a null."""
    return block[:1] in b"\r\n" or block.endswith((b"\n\n", b"\r\n\r\n", b"\n\r\n"))


def _top(block: bytes, header_line: int) -> int:
    """Return the number of bytes up to the end of the header, or of the first line."""
    end = 0
    for _ in range(max(header_line, 1)):
        end = block.find(b"\n", end) + 1 or len(block)
    return end


def _count(block: bytes, character: str) -> int:
    return int(np.count_nonzero(np.frombuffer(block, np.uint8) == ord(character)))


def _is_utf8(block: bytes) -> bool:
    try:
        block.decode()
    except UnicodeDecodeError:
        return False
    return True


def _squeeze(block: bytes, separator: str) -> bytes:
    """Drop the blanks around cells; of a run of blanks that is itself the separator leave one."""
    if separator == " ":
        block = block.replace(b"\t", b" ")
    elif b" " not in block and (separator == "\t" or b"\t" not in block):
        return block
    text = np.frombuffer(block, np.uint8)
    while True:
        blank = text == ord(" ")
        edge = text == ord("\n")
        if separator != " ":
            edge |= text == ord(separator)
        if separator not in " \t":
            blank |= text == ord("\t")
        drop = blank.copy()
        drop[1:] &= edge[:-1] | blank[:-1] if separator == " " else edge[:-1]
        drop[:-1] |= blank[:-1] & edge[1:]
        if not drop.any():
            return text.tobytes()
        text = text[~drop]
