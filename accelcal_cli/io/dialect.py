"""How a text table is written: separator, decimal mark, header; `sniff` finds it from the first lines.

The parsers of text.py and the writer of rewrite.py share the reading of one line that is defined here.
"""

from __future__ import annotations

import csv
import io
import re
from dataclasses import dataclass

from accelcal_cli.errors import DataError
from accelcal_cli.io.stream import LONGEST_LINE

SAMPLE = 1000
"""Content lines that the dialect is found from."""

BOM = b"\xef\xbb\xbf"

_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")

FEWEST_THOUSANDS = 6
"""Cells such as 33,368 from which on they are thousands, where none says that the comma is a decimal mark."""


@dataclass(frozen=True)
class Dialect:
    """The form of a text table. `separator` " " stands for runs of blanks and tabs."""

    separator: str
    decimal_comma: bool
    names: tuple[str, ...] | None  # of the header, None where there is none
    header_line: int  # 0 where the first content line is data
    first: tuple[str, ...]  # cells of the first data row, () where there is none

    @property
    def width(self) -> int:
        """Cells a row must have."""
        return len(self.first if self.names is None else self.names)


def split_cells(line: str, separator: str) -> list[str]:
    """Return the cells of one line, stripped of blanks and quotes."""
    if '"' not in line:
        return line.split() if separator == " " else [cell.strip() for cell in line.split(separator)]
    if separator == " ":
        line = " ".join(line.split())
    try:
        row = next(csv.reader([line.strip(" \r\n")], delimiter=separator, skipinitialspace=True))
    except csv.Error:  # a carriage return or an endless cell: then the quotes are no quotes either
        row = line.split(separator)
    return [cell.strip() for cell in row]


def looks_numeric(cell: str, decimal_comma: bool = True) -> bool:
    """Return whether a cell is meant as a number, be it NaN or infinite."""
    try:
        float(cell.replace(",", ".") if decimal_comma else cell)
    except ValueError:
        return False
    return True


def sniff(head: bytes, source: str) -> Dialect:
    """Find the dialect of a table from its first bytes; DataError, which names the `source`, for no text table."""
    lines, comment = _sample(head, source)
    if not lines:
        raise DataError(f"{source}: is empty; readings were expected, one row per pose")
    texts = [text for _, text in lines]
    separator = _separator(texts[1:] or texts)
    number, opening = lines[0]
    cells = _header_cells(opening, separator)
    names: tuple[str, ...] | None = None
    if _is_header(cells, split_cells(texts[1], separator) if len(texts) > 1 else []):
        names, texts = tuple(cells), texts[1:]
    first = split_cells(texts[0], separator) if texts else []
    if names is None:
        number = 0
        first = _without_tail(first)
        names = _names_of_comment(comment, separator, len(first))
    elif len(first) != len(names) or not first[-1]:
        names = tuple(_without_tail(list(names)))
    decimal_comma = _decimal_comma(texts, separator)
    if decimal_comma:
        _refuse_thousands(texts, separator, source)
    return Dialect(separator, decimal_comma, names, number, tuple(first))


def _sample(head: bytes, source: str) -> tuple[list[tuple[int, str]], str]:
    """Return the first content lines with their numbers, and the last comment line before them."""
    lines: list[tuple[int, str]] = []
    comment = ""
    for number, raw in enumerate(io.BytesIO(head.removeprefix(BOM)), 1):
        text = decode_line(raw, number, source, strict=not lines).strip("\r\n")
        if text.lstrip().startswith("#"):
            comment = comment if lines else text.lstrip()[1:]
        elif not is_blank(text):
            lines.append((number, text))
        if len(lines) == SAMPLE:
            break
    if len(lines) > 2 and not head.endswith(b"\n"):
        lines.pop()  # the head may end within a line
    return lines, comment


def is_blank(line: str) -> bool:
    """Return whether a line is blanks and separators only, or the note `sep=;`: spreadsheets leave both."""
    rest = line.strip(" \t\r\n,;")
    return not rest or rest.lower() == "sep="


def decode_line(raw: bytes, number: int, source: str, *, strict: bool = True) -> str:
    """Return the text of one line; DataError with its number for binary data, another encoding or an endless line."""
    if b"\0" in raw:
        raise DataError(f"{source}, line {number}: holds NUL bytes; this is binary data, not a text table")
    if len(raw) > LONGEST_LINE:
        raise DataError(f"{source}, line {number}: is longer than 1 MB; this is not a table of readings")
    try:
        return raw.decode(errors="strict" if strict else "replace")
    except UnicodeDecodeError as problem:
        raise DataError(
            f"{source}, line {number}: byte {raw[problem.start]:#04x} at position {problem.start + 1} "
            "is not UTF-8 text; save the file as UTF-8"
        ) from problem


