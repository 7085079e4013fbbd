"""A raw log: acceleration at a fixed rate, with time and turning rate where there are such columns.

`RawLog` reads a table once, from top to bottom. Its first rows show what the time column is: time of some unit and rate
(`Clock`), dates, a row number, or no time at all.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import RawColumns, choose_raw, restrict
from accelcal_cli.io.reader import InputTable, RowBlock, open_table, shorten
from accelcal_cli.io.rows import OneSensor, ZeroRows

PROBE = 1000
"""Rows that determine the step of the time column, and whether a column without a name is time."""

HEAD = 20_000
"""First rows that show whether several sensors take turns, at most."""

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
"""Units of a time column, in seconds."""

SLOWEST = 1.0
"""Hz: no raw log is slower, so the time of one that seems slower is in a smaller unit."""

_UNIT = re.compile(
    r"(?:.*[\W_])?(?:(s|secs?|seconds?)|(ms|msecs?|millis|milliseconds?)|([uµμ]s|[uµμ]secs?|micros|microseconds?)"
    r"|(ns|nsecs?|nanos|nanoseconds?))[\W_]*",
    re.IGNORECASE,
)
_ZONE = re.compile(r"(?:[zZ]|[+-]\d\d(?::?\d\d)?)$")


def open_raw_log(
    source: str | Path,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
    *,
    stdin: BinaryIO | None = None,
    where: Sequence[str] = (),
) -> RawLog:
    """Open a raw log in any form that `read_readings` reads; ``-`` is standard input.

    Args:
        source: path, or ``-``.
        columns, gyro: three columns each, by name or by number from 1; found by their names when None; no
            gyroscope with `gyro` of ``["none"]``.
        time: a column, ``"none"``, or None to find it.
        stdin: standard input.
        where: conditions on the rows, each as COLUMN=VALUE.
    """
    table = open_table(source, stdin)
    try:
        restrict(table, where)
        return RawLog(table, choose_raw(table, columns, gyro, time))
    except BaseException:
        table.close()
        raise


class RawLog:
    """A raw log that is read once, from top to bottom."""

    def __init__(self, table: InputTable, columns: RawColumns) -> None:
        """Read the first rows of `table` to find out what the time column is."""
        self.name = table.name
        self.columns = columns
        self.zeros = ZeroRows()
        self._table = table
        rows = _of_one(table.blocks(columns.selection()), OneSensor(table, columns.identity, fleet=False))
        self._rows = seconds_of_dates(rows, self._time_at) if columns.dated else rows
        self._head = _first(self._rows, PROBE)
        self.clock = Clock()
        self.notes = list(columns.notes)
        self._settle_time()

    def _settle_time(self) -> None:
        """Take the time column for what it is: time, a row number, or no time at all."""
        columns = self.columns
        if columns.time is None:
            return
        times = np.concatenate([np.empty(0), *(rows.numbers[:, -1] for rows in self._head)])[:PROBE]
        steps = np.diff(times)
        if columns.guessed and not (len(steps) and (steps >= 0).all() and (steps > 0).any()):
            if columns.doubtful:
                raise DataError(columns.doubtful)
            self.columns = replace(columns, time=None)
            return
        names = self._table.names
        unit = None if names is None else unit_of(names[columns.time])
        self.clock = Clock.of(times, "s" if columns.dated else unit)
        if columns.dated:
            self.notes.append("time is counted in seconds from the first row")
        if columns.guessed:
            self.notes.append(f"column {columns.time + 1} taken as time: it never decreases")
        if self.clock.rate is None:
            self.columns = replace(columns, time=None)
            self.notes.append(f"column {columns.time + 1} counts rows, so it is not time")
        elif self.clock.unit != "s":
            self.notes.append(f"time taken as {self.clock.unit}: {self.clock.rate:.6g} rows per second")

    def _time_at(self, row: int) -> str:
        """Return how to name the time of a row (from 0) that has been read."""
        names, time = self._table.names, self.columns.time or 0
        column = str(time + 1) if names is None else f'"{names[time]}"'
        return f"{self.name}, {self.where(row)}, column {column}"

    @property
    def sha256(self) -> str:
        """SHA-256 of the input, once all blocks have been read."""
        return self._table.sha256

    @property
    def where(self) -> Callable[[int], str]:
        """How to name a row (from 0) that has been read."""
        return self._table.where

    def blocks(self) -> Iterator[Float]:
        """Yield the rows, block after block, in constant memory; time that goes back is a DataError.

        Shape (B, k): acceleration (3), turning rate (3) where there is a gyroscope, time where there is one, as given.
        """
        timed = self.columns.time is not None
        width, last = (6 if self.columns.gyro else 3) + timed, -np.inf
        for rows in chain(self._head, self._rows):
            numbers = rows.numbers[:, :width]
            self.zeros.keep(numbers[:, :3], rows.start)
            if timed and len(numbers):
                self._check_time(numbers[:, -1], last, rows.start)
                last = float(numbers[-1, -1])
            yield numbers

    def gyro_names(self) -> tuple[str, ...]:
        """Return the names of the gyroscope columns, or their numbers from 1; none without a gyroscope."""
        names = self._table.names
        return tuple(str(k + 1) if names is None else names[k] for k in self.columns.gyro or ())

    def head(self) -> Float:
        """Return the first rows, as `blocks` yields them, of the first block of PROBE or more."""
        timed = self.columns.time is not None
        width = (6 if self.columns.gyro else 3) + timed
        return np.concatenate([np.empty((0, width)), *(rows.numbers[:, :width] for rows in self._head)])[
            :HEAD
        ]

    def close(self) -> None:
        """Release the file."""
        self._table.close()

    def _check_time(self, time: Float, last: float, start: int) -> None:
        back = np.diff(time, prepend=last) < 0
        if back.any():
            row = int(np.argmax(back))
            before = time[row - 1] if row else last
            raise DataError(
                f"{self.name}, {self.where(start + row)}: time {time[row]:.10g} comes after {before:.10g}; expected "
                "time that never decreases (--time none leaves it out)"
            )


@dataclass(frozen=True)
class Clock:
    """Rate and unit of the time column.

    Attributes:
        rate: rows per second, Hz; None where it is unknown.
        unit: of the time column: s, ms, us or ns.
    """

    rate: float | None = None
    unit: str = "s"

    @property
    def period(self) -> float | None:
        """Time from row to row, in the unit of the time column; None where the rate is unknown."""
        return None if self.rate is None else 1.0 / (self.rate * UNITS[self.unit])

    @classmethod
    def of(cls, time: Float, unit: str | None = None) -> Self:
        """Return rate and unit, where it is not stated, from the times of the first rows, shape (n,).

        Without a unit a step of exactly 1 counts rows and gives no rate. A stated unit that would make the log
        slower than SLOWEST is ignored.
        """
        steps = np.diff(time)
        steps = steps[steps > 0]
        if not len(steps) or (unit is None and (steps == 1).all()):
            return cls()
        step = float(np.median(steps))
        if unit is None or step * UNITS[unit] > 1 / SLOWEST:
            unit = next((unit for unit, size in UNITS.items() if step * size <= 1 / SLOWEST), "ns")
        return cls(1.0 / (step * UNITS[unit]), unit)


def unit_of(name: str) -> str | None:
    """Return the unit that the name of a time column ends in, as in ``timestamp_ms`` or ``time [us]``."""
    match = _UNIT.fullmatch(name.strip())
    return None if match is None else list(UNITS)[next(k for k, part in enumerate(match.groups()) if part)]


def seconds_of_dates(rows: Iterable[RowBlock], place: Callable[[int], str]) -> Iterator[RowBlock]:
    """Yield rows whose text is date and time with the seconds since the first row as one more column.

    Args:
        rows: blocks with text; place: how to name a row (from 0) and its column.
    """
    first, zone = np.zeros(0, dtype="datetime64[ns]"), ""
    for block in rows:
        text = [cell.replace(",", ".") for cell in block.texts[0]]
        if not len(first) and text:
            match = _ZONE.search(text[0][len("2026-03-01") :])
            zone = "" if match is None else match[0]
        stamps = _stamps([cell.removesuffix(zone) for cell in text], block.start, text, place)
        first = first if len(first) else stamps[:1]
        seconds = (stamps - first).astype(np.int64) / 1e9
        yield RowBlock(block.start, np.column_stack([block.numbers, seconds]))


def _stamps(
    cells: list[str], start: int, shown: list[str], place: Callable[[int], str]
) -> NDArray[np.datetime64]:
    """Return the cells as points in time, all in one time zone, ns."""
    if all(cell[:4].isdigit() for cell in cells):
        try:
            return _read(cells)
        except (ValueError, UserWarning):
            pass
    wrong = next(k for k, cell in enumerate(cells) if not _is_stamp(cell))
    raise DataError(
        f"{place(start + wrong)}: {shorten(shown[wrong])} is not a time; expected numbers, or dates as "
        "2026-03-01T12:30:00.25, all in one time zone (--time none leaves it out)"
    )


def _read(cells: list[str]) -> NDArray[np.datetime64]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # about a time zone, which numpy would drop
        return np.array(cells, dtype="datetime64[ns]")


def _is_stamp(cell: str) -> bool:
    try:
        return cell[:4].isdigit() and not np.isnat(_read([cell])[0])
    except (ValueError, UserWarning):
        return False


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
