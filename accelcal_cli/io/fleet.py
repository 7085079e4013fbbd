"""Static readings of many sensors, from one table with a column that labels the sensor, or from one file per sensor.

`read_fleet` gathers the rows into stores that may be on disk. `FleetReadings.parts` cuts a fleet into parts that other
processes can take; `FleetReadings.batches` yields the sensors in batches of about equally many poses, as arrays that
fit the caches of the processor.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import compress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.columns import Columns, choose, own_sensor_column, restrict, sensor_column
from accelcal_cli.io.reader import PLAIN, InputTable, ReadOptions, open_table
from accelcal_cli.io.readings import InputForm, LabelledMeans, Readings, number_labels
from accelcal_cli.io.rows import (
    RowBlock,
    ZeroRows,
    add_stretches,
    left_row,
    places,
    set_aside,
    zero_rows,
)
from accelcal_cli.io.screening import LOOKED_AT, ROW_WIDE, UNEQUAL, Screened, needs_look
from accelcal_cli.io.stream import RowStore, Source
from accelcal_cli.notices import Notice

SLAB = 2_000_000
"""Poses that are in memory at once, unless one sensor has more."""

PART = 49_152
"""Poses of a part of a fleet, up to the end of a sensor: what a worker gets, and what is kept of an interrupted run."""

BATCH = 16_384
"""Poses of a batch at most, unless one sensor has more: few enough for the processor's caches."""

STRETCH = 1.25
"""No sensor of a batch has more than so many times the poses of another."""

MOST_POSES = 20_000_000
"""Poses with a label of their own in one table, at most."""

COLD = "Temperature column not used: calibrate fits slopes with temperature, one sensor at a time."


@dataclass(frozen=True)
class TableOrigin:
    """A table that poses were read from.

    Attributes:
        name: as given; sha256: of its bytes; columns: names of its output columns.
        first: number of its first pose among those of all tables.
        where: how to name one of its poses, counted from 0.
        notes: what the reader did that a user should know; form: how the table is written.
        rows: whether each row, not each label, is a pose; timed: whether the rows have times.
    """

    name: str
    sha256: str
    columns: tuple[str, str, str]
    first: int
    where: Callable[[int], str]
    notes: tuple[str, ...]
    form: InputForm
    rows: bool
    timed: bool


EXTRAS: tuple[int | slice, ...] = (0, slice(1, 4), slice(4, 7))
"""Where the store of what is known beside the output has the readings behind a pose, their standard deviations, and
their covariances."""


@dataclass(frozen=True, eq=False)
class Batch:
    """The poses of R sensors as arrays of one length J; a sensor with fewer repeats its last pose.

    Attributes:
        sensors: their numbers, shape (R,); count: poses of each, shape (R,).
        output: shape (R, J, 3), sensor units; pose: number of each pose among all, shape (R, J).
        behind: raw readings behind each pose, shape (R, J), NaN where not known; None where no table has them.
        scatter: standard deviation of one of them, shape (R, J, 3), sensor units, likewise; cross: covariances xy, xz
            and yz of one, shape (R, J, 3), sensor units squared, likewise.
    """

    sensors: Int
    count: Int
    output: Float
    pose: Int
    behind: Float | None = None
    scatter: Float | None = None
    cross: Float | None = None


