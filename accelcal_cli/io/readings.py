"""Static readings of an accelerometer, one row per pose, and the way there from a table or an array.

`read_readings` gathers the rows of a table into poses: one per row, or one per label, averaged as the rows stream by
(`LabelledMeans`). The outputs stay in a store that may be on disk; a calibration takes them in blocks. Before anything
is fitted, they are screened (screening.py).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import field, replace
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Generic, Protocol, Self, TypeVar, cast

import numpy as np
from numpy.typing import ArrayLike

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import Columns, are_no_counts, choose, restrict
from accelcal_cli.io.reader import LIMIT, PLAIN, ReadOptions, open_table
from accelcal_cli.io.rows import DeadColumns, OneSensor, RowBlock, ZeroRows
from accelcal_cli.io.screening import LOOKED_AT, Behind, Screened
from accelcal_cli.io.stream import IN_MEMORY, Frame, RowStore, is_frame
from accelcal_cli.notices import Notice
from accelcal_cli.schema import frozen

if TYPE_CHECKING:
    from accelcal_cli.sensor.vehicle import VehicleCorrection

HEAD = 1024
"""Rows of labelled poses that are kept to see in what steps the readings come."""

STUCK = 1_000_000
"""Equal readings in a row after which an input is not read on."""

MOST_LABELS = 1_000_000
"""Different labels of poses at most: their means are kept in memory."""

Label = TypeVar("Label", bound=Hashable)


@frozen()
class InputForm:
    """How an input is written.

    Attributes:
        source_format: ``csv``, ``parquet``, ``array``, ...
        rows: read, without those skipped; rows_skipped: broken ones left out.
        rate_hz: rows per second of a log, None where it is unknown.
        unit: of the readings as the file states it: g, mg, m/s^2 or counts; None where it does not.
        correction: what a vehicle had done to the readings that it logged; None where it is no log of a vehicle.
    """

    source_format: str = "array"
    rows: int = 0
    rows_skipped: int = 0
    rate_hz: float | None = None
    unit: str | None = None
    correction: VehicleCorrection | None = None


@frozen(eq=False)
class Readings:
    """Static readings of one sensor, one row per pose; rows with one label are averaged.

    Attributes:
        source: path as given, "<stdin>" or "<array>"; sha256: of the input bytes.
        columns: names (or numbers) of the output columns.
        poses: J; lower, upper: least and greatest output of each axis, shape (3,), sensor units.
        labels: of the poses; None where each row is a pose.
        count: raw readings behind each pose, shape (J,).
        scatter: standard deviation of one raw reading, shape (J, 3), sensor units, NaN if unknown.
        cross: covariances xy, xz and yz of one raw reading, shape (J, 3), sensor units squared, NaN if unknown.
        reference: known specific force, shape (J, 3), m/s^2 or g as given.
        temperature: shape (J,), as given, NaN where missing.
        notes: what the reader did that a user should know.
        warnings: why the readings may not be what they are taken for.
        form: how the input is written.
        in_time: whether the poses follow each other in time, so that neighbours may share errors.
    """

    source: str
    sha256: str
    columns: tuple[str, str, str]
    poses: int
    lower: Float
    upper: Float
    labels: tuple[str, ...] | None = None
    count: Float | None = None
    scatter: Float | None = None
    cross: Float | None = None
    reference: Float | None = None
    temperature: Float | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = ()
    form: InputForm = InputForm()
    in_time: bool = False
    _store: RowStore = field(default_factory=RowStore, repr=False)
    _line: Callable[[int], str] | None = field(default=None, repr=False)

    def blocks(self, rows: int = 65536) -> Iterator[tuple[int, Float]]:
        """Yield (first pose, output (B, 3) in sensor units), in constant memory, as often as asked."""
        yield from self._store.blocks(rows)

    def output(self) -> Float:
        """Return the output of every pose, (J, 3), sensor units."""
        return self._store.all()

    def where(self, pose: int) -> str:
        """Return how to name a pose (from 0) to the user: ``position "up"``, ``line 8`` or ``pose 8``."""
        if self.labels is not None:
            return f'position "{self.labels[pose]}"'
        return f"pose {pose + 1}" if self._line is None else self._line(pose)

    @staticmethod
    def from_array(
        output: ArrayLike,
        *,
        source: str = "<array>",
        labels: Sequence[str] | None = None,
        count: ArrayLike | None = None,
        scatter: ArrayLike | None = None,
        cross: ArrayLike | None = None,
        reference: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
        warnings: tuple[Notice, ...] | None = None,
    ) -> Readings:
        """Return readings from memory: output (J, 3) in sensor units, the rest as in the fields.

        They are screened unless `warnings` are stated.

        Raises:
            DataError: an array of another shape, or values that no readings have.
        """
        rows = _array("output", output, 3)
        poses = len(rows)
        if labels is not None and not len(set(map(str, labels))) == len(labels) == poses:
            raise DataError(f"labels: {poses} different labels were expected, one per pose")
        numbers = None if count is None else _array("count", count, 1, poses)[:, 0]
        if numbers is not None and are_no_counts(numbers).any():
            raise DataError("count: whole numbers of 1 or more were expected")
        spread = None if scatter is None else _array("scatter", scatter, 3, poses, gaps=True)
        warm = None if temperature is None else _array("temperature", temperature, 1, poses, gaps=True)[:, 0]
        collector = Collector(source, Columns((0, 1, 2), ("1", "2", "3")), zeros=reference is not None)
        collector.add(RowBlock(0, rows))
        # Rows of zeros may have been left out.
        kept = slice(None) if not collector.zeros.count else rows.any(axis=1)
        numbers = None if numbers is None else numbers[kept]
        spread = None if spread is None else spread[kept]
        sha256 = hashlib.sha256(rows.astype("<f8").tobytes()).hexdigest()
        return replace(
            collector.readings(sha256, known=(numbers, spread), warm=warm is not None, warnings=warnings),
            labels=None if labels is None else tuple(np.array(labels, dtype=str)[kept].tolist()),
            count=numbers,
            scatter=spread,
            cross=None if cross is None else _array("cross", cross, 3, poses, gaps=True)[kept],
            reference=None if reference is None else _array("reference", reference, 3, poses),
            temperature=None if warm is None else warm[kept],
        )

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
        warnings: tuple[Notice, ...] | None = None,
        form: InputForm | None = None,
    ) -> Self:
        """Return the same poses as those of another input, with its warnings and its form if stated."""
        return replace(
            self,
            sha256=sha256,
            columns=columns,
            notes=tuple(notes),
            warnings=self.warnings if warnings is None else warnings,
            form=self.form if form is None else form,
            _line=where,
        )


class HasReadings(Protocol):
    """What holds static readings beside other things: a detection, simulated samples."""

    def readings(self) -> Readings:
        """Return them."""


Data = str | Path | Frame | ArrayLike | Readings | HasReadings
"""What readings are taken from: a file, a frame, an array of shape (J, 3), or what holds them already."""


def read_readings(
    source: Data,
    columns: Sequence[str] | None = None,
    *,
    stdin: BinaryIO | None = None,
    options: ReadOptions = PLAIN,
) -> Readings:
    """Read static readings from a file, a frame or an array.

    Rows that share a position label are averaged.

    Args:
        source: a text table or a Parquet file, ``-`` for standard input; a frame of polars, pandas or Arrow; an array
            of outputs, shape (J, 3), one pose per row; a detection, or readings, which are returned as they are.
        columns: names of the three output columns, or their numbers from 1; without it their names decide.
        stdin: standard input; options: what the user knows of the form of a table, and which rows to read.

    Raises:
        DataError: a fault of the input, with its place, or readings of several sensors.
        UsageError: a fault of `columns` or of the conditions `options.where`.

    Examples:
        >>> import polars
        >>> from accelcal_cli import read_readings, simulate
        >>> simulated = simulate("mems", positions=12)
        >>> read_readings(simulated.output).poses
        12
        >>> table = polars.DataFrame(simulated.output, schema=["ax", "ay", "az"])
        >>> read_readings(table).columns
        ('ax', 'ay', 'az')
    """
    if isinstance(source, Readings):
        return source
    if hasattr(source, "readings"):
        return cast(HasReadings, source).readings()
    if not (isinstance(source, str | Path) or is_frame(source)):
        return Readings.from_array(cast(ArrayLike, source))
    table = open_table(cast(str | Path | Frame, source), stdin, options=options)
    try:
        restrict(table, options.where)
        collector = Collector(table.name, choose(table, columns, count=options.count))
        one = OneSensor(table, collector.columns.identity, fleet=True)
        for rows in table.blocks(collector.columns.selection()):
            collector.columns.check(table, rows)
            one.add(rows)
            collector.add(rows)
        collector.notes[:0] = table.notes
        form = InputForm(
            table.source_format,
            collector.rows,
            table.rows_skipped,
            None,
            collector.columns.unit,
            table.correction,
        )
        return collector.readings(table.sha256, table.where, form)
    finally:
        table.close()


class Collector:
    """Gathers blocks of rows into poses."""

    def __init__(self, source: str, columns: Columns, *, zeros: bool = False) -> None:
        """Expect rows as `columns.selection()` asks for them; with `zeros` those that are all zero are readings."""
        self.source, self.columns = source, columns
        self.zeros = ZeroRows()
        self._all = zeros or columns.reference is not None
        self.notes = list(columns.notes)
        self.store = RowStore()
        self.rows = 0
        self.lower, self.upper = np.full(3, np.inf), np.full(3, -np.inf)
        others = 3 * (columns.reference is not None) + (columns.temperature is not None)
        self._means = None if columns.label is None else LabelledMeans[str](source, 3 + others)
        self._extras: list[Float] | None = [] if columns.extras else None
        self._behind: Behind | None = None

    def add(self, rows: RowBlock) -> None:
        """Add one block."""
        rows = rows if self._all else self.zeros.without(rows)
        if not len(rows.numbers):
            if self.zeros.count >= STUCK and not self.rows:
                raise DataError(
                    f"{self.source}: the first {self.zeros.count:,} readings are all equal, (0, 0, 0)"
                )
            return
        output, extras = rows.numbers[:, :3], rows.numbers[:, 3:]
        self.rows += len(output)
        self._widen(output)
        if self.rows >= STUCK:
            self._refuse_equal(f"the first {self.rows:,} readings are all equal")
        if self._means is not None:
            count, scatter, others = self.columns.split(extras)
            if count is None and scatter is None:
                head = output[:HEAD].copy() if self._behind is None else self._behind.head
                self._behind = Behind(head, self.lower, self.upper)
            self._means.add(rows.texts[0], np.hstack([output, others]), count, scatter)
            return
        self.store.append(output)
        if self._extras is not None:
            self._extras.append(extras.copy())
            if self.store.rows > IN_MEMORY:
                self._extras = None
                self.notes.append(
                    f"columns other than the readings are not used: more than {IN_MEMORY:,} poses"
                )

    def readings(
        self,
        sha256: str,
        where: Callable[[int], str] | None = None,
        form: InputForm | None = None,
        *,
        known: tuple[Float | None, Float | None] = (None, None),
        warm: bool = False,
        warnings: tuple[Notice, ...] | None = None,
    ) -> Readings:
        """Return the poses of all rows; DataError where they are too few or all the same.

        Args:
            sha256: of the input; where: how to name a row (from 0) to the user; form: how the input is written.
            known: readings behind each pose (J,) and their scatter (J, 3), where no column has them.
            warm: whether temperatures are known, likewise.
            warnings: what is said of them; None to screen them.
        """
        columns, means = self.columns, self._means
        extras: tuple[Float | None, Float | None, Float | None] = (None, None, None)
        cross = None
        if means is not None:
            extras, cross = (means.count(), means.scatter(), means.mean[:, 3:]), means.cross()
            self._take_means(means)
        elif self._extras:
            extras = columns.split(np.concatenate(self._extras))
        count, scatter, others = extras
        self._check()
        line = where if where is None or not self.zeros.count else self._line_of(where)
        readings = Readings(
            self.source,
            sha256,
            columns.names,
            self.store.rows,
            self.lower,
            self.upper,
            None if means is None else tuple(means.index),
            count,
            scatter,
            cross,
            reference=None if others is None or columns.reference is None else others[:, :3],
            temperature=None if others is None or columns.temperature is None else others[:, -1],
            notes=tuple(self.notes),
            form=InputForm(rows=self.rows) if form is None else form,
            _store=self.store,
            _line=line,
        )
        if warnings is None:
            found = replace(
                self._screened(readings, known), warm=warm or columns.temperature is not None
            ).notices()
            warnings = (*found, *self.zeros.notices(where or _pose, self.store.rows))
        return replace(readings, warnings=warnings)

    def _screened(self, readings: Readings, known: tuple[Float | None, Float | None]) -> Screened:
        _, first = next(self.store.blocks(LOOKED_AT))
        count, scatter = (
            part if part is not None else other
            for part, other in zip((readings.count, readings.scatter), known, strict=True)
        )
        return Screened(
            np.asarray(first),
            self.columns.names,
            self.store.rows,
            readings.where,
            self.source,
            single=self._means is None and count is None,
            timed=self.columns.time is not None,
            count=None if count is None else count[: len(first)],
            scatter=None if scatter is None else scatter[: len(first)],
            behind=self._behind,
            zeros=bool(self.zeros.count),
        )

    def _line_of(self, where: Callable[[int], str]) -> Callable[[int], str]:
        """Return how to name a pose where rows of zeros have been left out."""
        rows = self.zeros.rows
        return lambda pose: where(rows.line(pose))

    def _take_means(self, means: LabelledMeans[str]) -> None:
        """Let the means of the labels be the poses."""
        if len(means.mean):
            self.store.append(means.mean[:, :3])
            self.lower, self.upper = means.mean[:, :3].min(axis=0), means.mean[:, :3].max(axis=0)
        if means.repeated:
            self.notes.append(f"{self.rows:,} rows averaged into {len(means.rows):,} positions by label")

    def _check(self) -> None:
        if self.zeros.count and not self.store.rows:
            raise DataError(
                f"{self.source}: all {self.zeros.count:,} readings are equal, (0, 0, 0); the sensor has to be turned "
                "between them"
            )
        if self.store.rows < 2:
            few = "only one pose" if self.store.rows else "no readings"
            if self.store.rows and self.columns.label is not None:
                few += f", for column {self.columns.label + 1} gives all {self.rows:,} rows the same label"
            raise DataError(
                f"{self.source}: holds {few}; turn the sensor between readings, best to twelve poses or more"
            )
        advice = "; the sensor has to be turned between them"
        self._refuse_equal(f"all {self.store.rows:,} readings are equal", advice)
        if not self._all:
            DeadColumns(self.source, self.columns.names, self.lower, self.upper, self.rows).check()

    def _widen(self, output: Float) -> None:
        self.lower = np.minimum(self.lower, [axis.min() for axis in output.T])
        self.upper = np.maximum(self.upper, [axis.max() for axis in output.T])

    def _refuse_equal(self, fault: str, advice: str = "") -> None:
        if (self.lower == self.upper).all():
            value = ", ".join(f"{value:g}" for value in self.lower)
            raise DataError(f"{self.source}: {fault}, ({value}){advice}")


class LabelledMeans(Generic[Label]):
    """Weighted mean and scatter of the rows of each label (Welford's update, block by block).

    A row may itself be a mean of `weight` raw readings with standard deviation `spread`; its raw readings
    then count as if they had been rows. Memory grows with the labels, never with the rows.

    Attributes:
        index: number of each label, in order of first occurrence.
        rows, weight: table rows and raw readings of each label, shape (J,).
        mean: shape (J, width); square: weighted sum of squares about the mean, shape (J, 3); product: of products xy,
            xz and yz, shape (J, 3).
        spread: standard deviation stated by the label's last row, shape (J, 3), sensor units.
    """

    def __init__(self, source: str, width: int, most: int | None = None) -> None:
        """Average rows of `width` numbers; the first three are the sensor output."""
        self.source = source
        self.most = MOST_LABELS if most is None else most
        self.index: dict[Label, int] = {}
        self.rows, self.weight = np.zeros(0), np.zeros(0)
        self.mean, self.square, self.spread = np.zeros((0, width)), np.zeros((0, 3)), np.zeros((0, 3))
        self.product = np.zeros((0, 3))
        self.weighted = self.spreads = False

    def add(
        self,
        labels: Sequence[Label],
        rows: Float,
        weight: Float | None = None,
        spread: Float | None = None,
    ) -> None:
        """Add rows (B, width), with weights (B,) and standard deviations (B, 3) in sensor units if known."""
        codes, size = number_labels(self.index, labels), len(self.index)
        if not len(rows):
            return
        self._grow(size)
        self.weighted, self.spreads = weight is not None, spread is not None
        weight = np.ones(len(rows)) if weight is None else weight
        self.rows += np.bincount(codes, minlength=size)
        self._merge(codes, rows, weight)
        if spread is not None:
            self.spread[codes] = spread
            inner = np.where(weight[:, None] > 1, spread**2 * (weight[:, None] - 1), 0.0)
            np.add.at(self.square, codes, inner)

    def _merge(self, codes: Int, rows: Float, weight: Float) -> None:
        origin = rows[0]  # sums of differences keep the digits that a large offset would eat
        shifted = rows - origin
        fresh = _sums(codes, weight, len(self.weight))
        present = fresh > 0
        total = self.weight + fresh
        share = np.divide(fresh, total, out=np.zeros_like(total), where=present)
        apart, steps = [], []
        for k in range(rows.shape[1]):
            mean = np.divide(
                _sums(codes, weight * shifted[:, k], len(fresh)),
                fresh,
                out=np.zeros_like(fresh),
                where=present,
            )
            step = np.where(present, origin[k] + mean - self.mean[:, k], 0.0)
            if k < 3:
                apart.append(shifted[:, k] - mean[codes])
                steps.append(step)
                inner = _sums(codes, weight * apart[k] ** 2, len(fresh))
                self.square[:, k] += inner + step**2 * self.weight * share
            self.mean[:, k] += step * share
        for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
            inner = _sums(codes, weight * apart[i] * apart[j], len(fresh))
            self.product[:, p] += inner + steps[i] * steps[j] * self.weight * share
        self.weight = total

    def _grow(self, size: int) -> None:
        if size > self.most:
            raise DataError(f"{self.source}: more than {self.most:,} different position labels")
        more = size - len(self.rows)
        if more:
            self.rows, self.weight = (np.append(old, np.zeros(more)) for old in (self.rows, self.weight))
            self.mean, self.square, self.product, self.spread = (
                np.vstack([old, np.zeros((more, old.shape[1]))])
                for old in (self.mean, self.square, self.product, self.spread)
            )

    @property
    def repeated(self) -> bool:
        """Whether any label has more than one row."""
        return bool((self.rows > 1).any())

    def count(self) -> Float | None:
        """Return the raw readings of each label (J,); None where rows are single or means of an unknown number."""
        return self.weight if self.weighted or (self.repeated and not self.spreads) else None

    def scatter(self) -> Float | None:
        """Return the standard deviation of one raw reading (J, 3), sensor units; NaN where it is unknown."""
        if not (self.spreads or self.repeated):
            return None
        freedom = (self.weight if self.spreads else self.rows)[:, None] - 1
        single = np.full_like(self.spread, np.nan) if not self.spreads else self.spread
        pooled = np.sqrt(np.divide(self.square, freedom, out=np.zeros_like(self.square), where=freedom > 0))
        return np.where(self.rows[:, None] > 1, pooled, single)

    def cross(self) -> Float | None:
        """Return the covariances xy, xz and yz of one raw reading (J, 3), sensor units squared; NaN where unknown.

        None where a row states standard deviations: those say nothing of how the axes go together.
        """
        if self.spreads or not self.repeated:
            return None
        freedom = self.rows[:, None] - 1
        return np.divide(self.product, freedom, out=np.full_like(self.product, np.nan), where=freedom > 0)


def number_labels(index: dict[Label, int], labels: Sequence[Label]) -> Int:
    """Return the number of each label, shape (B,), by the index, to which a new one is added with the next number."""
    return np.fromiter((index.setdefault(label, len(index)) for label in labels), np.intp, len(labels))


def _sums(codes: Int, values: Float, size: int) -> Float:
    return np.bincount(codes, weights=values, minlength=size).astype(np.float64, copy=False)


def _pose(row: int) -> str:
    return f"pose {row + 1}"


def _array(what: str, values: ArrayLike, width: int, rows: int | None = None, *, gaps: bool = False) -> Float:
    """Return a copy of an array, checked: (rows, width), or (rows,) where width is 1, finite, of sane size."""
    array = np.array(values, dtype=np.float64)
    shaped = array.reshape(-1, 1) if width == 1 and array.ndim == 1 else array
    if shaped.ndim != 2 or shaped.shape[1] != width or (rows is not None and len(shaped) != rows):
        wanted = f"({'J' if rows is None else rows}, {width})" if width > 1 else f"({rows},)"
        raise DataError(f"{what}: an array of shape {wanted} was expected, not {array.shape}")
    sound = np.abs(shaped) <= LIMIT
    if not (sound | (np.isnan(shaped) & gaps)).all():
        raise DataError(f"{what}: row {int(np.argmin(sound.all(axis=1)))} is not finite or too large")
    return shaped
