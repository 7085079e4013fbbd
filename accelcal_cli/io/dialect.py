"""How a text is written and where its table begins; `understand` finds it from the head.

Separator and decimal mark come first (`sniff`). Devices write a page about themselves above their readings: the first
row is found by what rows are, lines of one width with numbers in the same places, and the lines above it are the
header, units, or a preamble (`find_layout`). The parsers of reader.py and the writer of rewrite.py share the reading of
one line that is defined here.
"""

from __future__ import annotations

import csv
import io
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import field, replace
from typing import TYPE_CHECKING

from accelcal_cli.errors import DataError
from accelcal_cli.io.stream import LONGEST_LINE
from accelcal_cli.io.vocabulary import (
    LAYOUTS,
    Facts,
    count_known,
    is_known,
    is_unit_row,
    note_of_vehicle,
    parse_unit,
    read_facts,
)
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from accelcal_cli.io.lines import LineFilter, MessageFilter

SAMPLE = 1000
"""Content lines that the dialect is found from."""

SAMPLED = 64
"""Lines that the separator is found from."""

MARKS = ("#", "//", "%")
"""What a line of comment begins with."""

BOM = b"\xef\xbb\xbf"

OPENING = 1 << 16
"""Bytes in which an ArduPilot log says what its messages are."""

TAIL = 64
"""Last lines of a sample by which rows are known: what stands above a table is no longer among them."""

AHEAD = 20
"""Lines after the first row of which most have to be rows, too."""

MOST = 0.6
"""Part that is most."""

EPOCH = 1e8
"""A first row of one number, at least this large, is the start of a recording in seconds since 1970."""

REMARKS = ("comment", "comments", "remark", "remarks", "bemerkung", "commentaire")
"""Names of a last column that rows may lack."""

FAR = 50.0
"""A row of running numbers is a header where the rows below it are so many times larger."""

_QUOTED = re.compile(r'"[^"]*"')
_DECIMAL_COMMA = re.compile(r"[+-]?\d*,\d+(?:[eE][+-]?\d+)?")
_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2}(?:,\d{3})+")

FEWEST_THOUSANDS = 6
"""Cells such as 33,368 from which on they are thousands, where none says that the comma is a decimal mark."""


_MARKED = re.compile(r"(?:[^\W\d]|#).*[:=]\s*[-+]?(?:\d+\.?\d*|\.\d+)?|[:=|>]|->|\$[A-Z]+")
"""A cell that is a word with its number, or the mark between them: ``Raw:``, ``aX:3.66``, ``=``, ``$ACC``."""


class ThousandsError(DataError):
    """Commas separate thousands; no other reading of the text helps."""


@frozen()
class Dialect:
    """The form of a text table. `separator` " " stands for runs of blanks and tabs.

    Attributes:
        names: of the header, None where there is none; header_line: its number, 0 where it has none.
        first: cells of the first data row, () where there is none.
        top: the last line above the rows, 0 where they begin at once.
        units: of the columns, by a row below the header.
        above: lines of a preamble; facts: what they say.
    """

    separator: str
    decimal_comma: bool
    names: tuple[str, ...] | None
    header_line: int
    first: tuple[str, ...]
    top: int = 0
    units: tuple[str, ...] | None = None
    above: int = 0
    facts: Facts = field(default_factory=Facts)

    @property
    def width(self) -> int:
        """Cells a row must have."""
        return len(self.first if self.names is None else self.names)

    @property
    def marks(self) -> tuple[str, ...]:
        """What a line of comment begins with."""
        return MARKS if self.separator == ";" else (*MARKS, ";")

    def notes(self) -> list[str]:
        """Say what stands above the table and was understood of it, if anything does."""
        above, facts = self.above, str(self.facts)
        skipped = f"{above:,} line{'s' * (above != 1)} above the table skipped" if above else "comments"
        stated = skipped + f": {facts}" * bool(facts) if above or facts else ""
        names = self.names if self.header_line and self.names else ()
        return list(filter(None, [stated, note_of_vehicle(names)]))


@frozen()
class Layout:
    """Lines of a sample by what they are, numbered from 0.

    Attributes:
        first: of the first row; beyond the last line where there are no rows.
        names: of the columns, None where there is no header; header: its line, None where it has none of its own.
        units: cells of the row of units, None where there is none.
        rate: that a row of numbers above the table states, Hz.
    """

    first: int
    names: tuple[str, ...] | None = None
    header: int | None = None
    units: tuple[str, ...] | None = None
    rate: float | None = None


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