@dataclass(frozen=True, eq=False)
class FleetReadings:
    """Static readings of R sensors.

    Attributes:
        source: the file, or how many.
        sensors: their labels, in the order in which they came; poses: J of each, shape (R,).
        origins: the tables, in their order.
        zeros: rows that were zero in all axes and were left out, by number of the sensor: how many, and which.
        in_order: whether all poses of a sensor came one after the other.
    """

    source: str
    sensors: tuple[str, ...]
    poses: Int
    origins: tuple[TableOrigin, ...]
    _store: RowStore = field(repr=False)  # number of the sensor, output
    _extras: RowStore | None = field(repr=False)  # readings behind the pose, their standard deviation
    zeros: dict[int, tuple[int, str]] = field(default_factory=dict)
    in_order: bool = False
    _numbers: Int | None = field(default=None, repr=False)  # of the poses among those of all parts

    @property
    def unit(self) -> str | None:
        """Unit of the readings where all tables state the same."""
        units = {origin.form.unit for origin in self.origins}
        return units.pop() if len(units) == 1 else None

    def origin(self, pose: int) -> TableOrigin:
        """Return the table that a pose came from, by its number among all."""
        return self.origins[bisect.bisect_right(self.origins, pose, key=lambda origin: origin.first) - 1]

    def where(self, pose: int) -> str:
        """Return how to name a pose, by its number among all: ``line 8``."""
        origin = self.origin(pose)
        return origin.where(pose - origin.first)

    def one(self, batch: Batch, at: int) -> Readings:
        """Return the readings of the sensor at `at` in a batch, as `calibrate` takes them."""
        count, poses = int(batch.count[at]), batch.pose[at]
        origin, name = self.origin(int(poses[0])), self.sensors[batch.sensors[at]]
        return Readings.from_array(
            batch.output[at, :count],
            source=f'{origin.name}, sensor "{name}"',
            count=_known(batch.behind, at, count),
            scatter=_known(batch.scatter, at, count),
            cross=_known(batch.cross, at, count),
            warnings=self.warnings(batch, at),
        ).known_as(
            origin.sha256,
            origin.columns,
            origin.notes,
            lambda pose: self.where(int(poses[pose])),
            form=origin.form,
        )

    def warnings(self, batch: Batch, at: int) -> tuple[Notice, ...]:
        """Return why the readings of the sensor at `at` in a batch may not be poses."""
        count, poses, sensor = int(batch.count[at]), batch.pose[at], int(batch.sensors[at])
        origin, first = self.origin(int(poses[0])), min(count, LOOKED_AT)
        screened = Screened(
            batch.output[at, :first],
            origin.columns,
            count,
            lambda pose: self.where(int(poses[pose])),
            origin.name,
            single=origin.rows,
            timed=origin.timed,
            count=_known(batch.behind, at, first),
            scatter=_known(batch.scatter, at, first),
            zeros=sensor in self.zeros,
        )
        return (*screened.notices(), *zero_rows(*self.zeros.get(sensor, (0, "")), count))

    def doubtful(self, batch: Batch) -> Bool:
        """Return which sensors of a batch may have warnings, shape (R,)."""
        doubtful = needs_look(batch.output[:, :LOOKED_AT], batch.count)
        if batch.scatter is not None:
            doubtful |= (batch.scatter == 0).any(axis=(1, 2))
            noise = np.sqrt((batch.scatter**2).sum(axis=2) / (1.0 if batch.behind is None else batch.behind))
            doubtful |= noise.max(axis=1) > UNEQUAL * noise.min(axis=1)
            real = (np.arange(batch.output.shape[1]) < batch.count[:, None])[..., None]
            output = np.where(real, batch.output, np.nan)
            extent = np.fmax.reduce(output, axis=1) - np.fmin.reduce(output, axis=1)
            doubtful |= extent.max(axis=1) < ROW_WIDE * np.fmax.reduce(batch.scatter, axis=(1, 2))
        return np.asarray(doubtful | np.isin(batch.sensors, list(self.zeros)))

    def labelled(self, batch: Batch) -> Bool:
        """Return which sensors of a batch have poses that a label made, shape (R,)."""
        if len({origin.rows for origin in self.origins}) == 1:
            return np.full(len(batch.sensors), not self.origins[0].rows)
        return np.array([not self.origin(pose).rows for pose in batch.pose[:, 0].tolist()])

    def batches(self) -> Iterator[Batch]:
        """Yield every sensor once, in batches of about equally many poses."""
        ends, first = np.cumsum(self.poses), 0
        while first < len(ends):
            start = int(ends[first] - self.poses[first])
            last = max(int(np.searchsorted(ends, start + SLAB, side="right")), first + 1)
            yield from self._slab(first, last)
            first = last

    def parts(self) -> Iterator[FleetReadings]:
        """Yield the sensors in parts of about PART poses: readings of their own, which another process can take.

        The cuts depend on the readings alone.
        """
        bounds = cuts(self.poses)
        if len(bounds) < 2:
            yield self
            return
        ends, at = np.cumsum(self.poses), 0
        while at < len(
            bounds
        ):  # as many parts as fit into memory: rows in any order are searched once for all of them
            first, behind = bounds[at][0], at + 1
            start = int(ends[first] - self.poses[first])
            while behind < len(bounds) and ends[bounds[behind][1] - 1] - start <= SLAB:
                behind += 1
            last = bounds[behind - 1][1]
            rows, pose = self._select(first, last)
            extras = None if self._extras is None else _gather(self._extras, pose)
            order = np.argsort(rows[:, 0], kind="stable")
            for low, high in bounds[at:behind]:
                own = order[int(ends[low] - self.poses[low]) - start : int(ends[high - 1]) - start]
                yield self._part(low, high, rows[own], None if extras is None else extras[own], pose[own])
            at = behind

    def _part(self, first: int, last: int, rows: Float, extras: Float | None, pose: Int) -> FleetReadings:
        """Return the sensors from `first` to `last` - 1, whose poses are these rows."""
        store, more = RowStore(4), None if extras is None else RowStore(7)
        rows[:, 0] -= first
        store.append(rows)
        if more is not None and extras is not None:
            more.append(extras)
        return replace(
            self,
            sensors=self.sensors[first:last],
            poses=self.poses[first:last],
            origins=tuple(_origin_of(origin, pose) for origin in self.origins),
            zeros={code - first: said for code, said in self.zeros.items() if first <= code < last},
            in_order=True,
            _store=store,
            _extras=more,
            _numbers=pose,
        )

    def _slab(self, first: int, last: int) -> Iterator[Batch]:
        """Yield the sensors from `first` to `last` - 1."""
        rows, pose = self._select(first, last)
        extras = None if self._extras is None else _gather(self._extras, pose)
        pose = pose if self._numbers is None else self._numbers[pose]
        order = np.argsort(rows[:, 0], kind="stable")
        counts = self.poses[first:last]
        starts = np.cumsum(counts) - counts
        by_count = np.argsort(counts, kind="stable")
        for group in _groups(counts[by_count]):
            index = by_count[group]
            steps = np.minimum(np.arange(int(counts[index].max())), counts[index, None] - 1)
            at = order[starts[index, None] + steps]
            count, output = counts[index], rows[at, 1:]
            yield Batch(
                first + index,
                count,
                output,
                pose[at],
                *(None if extras is None else extras[at][..., part] for part in EXTRAS),
            )

    def _select(self, first: int, last: int) -> tuple[Float, Int]:
        """Return the rows of the sensors from `first` to `last` - 1 and the numbers of their poses."""
        if last - first == len(self.poses):
            return self._store.all(), np.arange(self._store.rows)
        if self.in_order:
            start, count = int(self.poses[:first].sum()), int(self.poses[first:last].sum())
            return self._store.part(start, start + count), np.arange(start, start + count)
        rows, numbers = [], []
        for start, block in self._store.blocks():
            chosen = np.flatnonzero((block[:, 0] >= first) & (block[:, 0] < last))
            rows.append(block[chosen])
            numbers.append(start + chosen)
        return np.concatenate(rows), np.concatenate(numbers)


