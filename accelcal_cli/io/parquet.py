"""Tables whose columns have types, Parquet, Arrow and frames, read with polars; logs written as Parquet, or as text."""

from __future__ import annotations

import hashlib
import struct
import tempfile
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, Any, TypeVar, cast

import numpy as np
import polars as pl

from accelcal_cli.arrays import Int
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import NativeTable, RandomAccess, no_room
from accelcal_cli.io.reader import LIMIT, NO_LABEL, InputTable, Selection, TextTable
from accelcal_cli.io.rewrite import Change, system_errors
from accelcal_cli.io.rows import RowBlock, RowFilter, kept_row
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts

ROWS = 500_000
"""Rows of a block."""

WHOLE, NAME_OF_DIGITS = r"^-?(0|[1-9][0-9]*)$", r"^-?0[0-9]"
"""Cells that are whole numbers, and cells such as 007, which are names though they are digits."""

ARROW_FILE, ARROW_STREAM = b"ARROW1", b"\xff\xff\xff\xff"
"""How a file begins, and every message."""

ARROW_END = ARROW_STREAM + b"\0\0\0\0"
"""What ends a stream."""

DICTIONARY, BATCH = 2, 3
"""Kinds of messages with rows, or what rows refer to."""

Cells = TypeVar("Cells", pl.Series, pl.Expr)

GROUP = 100_000
"""Rows that are written at once: groups of polars' own choice are larger the longer the table is."""

PREVIEW = 2000
"""Rows that the columns are told by where their names do not."""