def to_number(cell: str, decimal_comma: bool) -> float | None:
    """Return the value of a cell, None where it is not a number. Stricter than float(): no 1_000, no foreign digits."""
    thousands = decimal_comma and "." in cell  # 1.234,5 and 1.234
    if thousands or "_" in cell or not cell.isascii():
        return None
    try:
        return float(cell.replace(",", ".", 1) if decimal_comma else cell)
    except ValueError:
        return None


def understand(
    head: bytes, source: str, skip: int = 0, prefix: str | None = None, accelerometer: str | None = None
) -> tuple[LineFilter | MessageFilter | None, Dialect]:
    """Return the dialect of a text, and the filter of its lines where its numbers stand among words.

    Args:
        head: its first bytes; source: named in messages; skip: lines at its beginning that are not looked at.
        prefix, accelerometer: what the lines of readings begin with, and which to read; None to find them.

    Raises:
        DataError: neither a table nor lines of readings.
    """
    if b"FMT," in head[:OPENING] and (found := _of_messages(head, source, prefix, accelerometer)):
        return found
    dialect: Dialect | None = None
    fault: DataError | None = None
    if prefix is None:
        try:
            dialect = sniff(head, source, skip)
        except ThousandsError:
            raise
        except DataError as problem:
            fault = problem
        if dialect is not None and not _is_worded(dialect):
            return None, dialect
    from accelcal_cli.io.lines import find_filter  # most texts have no words between their numbers

    lines = head[: 1 << 18].decode(errors="replace").splitlines()[skip:]
    words = find_filter([line for line in lines if line.strip()][: 2 * SAMPLE], source, prefix)
    if words is None:
        if dialect is None:
            raise fault or DataError(f"{source}: no line has three numbers; readings were expected")
        return None, dialect
    dialect = sniff(words.translate(head), source, skip)
    units = words.kind.units if any(words.kind.units) else None
    if words.kind.names is not None:
        dialect = replace(dialect, names=words.kind.names, header_line=0)
    return words, replace(dialect, units=units, above=0)


def _of_messages(head: bytes, source: str, *wanted: str | None) -> tuple[MessageFilter, Dialect] | None:
    """Return filter and dialect of an ArduPilot log, None for any other text."""
    from accelcal_cli.io.lines import find_messages

    messages = find_messages(head, source, *wanted)
    if messages is None:
        return None
    rows = (line for line in messages.translate(head).splitlines() if line.strip())
    first = split_cells(next(rows, b"").decode(errors="replace"), ",")
    return messages, Dialect(",", False, messages.columns, 0, tuple(first), units=messages.units)


def _is_worded(dialect: Dialect) -> bool:
    """Return whether words stand between the numbers of a line rather than above them."""
    numbers = sum(looks_numeric(cell) for cell in dialect.first)
    lines = [dialect.first] if dialect.header_line == 0 else [dialect.names or (), dialect.first]
    marked = all(any(_MARKED.fullmatch(cell) for cell in cells) for cells in lines)
    return marked or (dialect.header_line == 0 and numbers < 3)


def sniff(head: bytes, source: str, skip: int = 0) -> Dialect:
    """Find the dialect of a table from its first bytes; the first `skip` lines are not looked at.

    Raises:
        DataError: no text table; the message names the `source`.
    """
    lines, comments = _sample(head, source, skip)
    if not lines:
        raise DataError(f"{source}: is empty; readings were expected, one row per pose")
    texts = [text for _, text in lines]
    dense = _dense((texts[1:] or texts)[-4 * SAMPLED :])[-SAMPLED:]
    separator = _separator(dense)
    if separator == " " and _names_tabs(texts, dense):
        separator = "\t"
    rows = [split_cells(text, separator) for text in texts]
    layout = find_layout(texts, rows, separator)
    first = rows[layout.first] if layout.first < len(rows) else []
    numbers = [number for number, _ in lines]
    names, header = layout.names, 0 if layout.header is None else numbers[layout.header]
    titles = (layout.header is not None) + (layout.units is not None)
    above = [text for _, text in lines[: layout.first]]
    remarks = [text for number, text in comments if not first or number < numbers[layout.first]]
    facts = read_facts([*remarks, *above])
    if layout.rate is not None:
        facts = replace(facts, rate=layout.rate, start=texts[0].split(separator)[0].strip())
    units = layout.units
    if names is None:
        first = _without_tail(first)
        names, remarked = _names_of_comments(remarks, separator, len(first))
        units = units or remarked
        names = names or LAYOUTS.get((facts.device, len(first)))
    elif len(first) != len(names) or not first[-1]:
        names = tuple(_without_tail(list(names)))
    rows_of_data = texts[layout.first :]
    decimal_comma = _decimal_comma(rows_of_data, separator)
    if decimal_comma:
        _refuse_thousands(rows_of_data, separator, source)
    return Dialect(
        separator,
        decimal_comma,
        names,
        header,
        tuple(first),
        max(skip, numbers[layout.first] - 1 if first else numbers[-1]) if layout.first or skip else 0,
        units,
        len(above) - titles,
        facts,
    )