def cuts(rows: Int) -> list[tuple[int, int]]:
    """Return the parts of a fleet whose sensors have so many rows, shape (R,): first sensor, and the one behind."""
    ends, first, bounds = np.cumsum(rows), 0, []
    while first < len(ends):
        before = int(ends[first] - rows[first])
        last = min(int(np.searchsorted(ends, before + PART)) + 1, len(ends))
        bounds.append((first, last))
        first = last
    return bounds


def _origin_of(origin: TableOrigin, pose: Int) -> TableOrigin:
    """Return the origin of some poses alone: of their labels where poses have labels."""
    if not isinstance(origin.where, _Labels):
        return origin
    own = pose[(pose >= origin.first) & (pose < origin.first + len(origin.where.names))] - origin.first
    return replace(origin, where=origin.where.only(own.tolist()))


def _gather(store: RowStore, numbers: Int) -> Float:
    """Return the rows of these numbers, which ascend."""
    if len(numbers) == store.rows:
        return store.all()
    if len(numbers) and numbers[-1] - numbers[0] == len(numbers) - 1:
        return store.part(int(numbers[0]), int(numbers[-1]) + 1)
    placed = (
        (start, block, *np.searchsorted(numbers, (start, start + len(block))))
        for start, block in store.blocks()
    )
    return np.concatenate([block[numbers[low:high] - start] for start, block, low, high in placed])


