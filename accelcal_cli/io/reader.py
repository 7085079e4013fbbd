"""Numeric tables as streams of row blocks: one interface for text of any dialect and for Parquet.

A `TextTable` is read by two parsers: `CarefulParser` goes line by line in Python, defines what a table means and names
the cell that is wrong; `FastParser` lets polars read whole blocks wherever that is sure to mean the same.
"""

from __future__ import annotations

import io
import math
from array import array
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Protocol

import numpy as np

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.dialect import (
    BOM,
    MARKS,
    SAMPLE,
    Dialect,
    decode_line,
    is_blank,
    is_comment,
    looks_numeric,
    split_cells,
    to_number,
    understand,
)
from accelcal_cli.io.rows import MOST_BAD, SKIPPABLE, LineMap, PassedLines, RowBlock, RowFilter, kept_line
from accelcal_cli.io.stream import LONGEST_LINE, TYPED, ByteSource, Source, open_source
from accelcal_cli.io.vocabulary import Facts
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    import polars as pl

    from accelcal_cli.sensor.vehicle import VehicleCorrection

LIMIT = 1e100
"""Largest reading: greater values cannot be squared safely."""

SHOWN = 40
"""Characters of a bad cell that a message shows."""

NO_LABEL = "is empty; every row needs its label"

NEARBY = 1000
"""Lines after a broken one that show whether few are."""


@frozen()
class ReadOptions:
    """What a user states about the form of a table.

    Attributes:
        skip_rows: lines at its beginning that are not looked at.
        skip_bad: leave out rows that cannot be read, up to MOST_BAD of them.
        line: what the lines of readings begin with, among lines of several kinds; None to find them by their words.
        count: the column of counts, or ``none``; None to find it by its name.
        where: conditions that the rows to read meet, each as COLUMN=VALUE.
        accelerometer: of a log that has several, by its name there; many: whether polars reads short inputs, too.
    """

    skip_rows: int = 0
    skip_bad: bool = False
    line: str | None = None
    count: str | None = None
    where: tuple[str, ...] = ()
    accelerometer: str | None = None
    many: bool = False


PLAIN = ReadOptions()


@frozen()
class Selection:
    """Columns to read, counted from 0."""

    numbers: tuple[int, ...]
    gaps: frozenset[int] = frozenset()  # columns whose cells may be empty, or nan where they are numbers
    # Columns read as text: labels, which no row may lack unless they are among the gaps.
    texts: tuple[int, ...] = ()
    needed: tuple[int, ...] = ()  # a line where all of these are empty is no row: that of another sensor
    carried: frozenset[int] = frozenset()  # columns of a slower sensor: an empty cell takes the last value


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
    def units(self) -> tuple[str, ...] | None:
        """Units of the columns, where a row below the header states them."""

    @property
    def facts(self) -> Facts:
        """What stands above the table."""

    @property
    def source_format(self) -> str:
        """How the input is written: ``csv``, whatever separates its columns, ``parquet``, or a native format's name."""

    @property
    def correction(self) -> VehicleCorrection | None:
        """What a vehicle had done to the readings that it logged; None where it is no log of a vehicle."""

    @property
    def notes(self) -> tuple[str, ...]:
        """What was skipped, in sentences; complete once all blocks have been read."""

    @property
    def rows_skipped(self) -> int:
        """Rows left out as broken so far."""

    @property
    def lenient(self) -> bool:
        """Whether broken rows are to be left out."""

    def leave_out(self, row: int) -> None:
        """Count a row (from 0) that has been read among the broken ones."""

    def preview(self) -> list[list[str]]:
        """Return the cells of some of the first rows that are read."""

    def keep_only(self, rows: RowFilter) -> None:
        """Read only those rows."""

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


def open_table(
    source: Source, stdin: BinaryIO | None = None, *, hashed: bool = True, options: ReadOptions = PLAIN
) -> InputTable:
    """Open a table of any supported form; ``-`` is standard input. Without the hash it is read a little faster."""
    if not isinstance(source, str | Path):
        from accelcal_cli.io.parquet import MemoryTable

        return MemoryTable(source)
    stream, path = open_source(source, stdin, hashed=hashed), None if str(source) == "-" else Path(source)
    try:
        if stream.head.startswith(TYPED) or (path and path.suffix.lower() in {".parquet", ".pq"}):
            from accelcal_cli.io.parquet import open_typed

            return open_typed(stream, None if stream.forms else path, options.accelerometer)
        if stream.native is not None:
            from accelcal_cli.io.formats.base import NativeTable

            return NativeTable(stream, None if stream.forms else path, options)
        return TextTable(stream, options)
    except BaseException:
        stream.close()
        raise


