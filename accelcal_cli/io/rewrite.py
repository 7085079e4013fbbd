"""A text log rewritten with new columns, added or in place of its readings; every other byte stays as it was."""

from __future__ import annotations

import errno
import io
import os
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import IO, TYPE_CHECKING

from accelcal_cli.arrays import Float
from accelcal_cli.io.dialect import BOM, Dialect, is_blank, is_comment, split_cells
from accelcal_cli.io.reader import Selection, TextTable, has_outer_blank_line
from accelcal_cli.io.stream import BackgroundThread

if TYPE_CHECKING:
    import polars as pl

BATCH = 8192
"""Rows that polars formats at a time."""

SMALL = 1 << 20
"""Bytes: a block up to this size does not need polars."""


@dataclass(frozen=True)
class Change:
    """What to do to every row.

    Attributes:
        selection: the columns that the new ones are computed from.
        compute: new columns, shape (B, k), of the selected ones, shape (B, n).
        names: of the new columns.
        places: columns that the first new ones replace; empty when all are added at the end.
    """

    selection: Selection
    compute: Callable[[Float], Float]
    names: Sequence[str]
    places: tuple[int, ...] = ()

    def put(self, frame: pl.DataFrame, columns: list[pl.Series]) -> pl.DataFrame:
        """Return a frame of old columns with the new ones in their places and at its end."""
        for place, column in zip(self.places, columns, strict=False):
            frame.replace_column(place, column)
        return frame.hstack(columns[len(self.places) :])


def rewrite(table: TextTable, change: Change, file: IO[bytes]) -> None:
    """Write the changed log in constant memory: a block is written in the background while the next is parsed.

    Of lines with words, or of several kinds, the rows that were found in them are written, below a header.

    Raises:
        DataError: a cell that is wrong, by its line and column.
        OSError: the file cannot be written.
    """
    lines, writing = _LineWriter(table.dialect, change, translated=table.translated), BackgroundThread()
    try:
        file.write(lines.header())
        for block, rows in table.pairs(change.selection):
            lines.passed.update(table.passed.lines())
            writing.start(partial(lines.write, block, change.compute(rows.numbers), file))
    finally:
        writing.wait()


