"""Static readings of many sensors, and the batches that they are calibrated in.

`FleetReadings.parts` cuts a fleet into parts that other processes can take; `FleetReadings.batches` yields the sensors
in batches of about equally many poses, as arrays that fit the caches of the processor.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.io.readings import InputForm, Readings
from accelcal_cli.io.rows import zero_rows
from accelcal_cli.io.screening import LOOKED_AT, ROW_WIDE, UNEQUAL, Screened, needs_look
from accelcal_cli.io.stream import RowStore
from accelcal_cli.notices import Notice

SLAB = 2_000_000
"""Poses that are in memory at once, unless one sensor has more."""

PART = 49_152
"""Poses of a part of a fleet, up to the end of a sensor: what a worker gets, and what is kept of an interrupted run."""

BATCH = 32_768
"""Poses of a batch at most, unless one sensor has more: arrays that a third-level cache holds, and so many sensors that
the interpreter is a small part."""

STRETCH = 1.25
"""No sensor of a batch has more than so many times the poses of another."""


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
        store, more = RowStore(4), None if extras is None else RowStore(WIDTH)
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
                first + index, count, output, pose[at], *_parts(None if extras is None else extras[at])
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
    if not isinstance(origin.where, PoseLabels):
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


def _parts(extras: Float | None) -> Iterator[Float | None]:
    """Yield what is known of poses beside the output, by `EXTRAS`; None for what is known of none."""
    for part in EXTRAS:
        values = None if extras is None else extras[..., part]
        yield None if values is None or np.isnan(values).all() else values


def _known(extra: Float | None, at: int, count: int) -> Float | None:
    """Return what is known of one sensor's poses; None where nothing is."""
    known = None if extra is None else extra[at, :count]
    return None if known is None or np.isnan(known).all() else known


@dataclass(frozen=True)
class PoseLabels:
    """The names of poses by their labels."""

    names: dict[int, str]

    def __call__(self, pose: int) -> str:
        """Return how to name a pose."""
        return f'position "{self.names[pose]}"'

    def only(self, poses: Sequence[int]) -> PoseLabels:
        """Return those of some poses."""
        return PoseLabels({pose: self.names[pose] for pose in poses})