def _sample(head: bytes, source: str, skip: int) -> tuple[list[tuple[int, str]], list[tuple[int, str]]]:
    """Return the first content lines and the comments, with their numbers."""
    lines: list[tuple[int, str]] = []
    comments: list[tuple[int, str]] = []
    for number, raw in enumerate(io.BytesIO(head.removeprefix(BOM)), 1):
        if number <= skip:
            continue
        text = decode_line(raw, number, source, strict=not lines).strip("\r\n")
        if is_comment(text, MARKS):
            if len(comments) < SAMPLE:
                comments.append((number, text.lstrip().lstrip("#/%").strip()))
        elif not is_blank(text):
            lines.append((number, text))
        if len(lines) == SAMPLE:
            break
    if len(lines) > 2 and not head.endswith(b"\n"):
        lines.pop()  # the head may end within a line
    semicolons = [text.lstrip().startswith(";") for _, text in lines]
    if any(semicolons) and not any(";" in text.lstrip()[1:] for _, text in lines[-AHEAD:]):
        comments += [line for line, mark in zip(lines, semicolons, strict=True) if mark]
        lines = [line for line, mark in zip(lines, semicolons, strict=True) if not mark]
    return lines, comments


def is_comment(line: str, marks: tuple[str, ...]) -> bool:
    """Return whether a line begins with one of the marks of a comment."""
    return line.lstrip().startswith(marks)


def _dense(lines: list[str]) -> list[str]:
    """Return the lines that are mostly digits, where such lines end a sample: the others stand above a table."""
    dense = [2 * sum(c.isdigit() for c in line) >= len("".join(line.split())) for line in lines]
    if 2 * sum(dense[-12:]) < len(dense[-12:]):
        return lines
    return [line for line, yes in zip(lines, dense, strict=True) if yes]


def _names_tabs(lines: list[str], rows: list[str]) -> bool:
    """Return whether a line without numbers has as many cells between tabs as the last row, empty ones included."""
    width = rows[-1].count("\t")
    titles = (line for line in lines if line.count("\t") == width > 1)
    return any(not any(map(looks_numeric, line.split("\t"))) for line in titles)


def _other_cells(line: str, separator: str) -> list[list[str]]:
    """Return the cells of a header as other separators than that of the rows divide it."""
    forms = [_header_cells(line, separator), re.split(r"\t+|\s{2,}", line.strip())]
    return forms + [split_cells(line, other) for other in (",", ";", "\t", "|") if other != separator]


def is_blank(line: str) -> bool:
    """Return whether a line is blanks and separators only, or the note `sep=;`: spreadsheets leave both."""
    rest = line.strip(' \t\r\n,;|"')
    return not rest or rest.lower() in ("sep=", "sep")


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
    bare = [_QUOTED.sub("0", line.strip("\r\n")) for line in lines]
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
    """Raise ThousandsError where commas separate thousands, as in 33,368, which a decimal comma would read as 33.368.

    Fractions of three digits are told from thousands by cells such as 0,012: no number with thousands begins so.
    """
    cells = [cell for line in lines for cell in split_cells(line, separator) if "," in cell]
    numbers = [cell for cell in cells if _DECIMAL_COMMA.fullmatch(cell) or _THOUSANDS.fullmatch(cell)]
    if len(numbers) < FEWEST_THOUSANDS or not all(_THOUSANDS.fullmatch(cell) for cell in numbers):
        return
    shown = numbers[0]
    raise ThousandsError(
        f'{source}: "{shown}" has a thousands separator, it seems, as have all numbers with a comma: a decimal comma '
        f"would make it {shown.replace(',', '.', 1)}; save the table without thousands separators "
        f"({shown.replace(',', '')}), or, if the comma is a decimal mark, with decimal points"
    )


