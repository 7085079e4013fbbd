"""A raw log: three accelerometer columns at a fixed rate, with time and three gyroscope columns where they exist."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.cells import Rows
from accelcal_cli.sensor.clock import Clock, dated, unit_of
from accelcal_cli.sensor.rawcolumns import RawColumns, choose_raw
from accelcal_cli.sensor.tabular import Table, open_table
from accelcal_cli.streams import Float

PROBE = 1000
"""Rows that tell the step of the time column, and whether a column without a name is one."""


@dataclass(frozen=True)
class RawRows:
    """A block of rows of a raw log.

    Attributes:
        numbers: acceleration (3), turning rate (3) where there is a gyroscope, time where there is one, shape (B, k).
        gyro, timed: which of them there are.
    """

    numbers: Float
    gyro: bool = False
    timed: bool = False

    @property
    def time(self) -> Float | None:
        """Time of each row, shape (B,), as given."""
        return self.numbers[:, -1] if self.timed else None


class RawLog:
    """A raw log that is read once, from top to bottom."""

    def __init__(self, table: Table, columns: RawColumns) -> None:
        """Read the first rows of `table`: they tell what the time column is."""
        self.name = table.name
        self.columns = columns
        self._table = table
        self._rows = table.blocks(columns.selection())
        if columns.dated:
            self._rows = dated(self._rows, self._time_at)
        self._head = _first(self._rows, PROBE)
        self.clock = Clock()
        self.notes = list(columns.notes)
        self._settle_time()

    def _settle_time(self) -> None:
        """Take the time column for what it is: time, a row number, or no time at all."""
        columns, times = self.columns, _column(self._head, -1)[:PROBE]
        if columns.time is None:
            return
        steps = np.diff(times)
        if columns.guessed and not (len(steps) and (steps >= 0).all() and (steps > 0).any()):
            if columns.doubtful:
                raise DataError(columns.doubtful)
            self.columns = replace(columns, time=None)
            return
        self.clock = Clock.of(times, self._unit())
        if columns.dated:
            self.notes.append("time is counted in seconds from the first row")
        if columns.guessed:
            self.notes.append(f"column {columns.time + 1} taken as time: it never decreases")
        if self.clock.rate is None:
            self.columns = replace(columns, time=None)
            self.notes.append(f"column {columns.time + 1} counts rows, it is no time")
        elif self.clock.unit != "s":
            self.notes.append(f"time taken as {self.clock.unit}: {self.clock.rate:.6g} rows a second")

    def _unit(self) -> str | None:
        """Unit of the time column, where it is known before its steps are."""
        if self.columns.dated:
            return "s"
        names, time = self._table.names, self.columns.time
        return None if names is None or time is None else unit_of(names[time])

    def _time_at(self, row: int) -> str:
        """How to name the time of a row (from 0) that has been read."""
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

    def blocks(self) -> Iterator[RawRows]:
        """Yield the rows, block after block, in constant memory; time that goes back is a DataError."""
        last = -np.inf
        while self._head:
            rows = self._head.pop(0)
            raw = self._part(rows.numbers)
            if raw.time is not None and len(raw.time):
                self._check_time(raw.time, last, rows.start)
                last = float(raw.time[-1])
            yield raw
            if not self._head:
                self._head.extend(_first(self._rows, 1))

    def close(self) -> None:
        """Release the file."""
        self._table.close()

    def _part(self, numbers: Float) -> RawRows:
        sensors = 6 if self.columns.gyro else 3
        timed = self.columns.time is not None
        return RawRows(numbers[:, : sensors + timed], sensors == 6, timed)

    def _check_time(self, time: Float, last: float, start: int) -> None:
        back = np.diff(time, prepend=last) < 0
        if not back.any():
            return
        row = int(np.argmax(back))
        before = time[row - 1] if row else last
        raise DataError(
            f"{self.name}, {self.where(start + row)}: time {time[row]:.10g} comes after {before:.10g}; expected "
            "time that never decreases (--time none leaves it out)"
        )


def open_raw_log(
    source: str | Path,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
    *,
    stdin: BinaryIO | None = None,
) -> RawLog:
    """Open a raw log in any form that `read_readings` reads; ``-`` is standard input.

    Args:
        source: path, or ``-``.
        columns, gyro: three columns each, by name or by number from 1; found by their names when None; no
            gyroscope with `gyro` of ``["none"]``.
        time: a column, ``"none"``, or None to find it.
        stdin: standard input.
    """
    table = open_table(source, stdin)
    try:
        return RawLog(table, choose_raw(table, columns, gyro, time))
    except BaseException:
        table.close()
        raise


def _first(rows: Iterator[Rows], least: int) -> list[Rows]:
    """Take blocks until they hold `least` rows, or all there are."""
    taken: list[Rows] = []
    while sum(len(block.numbers) for block in taken) < least:
        block = next(rows, None)
        if block is None:
            break
        taken.append(block)
    return taken


def _column(blocks: list[Rows], k: int) -> Float:
    return np.concatenate([np.empty(0), *(block.numbers[:, k] for block in blocks)])
