"""Rows that are no readings of the sensor, found while a table is read: zeros of an idle logger, other sensors."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable, Sequence
from itertools import compress

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import is_kind
from accelcal_cli.io.reader import InputTable, LineMap, RowBlock
from accelcal_cli.notices import Notice

SHOWN = 6
"""Rows, poses or values that a sentence names at most."""

MOST_SENSORS = 1000
"""A column with more values does not label sensors."""

KIND_OF_SENSOR = re.compile(r"acc|gyr|mag|baro|imu|linear|gravity|rot|compass|temp", re.IGNORECASE)
ACCELEROMETER = re.compile(r".*acc", re.IGNORECASE)


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
        if keep is None:
            return rows
        texts = tuple(list(compress(text, keep.tolist())) for text in rows.texts)
        return RowBlock(rows.start, rows.numbers[keep], texts)

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


def add_stretches(stretches: list[tuple[int, int]], rows: Int) -> None:
    """Add runs of consecutive rows, ascending, to some stretches, of which the first SHOWN are kept."""
    breaks = np.flatnonzero(np.diff(rows) > 1)
    firsts, lasts = np.append(rows[:1], rows[breaks + 1]), np.append(rows[breaks], rows[-1:])
    if stretches and stretches[-1][1] + 1 == firsts[0]:
        stretches[-1] = stretches[-1][0], int(lasts[0])
        firsts, lasts = firsts[1:], lasts[1:]
    room = SHOWN - len(stretches)
    stretches += zip(firsts[:room].tolist(), lasts[:room].tolist(), strict=True)


def places(stretches: list[tuple[int, int]], where: Callable[[int], str]) -> str:
    """Return how to name stretches of rows."""
    shown = [where(a) if a == b else f"{where(a)} to {where(b)}" for a, b in stretches]
    return ", ".join(shown) + (", ..." if len(shown) == SHOWN else "")


def named(shown: list[str], count: int) -> str:
    """Return names in a list, and how many more there are."""
    more = count - len(shown)
    return ", ".join(shown) + (f" and {more:,} more" if more > 0 else "")