class TextTable:
    """A table in text form."""

    def __init__(self, source: ByteSource, options: ReadOptions = PLAIN) -> None:
        """Find the dialect of `source` from its head."""
        self.name = source.name
        self._source, self._options = source, options
        form = options.skip_rows, options.line, options.accelerometer
        self._words, self.dialect = understand(source.head, source.name, *form)
        self.correction = None if self._words is None else self._words.correction
        if (sensor := options.accelerometer) is not None and self.correction is None:
            raise UsageError(f'--accelerometer "{sensor}": {self.name} is a table; use --columns or --where')
        self.names, self.units, self.facts = self.dialect.names, self.dialect.units, self.dialect.facts
        cells = self.dialect.first + ("",) * (self.dialect.width - len(self.dialect.first))
        self.numeric = tuple(looks_numeric(cell) for cell in cells[: self.dialect.width])
        self.has_rows = bool(self.dialect.first)
        self.passed, self.lenient = PassedLines(), options.skip_bad
        self.filter: RowFilter | None = None
        self._lines = LineMap()

    @property
    def translated(self) -> bool:
        """Whether the rows are not the lines of the input but what was found in them."""
        return self._words is not None

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes read so far."""
        return self._source.sha256

    source_format = "csv"

    @property
    def rows_skipped(self) -> int:
        """Rows left out as broken so far."""
        return len(self.passed.bad) + (self.passed.cut is not None)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was skipped, in sentences; complete once all blocks have been read."""
        notes = [f"read as {' in '.join(reversed(self._source.forms))}"] * bool(self._source.forms)
        if self._options.skip_rows:
            notes.append(f"the first {self._options.skip_rows:,} lines skipped (--skip-rows)")
        notes += self.dialect.notes()
        notes += () if self._words is None else self._words.notes()
        return (*notes, *self.passed.notes())

    def leave_out(self, row: int) -> None:
        """Count a row (from 0) that has been read among the broken ones."""
        self.passed.bad.append(self._lines.line(row))

    def preview(self) -> list[list[str]]:
        """Return the cells of some rows of the head that are read, spread over it."""
        marks, separator = self.dialect.marks, self.dialect.separator
        rows = [split_cells(text, separator) for text in self._sample if not is_comment(text, marks)]
        whole = [cells for cells in rows if len(cells) >= self.dialect.width]
        return [cells for cells in whole if self.filter is None or self.filter.meets(cells)]

    @cached_property
    def _sample(self) -> list[str]:
        """Lines spread over the head."""
        head = self._source.head if self._words is None else self._words.translate(self._source.head)
        ends = np.flatnonzero(np.frombuffer(head, np.uint8) == ord("\n"))
        starts = np.append(0, ends + 1)[self.dialect.top :]
        ends = np.append(ends, len(head))[self.dialect.top :]
        filled = ends > starts
        starts, ends = starts[filled], ends[filled]
        step = max(1, len(starts) // SAMPLE)
        pairs = zip(starts[::step].tolist(), ends[::step].tolist(), strict=True)
        return [head[start:end].decode(errors="replace").rstrip("\r") for start, end in pairs]

    def keep_only(self, rows: RowFilter) -> None:
        """Read only those rows, which may hold numbers where the first row of the table holds none."""
        self.filter = rows
        first = next(iter(self.preview()), None)
        if first is not None:
            self.numeric = tuple(looks_numeric(cell) for cell in first[: self.dialect.width])

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns; short inputs never import polars."""
        return (rows for _, rows in self.pairs(selection))

    def pairs(self, selection: Selection) -> Iterator[tuple[bytes, RowBlock]]:
        """Read blocks of whole lines, each with the selected columns of its rows."""
        careful = CarefulParser(self.name, self.dialect, selection, self.filter, lenient=self.lenient)
        self._lines, self.passed = careful.lines, careful.passed
        parser = careful if self._source.whole and not self._options.many else FastParser(careful)
        for raw in self._source.blocks():
            block = raw if self._words is None else self._words.translate(raw)
            top = _top(block, self.dialect.top) if careful.line == 0 else 0
            if top and (kept := self._kept(block[:top], top=self.dialect.top > 0)):
                yield kept, careful.parse(kept)
            if top < len(block) and (kept := self._kept(block[top:])):
                yield kept, parser.parse(kept)
        if self.filter is not None:
            self.filter.check()
        careful.check_passed()

    def _kept(self, block: bytes, *, top: bool = False) -> bytes:
        rows = self.filter
        return block if rows is None else rows.keep_all(block) if top else rows.keep(block, self.dialect)

    @property
    def where(self) -> Callable[[int], str]:
        """Line of a row that has been read."""
        if self.filter is None:
            return self._lines.where
        return partial(kept_line, self._lines, self.filter.lines)

    def close(self) -> None:
        """Release the file."""
        self._source.close()


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
    lenient: bool = False  # leave out broken rows
    passed: PassedLines = field(default_factory=PassedLines)
    last: dict[int, float] = field(default_factory=dict)  # values of the columns that are carried on

    def __post_init__(self) -> None:
        """Let lines that are no rows be named by their numbers in the input."""
        self.passed.kept = None if self.filter is None else self.filter.lines

    def parse(self, block: bytes) -> RowBlock:
        """Return the rows of a block of whole lines; the first wrong cell raises DataError."""
        start, values, top = self.row, array("d"), max(self.dialect.top, self.dialect.header_line)
        texts: tuple[list[str], ...] = tuple([] for _ in self.selection.texts)
        lines = io.BytesIO(block)
        for raw in lines:
            self.line += 1
            if self.line <= top:
                continue
            try:
                parts = self._parts(raw)
            except DataError as fault:
                if self._is_passed(raw):
                    continue
                if self._few_are_broken(lines):
                    raise DataError(f"{fault}{SKIPPABLE}") from fault
                raise
            if parts is None:
                continue
            self.lines.add(self.row, self.line)
            values.extend(parts[0])
            for text, label in zip(texts, parts[1], strict=True):
                text.append(label)
            self.row += 1
        numbers = np.frombuffer(values, dtype=np.float64) if values else np.empty(0)
        return RowBlock(start, numbers.reshape(self.row - start, len(self.selection.numbers)), texts)

    def _few_are_broken(self, lines: Iterable[bytes]) -> bool:
        """Return whether --skip-bad would leave out this row, going by the rows so far and the next lines."""
        rows, bad = self.row, 1
        for raw in islice(lines, NEARBY):
            self.line += 1
            try:
                rows += self._parts(raw) is not None
            except DataError:
                bad += 1
        return bad <= MOST_BAD * (bad + rows)

    def check_passed(self) -> None:
        """Refuse a table of which too many rows are broken."""
        bad = len(self.passed.bad)
        if bad > MOST_BAD * (bad + self.row):
            raise DataError(
                f"{self.source}: {bad:,} of {bad + self.row:,} rows are broken, more than the {MOST_BAD:.0%} that "
                f"--skip-bad leaves out: {self.passed.named(self.passed.bad)}"
            )

    def _parts(self, raw: bytes) -> tuple[list[float], list[str]] | None:
        """Return numbers and texts of a line, None for one that is no row."""
        line = decode_line(raw.removeprefix(BOM) if self.line == 1 else raw, self._line(), self.source)
        if is_blank(line) or is_comment(line, self.dialect.marks):
            return None
        cells = self._cells(line)
        selection, needed = self.selection, self.selection.needed
        if self.dialect.header_line and self._is_header(cells):
            self.passed.headers.append(self.line)
            return None
        for column in selection.carried:
            if (value := to_number(cells[column], self.dialect.decimal_comma)) is not None:
                self.last[column] = value
        if needed and not any(cells[column] for column in needed):
            self.passed.merged += 1
            return None
        numbers = [self._number(cells[column], column) for column in selection.numbers]
        return numbers, [self._label(cells[column], column) for column in selection.texts]

    def _is_header(self, cells: Sequence[str]) -> bool:
        """Return whether a row repeats the header or the units below it."""
        names, units = self.dialect.names or (), self.dialect.units or ()
        return tuple(cells) == names or (bool(units) and tuple(cells) == units[: len(cells)])

    def _is_passed(self, raw: bytes) -> bool:
        """Return whether a line that cannot be read is left out: one that power-off cut, or any on request."""
        if not raw.endswith(b"\n") and len(raw) <= LONGEST_LINE and self._is_cut(raw):
            self.passed.cut = self.line
            return True
        if self.lenient:
            self.passed.bad.append(self.line)
        return self.lenient

    def _is_cut(self, raw: bytes) -> bool:
        cells = split_cells(raw.decode(errors="replace").strip("\0\r\n"), self.dialect.separator)
        return bool(self.row) and (b"\0" in raw or len(cells) < self.dialect.width)

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
        if not cell and column in self.last:
            return self.last[column]
        if column in self.selection.gaps and (not cell or (value is not None and math.isnan(value))):
            return math.nan
        raise DataError(f"{self._place(column)}: {_describe_cell(cell, value, self.dialect.decimal_comma)}")

    def _label(self, cell: str, column: int) -> str:
        if cell or column in self.selection.gaps:
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
        marked = any(mark.encode() in block for mark in MARKS) or (dialect.separator != ";" and b";" in block)
        odd = marked or b"\0" in block or not block.endswith(b"\n")
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
        # Column after column, which is faster to reduce.
        numbers = np.array([column.to_numpy() for column in series]).T
        if series and not (numbers.min() >= -LIMIT and numbers.max() <= LIMIT):  # nan fails both
            return None
        texts = tuple(frame[str(k)].str.strip_chars().fill_null("").to_list() for k in selection.texts)
        whole = all(k in selection.gaps or all(text) for k, text in zip(selection.texts, texts, strict=True))
        return RowBlock(self.careful.skip(len(frame)), numbers, texts) if whole else None

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


def _top(block: bytes, top: int) -> int:
    """Return the number of bytes up to the end of line `top`, or of the first line."""
    end = 0
    for _ in range(max(top, 1)):
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