class FrameTable(ABC):
    """A table whose columns have types, read as frames of polars."""

    names: tuple[str, ...]
    numeric: tuple[bool, ...]
    has_rows: bool
    units: tuple[str, ...] | None = None
    facts = Facts()
    correction = None
    notes: tuple[str, ...] = ()
    rows_skipped = 0
    lenient = False  # its cells have types: none is broken
    source_format: str
    seekable = False  # whether some rows can be read alone
    window: tuple[int, int | None] = (0, None)  # first row that is read, and the one after the last

    def __init__(self, source: ByteSource) -> None:
        """Take over the source."""
        self.name = source.name
        self.filter: RowFilter | None = None
        self._source = source

    @abstractmethod
    def _head(self) -> pl.DataFrame:
        """Return the first rows, PREVIEW at most."""

    @abstractmethod
    def _batches(self, wanted: Sequence[str]) -> Iterator[pl.DataFrame]:
        """Yield the rows with the columns that are wanted, in blocks."""

    def _take(self, schema: pl.Schema) -> None:
        """Take over names and types of the columns."""
        self.names = tuple(schema)
        self.numeric = tuple(kind.is_numeric() for kind in schema.values())

    @property
    def sha256(self) -> str:
        """SHA-256 of the input."""
        deque(self._source.rest(), maxlen=0)
        return self._source.sha256

    def leave_out(self, row: int) -> None:  # noqa: B027
        """Never called: no row is broken."""

    def preview(self) -> list[list[str]]:
        """Return the cells of those of the first rows that are read."""
        rows = (["" if cell is None else str(cell) for cell in row] for row in self._head().iter_rows())
        return [cells for cells in rows if self.filter is None or self.filter.meets(cells)]

    def keep_only(self, rows: RowFilter) -> None:
        """Read only those rows."""
        self.filter = rows

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns."""
        conditions = () if self.filter is None else (c.column for c in self.filter.conditions)
        wanted = dict.fromkeys(self.names[k] for k in (*selection.numbers, *selection.texts, *conditions))
        return (rows for _, rows in self.pairs(selection, list(wanted)))

    def pairs(
        self, selection: Selection, wanted: Sequence[str] | None = None
    ) -> Iterator[tuple[pl.DataFrame, RowBlock]]:
        """Read blocks of all columns, or of those `wanted`, each with the selected columns of its rows."""
        for column in selection.numbers:
            if not self.numeric[column]:
                raise DataError(f'{self.name}, column "{self.names[column]}": does not hold numbers')
        start = self.window[0]
        for whole in self._batches(wanted or self.names):
            frame = whole if self.filter is None else self.filter.rows(whole)
            numbers = np.empty((frame.height, len(selection.numbers)))
            for k, column in enumerate(selection.numbers):
                series = frame[self.names[column]].cast(pl.Float64).fill_null(float("nan"))
                numbers[:, k] = series.to_numpy()
                self._check(numbers[:, k], start, column, column in selection.gaps)
            labels = tuple(self._labels(frame, start, column) for column in selection.texts)
            yield frame, RowBlock(start, numbers, labels)
            start += frame.height
        if self.filter is not None:
            self.filter.check()

    @property
    def where(self) -> Callable[[int], str]:
        """Row number, counted from 1."""
        if self.filter is None:
            return _row
        return partial(kept_row, self.filter.lines)

    def close(self) -> None:
        """Close the file."""
        self._source.close()

    def _check(self, numbers: np.ndarray, start: int, column: int, gaps: bool) -> None:
        bad = ~(np.abs(numbers) <= LIMIT) & ~(np.isnan(numbers) & gaps)
        if bad.any():
            row, value = int(np.argmax(bad)), numbers[np.argmax(bad)]
            what = "is empty or nan" if np.isnan(value) else f"{value:g} is too large or infinite"
            raise DataError(f"{self._place(start + row, column)}: {what}; a finite number was expected")

    def _labels(self, frame: pl.DataFrame, start: int, column: int) -> list[str]:
        series = frame[self.names[column]]
        try:
            labels: list[str | None] = series.cast(pl.String).to_list()
        except pl.exceptions.PolarsError:  # lists, or bytes that are not UTF-8
            raise DataError(
                f'{self.name}, column "{series.name}": holds {series.dtype}; text or numbers were expected as labels'
            ) from None
        if not all(labels):
            row = next(row for row, label in enumerate(labels) if not label)
            raise DataError(f"{self._place(start + row, column)}: {NO_LABEL}")
        return cast("list[str]", labels)

    def runs(self, column: int) -> tuple[pl.Series, Int]:
        """Return the labels of a column, each once for a run of equal ones, shape (R,), and the rows of each run."""
        labels, lengths, start = list[pl.Series](), list[Int](), 0
        for frame in self._batches([self.names[column]]):
            cells = frame.to_series()
            if cells.null_count():
                self._labels(frame, start, column)  # names the row
            short = cells.rle()
            own = self._labels(short.struct.field("value").to_frame(self.names[column]), start, column)
            rows = short.struct.field("len").to_numpy().astype(np.intp)
            if labels and labels[-1][-1] == own[0]:
                lengths[-1][-1] += rows[0]
                own, rows = own[1:], rows[1:]
            if own:
                labels.append(pl.Series(own, dtype=pl.String))
                lengths.append(rows)
            start += frame.height
        return pl.concat(labels), np.concatenate(lengths)

    def _place(self, row: int, column: int) -> str:
        return f'{self.name}, {self.where(row)}, column "{self.names[column]}"'


class ParquetTable(FrameTable):
    """A Parquet file, streamed a batch of rows at a time."""

    source_format = "parquet"
    form = "Parquet"

    def __init__(self, source: ByteSource, path: Path | None) -> None:
        """Read the schema. Without a `path` (standard input) make a copy: the schema is at the end of the file."""
        super().__init__(source)
        self._file = RandomAccess(source, path, f".{self.source_format}")
        self._path = self._file.path
        try:
            with _named_errors(self.name, self.form):
                frame = self._scan(self._path)
                self._take(frame.collect_schema())
                self.has_rows = bool(frame.head(1).collect().height)
        except BaseException:
            self._file.close()
            raise
        self.seekable = path is not None

    @staticmethod
    def _scan(path: Path) -> pl.LazyFrame:
        return pl.scan_parquet(path)

    @property
    def sha256(self) -> str:
        """SHA-256 of the file."""
        self._file.wait()
        return self._source.sha256

    def _head(self) -> pl.DataFrame:
        with _named_errors(self.name, self.form):
            return self._scan(self._path).head(PREVIEW).collect()

    def _batches(self, wanted: Sequence[str]) -> Iterator[pl.DataFrame]:
        lazy, (read, end) = self._scan(self._path).select(wanted), self.window
        while read != end and not (frame := self._batch(lazy, read, end)).is_empty():
            read += frame.height
            yield frame

    def _batch(self, lazy: pl.LazyFrame, start: int, end: int | None) -> pl.DataFrame:
        with _named_errors(self.name, self.form):
            return lazy.slice(start, ROWS if end is None else min(ROWS, end - start)).collect()

    def close(self) -> None:
        """Remove the copy and close the file."""
        self._file.close()
        super().close()


class ArrowTable(ParquetTable):
    """A file of Arrow IPC, whose schema is at its end, too."""

    source_format = "arrow"
    form = "Arrow"

    @staticmethod
    def _scan(path: Path) -> pl.LazyFrame:
        return pl.scan_ipc(path)


class MemoryTable(FrameTable):
    """A frame in memory."""

    source_format = "frame"

    def __init__(self, data: object) -> None:
        """Take over a frame of polars, pandas or Arrow.

        Raises:
            DataError: a frame that polars does not understand.
        """
        self.name = "<frame>"
        self.filter = None
        self._whole = frame_of(data)
        self._take(self._whole.schema)
        self.has_rows = not self._whole.is_empty()

    def _head(self) -> pl.DataFrame:
        return self._whole.head(PREVIEW)

    def _batches(self, wanted: Sequence[str]) -> Iterator[pl.DataFrame]:
        return self._whole.select(wanted).iter_slices(ROWS)

    @property
    def sha256(self) -> str:
        """SHA-256 of the columns as an uncompressed Arrow file."""
        return hashlib.sha256(self._whole.write_ipc(None).getbuffer()).hexdigest()

    def close(self) -> None:
        """Do nothing: the frame is the caller's."""


