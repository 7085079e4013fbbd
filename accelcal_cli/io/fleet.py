"""Static readings of many sensors, from one table with a column that labels the sensor, or from one file per sensor.

`read_fleet` gathers the rows into stores that may be on disk; a `FleetCollector` reads a window of them, too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.batches import EXTRAS, WIDTH, FleetReadings, PoseLabels, TableOrigin
from accelcal_cli.io.columns import Columns, choose, own_sensor_column, restrict, sensor_column
from accelcal_cli.io.reader import PLAIN, InputTable, ReadOptions, open_table
from accelcal_cli.io.readings import InputForm, LabelledMeans, number_labels
from accelcal_cli.io.rows import (
    RowBlock,
    ZeroRows,
    add_stretches,
    left_row,
    places,
    set_aside,
)
from accelcal_cli.io.stream import RowStore, Source

MOST_POSES = 20_000_000
"""Poses with a label of their own in one table, at most."""

COLD = "Temperature column not used; --temperature fits slopes with it, sensor by sensor."


def read_fleet(
    sources: Sequence[Source],
    columns: Sequence[str] | None = None,
    sensor: str | None = None,
    *,
    stdin: BinaryIO | None = None,
    options: ReadOptions = PLAIN,
) -> FleetReadings:
    """Read the static readings of many sensors; ``-`` is standard input.

    One table has a column that labels the sensor, found by its name or named by `sensor`. Of several files each is
    one sensor, named by its file, unless `sensor` names that column. `columns` are the three output columns. Of the
    rows only those are read that meet the conditions `where`, each as COLUMN=VALUE.

    Raises:
        DataError: a fault of the input, with its place.
        UsageError: a fault of `columns`, `sensor` or `where`, or a file twice.
    """
    check_once(sources)
    each = len(sources) > 1 and sensor is None
    names: Sequence[str | None] = file_names(list(map(str, sources))) if each else [None] * len(sources)
    collector = FleetCollector(columns, sensor, options)
    for source, name in zip(sources, names, strict=True):
        collector.open(source, name, stdin)
    label = collector.origins[0].name if len(sources) == 1 else f"{len(sources)} files"
    if not each:
        check_poses(label, len(collector.index), collector.store.rows)
    return collector.readings(label)


def check_poses(name: str, sensors: int, poses: int) -> None:
    """Raise DataError where every row has another sensor."""
    if poses == sensors > 1:
        raise DataError(
            f"{name}: every row has another sensor; expected several poses of each (--sensor-column says which "
            "column labels the sensor)"
        )


def check_once(sources: Sequence[Source]) -> None:
    """Raise UsageError where a file is given twice."""
    for k, source in enumerate(sources):
        if isinstance(source, str | Path) and source in sources[:k]:
            raise UsageError(f"{source}: is given twice")


def file_names(sources: Sequence[str]) -> Sequence[str]:
    """Return a name for each file: its own without the ending, with as many folders as tell them apart."""
    paths = [Path(source) for source in sources]
    names = [path.stem for path in paths]
    for parts in range(2, max(len(path.parts) for path in paths) + 1):
        if len(set(names)) == len(names):
            break
        names = ["/".join((*path.parts[-parts:-1], path.stem)) for path in paths]
    return names if len(set(names)) == len(names) else sources


@dataclass(frozen=True, eq=False)
class Window:
    """Some rows of a typed table, whose sensors are known.

    Attributes:
        first: the first row, from 0; sensors: their labels, each once; rows: of each, shape (R,).
        total, sha256: rows and hash of the whole table.
    """

    first: int
    sensors: list[str]
    rows: Int
    total: int
    sha256: str


@dataclass(eq=False)
class FleetCollector:
    """Gathers the rows of tables into poses of sensors.

    Attributes:
        wanted: the three output columns, `sensor`: the one that labels the sensor, None to find them.
        options: what the user knows of the form of a table.
        in_order: whether all poses of a sensor came one after the other.
    """

    wanted: Sequence[str] | None = None
    sensor: str | None = None
    options: ReadOptions = PLAIN
    in_order: bool = True
    _last: int = -1
    index: dict[str, int] = field(default_factory=dict)
    poses: Int = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    store: RowStore = field(default_factory=lambda: RowStore(4))
    extras: RowStore | None = None
    origins: list[TableOrigin] = field(default_factory=list)
    zeros: dict[int, tuple[int, str]] = field(default_factory=dict)

    def open(
        self,
        source: Source,
        name: str | None,
        stdin: BinaryIO | None = None,
        window: Window | None = None,
    ) -> None:
        """Read one table: of the sensor `name`, or of many."""
        table = open_table(source, stdin, hashed=window is None, options=self.options)
        try:
            restrict(table, self.options.where)
            self.read(table, name, window)
        finally:
            table.close()

    def readings(self, source: str) -> FleetReadings:
        """Return what was gathered."""
        return FleetReadings(
            source,
            tuple(self.index),
            self.poses,
            tuple(self.origins),
            self.store,
            self.extras,
            self.zeros,
            self.in_order,
        )

    def columns(self, table: InputTable, name: str | None) -> Columns:
        """Return the columns of a table: of the sensor `name`, or of many."""
        column = sensor_column(table, self.sensor) if name is None else own_sensor_column(table)
        columns = choose(table, self.wanted, column, self.options.count)
        if column in columns.output:
            shown = columns.names[columns.output.index(column)]
            raise UsageError(f'--sensor-column: column "{shown}" of {table.name} is a reading, not a label')
        return columns

    def read(self, table: InputTable, name: str | None, window: Window | None = None) -> None:
        """Read one table: of the sensor `name`, or of many, or a window of it."""
        first = self.store.rows
        columns = self.columns(table, name)
        means = _means_of(table.name, columns)
        zeros, idle, rows_read = ZeroRows(), dict[int, list[int]](), 0
        if window is not None and columns.reference is not None:
            zeros.rows.add(0, window.first)
        for rows, codes in self._coded(table, columns, name, window):
            rows_read += len(rows.numbers)
            columns.check(table, rows)
            numbers, label = (
                rows.numbers,
                rows.texts[columns.sensor is not None and window is None] if means is not None else (),
            )
            keep = None if columns.reference is not None else zeros.keep(numbers[:, :3], rows.start)
            if keep is not None:
                set_aside(idle, codes, keep, rows.start)
                codes, numbers, label = codes[keep], numbers[keep], list(compress(label, keep.tolist()))
            output, (count, scatter, more) = numbers[:, :3], columns.split(numbers[:, 3:])
            if means is None:
                self._add(codes, output, count, scatter, None, *_of_others(columns, more))
            else:
                own = list(zip(codes.tolist(), label, strict=True))
                means.add(own, np.hstack([output, more]), count, scatter)
        if means is not None:
            self._add_means(means, columns)
        self._note_zeros(idle, table.where)
        place = partial(left_row, table.where, zeros.rows) if zeros.count or window else table.where
        if means is not None:
            place = PoseLabels(dict(enumerate(label for _, label in means.index)))
        read = rows_read if window is None else window.total
        form = InputForm(table.source_format, read, table.rows_skipped, None, columns.unit)
        sha256 = table.sha256 if window is None else window.sha256
        ways = {"rows": means is None, "timed": columns.time is not None}
        notes = notes_of(table, columns)
        self.origins.append(TableOrigin(table.name, sha256, columns.names, first, place, notes, form, **ways))

    def _coded(
        self, table: InputTable, columns: Columns, name: str | None, window: Window | None
    ) -> Iterator[tuple[RowBlock, Int]]:
        """Yield the rows of a table, none empty, with the numbers of their sensors, shape (B,)."""
        selection = columns.selection()
        if window is None:
            for rows in table.blocks(selection):
                if len(rows.numbers):
                    labels = rows.texts[0] if name is None else _only(table, columns, rows, name)
                    yield rows, number_labels(self.index, labels)
            return
        codes = np.repeat(number_labels(self.index, window.sensors), window.rows)
        table.window = (window.first, window.first + len(codes))  # type: ignore[attr-defined]  # a typed table has one
        for rows in table.blocks(replace(selection, texts=selection.texts[1:])):
            start = rows.start - window.first
            yield rows, codes[start : start + len(rows.numbers)]

    def _add_means(self, means: LabelledMeans[tuple[int, str]], columns: Columns) -> None:
        """Add the poses that labels made."""
        codes = np.array([code for code, _ in means.index], dtype=np.intp)
        known = means.count(), means.scatter(), means.cross()
        self._add(codes, means.mean[:, :3], *known, *_of_others(columns, means.mean[:, 3:]))

    def _note_zeros(self, idle: dict[int, list[int]], where: Callable[[int], str]) -> None:
        """Note the rows of zeros of each sensor; one that has nothing else keeps them."""
        for code, rows in idle.items():
            before, shown = self.zeros.get(code, (0, ""))
            stretches: list[tuple[int, int]] = []
            add_stretches(stretches, np.array(rows))
            self.zeros[code] = before + len(rows), shown or places(stretches, where)
            if code >= len(self.poses) or not self.poses[code]:
                self._add(np.full(len(rows), code), np.zeros((len(rows), 3)), None, None)
                del self.zeros[code]

    def _add(
        self,
        codes: Int,
        output: Float,
        behind: Float | None,
        scatter: Float | None,
        cross: Float | None = None,
        reference: Float | None = None,
        temperature: Float | None = None,
    ) -> None:
        """Add poses: the numbers of their sensors (B,), output (B, 3), and what is known of the extras."""
        known = behind, scatter, cross, reference, temperature
        before = self.store.rows
        if len(codes):
            self.in_order &= bool(codes[0] >= self._last and (codes[1:] >= codes[:-1]).all())
            self._last = int(codes[-1])
        self.poses = np.pad(self.poses, (0, len(self.index) - len(self.poses)))
        self.poses += np.bincount(codes, minlength=len(self.poses))
        self.store.append(np.column_stack([codes, output]))
        if all(part is None for part in known) and self.extras is None:
            return
        if self.extras is None:
            self.extras = RowStore(WIDTH)
            self.extras.append(np.full((before, WIDTH), np.nan))
        rows = np.empty((len(codes), WIDTH))
        for part, values in zip(EXTRAS, known, strict=True):
            rows[:, part] = np.nan if values is None else values
        self.extras.append(rows)


def notes_of(table: InputTable, columns: Columns) -> tuple[str, ...]:
    """Return what there is to say of a table and its columns."""
    return (*table.notes, *columns.notes, *(() if columns.temperature is None else (COLD,)))


def _means_of(source: str, columns: Columns) -> LabelledMeans[tuple[int, str]] | None:
    """Return what averages the rows of a label: output, known specific force and temperature; None without labels."""
    others = 3 * (columns.reference is not None) + (columns.temperature is not None)
    return None if columns.label is None else LabelledMeans(source, 3 + others, MOST_POSES)


def _of_others(columns: Columns, others: Float) -> tuple[Float | None, Float | None]:
    """Return the known specific force, shape (B, 3), and the temperature, shape (B,), of the other columns."""
    return (
        None if columns.reference is None else others[:, :3],
        None if columns.temperature is None else others[:, -1],
    )


def _only(table: InputTable, columns: Columns, rows: RowBlock, name: str) -> list[str]:
    """Return the name of a file's sensor for each row; more than one label in its sensor column is refused."""
    if columns.sensor is not None and len(set(rows.texts[0])) > 1:
        shown = (table.names or ())[columns.sensor]
        raise DataError(
            f'{table.name}: column "{shown}" labels several sensors where one file per sensor was expected; '
            f'state --sensor-column "{shown}" to read every file that way'
        )
    return [name] * len(rows.numbers)
