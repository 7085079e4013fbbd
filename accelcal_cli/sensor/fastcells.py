"""The fast parser of table rows: polars on whole blocks, wherever that is sure to mean the same."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.sensor.cells import LIMIT, CarefulParser, Rows

if TYPE_CHECKING:
    import polars as pl


class FastParser:
    """Parses what polars reads beyond doubt, and hands every other block to the careful parser.

    Beyond doubt: no quotes, comments or blank lines, every row as wide as the first, every number finite.
    So the careful parser alone says what a table means, and words every error.
    """

    def __init__(self, careful: CarefulParser) -> None:
        """Share rows, lines and selection with `careful`."""
        self.careful = careful

    def parse(self, block: bytes) -> Rows:
        """Rows of a block of whole lines."""
        for form in (self._bare, self._plain):
            plain = form(block)
            frame = None if plain is None else self._frame(plain)
            numbers = None if frame is None else self._numbers(frame)
            texts = None if frame is None else self._texts(frame)
            if numbers is not None and texts is not None:
                return Rows(self.careful.skip(len(numbers)), numbers, texts)
        return self.careful.parse(block)

    def _bare(self, block: bytes) -> bytes | None:
        """The block as it is, where every column is read as a number, so that nothing odd can hide."""
        dialect, selection = self.careful.dialect, self.careful.selection
        if len(set(selection.numbers)) < dialect.width or selection.texts:
            return None
        doubtful = dialect.decimal_comma or not block.endswith(b"\n") or has_outer_blank_line(block)
        return None if doubtful else block

    def _plain(self, block: bytes) -> bytes | None:
        """The block with one-byte separators only, or None if it needs care."""
        dialect = self.careful.dialect
        if b"#" in block or b"\0" in block or not block.endswith(b"\n"):
            return None
        if not set(self.careful.selection.texts).isdisjoint(self.careful.selection.numbers):
            return None
        if dialect.decimal_comma and (b"." in block or dialect.separator == ","):
            return None
        if not block.isascii() and not _is_utf8(block):
            return None
        if b"\r" in block:
            block = block.replace(b"\r\n", b"\n")
        squeezed = _squeeze(block, dialect.separator)
        if b'"' in block and (dialect.separator == " " or squeezed != block):
            return None  # blanks within quotes belong to the cell
        return None if b"\r" in squeezed or has_outer_blank_line(squeezed) else squeezed

    def _frame(self, block: bytes) -> pl.DataFrame | None:
        import polars as pl

        dialect, selection = self.careful.dialect, self.careful.selection
        quoted = b'"' in block
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
        if quoted and _count(block, "\n") != len(frame):
            return None  # a cell goes on over the end of its line
        if frame[str(dialect.width - 1)].null_count():  # an empty last cell, or a row that is short
            short = quoted or _count(block, dialect.separator) != (dialect.width - 1) * len(frame)
            return None if short else frame
        return frame

    def _numbers(self, frame: pl.DataFrame) -> NDArray[np.float64] | None:
        columns = self.careful.selection.numbers
        numbers = np.empty((len(columns), len(frame))).T  # one column after the other: faster to reduce
        for k, column in enumerate(columns):
            series = frame[str(column)]
            if series.null_count():
                return None
            numbers[:, k] = series.to_numpy()
        sound = numbers.min() >= -LIMIT and numbers.max() <= LIMIT  # nan fails both
        return numbers if sound else None

    def _texts(self, frame: pl.DataFrame) -> tuple[list[str], ...] | None:
        """Stripped text of the text columns, None where a cell is empty."""
        found = []
        for column in self.careful.selection.texts:
            text = [(cell or "").strip() for cell in frame[str(column)].to_list()]
            if not all(text):
                return None
            found.append(text)
        return tuple(found)


def has_outer_blank_line(block: bytes) -> bool:
    """Whether a block begins or ends with a blank line; polars passes over these without a null."""
    return block[:1] in b"\r\n" or block.endswith((b"\n\n", b"\r\n\r\n", b"\n\r\n"))


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