def frame_of(data: object) -> pl.DataFrame:
    """Return a frame of polars, pandas, Arrow or whatever speaks the Arrow stream protocol as one of polars.

    Raises:
        DataError: a frame that polars does not understand.
    """
    if isinstance(data, pl.DataFrame):
        return data
    if isinstance(data, pl.LazyFrame):
        return data.collect()
    try:
        if type(data).__module__.startswith("pandas"):  # its own Arrow stream needs pyarrow
            columns: Any = data
            return pl.DataFrame([_series(str(name), columns[name].to_numpy()) for name in columns.columns])
        return pl.DataFrame(data)  # type: ignore[arg-type]  # anything with __arrow_c_stream__
    except (pl.exceptions.PolarsError, TypeError, ValueError) as problem:
        reason = str(problem).strip().splitlines()[0][:200]
        raise DataError(f"<frame>: cannot be read as a table ({reason})") from problem


def _series(name: str, values: np.ndarray) -> pl.Series:
    """Return a column of pandas; what it has no type for is text, or nothing where it is missing."""
    if values.dtype != object:
        return pl.Series(name, values)
    missing = [value is None or value != value for value in values]
    return pl.Series(name, [None if gone else str(v) for v, gone in zip(values, missing, strict=True)])


class ArrowStream(FrameTable):
    """A stream of Arrow IPC, a record batch at a time.

    Each record batch is given to polars behind the schema and the dictionaries (arrow.apache.org, Serialization and
    Interprocess Communication): polars itself reads a whole stream into memory.
    """

    source_format = "arrow"

    def __init__(self, source: ByteSource) -> None:
        """Read the schema and the first record batch."""
        super().__init__(source)
        with _named_errors(self.name, "Arrow"):
            self._frames = self._read(ArrowMessages(chain([source.head], source.rest())))
            self._first = next(self._frames)
            while self._first.is_empty() and (frame := next(self._frames, None)) is not None:
                self._first = frame
        self._take(self._first.schema)
        self.has_rows = not self._first.is_empty()

    @staticmethod
    def _read(messages: ArrowMessages) -> Iterator[pl.DataFrame]:
        """Yield first an empty frame with the schema, then the record batches."""
        before = [next(messages)[1]]
        yield pl.read_ipc_stream(b"".join([*before, ARROW_END]))
        for kind, data in messages:
            if kind == DICTIONARY:
                before.append(data)
            elif kind == BATCH:
                yield pl.read_ipc_stream(b"".join([*before, data, ARROW_END]))

    def _head(self) -> pl.DataFrame:
        return self._first.head(PREVIEW)

    def _batches(self, wanted: Sequence[str]) -> Iterator[pl.DataFrame]:
        frames = chain([self._first], self._frames)
        while True:
            with _named_errors(self.name, "Arrow"):
                frame = next(frames, None)
            if frame is None:
                return
            for start in range(0, frame.height, ROWS):
                yield frame.slice(start, ROWS).select(wanted)


