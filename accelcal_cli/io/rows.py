"""The rows of a table: on which lines they are, and which of them are read.

A `RowBlock` is some rows that have been parsed, a `LineMap` says on which line each row is, and `PassedLines` which
lines are no rows. A `RowFilter` is what `--where COLUMN=VALUE` means. It goes before the parser: rows that do not meet
the conditions are never parsed, so that they may hold what no reading may, and it remembers where the rows that stay
came from, so that messages name the lines of the input. `ZeroRows` and `OneSensor` look at the rows that have been
parsed.
"""

from __future__ import annotations

import bisect
import io
import re
import shlex
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import compress
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import BOM, MARKS, Dialect, is_blank, is_comment, split_cells
from accelcal_cli.io.vocabulary import is_kind
from accelcal_cli.notices import Notice
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    import polars as pl

    from accelcal_cli.io.reader import InputTable

MOST_BAD = 0.05
"""Part of the rows that --skip-bad leaves out at most."""

SKIPPABLE = "; --skip-bad leaves out broken rows"
"""What ends the refusal of a row that is one of few broken ones."""

NAMED = 8
"""Lines that a note names at most."""


VALUES = 8
"""Values of a column that a message shows at most."""

SMALL = 1 << 18
"""Bytes: a block up to this size does not need polars."""

SHOWN = 6
"""Rows, poses or values that a sentence names at most."""

FEWEST_DEAD = 4
"""Rows from which on two columns that never change are dead."""

MOVES = 0.1
"""Part of the largest reading by which the third column changes, then."""

MOST_SENSORS = 1000
"""A column with more values does not label sensors."""

KIND_OF_SENSOR = re.compile(r"acc|gyr|mag|baro|imu|linear|gravity|rot|compass|temp", re.IGNORECASE)
ACCELEROMETER = re.compile(r".*acc", re.IGNORECASE)


@frozen(eq=False)
class RowBlock:
    """Rows of a table: `numbers` (B, k) and `texts`, each of length B, in the order of the selection.

    `start` is the number of the first row in the table, from 0.
    """

    start: int
    numbers: Float
    texts: tuple[Sequence[str], ...] = ()

    def only(self, keep: Bool) -> RowBlock:
        """Return the rows that `keep`, shape (B,), marks, numbered as before."""
        texts = tuple(list(compress(text, keep.tolist())) for text in self.texts)
        return RowBlock(self.start, self.numbers[keep], texts)

    def joined(self, other: RowBlock) -> RowBlock:
        """Return these rows and those of another block after them."""
        texts = tuple([*text, *more] for text, more in zip(self.texts, other.texts, strict=True))
        return RowBlock(self.start, np.concatenate([self.numbers, other.numbers]), texts)


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


def kept_line(lines: LineMap, kept: LineMap, row: int) -> str:
    """Return how to name a row of lines that a filter kept; a function of its own, so that processes can send it."""
    return f"line {kept.line(lines.line(row))}"


def kept_row(kept: LineMap, row: int) -> str:
    """Return how to name a row, from 0, of those that a filter kept: ``row 8``."""
    return f"row {kept.line(row + 1)}"


def left_row(where: Callable[[int], str], rows: LineMap, pose: int) -> str:
    """Return how to name a pose, where rows before it may have been left out or not read."""
    return where(rows.line(pose))


@dataclass(eq=False)
class PassedLines:
    """Lines below the header that are no rows: broken, cut off, headers again, of other sensors.

    Attributes:
        bad: numbers of broken lines; headers: of repeated headers; merged: how many lines are of other sensors.
        cut: number of the last line, if it was cut off.
        kept: where the lines come from, if only some of the input were looked at; the numbers above count these.
    """

    bad: array[int] = field(default_factory=lambda: array("q"))
    headers: array[int] = field(default_factory=lambda: array("q"))
    merged: int = 0
    cut: int | None = None
    kept: LineMap | None = None

    def lines(self) -> list[int]:
        """Return the numbers of lines that are broken, cut off, or headers again."""
        return [*self.bad, *self.headers, *(() if self.cut is None else (self.cut,))]

    def notes(self) -> list[str]:
        """Say what was left out."""
        notes = []
        if self.bad:
            plural = "s" * (len(self.bad) != 1)
            notes.append(
                f"{len(self.bad):,} broken row{plural} left out (--skip-bad): {self.named(self.bad)}"
            )
        if self.cut is not None:
            notes.append(f"the last line, {self._line(self.cut):,}, left out: it is cut off")
        if self.headers:
            notes.append(f"the header is repeated and left out: {self.named(self.headers)}")
        if self.merged:
            notes.append(f"{self.merged:,} rows left out: their cells of the readings are empty")
        return notes

    def named(self, numbers: Sequence[int]) -> str:
        """Return how a message names lines of the input: ``lines 5, 9 and 3 more``."""
        shown = ", ".join(str(self._line(number)) for number in sorted(numbers)[:NAMED])
        more = f" and {len(numbers) - NAMED:,} more" if len(numbers) > NAMED else ""
        return f"line{'s' * (len(numbers) != 1)} {shown}{more}"

    def _line(self, number: int) -> int:
        return number if self.kept is None else self.kept.line(number)


