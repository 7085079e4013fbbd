"""Which columns of a raw log are acceleration, rotation and time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.sensor.cells import Selection
from accelcal_cli.sensor.colnames import gyro_columns, time_column
from accelcal_cli.sensor.columns import Triple, choose, find_column, stated
from accelcal_cli.sensor.tabular import Table

NONE = "none"

NAMELESS: dict[int, tuple[Triple, Triple | None, int | None]] = {
    3: ((0, 1, 2), None, None),
    4: ((1, 2, 3), None, 0),
    6: ((0, 1, 2), (3, 4, 5), None),
    7: ((1, 2, 3), (4, 5, 6), 0),
}
"""Acceleration, gyroscope and time of a log without a header, by its number of columns."""


@dataclass(frozen=True)
class RawColumns:
    """Columns of a raw log, counted from 0.

    Attributes:
        output: the accelerometer; names: of its columns, or their numbers from 1.
        gyro, time: None where there are none.
        dated: `time` holds dates, not numbers.
        guessed: `time` is only time when it never decreases.
        doubtful: what to say when a guessed time column is none and so nothing is known of the others.
        notes: what a user should know.
    """

    output: Triple
    names: tuple[str, str, str]
    gyro: Triple | None = None
    time: int | None = None
    dated: bool = False
    guessed: bool = False
    doubtful: str = ""
    notes: tuple[str, ...] = ()

    def selection(self) -> Selection:
        """What to ask of the table: acceleration, gyroscope, time; dates as text."""
        sensors = (*self.output, *(self.gyro or ()))
        if self.time is None:
            return Selection(sensors)
        return Selection(sensors, texts=(self.time,)) if self.dated else Selection((*sensors, self.time))


def choose_raw(
    table: Table,
    columns: Sequence[str] | None = None,
    gyro: Sequence[str] | None = None,
    time: str | None = None,
) -> RawColumns:
    """Find the columns of a raw log; what is stated wins over names, names over the number of columns.

    Raises:
        DataError: the table does not say which columns to take.
        UsageError: a stated column does not exist or is stated twice.
    """
    if not table.has_rows:
        raise DataError(f"{table.name}: has a header but no rows below it")
    found = _nameless(table) if columns is None and table.names is None else _named(table, columns)
    turning = found.gyro if gyro is None else _stated_gyro(table, gyro)
    clock, guessed = found.time, found.guessed
    if time is not None:
        clock, guessed = None if time.lower() == NONE else find_column(table, time, "--time"), False
    elif clock is not None and clock in (turning or ()):
        clock = None
    used = [*found.output, *(turning or ()), *(() if clock is None else (clock,))]
    if len(set(used)) < len(used):
        raise UsageError("--columns, --gyro, --time: a column is asked for twice")
    return replace(
        found,
        gyro=turning,
        time=clock,
        dated=clock is not None and not table.numeric[clock],
        guessed=guessed,
        doubtful=found.doubtful if time is None else "",
    )


def _named(table: Table, columns: Sequence[str] | None) -> RawColumns:
    """Go by the names of the columns, or, for a stated accelerometer, by what the names leave."""
    chosen = choose(table, columns)
    names = table.names
    if names is None:
        guess = 0 if 0 not in chosen.output and table.numeric[0] else None
        return RawColumns(chosen.output, chosen.names, time=guess, guessed=True)
    gyro, time = gyro_columns(names), time_column(names)
    if gyro is not None and set(gyro) & set(chosen.output):
        gyro = None
    if time in (*chosen.output, *(gyro or ())):
        time = None
    return RawColumns(chosen.output, chosen.names, gyro, time)


def _nameless(table: Table) -> RawColumns:
    width = len(table.numeric)
    if width not in NAMELESS:
        raise DataError(
            f"{table.name}: has {width} columns and no header; expected 3 (acceleration), 4 (time, acceleration), "
            "6 (acceleration, gyroscope) or 7 (time, acceleration, gyroscope); say which are x, y, z with "
            "--columns, as in --columns 2,3,4"
        )
    output, gyro, time = NAMELESS[width]
    names = (str(output[0] + 1), str(output[1] + 1), str(output[2] + 1))
    note = f"no header: columns {_listed(output)} taken as acceleration x, y, z"
    if gyro is not None:
        note += f", columns {_listed(gyro)} as gyroscope"
    doubtful = (
        f"{table.name}: has {width} columns and no header, and the first is not time; say which are x, y, z "
    )
    doubtful += "with --columns, as in --columns 1,2,3"
    return RawColumns(output, names, gyro, time, guessed=time is not None, doubtful=doubtful, notes=(note,))


def _stated_gyro(table: Table, gyro: Sequence[str]) -> Triple | None:
    words = [gyro] if isinstance(gyro, str) else list(gyro)
    return None if [word.lower() for word in words] == [NONE] else stated(table, words, "--gyro")


def _listed(columns: Triple) -> str:
    return ", ".join(str(k + 1) for k in columns)