class _LineWriter:
    """Writes blocks of whole lines, and keeps count of lines across blocks."""

    def __init__(self, dialect: Dialect, change: Change, *, translated: bool) -> None:
        self.dialect, self.change, self.translated = dialect, change, translated
        self.line = 0
        self.passed: set[int] = set()  # lines that are no rows
        self.glue = dialect.separator.encode()
        self.titled = dialect.names is None or dialect.header_line > 0
        self.quoted = dialect.decimal_comma and dialect.separator == ","

    def header(self) -> bytes:
        """Return the header of rows that were found in lines, nothing for lines that stay."""
        if not self.translated or self.dialect.names is None:
            return b""
        names = self.glue.join(name.encode() for name in self.dialect.names)
        return self._changed(names, [name.encode() for name in self.change.names]) + b"\n"

    def write(self, block: bytes, values: Float, file: IO[bytes]) -> None:
        """Write the changed block: by polars where every line is a plain row, else line by line."""
        end = "\r\n" if b"\r" in block else "\n"
        if not (
            self._plain(block, len(values), end.encode()) and self._write_plain(block, values, end, file)
        ):
            file.write(self._careful(block, values))

    def _plain(self, block: bytes, rows: int, end: bytes) -> bool:
        """Return whether to try polars: past the header, one kind of line ends, no blank line that it would drop."""
        past_header = self.titled and self.line >= self.dialect.top
        one_end = end == b"\n" or block.count(end) == block.count(b"\r") == block.count(b"\n")
        whole = one_end and block.endswith(end) and not has_outer_blank_line(block)
        regular = not self.change.places or self._regular(block, rows)
        return len(block) >= SMALL and not self.quoted and past_header and whole and regular

    def _regular(self, block: bytes, rows: int) -> bool:
        """Return whether only separators divide the cells, as many on every line, with none left at its end."""
        return (
            b'"' not in block
            and self.glue != b" "
            and block.count(self.glue) == (self.dialect.width - 1) * rows
        )

    def _write_plain(self, block: bytes, values: Float, end: str, file: IO[bytes]) -> bool:
        import polars as pl

        separator, width = self.dialect.separator, self.dialect.width
        # With a separator that no text has, a line is one cell.
        split, names = (separator, range(width)) if self.change.places else ("\x01", range(1))
        if split == "\x01" and b"\x01" in block:
            return False
        schema = {f"old {k}": pl.String for k in names}
        try:
            frame = pl.read_csv(block, has_header=False, schema=schema, quote_char=None, separator=split)
        except pl.exceptions.PolarsError:
            return False
        left_over = (
            separator != " " and not self.change.places and frame["old 0"].str.ends_with(separator).any()
        )
        odd = len(frame) != len(values)  # comments, or blank lines
        if odd or (left_over and not self._regular(block, len(values))):
            return False
        new = [pl.Series(f"new {k}", column) for k, column in enumerate(values.T)]
        file.flush()
        with system_errors():
            self.change.put(frame, new).write_csv(
                file,
                include_header=False,
                separator=separator,
                line_terminator=end,
                quote_style="never",
                batch_size=BATCH,
                decimal_comma=self.dialect.decimal_comma,
            )
        self.line += len(values)
        return True

    def _careful(self, block: bytes, values: Float) -> bytes:
        """Return the changed block, line by line."""
        cells = [[self._number(v) for v in row] for row in values.tolist()]
        out, row = [], 0
        for raw in io.BytesIO(block):
            self.line += 1
            line = raw.rstrip(b"\r\n")
            text = line.removeprefix(BOM).decode(errors="replace").lstrip()
            if self.translated and is_blank(text):
                continue
            if self.line == self.dialect.header_line:
                line = self._changed(line, [name.encode() for name in self.change.names])
            elif is_comment(text, self.dialect.marks):
                line = self._comment(line)
            elif not (is_blank(text) or self.line <= self.dialect.top or self.line in self.passed):
                self.titled = True
                line = self._changed(line, cells[row])
                row += 1
            out += [line, raw[len(raw.rstrip(b"\r\n")) :]]
        return b"".join(out)

    def _number(self, value: float) -> bytes:
        text = repr(value) if value == value else "NaN"  # as polars writes it
        text = text.replace(".", ",") if self.dialect.decimal_comma else text
        return (f'"{text}"' if self.quoted else text).encode()

    def _comment(self, line: bytes) -> bytes:
        """Return a comment line; one that names the columns names the new ones, too."""
        body = line.lstrip().lstrip(b"#/%;")
        names = split_cells(body.decode(errors="replace"), self.dialect.separator)
        if self.titled or names != list(self.dialect.names or ()):
            return line
        self.titled = True
        return line.removesuffix(body) + self._changed(body, [name.encode() for name in self.change.names])

    def _changed(self, line: bytes, cells: Sequence[bytes]) -> bytes:
        """Return a line with the first new cells in their places and the others at its end."""
        spans = _spans(line, self.glue)
        if len(spans) == self.dialect.width + 1 and spans[-1][0] == spans[-1][1]:
            line = line[: spans.pop()[0] - 1]  # a separator at the end of the line
        places = self.change.places
        for place, cell in sorted(zip(places, cells, strict=False), reverse=True):
            start, stop = spans[place]
            line = line[:start] + cell + line[stop:]
        return self.glue.join([line, *cells[len(places) :]])


def _spans(line: bytes, glue: bytes) -> list[tuple[int, int]]:
    """Return where the cells of a line start and stop; a separator within quotes divides none."""
    if glue == b" ":
        return [match.span() for match in re.finditer(rb'"[^"]*"|\S+', line)]
    cuts = [at.start() for at in re.finditer(re.escape(glue), line)]
    if b'"' in line:
        cuts = [at for at in cuts if line.count(b'"', 0, at) % 2 == 0]
    return list(zip([0, *(at + 1 for at in cuts)], [*cuts, len(line)], strict=True))


@contextmanager
def system_errors() -> Iterator[None]:
    """Raise the faults of the system that polars wraps as OSError again: a full disk, a closed pipe."""
    import polars as pl

    try:
        yield
    except (pl.exceptions.PolarsError, OSError) as problem:
        if isinstance(problem, OSError) and problem.errno:
            raise
        reason = str(problem).strip().splitlines()[0]
        number = re.search(r"os error (\d+)", reason)
        code = int(number[1]) if number else errno.EIO
        raise OSError(code, os.strerror(code) if number else reason) from problem
