"""Static readings of many sensors, from one table with a column that labels the sensor, or from one file per sensor.

`read_fleet` gathers the rows into stores that may be on disk; `FleetReadings.batches` yields the sensors in batches of
about equally many poses, as arrays that fit the caches of the processor.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import compress
from pathlib import Path
from typing import BinaryIO

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.columns import Columns, choose, own_sensor_column, restrict, sensor_column
from accelcal_cli.io.reader import PLAIN, InputTable, ReadOptions, open_table
from accelcal_cli.io.readings import InputForm, LabelledMeans, Readings, number_labels
from accelcal_cli.io.rows import RowBlock, ZeroRows, add_stretches, places, zero_rows
from accelcal_cli.io.screening import LOOKED_AT, ROW_WIDE, UNEQUAL, Screened, needs_look
from accelcal_cli.io.stream import RowStore, Source
from accelcal_cli.notices import Notice

SLAB = 2_000_000
"""Poses that are in memory at once, unless one sensor has more."""

BATCH = 32_768
"""Poses of a batch at most, unless one sensor has more: arrays that a third-level cache holds, and so many sensors that
the interpreter is a small part."""

STRETCH = 1.25
"""No sensor of a batch has more than so many times the poses of another."""

MOST_POSES = 20_000_000
"""Poses with a label of their own in one table, at most."""

COLD = "Temperature column not used; --temperature fits slopes with it, sensor by sensor."


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


EXTRAS: tuple[int | slice, ...] = (0, slice(1, 4), slice(4, 7), slice(7, 10), 10)
"""Where the store of what is known beside the output has the readings behind a pose, their standard deviations, their
covariances, the known specific force and the temperature."""

WIDTH = 11
"""Columns of that store."""


@dataclass(frozen=True, eq=False)
class Batch:
    """The poses of R sensors as arrays of one length J; a sensor with fewer repeats its last pose.

    Attributes:
        sensors: their numbers, shape (R,); count: poses of each, shape (R,).
        output: shape (R, J, 3), sensor units; pose: number of each pose among all, shape (R, J).
        behind: raw readings behind each pose, shape (R, J), NaN where not known; None where no table has them.
        scatter: standard deviation of one of them, shape (R, J, 3), sensor units, likewise; cross: covariances xy, xz
            and yz of one, shape (R, J, 3), sensor units squared, likewise.
        reference: known specific force, shape (R, J, 3), and temperature, shape (R, J), likewise.
    """

    sensors: Int
    count: Int
    output: Float
    pose: Int
    behind: Float | None = None
    scatter: Float | None = None
    cross: Float | None = None
    reference: Float | None = None
    temperature: Float | None = None


@dataclass(frozen=True, eq=False)
class FleetReadings:
    """Static readings of R sensors.

    Attributes:
        source: the file, or how many.
        sensors: their labels, in the order in which they came; poses: J of each, shape (R,).
        origins: the tables, in their order.
        zeros: rows that were zero in all axes and were left out, by number of the sensor: how many, and which.
    """

    source: str
    sensors: tuple[str, ...]
    poses: Int
    origins: tuple[TableOrigin, ...]
    _store: RowStore = field(repr=False)  # number of the sensor, output
    _extras: RowStore | None = field(repr=False)  # readings behind the pose, their standard deviation
    zeros: dict[int, tuple[int, str]] = field(default_factory=dict)

    @property
    def warm(self) -> bool:
        """Whether a table has temperatures."""
        return self._extras is not None and any(
            not np.isnan(block[:, EXTRAS[-1]]).all() for _, block in self._extras.blocks()
        )

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

    def one(self, batch: Batch, at: int, *, screened: bool = True) -> Readings:
        """Return the readings of the sensor at `at` in a batch, as `calibrate` takes them; those that are not doubtful
        need not be screened."""
        count, poses = int(batch.count[at]), batch.pose[at]
        origin, name = self.origin(int(poses[0])), self.sensors[batch.sensors[at]]
        return Readings.from_array(
            batch.output[at, :count],
            source=f'{origin.name}, sensor "{name}"',
            count=_known(batch.behind, at, count),
            scatter=_known(batch.scatter, at, count),
            cross=_known(batch.cross, at, count),
            reference=_known(batch.reference, at, count),
            temperature=_known(batch.temperature, at, count),
            warnings=self.warnings(batch, at) if screened else (),
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
            warm=_known(batch.temperature, at, first) is not None,
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

    def _slab(self, first: int, last: int) -> Iterator[Batch]:
        """Yield the sensors from `first` to `last` - 1."""
        rows, pose = self._select(first, last)
        extras = None if self._extras is None else _gather(self._extras, pose)
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
                first + index, count, output, pose[at], *_parts(None if extras is None else extras[at])
            )

    def _select(self, first: int, last: int) -> tuple[Float, Int]:
        """Return the rows of the sensors from `first` to `last` - 1 and the numbers of their poses."""
        if last - first == len(self.poses):
            return self._store.all(), np.arange(self._store.rows)
        rows, numbers = [], []
        for start, block in self._store.blocks():
            chosen = np.flatnonzero((block[:, 0] >= first) & (block[:, 0] < last))
            rows.append(block[chosen])
            numbers.append(start + chosen)
        return np.concatenate(rows), np.concatenate(numbers)


def _gather(store: RowStore, numbers: Int) -> Float:
    """Return the rows of these numbers, which ascend."""
    if len(numbers) == store.rows:
        return store.all()
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


def _parts(extras: Float | None) -> Iterator[Float | None]:
    """Yield what is known of poses beside the output, by `EXTRAS`; None for what is known of none."""
    for part in EXTRAS:
        values = None if extras is None else extras[..., part]
        yield None if values is None or np.isnan(values).all() else values


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
    collector = _FleetCollector()
    for source, name in zip(sources, names, strict=True):
        table = open_table(source, stdin, options=options)
        try:
            restrict(table, options.where)
            collector.read(table, columns, sensor, name, options.count)
        finally:
            table.close()
    label = collector.origins[0].name if len(sources) == 1 else f"{len(sources)} files"
    if not each and collector.store.rows == len(collector.index) > 1:
        raise DataError(
            f"{label}: every row has another sensor; expected several poses of each (--sensor-column says which "
            "column labels the sensor)"
        )
    sensors, origins = tuple(collector.index), tuple(collector.origins)
    zeros = collector.zeros
    return FleetReadings(label, sensors, collector.poses, origins, collector.store, collector.extras, zeros)


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


@dataclass(eq=False)
class _FleetCollector:
    """Gathers the rows of tables into poses of sensors."""

    index: dict[str, int] = field(default_factory=dict)
    poses: Int = field(default_factory=lambda: np.zeros(0, dtype=np.intp))
    store: RowStore = field(default_factory=lambda: RowStore(4))
    extras: RowStore | None = None
    origins: list[TableOrigin] = field(default_factory=list)
    zeros: dict[int, tuple[int, str]] = field(default_factory=dict)

    def read(
        self,
        table: InputTable,
        wanted: Sequence[str] | None,
        sensor: str | None,
        name: str | None,
        counts: str | None = None,
    ) -> None:
        """Read one table: of the sensor `name`, or of many."""
        first = self.store.rows
        column = sensor_column(table, sensor) if name is None else own_sensor_column(table)
        columns = choose(table, wanted, column, counts)
        if column in columns.output:
            shown = columns.names[columns.output.index(column)]
            raise UsageError(f'--sensor-column: column "{shown}" of {table.name} is a reading, not a label')
        means = _means_of(table.name, columns)
        zeros, idle, rows_read = ZeroRows(), dict[int, list[int]](), 0
        for rows in table.blocks(columns.selection()):
            if not len(rows.numbers):
                continue
            rows_read += len(rows.numbers)
            columns.check(table, rows)
            labels = rows.texts[0] if name is None else _only(table, columns, rows, name)
            codes = number_labels(self.index, labels)
            numbers, label = rows.numbers, rows.texts[columns.sensor is not None] if means is not None else ()
            keep = None if columns.reference is not None else zeros.keep(numbers[:, :3], rows.start)
            if keep is not None:
                _set_aside(idle, codes, keep, rows.start)
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
        place = _past_zeros(table.where, zeros) if zeros.count else table.where
        self.origins.append(
            TableOrigin(
                table.name,
                table.sha256,
                columns.names,
                first,
                place if means is None else _by_label([label for _, label in means.index]),
                (*table.notes, *columns.notes),
                InputForm(table.source_format, rows_read, table.rows_skipped, None, columns.unit),
                rows=means is None,
                timed=columns.time is not None,
            )
        )

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


def _set_aside(idle: dict[int, list[int]], codes: Int, keep: Bool, start: int) -> None:
    """Add the rows that are not kept, from `start` on, to those of their sensors, by its number."""
    for row in np.flatnonzero(~keep).tolist():
        idle.setdefault(int(codes[row]), []).append(start + row)


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


def _past_zeros(where: Callable[[int], str], zeros: ZeroRows) -> Callable[[int], str]:
    return lambda pose: where(zeros.rows.line(pose))


def _by_label(labels: list[str]) -> Callable[[int], str]:
    return lambda pose: f'position "{labels[pose]}"'