def _separator(lines: list[str]) -> str:
    """Return the separator of the data lines: the one under which the largest share of cells are numbers."""
    bare = [_QUOTED.sub("0", line.strip("\r\n")) for line in lines[:64]]
    best, share = " ", -1.0
    for separator in (";", "\t", ",", " "):
        rows = [split_cells(line, separator) for line in bare]
        if 2 * sum(len(row) > 1 for row in rows) <= len(bare):
            continue
        numeric = _numeric_share(rows, decimal_comma=separator != ",")
        # aligned columns: tabs in runs, which would else be empty cells
        aligned = separator == " " and best == "\t" and numeric == share and _uneven("\t", " ", bare)
        if numeric > share or aligned:
            best, share = separator, numeric
    return best


def _numeric_share(rows: list[list[str]], *, decimal_comma: bool) -> float:
    cells = [cell for row in rows for cell in row if cell]
    numeric = sum(_DECIMAL_COMMA.fullmatch(cell) is not None for cell in cells) if decimal_comma else 0
    return (numeric + sum(looks_numeric(cell, decimal_comma=False) for cell in cells)) / max(len(cells), 1)


def _uneven(first: str, second: str, lines: list[str]) -> bool:
    """Return whether `first` leaves rows of different widths and `second` does not."""
    widths = [{len(split_cells(line.strip(), separator)) for line in lines} for separator in (first, second)]
    gaps = any("" in split_cells(line.strip(), first) for line in lines)
    return (len(widths[0]) > 1 or gaps) and len(widths[1]) == 1


def _decimal_comma(lines: list[str], separator: str) -> bool:
    """Return whether the first fraction among the data is written with a comma."""
    rows = (split_cells(line, separator) for line in lines if "," in line or "." in line)
    commas = (
        (_DECIMAL_COMMA.fullmatch(cell) is not None, "." in cell and looks_numeric(cell))
        for row in rows
        for cell in row
    )
    return next((comma for comma, point in commas if comma or point), False)


def _refuse_thousands(lines: list[str], separator: str, source: str) -> None:
    """Raise DataError where commas separate thousands, as in 33,368, which a decimal comma would read as 33.368.

    Fractions of three digits are told from thousands by cells such as 0,012: no number with thousands begins so.
    """
    cells = [cell for line in lines for cell in split_cells(line, separator) if "," in cell]
    numbers = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell) or _THOUSANDS.fullmatch(cell)]
    if len(numbers) < FEWEST_THOUSANDS or not all(_THOUSANDS.fullmatch(cell) for cell in numbers):
        return
    shown = numbers[0]
    raise DataError(
        f'{source}: "{shown}" has a thousands separator, it seems, as have all numbers with a comma: a decimal comma '
        f"would make it {shown.replace(',', '.', 1)}; save the table without thousands separators "
        f"({shown.replace(',', '')}), or, if the comma is a decimal mark, with decimal points"
    )


def _header_cells(line: str, separator: str) -> list[str]:
    """Return the cells of a header; a unit in brackets belongs to the name before it, blank or not."""
    aligned = separator == " " and '"' not in line
    return re.split(r"\s+(?![\[(])", line.strip()) if aligned else split_cells(line, separator)


def _is_header(cells: list[str], second: list[str]) -> bool:
    if not any(looks_numeric(cell) for cell in cells):
        return True
    # column numbers from zero, as data-frame libraries write for a nameless array, above rows of fractions
    tail = cells[1:] if not cells[0] else cells
    counting = tail == [str(k) for k in range(len(tail))]
    return counting and len(second) == len(cells) and all("." in cell for cell in second[-len(tail) :])


def _without_tail(cells: list[str]) -> list[str]:
    """Return the cells without the empty one that a separator at the end of the line makes."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _names_of_comment(comment: str, separator: str, width: int) -> tuple[str, ...] | None:
    """Return the names in a comment line above the data, if it has one word for each column."""
    cells = _header_cells(comment, separator)
    fits = len(cells) == width > 1 and all(cells) and not any(looks_numeric(cell) for cell in cells)
    return tuple(cells) if fits else None
