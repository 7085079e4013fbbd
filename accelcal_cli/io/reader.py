"""Numeric tables as streams of row blocks: one interface for text of any dialect and for Parquet."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, Protocol

from accelcal_cli.io.dialect import looks_numeric, sniff
from accelcal_cli.io.stream import ByteSource, open_source
from accelcal_cli.io.text import CarefulParser, FastParser, LineMap, RowBlock, Selection


class Table(Protocol):
    """A table that can be read once, from top to bottom."""

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
        self._source = source
        self._lines = LineMap()

    @property
    def sha256(self) -> str:
        """SHA-256 of the bytes read so far."""
        return self._source.sha256

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns; short inputs never import polars."""
        for _, rows in self.pairs(selection):
            yield rows

    def pairs(self, selection: Selection) -> Iterator[tuple[bytes, RowBlock]]:
        """Read blocks of whole lines, each with the selected columns of its rows."""
        careful = CarefulParser(self.name, self.dialect, selection)
        self._lines = careful.lines
        parse = careful.parse if self._source.whole else FastParser(careful).parse
        for block in self._source.blocks():
            top = _top(block, self.dialect.header_line) if careful.line == 0 else 0
            if top:
                yield block[:top], careful.parse(block[:top])
            if top < len(block):
                yield block[top:], parse(block[top:])

    @property
    def where(self) -> Callable[[int], str]:
        """Line of a row that has been read."""
        return self._lines.where

    def close(self) -> None:
        """Release the file."""
        self._source.close()


def open_table(source: str | Path, stdin: BinaryIO | None = None, *, hashed: bool = True) -> Table:
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


def _top(block: bytes, header_line: int) -> int:
    """Return the number of bytes up to the end of the header, or of the first line."""
    end = 0
    for _ in range(max(header_line, 1)):
        end = block.find(b"\n", end) + 1 or len(block)
    return end
