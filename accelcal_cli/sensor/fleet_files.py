"""Files of many sensors: one table with a column that labels the sensor, or one file a sensor."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.sensor.cells import Rows
from accelcal_cli.sensor.columns import Columns, choose, sensor_column, sensor_columns
from accelcal_cli.sensor.fleet import FleetReadings, Origin
from accelcal_cli.sensor.readings import check_rows
from accelcal_cli.sensor.repeats import LabelledMeans
from accelcal_cli.sensor.spool import RowStore
from accelcal_cli.sensor.tabular import Table, open_table
from accelcal_cli.streams import Float, Int

MOST_POSES = 20_000_000
"""Poses with a label of their own in one table, at most."""

COLD = "Temperature column not used: slopes with temperature go sensor by sensor, with calibrate."


def read_fleet(
    sources: Sequence[str],
    columns: Sequence[str] | None = None,
    sensor: str | None = None,
    *,
    stdin: BinaryIO | None = None,
) -> FleetReadings:
    """Read the static readings of many sensors; ``-`` is standard input.

    One table has a column that labels the sensor, found by its name or named by `sensor`. Of several files each is
    one sensor, named by its file, unless `sensor` names that column. `columns` are the three output columns.

    Raises:
        DataError: a fault of the input, with its place; UsageError: of `columns` or `sensor`, or a file twice.
    """
    again = next((source for k, source in enumerate(sources) if source in sources[:k]), None)
    if again is not None:
        raise UsageError(f"{again}: is given twice")
    each = len(sources) > 1 and sensor is None
    names = _file_names(sources) if each else [None] * len(sources)
    gathered = _Gathering()
    for source, name in zip(sources, names, strict=True):
        table = open_table(source, stdin)
        try:
            gathered.read(table, columns, sensor, name)
        finally:
            table.close()
    label = gathered.origins[0].name if len(sources) == 1 else f"{len(sources)} files"
    if not each and gathered.store.rows == len(gathered.index) > 1:
        raise DataError(
            f"{label}: every row has another sensor; expected several poses of each (--sensor-column says which "
            "column labels the sensor)"
        )
    return gathered.fleet(label)


def _file_names(sources: Sequence[str]) -> Sequence[str | None]:
    """Return a name for each file: its own without the ending, with as many folders as tell them apart."""
    paths = [Path(source) for source in sources]
    names = [path.stem for path in paths]
    for parts in range(2, max(len(path.parts) for path in paths) + 1):
        if len(set(names)) == len(names):
            break
        names = ["/".join((*path.parts[-parts:-1], path.stem)) for path in paths]
    return names if len(set(names)) == len(names) else sources


class _Gathering:
    """What the tables so far hold."""

    def __init__(self) -> None:
        self.index: dict[str, int] = {}
        self.poses: Int = np.zeros(0, dtype=np.intp)
        self.store = RowStore(4)
        self.extras: RowStore | None = None
        self.origins: list[Origin] = []

    def fleet(self, source: str) -> FleetReadings:
        return FleetReadings(
            source, tuple(self.index), self.poses, tuple(self.origins), self.store, self.extras
        )

    def read(self, table: Table, wanted: Sequence[str] | None, sensor: str | None, name: str | None) -> None:
        """Read one table: of the sensor `name`, or of many."""
        first = self.store.rows
        column = sensor_column(table, sensor) if name is None else _own_column(table)
        columns = choose(table, wanted, column)
        if column in columns.output:
            shown = columns.names[columns.output.index(column)]
            raise UsageError(f'--sensor-column: column "{shown}" of {table.name} is a reading, not a label')
        means = None if columns.label is None else LabelledMeans[tuple[int, str]](table.name, 3, MOST_POSES)
        for rows in table.blocks(columns.selection()):
            if not len(rows.numbers):
                continue
            check_rows(table, columns, rows)
            codes = self._codes(rows.texts[0] if name is None else _only(table, columns, rows, name))
            if means is None:
                self._add(codes, rows.numbers[:, :3], *_extras(columns, rows))
            else:
                keys = list(zip(codes.tolist(), rows.texts[-1], strict=True))
                means.add(keys, rows.numbers[:, :3], *_extras(columns, rows))
        where = table.where
        if means is not None:
            keys = list(means.index)
            codes = np.array([code for code, _ in keys], dtype=np.intp)
            self._add(codes, means.mean, means.count(), means.scatter())
            where = _by_label([label for _, label in keys])
        self.origins.append(
            Origin(
                table.name,
                table.sha256,
                columns.names,
                first,
                where,
                columns.notes if columns.temperature is None else (*columns.notes, COLD),
                rows=means is None,
                timed=columns.time is not None,
            )
        )

    def _codes(self, labels: Sequence[str]) -> Int:
        """Return the numbers of sensors, shape (B,), by their labels; a new one gets the next."""
        index = self.index
        found = (index.setdefault(label, len(index)) for label in labels)
        return np.fromiter(found, np.intp, len(labels))

    def _add(self, codes: Int, output: Float, behind: Float | None, scatter: Float | None) -> None:
        """Add poses: the numbers of their sensors (B,), output (B, 3), and what is known of the extras."""
        before = self.store.rows
        self.poses = np.pad(self.poses, (0, len(self.index) - len(self.poses)))
        self.poses += np.bincount(codes, minlength=len(self.poses))
        self.store.append(np.column_stack([codes, output]))
        if behind is None and scatter is None and self.extras is None:
            return
        if self.extras is None:
            self.extras = RowStore(4)
            self.extras.append(np.full((before, 4), np.nan))
        rows = np.full((len(codes), 4), np.nan)
        if behind is not None:
            rows[:, 0] = behind
        if scatter is not None:
            rows[:, 1:] = scatter
        self.extras.append(rows)


def _own_column(table: Table) -> int | None:
    """Return the column that labels the sensor in a table that should hold one only, if there is one."""
    found, _ = sensor_columns(table)
    return found[0] if len(found) == 1 else None


def _only(table: Table, columns: Columns, rows: Rows, name: str) -> list[str]:
    """Return the name of a file's sensor for each row; more than one label in its sensor column is refused."""
    if columns.sensor is not None and len(set(rows.texts[0])) > 1:
        shown = (table.names or ())[columns.sensor]
        raise DataError(
            f'{table.name}: column "{shown}" labels several sensors where one file a sensor was expected; '
            f'state --sensor-column "{shown}" to read every file so'
        )
    return [name] * len(rows.numbers)


def _by_label(labels: list[str]) -> Callable[[int], str]:
    return lambda pose: f'position "{labels[pose]}"'


def _extras(columns: Columns, rows: Rows) -> tuple[Float | None, Float | None]:
    """Return count (B,) and standard deviation (B, 3) of the rows, where the table has them."""
    at = 3 if columns.count is None else 4
    count = None if columns.count is None else rows.numbers[:, 3]
    return count, None if columns.scatter is None else rows.numbers[:, at : at + 3]