@frozen()
class Condition:
    """A column, counted from 0 and by name, and the value that a row must have there, as text."""

    column: int
    name: str
    value: str

    def holds(self, cell: str) -> bool:
        """Return whether a cell has the value: as text, or as number."""
        if cell == self.value:
            return True
        try:
            return float(cell) == float(self.value)
        except ValueError:
            return False

    def mask(self, cells: pl.Series) -> pl.Series:
        """Return which cells have the value."""
        import polars as pl

        text = cells.cast(pl.String).str.strip_chars(" \t\r")
        met = text == self.value
        try:
            number = float(self.value)
        except ValueError:
            return met.fill_null(False)
        return (met | (text.cast(pl.Float64, strict=False) == number)).fill_null(False)


@dataclass(eq=False)
class RowFilter:
    """Keeps the lines, or the rows of a frame, that meet all conditions.

    Attributes:
        source: named in messages; conditions: at least one.
        lines: line, or row from 1, of the input for each one that stays, from 1.
    """

    source: str
    conditions: Sequence[Condition]
    lines: LineMap = field(default_factory=LineMap)
    _seen: dict[str, None] = field(default_factory=dict)  # values of the first condition's column
    _read: int = 0
    _kept: int = 0
    _met: bool = False

    def keep_all(self, block: bytes) -> bytes:
        """Keep the lines of the top of a table: its header and what is above."""
        count = block.count(b"\n") + (not block.endswith(b"\n"))
        self._note(np.arange(count), count)
        return block

    def keep(self, block: bytes, dialect: Dialect) -> bytes:
        """Return the lines of a block of whole lines that meet the conditions, blank lines and comments left out."""
        mask = self._fast(block, dialect) if len(block) > SMALL else None
        if mask is None:
            mask = np.array([self._meets(raw, dialect) for raw in io.BytesIO(block)], dtype=bool)
        self._met |= bool(mask.any())
        self._note(np.flatnonzero(mask), len(mask))
        if mask.all():
            return block
        ends = np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n")) + 1
        ends = ends if len(ends) == len(mask) else np.append(ends, len(block))
        chosen = np.repeat(mask, np.diff(ends, prepend=0))
        return np.frombuffer(block, np.uint8)[chosen].tobytes()

    def rows(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return the rows of a frame that meet the conditions."""
        import polars as pl

        met = pl.Series([True]).new_from_index(0, frame.height)
        for condition in self.conditions:
            met &= condition.mask(frame[condition.name])
        mask = met.to_numpy()
        self._see(frame[self.conditions[0].name])
        self._met |= bool(mask.any())
        self._note(np.flatnonzero(mask), len(mask))
        return frame.filter(met)

    def keep_numbers(self, rows: Float) -> Bool:
        """Return which rows, shape (B, k), of numbers meet the conditions, shape (B,)."""
        mask = np.ones(len(rows), dtype=bool)
        for condition in self.conditions:
            try:
                mask &= rows[:, condition.column] == float(condition.value)
            except ValueError:
                mask[:] = False
        if len(self._seen) <= VALUES:
            values = dict.fromkeys(rows[:, self.conditions[0].column].tolist())
            self._seen.update((f"{value:g}", None) for value in list(values)[: VALUES + 1])
        self._met |= bool(mask.any())
        self._note(np.flatnonzero(mask), len(mask))
        return mask

    def meets(self, cells: Sequence[str]) -> bool:
        """Return whether a whole row meets the conditions."""
        return all(condition.holds(cells[condition.column]) for condition in self.conditions)

    def check(self) -> None:
        """Raise DataError where no row has met the conditions; to be called at the end of the table."""
        if self._met:
            return
        wanted = " and ".join(f'column "{c.name}" = {c.value}' for c in self.conditions)
        values = list(self._seen)
        held = ", ".join(values[:VALUES]) + (" and others" if len(values) > VALUES else "")
        raise DataError(
            f'{self.source}: no row has {wanted} (--where); column "{self.conditions[0].name}" holds {held}'
        )

    def _note(self, kept: Int, read: int) -> None:
        """Note which of the next `read` lines stay."""
        self.lines.add_many(self._kept + 1 + np.arange(len(kept)), self._read + 1 + kept)
        self._kept += len(kept)
        self._read += read

    def _meets(self, raw: bytes, dialect: Dialect) -> bool:
        """Return whether a line meets the conditions; one that is too short does, for the parser to find fault with."""
        line = raw.removeprefix(BOM).decode(errors="replace")
        if is_blank(line) or is_comment(line, dialect.marks):
            return False
        cells = split_cells(line.rstrip("\r\n"), dialect.separator)
        if len(cells) <= max(condition.column for condition in self.conditions):
            return True
        if len(self._seen) <= VALUES:
            self._seen[cells[self.conditions[0].column]] = None
        return self.meets(cells)

    def _fast(self, block: bytes, dialect: Dialect) -> Bool | None:
        """Return which lines meet the conditions, None where polars may see other lines than are there."""
        import polars as pl

        odd = (
            b'"' in block
            or any(mark.encode() in block for mark in MARKS)
            or (dialect.separator != ";" and b";" in block)
            or dialect.separator == " "
            or b"\n\n" in block
            or b"\n\r\n" in block
        )
        if odd or block[:1] in b"\r\n" or not block.endswith(b"\n"):
            return None
        schema = {str(k): pl.String for k in range(dialect.width)}
        try:
            frame = pl.read_csv(
                block,
                has_header=False,
                schema=schema,
                separator=dialect.separator,
                quote_char=None,
                columns=sorted({condition.column for condition in self.conditions}),
            )
        except pl.exceptions.PolarsError:
            return None
        if len(frame) != block.count(b"\n"):
            return None
        self._see(frame[str(self.conditions[0].column)])
        met = [condition.mask(frame[str(condition.column)]).to_numpy() for condition in self.conditions]
        return np.asarray(np.logical_and.reduce(met))

    def _see(self, cells: pl.Series) -> None:
        if len(self._seen) <= VALUES:
            self._seen.update(
                dict.fromkeys(str(value) for value in cells.unique(maintain_order=True)[: VALUES + 1])
            )


class ZeroRows:
    """Leaves out rows that are zero in all axes: idle sleep of a logger, or a bus that does not answer.

    No pose reads so, unless the bias is 1 g; with known specific force, which may be none, they stay.

    Attributes:
        count: rows left out; stretches: first and last of each run of them, SHOWN at most.
        rows: number of each row that stays.
    """

    def __init__(self) -> None:
        """Start without rows."""
        self.count, self.stretches = 0, list[tuple[int, int]]()
        self.rows = LineMap()
        self._kept = 0

    def without(self, rows: RowBlock) -> RowBlock:
        """Return a block, whose first three numbers are the output, without such rows."""
        keep = self.keep(rows.numbers[:, :3], rows.start)
        return rows if keep is None else rows.only(keep)

    def keep(self, output: Float, start: int) -> Bool | None:
        """Return which rows stay, shape (B,), or None for all; output (B, 3), `start` the number of the first."""
        if not len(output):
            return None
        zero = output[:, 0] == 0.0
        if zero.any():
            zero &= (output[:, 1] == 0.0) & (output[:, 2] == 0.0)
        keep = ~zero
        if not zero.any():
            self.rows.add(self._kept, start)
            self._kept += len(output)
            return None
        gone = np.flatnonzero(zero)
        self.count += len(gone)
        add_stretches(self.stretches, start + gone)
        place = self._kept + np.cumsum(keep) - keep
        for row in np.flatnonzero(keep & np.append(True, zero[:-1])).tolist():
            self.rows.add(int(place[row]), start + row)
        self._kept += int(np.count_nonzero(keep))
        return np.asarray(keep)

    def notices(self, where: Callable[[int], str], left: int) -> tuple[Notice, ...]:
        """Return what to say of them; `where` names a row, `left` rows have stayed."""
        return zero_rows(self.count, places(self.stretches, where), left)


def zero_rows(count: int, named: str, left: int) -> tuple[Notice, ...]:
    """Return what is said of `count` rows of zeros that were left out, where `left` others stay."""
    if not count:
        return ()
    text = f"{count:,} row{'s are' if count > 1 else ' is'} zero in all three axes"
    text += f" ({named})" if named else ""
    if count < left:
        return (Notice("zero-rows", "note", f"{text}: no accelerometer at rest reads so; left out."),)
    return (
        Notice(
            "zero-rows",
            "warning",
            f"{text} and were left out; only {left:,} others remain.",
            "Record again with idle sleep mode off, and check that --columns names the accelerometer.",
        ),
    )


class OneSensor:
    """Refuses a table whose rows are of several sensors, as a column of it says."""

    def __init__(self, table: InputTable, columns: Sequence[int], *, fleet: bool) -> None:
        """Watch the columns, which stand last among the texts of each block.

        Args:
            table: open; columns: counted from 0, whose values tell sensors apart.
            fleet: whether the table may go to accelcal fleet.
        """
        self.table, self.fleet = table, fleet
        self.values: dict[int, dict[str, None]] = {column: {} for column in columns}
        self.rows = 0

    def add(self, rows: RowBlock) -> None:
        """Look at a block; DataError where a column has several values, each for many rows."""
        self.rows += len(rows.numbers)
        texts = rows.texts[len(rows.texts) - len(self.values) :]
        for (column, values), cells in zip(self.values.items(), texts, strict=True):
            if len(values) > MOST_SENSORS:
                continue
            values.update(dict.fromkeys(cells))
            if 1 < len(values) <= self.rows / 2 and self._tells(column, list(values)):
                raise DataError(self._refusal(column, list(values)))

    def _tells(self, column: int, values: list[str]) -> bool:
        """Return whether the values are sensors: those of a column of kinds are, where one is a kind of sensor."""
        return not is_kind((self.table.names or ())[column]) or any(map(KIND_OF_SENSOR.match, values))

    def _refusal(self, column: int, values: list[str]) -> str:
        name = (self.table.names or ())[column]
        best = next((value for value in values if ACCELEROMETER.match(value)), values[0])
        shown = ", ".join(values[:SHOWN]) + (
            f" and {len(values) - SHOWN} more" if len(values) > SHOWN else ""
        )
        many = (
            f", or calibrate each with accelcal fleet --sensor-column {shlex.quote(name)}"
            if self.fleet
            else ""
        )
        return (
            f'{self.table.name}: column "{name}" has {len(values)} values ({shown}): these are readings of several '
            f"sensors; choose one with --where {shlex.quote(f'{name}={best}')}{many}"
        )


@dataclass
class DeadColumns:
    """Refuses readings of which two columns never change while the third does: gravity cannot turn so.

    Attributes:
        source: named in messages; names: of the three columns.
        lower, upper: least and greatest readings, shape (3,); rows: looked at.
    """

    source: str
    names: Sequence[str]
    lower: Float = field(default_factory=lambda: np.full(3, np.inf))
    upper: Float = field(default_factory=lambda: np.full(3, -np.inf))
    rows: int = 0

    def add(self, output: Float) -> None:
        """Look at rows (B, 3), as long as two columns may be dead."""
        if len(output) and np.count_nonzero(self.lower < self.upper) < 2:
            self.rows += len(output)
            self.lower = np.minimum(self.lower, output.min(axis=0))
            self.upper = np.maximum(self.upper, output.max(axis=0))

    def check(self) -> None:
        """Raise DataError at the end of the rows."""
        dead = [k for k in range(3) if self.lower[k] == self.upper[k]]
        span = float(np.max(self.upper - self.lower))
        if self.rows < FEWEST_DEAD or len(dead) != 2:
            return
        if span <= MOVES * max(np.abs(self.lower).max(), np.abs(self.upper).max()):
            return
        shown = " and ".join(f'"{self.names[k]}"' for k in dead)
        held = " and ".join(f"{self.lower[k]:g}" for k in dead)
        other = self.names[3 - sum(dead)]
        raise DataError(
            f'{self.source}: columns {shown} never change ({held} in all rows) while "{other}" does: they are dead '
            "axes, or no axes of the accelerometer; check the sensor, or say which columns are x, y, z with --columns"
        )


def add_stretches(stretches: list[tuple[int, int]], rows: Int) -> None:
    """Add runs of consecutive rows, ascending, to some stretches, of which the first SHOWN are kept."""
    breaks = np.flatnonzero(np.diff(rows) > 1)
    firsts, lasts = np.append(rows[:1], rows[breaks + 1]), np.append(rows[breaks], rows[-1:])
    if stretches and stretches[-1][1] + 1 == firsts[0]:
        stretches[-1] = stretches[-1][0], int(lasts[0])
        firsts, lasts = firsts[1:], lasts[1:]
    room = SHOWN - len(stretches)
    stretches += zip(firsts[:room].tolist(), lasts[:room].tolist(), strict=True)


def set_aside(idle: dict[int, list[int]], codes: Int, keep: Bool, start: int) -> None:
    """Add the rows that are not kept, from `start` on, to those of their sensors, by its number."""
    for row in np.flatnonzero(~keep).tolist():
        idle.setdefault(int(codes[row]), []).append(start + row)


def places(stretches: list[tuple[int, int]], where: Callable[[int], str]) -> str:
    """Return how to name stretches of rows."""
    shown = [where(a) if a == b else f"{where(a)} to {where(b)}" for a, b in stretches]
    return ", ".join(shown) + (", ..." if len(shown) == SHOWN else "")


def named(shown: list[str], count: int) -> str:
    """Return names in a list, and how many more there are."""
    more = count - len(shown)
    return ", ".join(shown) + (f" and {more:,} more" if more > 0 else "")
