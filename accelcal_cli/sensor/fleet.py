"""Static readings of many sensors, handed out in batches whose arrays a computer likes."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from accelcal_cli.sensor.doubts import LOOKED_AT, doubts, log_cautions
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.sensor.spool import RowStore
from accelcal_cli.streams import Bool, Float, Int

SLAB = 2_000_000
"""Poses that are in memory at once, unless one sensor has more."""

BATCH = 16_384
"""Poses of a batch at most, unless one sensor has more: few enough for the processor's caches."""

STRETCH = 1.25
"""No sensor of a batch has more than so many times the poses of another."""


@dataclass(frozen=True)
class Origin:
    """A table that was read.

    Attributes:
        name: as given; sha256: of its bytes; columns: names of its output columns.
        first: number of its first pose among those of all tables.
        where: how to name one of its poses, counted from 0.
        notes: what the reader did that a user should know.
        rows: whether each row is taken for a pose, not each label; timed: whether they have times.
    """

    name: str
    sha256: str
    columns: tuple[str, str, str]
    first: int
    where: Callable[[int], str]
    notes: tuple[str, ...]
    rows: bool
    timed: bool


@dataclass(frozen=True, eq=False)
class Batch:
    """The poses of R sensors as arrays of one length J; a sensor with fewer repeats its last pose.

    Attributes:
        sensors: their numbers, shape (R,); count: poses of each, shape (R,).
        output: shape (R, J, 3), sensor units; pose: number of each pose among all, shape (R, J).
        behind: raw readings behind each pose, shape (R, J), NaN where not known; None where no table tells.
        scatter: standard deviation of one of them, shape (R, J, 3), sensor units, likewise.
    """

    sensors: Int
    count: Int
    output: Float
    pose: Int
    behind: Float | None = None
    scatter: Float | None = None

    @property
    def real(self) -> Bool:
        """Which poses are no repetitions, shape (R, J)."""
        return np.asarray(np.arange(self.output.shape[1]) < self.count[:, None])

    def take(self, index: Int) -> Batch:
        """Return the sensors at `index`."""
        behind = None if self.behind is None else self.behind[index]
        scatter = None if self.scatter is None else self.scatter[index]
        return Batch(
            self.sensors[index], self.count[index], self.output[index], self.pose[index], behind, scatter
        )


@dataclass(frozen=True, eq=False)
class FleetReadings:
    """Static readings of R sensors.

    Attributes:
        source: the file, or how many.
        sensors: their labels, in the order in which they came; poses: J of each, shape (R,).
        origins: the tables, in their order.
    """

    source: str
    sensors: tuple[str, ...]
    poses: Int
    origins: tuple[Origin, ...]
    _store: RowStore = field(repr=False)  # number of the sensor, output
    _extras: RowStore | None = field(repr=False)  # readings behind the pose, their standard deviation

    @cached_property
    def _firsts(self) -> list[int]:
        return [origin.first for origin in self.origins]

    def origin(self, pose: int) -> Origin:
        """Return the table that a pose came from, by its number among all."""
        return self.origins[bisect.bisect_right(self._firsts, pose) - 1]

    def where(self, pose: int) -> str:
        """Return how to name a pose, by its number among all: ``line 8``."""
        origin = self.origin(pose)
        return origin.where(pose - origin.first)

    def one(self, batch: Batch, at: int) -> Readings:
        """Return the readings of the sensor at `at` in a batch, as `calibrate` takes them."""
        count, poses = int(batch.count[at]), batch.pose[at]
        origin, name = self.origin(int(poses[0])), self.sensors[batch.sensors[at]]
        readings = Readings.from_array(
            batch.output[at, :count],
            source=f'{origin.name}, sensor "{name}"',
            count=_known(batch.behind, at, count),
            scatter=_known(batch.scatter, at, count),
        )
        return readings.known_as(
            origin.sha256,
            origin.columns,
            origin.notes,
            lambda pose: self.where(int(poses[pose])),
            self.cautions(batch, at),
        )

    def cautions(self, batch: Batch, at: int) -> tuple[str, ...]:
        """Return why the readings of the sensor at `at` in a batch may be no poses, in sentences."""
        origin, output = self.origin(int(batch.pose[at, 0])), batch.output[at, : batch.count[at]]
        first = output[:LOOKED_AT]
        log: tuple[str, ...] = ()
        if origin.rows:
            span = float(np.ptp(output, axis=0).max())
            log = log_cautions(len(output), first, span, timed=origin.timed)
        return (*log, *doubts(first, origin.columns))

    def batches(self) -> Iterator[Batch]:
        """Yield every sensor once, in batches of about equally many poses."""
        ends = np.cumsum(self.poses)
        first = 0
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
            yield Batch(
                first + index,
                counts[index],
                rows[at, 1:],
                pose[at],
                None if extras is None else extras[at, 0],
                None if extras is None else extras[at, 1:],
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
    parts = []
    for start, block in store.blocks():
        low, high = np.searchsorted(numbers, (start, start + len(block)))
        parts.append(block[numbers[low:high] - start])
    return np.concatenate(parts)


def _groups(counts: Int) -> Iterator[slice]:
    """Yield runs of sensors, sorted by their counts, that make a batch."""
    first = 0
    while first < len(counts):
        longest = int(STRETCH * counts[first])
        last = int(np.searchsorted(counts, longest, side="right"))
        last = min(last, first + max(1, BATCH // longest))
        yield slice(first, last)
        first = last


def _known(extra: Float | None, at: int, count: int) -> Float | None:
    """Return what is known of one sensor's poses; None where nothing is."""
    found = None if extra is None else extra[at, :count]
    return None if found is None or np.isnan(found).all() else found