def _header_cells(line: str, separator: str) -> list[str]:
    """Return the cells of a header; a unit in brackets belongs to the name before it, blank or not."""
    aligned = separator == " " and '"' not in line
    return re.split(r"\s+(?![\[(])", line.strip()) if aligned else split_cells(line, separator)


def _without_tail(cells: list[str]) -> list[str]:
    """Return the cells without the empty one that a separator at the end of the line makes."""
    return cells[:-1] if len(cells) > 1 and not cells[-1] else cells


def _names_of_comments(
    comments: list[str], separator: str, width: int
) -> tuple[tuple[str, ...] | None, tuple[str, ...] | None]:
    """Return names and units in comment lines above the data, the last of each with one word for each column."""
    names: tuple[str, ...] | None = None
    units: tuple[str, ...] | None = None
    for comment in reversed(comments):
        for cells in (_header_cells(comment, separator), *_other_cells(comment, separator)):
            if not (len(cells) == width > 1 and all(cells)) or any(looks_numeric(cell) for cell in cells):
                continue
            if is_unit_row(cells) and units is None:
                units = tuple(cells)
            elif names is None and is_known(cells):
                names = tuple(cells)
            break
    return names, units


def find_layout(texts: Sequence[str], rows: Sequence[Sequence[str]], separator: str) -> Layout:
    """Find header, units and first row among the lines of a sample, as texts and as the cells of each."""
    width, numeric = _profile(rows[-TAIL:] if len(rows) > 2 * TAIL else rows[len(rows) // 2 :])
    if not numeric:
        bare = bool(rows) and not any(looks_numeric(cell) for cell in rows[0])
        return Layout(1, tuple(rows[0]), 0) if bare else Layout(0)
    alike = [_is_row(cells, width, numeric) for cells in rows]
    first = _below_title(rows, alike, _first_row(rows, alike), width)
    start = _stated_start(rows[first : first + 2])
    if start is not None:
        return Layout(first + start[0], rate=start[1])
    if first == 0 and _is_numbered_header(rows[:AHEAD]):
        return Layout(first + 1, tuple(rows[first]), first)
    return _with_header(texts, rows, first, width, separator)


def fits(cells: Sequence[str], width: int) -> bool:
    """Return whether a line has `width` cells, with or without an empty one at its end."""
    return len(cells) == width or (len(cells) == width + 1 and not cells[-1])


def _profile(rows: Sequence[Sequence[str]]) -> tuple[int, list[int]]:
    """Return the usual width of rows, and the columns that mostly hold numbers."""
    widths = Counter(len(cells) for cells in rows if any(looks_numeric(cell) for cell in cells))
    if not widths:
        return 0, []
    width = widths.most_common(1)[0][0]
    alike = [cells for cells in rows if len(cells) == width]
    numeric = []
    for k in range(width):
        filled = [looks_numeric(cells[k]) for cells in alike if cells[k]]
        if filled and sum(filled) >= MOST * len(filled):
            numeric.append(k)
    return width, numeric


def _is_row(cells: Sequence[str], width: int, numeric: Sequence[int]) -> bool:
    if abs(len(cells) - width) > 1:
        return False
    filled = [looks_numeric(cells[k]) for k in numeric if k < len(cells) and cells[k]]
    return bool(filled) and (2 * sum(filled) >= len(filled) if fits(cells, width) else all(filled))


def _first_row(rows: Sequence[Sequence[str]], alike: Sequence[bool]) -> int:
    """Return the first of a stretch of rows, or a line of nothing but numbers just above it, which is a broken row."""
    first = next(
        (
            k
            for k, row in enumerate(alike)
            if row and sum(alike[k : k + AHEAD]) >= MOST * len(alike[k : k + AHEAD])
        ),
        0,
    )
    while first and len(rows[first - 1]) > 1 and all(looks_numeric(cell) for cell in rows[first - 1] if cell):
        first -= 1
    return first


def _below_title(rows: Sequence[Sequence[str]], alike: Sequence[bool], first: int, width: int) -> int:
    """Return the first row, below a header among lines of which only some look like rows: these describe columns."""
    for k in range(first, min(first + AHEAD, len(rows) - 1)):
        odd = alike[first:k].count(False) > 1 and not alike[k]
        if (
            odd
            and all(alike[k + 1 : k + AHEAD])
            and _is_title(rows[k], rows[k + 1], width)
            and is_known(rows[k])
        ):
            return k + 1
    return first


def _stated_start(rows: Sequence[Sequence[str]]) -> tuple[int, float | None] | None:
    """Return how many rows state start and rate, the same number in every column, and the rate; None for none."""
    equal = [len(cells) > 2 and len(set(cells)) == 1 and looks_numeric(cells[0]) for cells in rows]
    if not (equal and equal[0] and float(rows[0][0].replace(",", ".")) >= EPOCH):
        return None
    second = len(rows) > 1 and equal[1]
    return 1 + second, float(rows[1][0].replace(",", ".")) if second else None


def _is_numbered_header(rows: Sequence[Sequence[str]]) -> bool:
    """Return whether the first row numbers the columns, as data-frame libraries do for a nameless array."""
    if len(rows) < 2 or len(rows[1]) != len(rows[0]):
        return False
    tail = rows[0][1:] if not rows[0][0] else rows[0]
    if not any(list(tail) == [str(k + base) for k in range(len(tail))] for base in (0, 1)) or len(tail) < 2:
        return False
    below = [cells[-len(tail) :] for cells in rows[1:] if len(cells) == len(rows[0])]
    if all("." in cell for cell in below[0]):
        return True
    try:
        sizes = sorted(max(abs(float(cell)) for cell in cells if cell) for cells in below)
    except ValueError:
        return False
    return sizes[len(sizes) // 2] > FAR * len(tail)


def _with_header(
    texts: Sequence[str], rows: Sequence[Sequence[str]], first: int, width: int, separator: str
) -> Layout:
    block: dict[int, list[str]] = {}
    for k in range(first - 1, -1, -1):
        forms = [list(rows[k]), *(_other_cells(texts[k], separator) if k == first - 1 or not block else [])]
        whole = next((cells for cells in forms if _is_title(cells, rows[first], width)), None)
        if whole is None:
            break
        block[k] = whole
    if not block:  # headers and units may stand further up, each below a line that says so
        block = {
            k: list(cells)
            for k, cells in enumerate(rows[:first])
            if _is_title(cells, rows[first], width) and (is_known(cells) or is_unit_row(cells))
        }
    if not block:
        wrong = (
            first and is_known(rows[first - 1]) and not any(looks_numeric(cell) for cell in rows[first - 1])
        )
        return Layout(first, tuple(rows[first - 1]), first - 1) if wrong else Layout(first)
    units = [k for k in block if is_unit_row(block[k])]
    titles = [k for k in block if k not in units]
    if not titles:  # the names stand in a comment
        return Layout(first, units=tuple(block[max(units)]))
    header = max(titles, key=lambda k: (count_known(block[k]), k))
    below = next((tuple(block[k]) for k in units if k > header and any(map(_says, block[k]))), None)
    names = _grouped(block.get(header - 1) if header - 1 in titles else None, block[header])
    return Layout(first, tuple(names[:-1] if _ends_in_remark(names, width) else names), header, below)


def _is_title(cells: Sequence[str], row: Sequence[str], width: int) -> bool:
    """Return whether a line can be a header of rows: as many cells, few of them numbers."""
    ended = len(cells) == width - 1 and not row[-1]  # rows with a separator at their end
    if not (fits(cells, width) or ended or _ends_in_remark(cells, width)) or not any(cells):
        return False
    numbers = sum(looks_numeric(cell) for cell in cells)
    return not numbers or (is_known(cells) and 2 * numbers < sum(bool(cell) for cell in cells))


def _ends_in_remark(names: Sequence[str], width: int) -> bool:
    """Return whether a header has one more column, for remarks, which rows may lack."""
    return len(names) == width + 1 and names[-1].lower() in REMARKS


def _says(unit: str) -> bool:
    return parse_unit(unit) not in (None, "-")


def _grouped(groups: Sequence[str] | None, names: Sequence[str]) -> Sequence[str]:
    """Return names that occur twice with the name of their group, which stands above the first of them."""
    filled = [name for name in names if name]
    if groups is None or len(set(filled)) == len(filled) or len(groups) != len(names):
        return names
    whole, group = [], ""
    for above, name in zip(groups, names, strict=True):
        group = above or group
        whole.append(f"{group} {name}".strip())
    return whole
