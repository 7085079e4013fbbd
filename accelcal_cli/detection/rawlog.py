"""A raw log: acceleration at a fixed rate, with time and turning rate where there are such columns.

`RawLog` reads a table once, from top to bottom. Its first rows show what the time column is: time of some unit and
rate, dates, a row number, or no time at all (`io/clock.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.clock import (
    UNITS,
    Clock,
    SoundTimes,
    StampReader,
    seconds_of_dates,
    unit_of,
    wrong_time,
)
from accelcal_cli.io.columns import RawColumns, choose_raw, own_sensor_column, restrict, sensor_column
from accelcal_cli.io.reader import PLAIN, InputTable, ReadOptions, Selection, open_table
from accelcal_cli.io.readings import InputForm
from accelcal_cli.io.rows import MOST_SENSORS, SKIPPABLE, DeadColumns, OneSensor, RowBlock, ZeroRows
from accelcal_cli.io.stream import Source
from accelcal_cli.io.vocabulary import parse_unit
from accelcal_cli.notices import Notice

if TYPE_CHECKING:
    import polars

PROBE = 1000
"""Rows that determine the step of the time column, and whether a column without a name is time."""

HEAD = 20_000
"""First rows that show whether several sensors take turns, at most."""

CHANGES = 50
"""Changes of time among the first PROBE rows that determine the step."""


def open_raw_log(
    source: Source,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
    *,
    stdin: BinaryIO | None = None,
    options: ReadOptions = PLAIN,
) -> RawLog:
    """Open a raw log in any form that `read_readings` reads; ``-`` is standard input.

    Args:
        source: path, ``-``, or a frame.
        columns, gyro: three columns each, by name or by number from 1; found by their names when None; no
            gyroscope with `gyro` of ``["none"]``.
        time: a column, ``"none"``, or None to find it.
        stdin: standard input; options: what the user knows of the form of a table.
    """
    table = open_table(source, stdin, options=options)
    try:
        restrict(table, options.where)
        return RawLog(table, choose_raw(table, columns, gyro, time))
    except BaseException:
        table.close()
        raise


def read_log(source: Source, **how: Any) -> RawLog:
    """Open a raw log to look at it, or to find its static poses with `detect`.

    Args:
        source: path, ``-``, or a frame; how: see `open_raw_log`.

    Examples:
        >>> from accelcal_cli import read_log, simulate
        >>> log = read_log(simulate("mems", positions=2, raw=True))
        >>> round(log.clock.rate), log.to_frame().columns
        (100, ['ax', 'ay', 'az', 't'])
    """
    return open_raw_log(source, **how)


def sensors_of(
    source: str | Path, sensor: str | None = None, *, options: ReadOptions = PLAIN
) -> tuple[tuple[str, str], ...]:
    """Return the sensors that a log file has rows of: the label of each, and the condition that chooses its rows.

    Args:
        source: path. sensor: the column that labels them; None to find it by its name.
        options: what the user knows of the form of the table.

    Returns:
        Pairs of label and COLUMN=VALUE, in the order in which they come; none where no column labels sensors.

    Raises:
        DataError: unreadable, or a column of more values than there are sensors. UsageError: no such column.
    """
    table = open_table(source, hashed=False, options=options)
    try:
        restrict(table, options.where)
        column = own_sensor_column(table) if sensor is None else sensor_column(table, sensor)
        if column is None:
            return ()
        name = str(column + 1) if table.names is None else table.names[column]
        values: dict[str, None] = {}
        for rows in table.blocks(Selection((), frozenset({column}), (column,))):
            values.update(dict.fromkeys(filter(None, rows.texts[0])))
            if len(values) > MOST_SENSORS:
                raise DataError(
                    f'{table.name}: column "{name}" has more than {MOST_SENSORS:,} values; it does not label sensors'
                )
    finally:
        table.close()
    where = str(column + 1) if "=" in name else name
    return tuple((value, f"{where}={value}") for value in values)


class RawLog:
    """A raw log that is read once, from top to bottom."""

    def __init__(self, table: InputTable, columns: RawColumns) -> None:
        """Read the first rows of `table` to find out what the time column is."""
        self.name = table.name
        self.columns = columns
        self.zeros = ZeroRows()
        self._table = table
        dated = columns.dated
        self._stamps: StampReader | None = None
        rows = _of_one(table.blocks(columns.selection()), OneSensor(table, columns.identity, fleet=False))
        if dated:
            self._stamps = StampReader(self._time_at, table.facts.day_first, table.lenient)
            rows = seconds_of_dates(rows, self._stamps)
        self._sound = None
        if table.lenient and columns.time is not None and not columns.guessed:
            self._sound = SoundTimes(table)
            rows = self._sound.of(rows)
        self._rows = rows
        self._head = _first(self._rows, PROBE)
        self.clock = Clock()
        self._notes = list(columns.notes)
        self._settle_time()
        if self.clock.rate is None and table.facts.rate is not None:
            self.clock = Clock(table.facts.rate)
            self._notes.append(f"{table.facts.rate:g} rows per second, as stated above the table")

    @property
    def notes(self) -> list[str]:
        """What a user should know; complete once all blocks have been read."""
        return [*self._table.notes, *self._notes]

    def _settle_time(self) -> None:
        """Take the time column for what it is: time, a row number, or no time at all."""
        columns = self.columns
        if columns.time is None:
            return
        times = np.concatenate([np.empty(0), *(rows.numbers[:, -1] for rows in self._head)])
        steps = np.diff(times[:PROBE])
        if columns.guessed and not (len(steps) and (steps >= 0).all() and (steps > 0).any()):
            if columns.doubtful:
                raise DataError(columns.doubtful)
            self.columns = replace(columns, time=None)
            return
        unit = self._stated_unit(columns.time)
        counted = columns.dated and self._table.numeric[columns.time]  # read as text for its digits
        if np.count_nonzero(steps) >= CHANGES:
            times = times[:PROBE]  # else they are cut to seconds, and few rows tell no rate
        self.clock = Clock.of(times, "s" if columns.dated and not counted else unit)
        if columns.dated:
            self._notes.append(f"time is counted in {'units' if counted else 'seconds'} from the first row")
        if columns.guessed:
            self._notes.append(f"column {columns.time + 1} taken as time: it never decreases")
        if self.clock.rate is None:
            self.columns = replace(columns, time=None)
            self._notes.append(f"column {columns.time + 1} counts rows, so it is not time")
        elif self.clock.unit != "s":
            self._notes.append(f"time taken as {self.clock.unit}: {self.clock.rate:.6g} rows per second")
        if note := self.clock.note():
            self._notes.append(note)

    def _stated_unit(self, column: int) -> str | None:
        """Return the unit of the time column by the row of units, or by its name."""
        names, units = self._table.names, self._table.units
        if units is not None and column < len(units) and (unit := parse_unit(units[column])) in UNITS:
            return unit
        return None if names is None else unit_of(names[column])

    def _time_at(self, row: int) -> str:
        """Return how to name the time of a row (from 0) of the table."""
        names, time = self._table.names, self.columns.time or 0
        column = str(time + 1) if names is None else f'"{names[time]}"'
        return f"{self.name}, {self._table.where(row)}, column {column}"

    @property
    def began(self) -> np.datetime64 | None:
        """Date and time of the first row, where the time column has dates."""
        return None if self._stamps is None else self._stamps.began

    @property
    def form(self) -> InputForm:
        """How the log is written; its rows are those of the detection."""
        table, unit = self._table, self.columns.unit
        return InputForm(table.source_format, 0, table.rows_skipped, self.clock.rate, unit, table.correction)

    @property
    def sha256(self) -> str:
        """SHA-256 of the input, once all blocks have been read."""
        return self._table.sha256

    @property
    def where(self) -> Callable[[int], str]:
        """How to name a row (from 0) that has been read."""
        if self._sound is None:
            return self._table.where
        where, line = self._table.where, self._sound.rows.line
        return lambda row: where(line(row))

    def blocks(self) -> Iterator[Float]:
        """Yield the rows, block after block, in constant memory; time that goes back is a DataError.

        Shape (B, k): acceleration (3), turning rate (3) where there is a gyroscope, temperature where there is one
        (NaN where it is missing), time where there is one, as given.
        """
        timed = self.columns.time is not None
        width, last = (
            (6 if self.columns.gyro else 3) + (self.columns.temperature is not None) + timed,
            -np.inf,
        )
        dead = DeadColumns(self.name, self.columns.names)
        for rows in chain(self._head, self._rows):
            numbers = rows.numbers[:, :width]
            kept = self.zeros.keep(numbers[:, :3], rows.start)
            dead.add(numbers[:, :3] if kept is None else numbers[kept, :3])
            if timed and len(numbers):
                self._check_time(numbers[:, -1], last, rows.start)
                last = float(numbers[-1, -1])
            yield numbers
        dead.check()

    def to_frame(self) -> polars.DataFrame:
        """Return the whole log as a frame of polars; the log is read by it, and cannot be read again."""
        import polars

        columns, names = self.columns, self._table.names
        named = [*columns.output, *(columns.gyro or ())]
        named += [k for k in (columns.temperature, columns.time) if k is not None]
        keys = [str(k + 1) if names is None else names[k] for k in named]
        return polars.DataFrame(np.concatenate(list(self.blocks())), schema=keys)

    def gyro_names(self) -> tuple[str, ...]:
        """Return the names of the gyroscope columns, or their numbers from 1; none without a gyroscope."""
        names = self._table.names
        return tuple(str(k + 1) if names is None else names[k] for k in self.columns.gyro or ())

    def head(self) -> Float:
        """Return the first rows, as `blocks` yields them, of the first block of PROBE or more."""
        timed = self.columns.time is not None
        width = (6 if self.columns.gyro else 3) + (self.columns.temperature is not None) + timed
        return np.concatenate([np.empty((0, width)), *(rows.numbers[:, :width] for rows in self._head)])[
            :HEAD
        ]

    def zero_rows(self, rows: int) -> tuple[Notice, ...]:
        """Return what is said of rows of zeros among so many rows that were read."""
        return self.zeros.notices(self.where, rows - self.zeros.count)

    def close(self) -> None:
        """Release the file."""
        self._table.close()

    def _check_time(self, time: Float, last: float, start: int) -> None:
        back = time[1:] < time[:-1]
        if time[0] < last or back.any():
            row = 0 if time[0] < last else int(np.argmax(back)) + 1
            before = time[row - 1] if row else last
            single = (
                row
                and not self._table.lenient
                and wrong_time(time[max(row - 2, 0) :], min(row, 2)) is not None
            )
            few = SKIPPABLE if single else ""
            raise DataError(
                f"{self.name}, {self.where(start + row)}: time {time[row]:.10g} comes after {before:.10g}; expected "
                f"time that never decreases (--time none leaves it out){few}"
            )


def _of_one(rows: Iterator[RowBlock], one: OneSensor) -> Iterator[RowBlock]:
    """Yield rows, and refuse those of several sensors."""
    for block in rows:
        one.add(block)
        yield block


def _first(rows: Iterator[RowBlock], least: int) -> list[RowBlock]:
    """Take blocks until they hold `least` rows, or all there are."""
    head: list[RowBlock] = []
    while sum(len(block.numbers) for block in head) < least and (block := next(rows, None)):
        head.append(block)
    return head