class ArrowMessages:
    """The messages of an Arrow stream in blocks of bytes: kind, and the message with its body."""

    def __init__(self, blocks: Iterable[bytes]) -> None:
        """Take over the bytes."""
        self._blocks, self._rest = iter(blocks), b""

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Return itself."""
        return self

    def __next__(self) -> tuple[int, bytes]:
        """Return the next message; ValueError where it is cut off or none."""
        if not (lead := self._peek(8)) or lead.startswith(ARROW_END):
            raise StopIteration
        mark, size = struct.unpack("<4si", lead)
        if mark != ARROW_STREAM or size <= 0:
            raise ValueError("no message begins where one should")
        meta = self._peek(8 + size)[8:]
        (table,) = struct.unpack_from("<I", meta)
        (back,) = struct.unpack_from("<i", meta, table)
        entries, _, _, kind, _, body = struct.unpack_from(
            "<6H", meta, table - back
        )  # of a FlatBuffers vtable
        length = struct.unpack_from("<q", meta, table + body)[0] if entries > 10 and body else 0
        if length < 0:
            raise ValueError("a message has a negative length")
        return meta[table + kind], self._next(8 + size + length)

    def _peek(self, size: int) -> bytes:
        """Return the next bytes, none at the end of the input."""
        parts, length = [self._rest], len(self._rest)
        while length < size and (block := next(self._blocks, None)) is not None:
            parts.append(block)
            length += len(block)
        self._rest = b"".join(parts) if len(parts) > 1 else self._rest
        if 0 < len(self._rest) < size:
            raise ValueError("it is cut off")
        return self._rest[:size]

    def _next(self, size: int) -> bytes:
        data = self._peek(size)
        self._rest = self._rest[size:]
        return data


def open_typed(source: ByteSource, path: Path | None, accelerometer: str | None = None) -> FrameTable:
    """Return a table in Parquet or Arrow; `path` is None for standard input and what was packed.

    Raises:
        UsageError: an accelerometer was asked for, which a table does not tell apart. DataError: it cannot be read.
    """
    if accelerometer is not None:
        raise UsageError(
            f'--accelerometer "{accelerometer}": {source.name} is a table; use --columns or --where'
        )
    if source.head.startswith(ARROW_STREAM):
        return ArrowStream(source)
    return (ArrowTable if source.head.startswith(ARROW_FILE) else ParquetTable)(source, path)


def _row(row: int) -> str:
    return f"row {row + 1}"


@contextmanager
def _named_errors(name: str, form: str) -> Iterator[None]:
    """Raise what polars finds wrong with a file as DataError; a panic of its decoder is no subclass of its errors."""
    try:
        yield
    except DataError:
        raise
    except (
        *(pl.exceptions.PolarsError, pl.exceptions.PanicException, OSError),
        *(ValueError, IndexError, struct.error, MemoryError, StopIteration),
    ) as problem:
        reason = (str(problem).strip() or type(problem).__name__).splitlines()[0][:200]
        raise DataError(f"{name}: cannot be read as {form} ({reason})") from problem


def frames(table: InputTable, change: Change) -> Iterator[pl.DataFrame]:
    """Yield the changed log, block after block."""
    assert isinstance(table, FrameTable | NativeTable)
    for frame, rows in table.pairs(change.selection):
        yield _changed(frame, rows, change)


def _changed(frame: pl.DataFrame, rows: RowBlock, change: Change) -> pl.DataFrame:
    values = np.ascontiguousarray(change.compute(rows.numbers).T)
    new = [pl.Series(name, column) for name, column in zip(change.names, values, strict=True)]
    return change.put(frame, new)


def whole_frame(table: InputTable, change: Change) -> pl.DataFrame:
    """Return the changed log in memory."""
    if isinstance(table, FrameTable | NativeTable):
        return pl.concat(frames(table, change))
    assert isinstance(table, TextTable)
    cells = TextCells(table, change)
    with tempfile.TemporaryDirectory(prefix="accelcal-") as folder:
        return pl.concat(cells.typed(cells.keep(Path(folder))))


def to_text(table: InputTable, change: Change, file: IO[bytes]) -> None:
    """Write the changed log as CSV."""
    for k, frame in enumerate(frames(table, change)):
        with system_errors():
            frame.write_csv(file, include_header=k == 0)


def to_parquet(table: InputTable, change: Change, file: IO[bytes]) -> None:
    """Write the changed log as Parquet, by the name of the file if it has one.

    Raises:
        DataError: a cell that is wrong, by its line and column, or no room for a working copy.
        OSError: it cannot be written.
    """
    target = file.name if isinstance(file.name, str) else file  # an open descriptor has a number for a name
    if isinstance(table, FrameTable | NativeTable):
        with system_errors():
            sink(frames(table, change), target)
        return
    assert isinstance(table, TextTable)
    cells = TextCells(table, change)
    with tempfile.TemporaryDirectory(prefix="accelcal-") as folder:
        parts = cells.keep(Path(folder))
        with system_errors():
            sink(cells.typed(parts), target)


def sink(blocks: Iterator[pl.DataFrame], target: str | IO[bytes]) -> None:
    """Write blocks as they come."""
    from polars.io.plugins import register_io_source

    fault: list[BaseException] = []
    first = next(blocks)

    def source(*_: Any) -> Iterator[pl.DataFrame]:
        yield first
        try:
            yield from blocks
        except BaseException as problem:  # polars would wrap it beyond recognition
            fault.append(problem)

    register_io_source(source, schema=first.schema).sink_parquet(target, row_group_size=GROUP)
    if fault:
        raise fault[0]


class TextCells:
    """The cells of a text log as columns: what all rows tell whether a column is of whole numbers, numbers or text."""

    def __init__(self, table: TextTable, change: Change) -> None:
        """Take over a log that has not been read, and what to do to it."""
        self.table, self.change = table, change
        dialect, numbers = table.dialect, change.selection.numbers
        texts = tuple(k for k in range(dialect.width) if k not in numbers)
        self.selection = replace(change.selection, texts=texts, gaps=change.selection.gaps | set(texts))
        self.names = _names(dialect.names or (), dialect.width)
        self.kinds: dict[str, type[pl.DataType]] = {self.names[k]: pl.Null for k in texts}

    def keep(self, folder: Path) -> list[Path]:
        """Write the changed log, block after block, to files, and learn what its columns are."""
        parts: list[Path] = []
        for frame in self._frames():
            parts.append(folder / f"{len(parts)}.arrow")
            try:
                with system_errors():
                    frame.write_ipc(parts[-1], compression="lz4")
            except OSError as problem:
                raise no_room(self.table.name, problem) from problem
        return parts

    def typed(self, parts: Sequence[Path]) -> Iterator[pl.DataFrame]:
        """Yield the blocks again, with the columns that hold numbers in all rows as such."""
        numbers = [
            self._plain(pl.col(name)).cast(kind)
            for name, kind in self.kinds.items()
            if kind in (pl.Int64, pl.Float64)
        ]
        for part in parts:
            yield pl.read_ipc(part).with_columns(numbers)

    def _frames(self) -> Iterator[pl.DataFrame]:
        """Yield the changed log; cells that are not computed are text as yet, none where they are empty."""
        for rows in self.table.blocks(self.selection):
            numbers = dict(zip(self.selection.numbers, np.ascontiguousarray(rows.numbers.T), strict=True))
            texts = dict(zip(self.selection.texts, rows.texts, strict=True))
            columns = []
            for k, name in enumerate(self.names):
                if k in numbers:
                    columns.append(pl.Series(name, numbers[k]))
                    continue
                cells = pl.Series(name, texts[k], dtype=pl.String)
                columns.append(cells.set(cells == "", None))
                self.kinds[name] = self._kind(columns[-1], self.kinds[name])
            yield _changed(pl.DataFrame(columns), rows, self.change)

    def _kind(self, cells: pl.Series, so_far: type[pl.DataType]) -> type[pl.DataType]:
        """Return what a column is after some more cells; digits behind a leading zero are no number but a name."""
        if cells.null_count() == len(cells):
            return so_far
        if so_far in (pl.Null, pl.Int64):
            if cells.str.contains(WHOLE).all() and _fits(cells, pl.Int64):
                return pl.Int64
            so_far = pl.Float64
        named = cells.str.contains(NAME_OF_DIGITS).any() or (
            self.table.dialect.decimal_comma and cells.str.contains(".", literal=True).any()
        )
        if so_far == pl.Float64 and not named and _fits(self._plain(cells), pl.Float64):
            return pl.Float64
        return pl.String

    def _plain(self, cells: Cells) -> Cells:
        return cells.str.replace(",", ".", literal=True) if self.table.dialect.decimal_comma else cells


def _fits(cells: pl.Series, kind: type[pl.DataType]) -> bool:
    return cells.cast(kind, strict=False).null_count() == cells.null_count()


def _names(names: Sequence[str], width: int) -> list[str]:
    """Return a name for each of `width` columns: its own, its number from 1 where it has none, and no name twice."""
    made: list[str] = []
    for k in range(width):
        name = names[k] if k < len(names) and names[k] else str(k + 1)
        made.append(name if name not in made else f"{name}_{k + 1}")
    return made
