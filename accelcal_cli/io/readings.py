"""Static readings of an accelerometer: read from any table, one row a pose.

Rows of a table gathered into poses: one a row, or one a label.

Repeated readings of a labelled pose, averaged as they stream by.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Generic, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import Columns, choose
from accelcal_cli.io.reader import Table, open_table
from accelcal_cli.io.screening import LOOKED_AT, doubts, log_cautions
from accelcal_cli.io.stream import IN_MEMORY, RowStore
from accelcal_cli.io.text import LIMIT, Rows


@dataclass(frozen=True, eq=False)
class Readings:
    """Static readings of one sensor, one row a pose; rows with one label are averaged."""

    source: str  # path as given, "<stdin>" or "<array>"
    sha256: str  # of the input bytes
    columns: tuple[str, str, str]  # names (or numbers) of the output columns
    poses: int  # J
    lower: Float  # (3,) least output of each axis, sensor units
    upper: Float  # (3,) greatest output of each axis, sensor units
    labels: tuple[str, ...] | None = None
    count: Float | None = None  # (J,) raw readings behind each pose
    scatter: Float | None = None  # (J, 3) standard deviation of one raw reading, sensor units, nan if unknown
    reference: Float | None = None  # (J, 3) known specific force, m/s^2 or g as given
    temperature: Float | None = None  # (J,) as given, nan where missing
    notes: tuple[str, ...] = ()  # what the reader did that a user should know
    cautions: tuple[str, ...] = ()  # why the readings may not be what they are taken for
    _store: RowStore = field(default_factory=RowStore, repr=False)
    _line: Callable[[int], str] | None = field(default=None, repr=False)

    def blocks(self, rows: int = 65536) -> Iterator[tuple[int, Float]]:
        """Yield (first pose, output (B, 3) in sensor units), in constant memory, as often as asked."""
        return self._store.blocks(rows)

    def output(self) -> Float:
        """Return the output of every pose, (J, 3), sensor units."""
        return self._store.all()

    def where(self, pose: int) -> str:
        """How to name a pose (from 0) to the user: ``position "up"``, ``line 8`` or ``pose 8``."""
        if self.labels is not None:
            return f'position "{self.labels[pose]}"'
        return f"pose {pose + 1}" if self._line is None else self._line(pose)

    @classmethod
    def from_array(
        cls,
        output: ArrayLike,
        *,
        source: str = "<array>",
        labels: Sequence[str] | None = None,
        count: ArrayLike | None = None,
        scatter: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
    ) -> Self:
        """Take readings from memory: output (J, 3) in sensor units, the rest as in the fields."""
        rows = _shaped("output", output, 3)
        poses = len(rows)
        names = None if labels is None else _distinct(labels, poses)
        collector = Collector(source, Columns((0, 1, 2), ("1", "2", "3")))
        collector.add(Rows(0, rows))
        collector.finish()
        extras = Extras(
            names,
            None if count is None else _counts(_shaped("count", count, 1, poses)[:, 0]),
            None if scatter is None else _shaped("scatter", scatter, 3, poses, gaps=True),
            None if reference is None else _shaped("reference", reference, 3, poses),
            None if temperature is None else _shaped("temperature", temperature, 1, poses, gaps=True)[:, 0],
        )
        return cls._of(collector, extras, hashlib.sha256(rows.astype("<f8").tobytes()).hexdigest(), None)

    def with_output(self, output: Float) -> Self:
        """Return the same poses with other outputs, shape (J, 3)."""
        store = RowStore()
        store.append(output)
        return replace(self, lower=output.min(axis=0), upper=output.max(axis=0), _store=store)

    def known_as(
        self,
        sha256: str,
        columns: tuple[str, str, str],
        notes: Sequence[str],
        where: Callable[[int], str],
        cautions: tuple[str, ...] | None = None,
    ) -> Self:
        """Return the same poses with the origin of the input that they were taken from, and its cautions if stated."""
        own = self.cautions if cautions is None else cautions
        return replace(self, sha256=sha256, columns=columns, notes=tuple(notes), cautions=own, _line=where)

    @classmethod
    def _of(
        cls, collector: Collector, extras: Extras, sha256: str, line: Callable[[int], str] | None
    ) -> Self:
        extent = collector.extent
        return cls(
            source=collector.source,
            sha256=sha256,
            columns=collector.columns.names,
            poses=collector.store.rows,
            lower=extent.lower,
            upper=extent.upper,
            labels=extras.labels,
            count=extras.count,
            scatter=extras.scatter,
            reference=extras.reference,
            temperature=extras.temperature,
            notes=tuple(collector.notes),
            cautions=tuple(collector.cautions),
            _store=collector.store,
            _line=line,
        )


def read_readings(
    source: str | Path, columns: Sequence[str] | None = None, *, stdin: BinaryIO | None = None
) -> Readings:
    """Read static readings from a text table or a Parquet file; ``-`` is standard input.

    `columns` names the three output columns, or numbers them from 1; without it their names decide.
    Rows that share a position label are averaged. Every fault of the input is a DataError that says where,
    every fault of `columns` a UsageError.
    """
    table = open_table(source, stdin)
    try:
        collector = Collector(table.name, choose(table, columns))
        for rows in table.blocks(collector.columns.selection()):
            check_rows(table, collector.columns, rows)
            collector.add(rows)
        extras = collector.finish()
        return Readings._of(collector, extras, table.sha256, table.where)
    finally:
        table.close()


def check_rows(table: Table, columns: Columns, rows: Rows) -> None:
    """Refuse counts that are no counts and standard deviations below zero."""
    at = 3
    if columns.count is not None:
        count = rows.numbers[:, at]
        _refuse(table, rows, (count < 1) | (count != np.round(count)), columns.count, "count of 1 or more")
        at += 1
    for column in columns.scatter or ():
        _refuse(table, rows, rows.numbers[:, at] < 0, column, "standard deviation of 0 or more")
        at += 1


def _refuse(table: Table, rows: Rows, bad: NDArray[np.bool_], column: int, expected: str) -> None:
    if bad.any():
        where = table.where(rows.start + int(np.argmax(bad)))
        raise DataError(
            f'{table.name}, {where}, column "{(table.names or ())[column]}": a {expected} was expected'
        )


def _distinct(labels: Sequence[str], poses: int) -> tuple[str, ...]:
    names = tuple(str(label) for label in labels)
    if len(names) != poses or len(set(names)) != poses:
        raise DataError(f"labels: {poses} different labels were expected, one a pose")
    return names


def _counts(count: Float) -> Float:
    if ((count < 1) | (count != np.round(count))).any():
        raise DataError("count: whole numbers of 1 or more were expected")
    return count


def _shaped(
    what: str, values: ArrayLike, width: int, rows: int | None = None, *, gaps: bool = False
) -> Float:
    """Copy of an array, checked: (rows, width), or (rows,) where width is 1, finite, of sane size."""
    array = np.array(values, dtype=np.float64)
    shaped = array.reshape(-1, 1) if width == 1 and array.ndim == 1 else array
    if shaped.ndim != 2 or shaped.shape[1] != width or (rows is not None and len(shaped) != rows):
        wanted = f"({'J' if rows is None else rows}, {width})" if width > 1 else f"({rows},)"
        raise DataError(f"{what}: an array of shape {wanted} was expected, not {array.shape}")
    sound = np.abs(shaped) <= LIMIT
    if not (sound | (np.isnan(shaped) & gaps)).all():
        raise DataError(f"{what}: row {int(np.argmin(sound.all(axis=1)))} is not finite or too large")
    return shaped


STUCK = 1_000_000  # equal readings in a row after which an input is not read on


@dataclass
class Extent:
    """Least and greatest output of each axis (3,), sensor units, of the rows so far."""

    rows: int = 0
    lower: Float = field(default_factory=lambda: np.full(3, np.inf))
    upper: Float = field(default_factory=lambda: np.full(3, -np.inf))

    def add(self, output: Float) -> None:
        """Add rows (B, 3)."""
        self.rows += len(output)
        self.lower = np.minimum(self.lower, [axis.min() for axis in output.T])
        self.upper = np.maximum(self.upper, [axis.max() for axis in output.T])

    @property
    def stuck(self) -> bool:
        """Whether every row was the same."""
        return bool((self.lower == self.upper).all())


@dataclass(frozen=True, eq=False)
class Extras:
    """What is known of each pose beside its output; see `Readings` for shapes and units."""

    labels: tuple[str, ...] | None = None
    count: Float | None = None
    scatter: Float | None = None
    reference: Float | None = None
    temperature: Float | None = None


class Collector:
    """Gathers blocks of rows; `finish` gives the poses."""

    def __init__(self, source: str, columns: Columns) -> None:
        """Expect rows as `columns.selection()` asks for them."""
        self.source = source
        self.columns = columns
        self.notes, self.cautions = list(columns.notes), list[str]()
        self.store = RowStore()
        self.extent = Extent()
        self._means = None if columns.label is None else LabelledMeans[str](source, 3 + _others(columns))
        self._extras: list[Float] | None = [] if columns.extras else None

    def add(self, rows: Rows) -> None:
        """Take in one block."""
        if not len(rows.numbers):
            return
        output = rows.numbers[:, :3]
        self.extent.add(output)
        if self.extent.stuck and self.extent.rows >= STUCK:
            raise DataError(
                f"{self.source}: the first {self.extent.rows:,} readings are all equal, {self._value()}"
            )
        if self._means is None:
            self.store.append(output)
            self._keep_extras(rows.numbers[:, 3:])
        else:
            weight, spread, others = self._split(rows.numbers[:, 3:])
            self._means.add(rows.texts[0], np.hstack([output, others]), weight, spread)

    def finish(self) -> Extras:
        """Check the poses and return what came with them; `store` and `extent` then speak of poses."""
        extras = self._by_row() if self._means is None else self._by_label(self._means)
        if self.store.rows < 2:
            raise DataError(
                f"{self.source}: holds {self._few()}; turn the sensor between readings, best to twelve poses or more"
            )
        if self.extent.stuck:
            raise DataError(
                f"{self.source}: all {self.store.rows:,} readings are equal, {self._value()}; "
                "the sensor has to be turned between them"
            )
        _, first = next(iter(self.store.blocks(LOOKED_AT)))
        self.cautions += doubts(first, self.columns.names)
        return extras

    def _few(self) -> str:
        if not self.store.rows:
            return "no readings"
        if self._means is None or self.columns.label is None:
            return "only one pose"
        rows, column = int(self._means.rows.sum()), self.columns.label + 1
        return f"only one pose, for column {column} gives all {rows:,} rows the same label"

    def _value(self) -> str:
        return "(" + ", ".join(f"{value:g}" for value in self.extent.lower) + ")"

    def _split(self, extras: Float) -> tuple[Float | None, Float | None, Float]:
        """Part the extra columns (B, k) into count (B,), scatter (B, 3) and the others (B, m)."""
        at = 0 if self.columns.count is None else 1
        then = at + (0 if self.columns.scatter is None else 3)
        count = extras[:, 0] if at else None
        return count, extras[:, at:then] if then > at else None, extras[:, then:]

    def _keep_extras(self, extras: Float) -> None:
        if self._extras is None:
            return
        self._extras.append(extras.copy())
        if self.store.rows > IN_MEMORY:
            self._extras = None
            self.notes.append(f"columns beside the readings not used: more than {IN_MEMORY:,} poses")

    def _by_row(self) -> Extras:
        _, first = next(iter(self.store.blocks(LOOKED_AT)), (0, np.zeros((0, 3))))
        span = float((self.extent.upper - self.extent.lower).max())
        self.cautions += log_cautions(self.store.rows, first, span, timed=self.columns.time is not None)
        if not self._extras:
            return Extras()
        count, scatter, others = self._split(np.concatenate(self._extras))
        return Extras(None, count, scatter, *self._others(others))

    def _by_label(self, means: LabelledMeans[str]) -> Extras:
        if len(means.rows):
            self.extent = Extent()
            self.extent.add(means.mean[:, :3])
            self.store.append(means.mean[:, :3])
        if means.repeated:
            rows = int(means.rows.sum())
            self.notes.append(f"{rows:,} rows averaged into {len(means.rows):,} positions by label")
        reference, temperature = self._others(means.mean[:, 3:])
        return Extras(tuple(means.index), means.count(), means.scatter(), reference, temperature)

    def _others(self, others: Float) -> tuple[Float | None, Float | None]:
        """Part the other columns (J, m) into reference (J, 3) and temperature (J,)."""
        reference = None if self.columns.reference is None else others[:, :3]
        temperature = None if self.columns.temperature is None else others[:, -1]
        return reference, temperature


def _others(columns: Columns) -> int:
    """Number of extra columns that are plain quantities, averaged as the output is."""
    return (3 if columns.reference else 0) + (columns.temperature is not None)


MOST_LABELS = 1_000_000
Label = TypeVar("Label", bound=Hashable)


class LabelledMeans(Generic[Label]):
    """Weighted mean and scatter of the rows of each label (Welford's update, a block at a time).

    A row may itself be a mean of `weight` raw readings with standard deviation `spread`; its raw readings
    then count as if they had been rows. Memory grows with the labels, never with the rows.
    """

    def __init__(self, source: str, width: int, most: int | None = None) -> None:
        """Average rows of `width` numbers; the first three are the sensor output."""
        self.source = source
        self.most = MOST_LABELS if most is None else most
        self.index: dict[Label, int] = {}
        self.rows = np.zeros(0)  # (J,) table rows of each label
        self.weight = np.zeros(0)  # (J,) raw readings of each label
        self.mean = np.zeros((0, width))  # (J, width)
        self.square = np.zeros((0, 3))  # (J, 3) weighted sum of squares about the mean
        self.spread = np.zeros((0, 3))  # (J, 3) spread stated by the label's last row
        self.weighted = False
        self.spreads = False

    def add(
        self,
        labels: Sequence[Label],
        rows: Float,
        weight: Float | None = None,
        spread: Float | None = None,
    ) -> None:
        """Add rows (B, width), with weights (B,) and standard deviations (B, 3) in sensor units if known."""
        index = self.index
        codes = np.fromiter((index.setdefault(label, len(index)) for label in labels), np.intp, len(labels))
        self._grow(len(index))
        self.weighted, self.spreads = weight is not None, spread is not None
        weight = np.ones(len(rows)) if weight is None else weight
        self.rows += np.bincount(codes, minlength=len(index))
        self._merge(codes, rows, weight)
        if spread is not None:
            self.spread[codes] = spread
            inner = np.where(weight[:, None] > 1, spread**2 * (weight[:, None] - 1), 0.0)
            np.add.at(self.square, codes, inner)

    def _merge(self, codes: NDArray[np.intp], rows: Float, weight: Float) -> None:
        origin = rows[0]  # sums of differences keep the digits that a large offset would eat
        shifted = rows - origin
        fresh = _sums(codes, weight, len(self.weight))
        seen = fresh > 0
        total = self.weight + fresh
        share = np.divide(fresh, total, out=np.zeros_like(total), where=seen)
        for k in range(rows.shape[1]):
            mean = np.divide(
                _sums(codes, weight * shifted[:, k], len(fresh)), fresh, out=np.zeros_like(fresh), where=seen
            )
            step = np.where(seen, origin[k] + mean - self.mean[:, k], 0.0)
            if k < 3:
                inner = _sums(codes, weight * (shifted[:, k] - mean[codes]) ** 2, len(fresh))
                self.square[:, k] += inner + step**2 * self.weight * share
            self.mean[:, k] += step * share
        self.weight = total

    def _grow(self, size: int) -> None:
        if size > self.most:
            raise DataError(f"{self.source}: more than {self.most:,} different position labels")
        more = size - len(self.rows)
        if more:
            self.rows, self.weight = (np.append(old, np.zeros(more)) for old in (self.rows, self.weight))
            self.mean, self.square, self.spread = (
                np.vstack([old, np.zeros((more, old.shape[1]))])
                for old in (self.mean, self.square, self.spread)
            )

    @property
    def repeated(self) -> bool:
        """Whether any label came more than once."""
        return bool((self.rows > 1).any())

    def count(self) -> Float | None:
        """Raw readings of each label (J,); None where rows are single or means of an unknown number."""
        return self.weight if self.weighted or (self.repeated and not self.spreads) else None

    def scatter(self) -> Float | None:
        """Standard deviation of a single raw reading (J, 3) in sensor units; nan where nothing tells it."""
        if not (self.spreads or self.repeated):
            return None
        freedom = (self.weight if self.spreads else self.rows)[:, None] - 1
        single = np.full_like(self.spread, np.nan) if not self.spreads else self.spread
        pooled = np.sqrt(np.divide(self.square, freedom, out=np.zeros_like(self.square), where=freedom > 0))
        return np.where(self.rows[:, None] > 1, pooled, single)


def _sums(codes: NDArray[np.intp], values: Float, size: int) -> Float:
    return np.bincount(codes, weights=values, minlength=size).astype(np.float64, copy=False)