def _groups(counts: Int) -> Iterator[slice]:
    """Yield runs of sensors, sorted by their counts, that make a batch."""
    first = 0
    while first < len(counts):
        longest = int(STRETCH * counts[first])
        alike = int(np.searchsorted(counts, longest, side="right"))
        last = min(alike, first + max(1, BATCH // longest))
        yield slice(first, last)
        first = last


def _known(extra: Float | None, at: int, count: int) -> Float | None:
    """Return what is known of one sensor's poses; None where nothing is."""
    known = None if extra is None else extra[at, :count]
    return None if known is None or np.isnan(known).all() else known


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
        means = None if columns.label is None else LabelledMeans[tuple[int, str]](table.name, 3, MOST_POSES)
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
            output, (count, scatter, _) = numbers[:, :3], columns.split(numbers[:, 3:])
            if means is None:
                self._add(codes, output, count, scatter)
            else:
                means.add(list(zip(codes.tolist(), label, strict=True)), output, count, scatter)
        if means is not None:
            codes = np.array([code for code, _ in means.index], dtype=np.intp)
            self._add(codes, means.mean, means.count(), means.scatter(), means.cross())
        self._note_zeros(idle, table.where)
        place = partial(left_row, table.where, zeros.rows) if zeros.count or window else table.where
        if means is not None:
            place = _Labels(dict(enumerate(label for _, label in means.index)))
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
    ) -> None:
        """Add poses: the numbers of their sensors (B,), output (B, 3), and what is known of the extras."""
        before = self.store.rows
        if len(codes):
            self.in_order &= bool(codes[0] >= self._last and (codes[1:] >= codes[:-1]).all())
            self._last = int(codes[-1])
        self.poses = np.pad(self.poses, (0, len(self.index) - len(self.poses)))
        self.poses += np.bincount(codes, minlength=len(self.poses))
        self.store.append(np.column_stack([codes, output]))
        if behind is None and scatter is None and self.extras is None:
            return
        if self.extras is None:
            self.extras = RowStore(7)
            self.extras.append(np.full((before, 7), np.nan))
        rows = np.empty((len(codes), 7))
        for part, values in zip(EXTRAS, (behind, scatter, cross), strict=True):
            rows[:, part] = np.nan if values is None else values
        self.extras.append(rows)


def notes_of(table: InputTable, columns: Columns) -> tuple[str, ...]:
    """Return what there is to say of a table and its columns."""
    return (*table.notes, *columns.notes, *(() if columns.temperature is None else (COLD,)))


def _only(table: InputTable, columns: Columns, rows: RowBlock, name: str) -> list[str]:
    """Return the name of a file's sensor for each row; more than one label in its sensor column is refused."""
    if columns.sensor is not None and len(set(rows.texts[0])) > 1:
        shown = (table.names or ())[columns.sensor]
        raise DataError(
            f'{table.name}: column "{shown}" labels several sensors where one file per sensor was expected; '
            f'state --sensor-column "{shown}" to read every file that way'
        )
    return [name] * len(rows.numbers)


@dataclass(frozen=True)
class _Labels:
    """The names of poses by their labels."""

    names: dict[int, str]

    def __call__(self, pose: int) -> str:
        return f'position "{self.names[pose]}"'

    def only(self, poses: Sequence[int]) -> _Labels:
        """Return those of some poses."""
        return _Labels({pose: self.names[pose] for pose in poses})
