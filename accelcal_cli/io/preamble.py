"""Where the table begins in a text: what stands above it, its header, and a row of units below the header.

Devices write a page about themselves above their readings. `find_layout` finds the first row by what rows are, lines
of one width with numbers in the same places; the lines above it are the header, units, or a preamble, of which
`read_facts` takes rate, start, serial number, range and the order of day and month.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from accelcal_cli.io.vocabulary import describe, is_time, is_unit_row, parse_unit

TAIL = 64
"""Last lines of a sample by which rows are known: what stands above a table is no longer among them."""

AHEAD = 20
"""Lines after the first row of which most have to be rows, too."""

MOST = 0.6
"""Part that is most."""

EPOCH = 1e8
"""A first row of one number, at least this large, is the start of a recording in seconds since 1970."""

FAR = 50.0
"""A row of running numbers is a header where the rows below it are so many times larger."""

_RATE = re.compile(r"(\d+(?:\.\d+)?)\s*hz\b", re.IGNORECASE)
_RATE_NAMED = re.compile(
    r"(?:sampl\w*[ _-]?(?:rate|freq\w*)|update rate|data rate|measurement frequency|abtastrate|frequency)"
    r"\W+(\d+(?:\.\d+)?)",
    re.IGNORECASE,
)
_SERIAL = re.compile(
    r"(?:serial(?:[ _-]?(?:number|code|no|nr))?|device[ _]?id|seriennummer)\W+(\w[\w-]*)", re.IGNORECASE
)
_START = re.compile(r"start(?:[ _-]?(?:time|date))?\W+(\d[\d/.:T -]*\d)", re.IGNORECASE)
_RANGE = re.compile(r"range\W+([^,;\t]*?\d+\s*g)\b", re.IGNORECASE)
_ORDER = re.compile(r"\b(d{1,2}[/.-]m{1,2}|m{1,2}[/.-]d{1,2})[/.-]y{2,4}", re.IGNORECASE)

LAYOUTS: dict[tuple[str, int], tuple[str, ...]] = {
    ("GENEActiv", 7): ("time", "x [g]", "y [g]", "z [g]", "light [lux]", "button", "temperature [degC]"),
}
"""Names of the columns of devices that write none: by a word of the preamble and the width of the table."""


DEVICE_UNITS = {"ActiGraph": "g", "GENEActiv": "g", "Axivity": "g", "AX3": "g"}
"""Units of acceleration of devices that do not write it, by a word of the preamble."""


@dataclass(frozen=True)
class Facts:
    """What stands above a table, as far as it was understood.

    Attributes:
        rate: rows per second, Hz; start, serial, range: as written.
        day_first: whether dates begin with the day, None where nothing says.
        device: key of LAYOUTS, "" where there is none; unit: of the acceleration that it writes, None if unknown.
    """

    rate: float | None = None
    start: str = ""
    serial: str = ""
    range: str = ""
    day_first: bool | None = None
    device: str = ""
    unit: str | None = None

    def __str__(self) -> str:
        """What was understood, in words."""
        rate = "" if self.rate is None else f"{self.rate:g} Hz"
        parts = (("rate", rate), ("start", self.start), ("serial number", self.serial), ("range", self.range))
        return ", ".join(f"{name} {value}" for name, value in parts if value)


@dataclass(frozen=True)
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


def find_layout(
    rows: Sequence[Sequence[str]],
    is_number: Callable[[str], bool],
    other_cells: Callable[[int], list[list[str]]],
) -> Layout:
    """Find header, units and first row.

    Args:
        rows: cells of every line of the sample.
        is_number: whether a cell is one.
        other_cells: the cells of a line, by its number, as other separators would divide it.
    """
    width, numeric = _profile(
        rows[-max(TAIL, 1) :] if len(rows) > 2 * TAIL else rows[len(rows) // 2 :], is_number
    )
    if not numeric:
        bare = bool(rows) and not any(is_number(cell) for cell in rows[0])
        return Layout(1, tuple(rows[0]), 0) if bare else Layout(0)
    alike = [_is_row(cells, width, numeric, is_number) for cells in rows]
    first = _first_row(rows, alike, is_number)
    start = _stated_start(rows[first : first + 2], is_number)
    if start is not None:
        return Layout(first + start[0], rate=start[1])
    if first == 0 and _is_numbered_header(rows[:AHEAD]):
        return Layout(first + 1, tuple(rows[first]), first)
    return _with_header(rows, first, width, is_number, other_cells)


def read_facts(lines: Sequence[str]) -> Facts:
    """Return what the lines above a table say."""
    text = "\n".join(lines)
    rate = _RATE_NAMED.search(text) or _RATE.search(text)
    start, serial, span, order = (pattern.search(text) for pattern in (_START, _SERIAL, _RANGE, _ORDER))
    return Facts(
        float(rate[1]) if rate and float(rate[1]) > 0 else None,
        start[1].strip() if start else "",
        serial[1] if serial else "",
        span[1].strip() if span else "",
        None if order is None else order[1].lower().startswith("d"),
        next((device for device, _ in LAYOUTS if device.lower() in text.lower()), ""),
        next((unit for device, unit in DEVICE_UNITS.items() if device.lower() in text.lower()), None),
    )


def fits(cells: Sequence[str], width: int) -> bool:
    """Return whether a line has `width` cells, with or without an empty one at its end."""
    return len(cells) == width or (len(cells) == width + 1 and not cells[-1])


def _profile(rows: Sequence[Sequence[str]], is_number: Callable[[str], bool]) -> tuple[int, list[int]]:
    """Return the usual width of rows, and the columns that mostly hold numbers."""
    widths = Counter(len(cells) for cells in rows if any(is_number(cell) for cell in cells))
    if not widths:
        return 0, []
    width = widths.most_common(1)[0][0]
    alike = [cells for cells in rows if len(cells) == width]
    numeric = []
    for k in range(width):
        filled = [is_number(cells[k]) for cells in alike if cells[k]]
        if filled and sum(filled) >= MOST * len(filled):
            numeric.append(k)
    return width, numeric


def _is_row(
    cells: Sequence[str], width: int, numeric: Sequence[int], is_number: Callable[[str], bool]
) -> bool:
    if abs(len(cells) - width) > 1:
        return False
    filled = [is_number(cells[k]) for k in numeric if k < len(cells) and cells[k]]
    return bool(filled) and (2 * sum(filled) >= len(filled) if fits(cells, width) else all(filled))


def _first_row(rows: Sequence[Sequence[str]], alike: Sequence[bool], is_number: Callable[[str], bool]) -> int:
    """Return the first of a stretch of rows, or a line of nothing but numbers just above it, which is a broken row."""
    first = next(
        (
            k
            for k, row in enumerate(alike)
            if row and sum(alike[k : k + AHEAD]) >= MOST * len(alike[k : k + AHEAD])
        ),
        0,
    )
    while first and len(rows[first - 1]) > 1 and all(is_number(cell) for cell in rows[first - 1] if cell):
        first -= 1
    return first


def _stated_start(
    rows: Sequence[Sequence[str]], is_number: Callable[[str], bool]
) -> tuple[int, float | None] | None:
    """Return how many rows state start and rate, the same number in every column, and the rate; None for none."""
    equal = [len(cells) > 2 and len(set(cells)) == 1 and is_number(cells[0]) for cells in rows]
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
    rows: Sequence[Sequence[str]],
    first: int,
    width: int,
    is_number: Callable[[str], bool],
    other_cells: Callable[[int], list[list[str]]],
) -> Layout:
    block: dict[int, list[str]] = {}
    for k in range(first - 1, -1, -1):
        forms = [list(rows[k]), *(other_cells(k) if k == first - 1 or not block else [])]
        whole = next((cells for cells in forms if _is_title(cells, rows[first], width, is_number)), None)
        if whole is None:
            break
        block[k] = whole
    if not block:
        wrong = first and is_known(rows[first - 1]) and not any(is_number(cell) for cell in rows[first - 1])
        return Layout(first, tuple(rows[first - 1]), first - 1) if wrong else Layout(first)
    units = [k for k in block if is_unit_row(block[k])]
    titles = [k for k in block if k not in units]
    if not titles:  # the names stand in a comment
        return Layout(first, units=tuple(block[max(units)]))
    header = max(titles, key=lambda k: (_score(block[k]), k))
    below = next((tuple(block[k]) for k in units if k > header and any(map(_says, block[k]))), None)
    names = _grouped(block.get(header - 1) if header - 1 in titles else None, block[header])
    return Layout(first, tuple(names), header, below)


def _is_title(cells: Sequence[str], row: Sequence[str], width: int, is_number: Callable[[str], bool]) -> bool:
    """Return whether a line can be a header of rows: as many cells, few of them numbers."""
    ended = len(cells) == width - 1 and not row[-1]  # rows with a separator at their end
    if not (fits(cells, width) or ended) or not any(cells):
        return False
    numbers = sum(is_number(cell) for cell in cells)
    return not numbers or (is_known(cells) and 2 * numbers < sum(bool(cell) for cell in cells))


def _says(unit: str) -> bool:
    return parse_unit(unit) not in (None, "-")


def _score(names: Sequence[str]) -> int:
    """Return how many cells of a line are names that are known."""
    return sum(bool(name) and (is_time(name) or describe(name).axis is not None) for name in names)


def is_known(names: Sequence[str]) -> bool:
    """Return whether cells are names of columns, of which some say what they are."""
    return len(names) > 1 and _score(names) > 1


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
