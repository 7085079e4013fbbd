"""Static readings of an accelerometer, one row per pose, and the way there from a table or an array.

`read_readings` gathers the rows of a table into poses: one per row, or one per label, averaged as the rows stream by
(`LabelledMeans`). The outputs stay in a store that may be on disk; a calibration takes them in blocks. Before anything
is fitted, `log_warnings` and `doubts` say what makes them doubtful: logs, dead or duplicate axes, copied rows.
"""

from __future__ import annotations

import hashlib
import shlex
from collections.abc import Callable, Hashable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Generic, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import Columns, choose
from accelcal_cli.io.reader import LIMIT, PLAIN, InputTable, ReadOptions, RowBlock, open_table
from accelcal_cli.io.stream import IN_MEMORY, RowStore
from accelcal_cli.notices import COMMAND, Notice

STUCK = 1_000_000
"""Equal readings in a row after which an input is not read on."""

MOST_LABELS = 1_000_000
"""Different labels of poses at most: their means are kept in memory."""

RAW_ROWS = 500
"""From so many rows on, rows with a time each, or each much like the one before, are a raw log rather than poses."""

ALIKE, LOOKED_AT = 0.05, 4096
"""Poses differ from one to the next; most of the first LOOKED_AT rows of a log differ by less than this part of the
range."""

MANY_COPIES = 1 / 3
"""Part of the poses from which on copies are reported. One row that occurs twice does no harm, and readings without
noise repeat where an attitude does."""

LIVE = "Name the columns of three living axes (--columns), and turn the sensor about all of them."
"""What to do about a dead axis."""

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of axes."""

Label = TypeVar("Label", bound=Hashable)


@dataclass(frozen=True)
class InputForm:
    """How an input is written.

    Attributes:
        source_format: ``text, comma``, ``parquet``, ``array``, ...
        rows: read, without those skipped; rows_skipped: broken ones left out.
        rate_hz: rows per second of a log, None where it is unknown.
        unit: of the readings as the file states it: g, mg, m/s^2 or counts; None where it does not.
    """

    source_format: str = "array"
    rows: int = 0
    rows_skipped: int = 0
    rate_hz: float | None = None
    unit: str | None = None


@dataclass(frozen=True, eq=False)
class Readings:
    """Static readings of one sensor, one row per pose; rows with one label are averaged.

    Attributes:
        source: path as given, "<stdin>" or "<array>"; sha256: of the input bytes.
        columns: names (or numbers) of the output columns.
        poses: J; lower, upper: least and greatest output of each axis, shape (3,), sensor units.
        labels: of the poses; None where each row is a pose.
        count: raw readings behind each pose, shape (J,).
        scatter: standard deviation of one raw reading, shape (J, 3), sensor units, NaN if unknown.
        reference: known specific force, shape (J, 3), m/s^2 or g as given.
        temperature: shape (J,), as given, NaN where missing.
        notes: what the reader did that a user should know.
        warnings: why the readings may not be what they are taken for.
        form: how the input is written.
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
    reference: Float | None = None
    temperature: Float | None = None
    notes: tuple[str, ...] = ()
    warnings: tuple[Notice, ...] = ()
    form: InputForm = InputForm()
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
        reference: ArrayLike | None = None,
        temperature: ArrayLike | None = None,
    ) -> Readings:
        """Return readings from memory: output (J, 3) in sensor units, the rest as in the fields.

        Raises:
            DataError: an array of another shape, or values that no readings have.
        """
        rows = _array("output", output, 3)
        poses = len(rows)
        if labels is not None and not len(set(map(str, labels))) == len(labels) == poses:
            raise DataError(f"labels: {poses} different labels were expected, one per pose")
        numbers = None if count is None else _array("count", count, 1, poses)[:, 0]
        if numbers is not None and _are_no_counts(numbers).any():
            raise DataError("count: whole numbers of 1 or more were expected")
        collector = Collector(source, Columns((0, 1, 2), ("1", "2", "3")))
        collector.add(RowBlock(0, rows))
        return replace(
            collector.readings(hashlib.sha256(rows.astype("<f8").tobytes()).hexdigest()),
            labels=None if labels is None else tuple(map(str, labels)),
            count=numbers,
            scatter=None if scatter is None else _array("scatter", scatter, 3, poses, gaps=True),
            reference=None if reference is None else _array("reference", reference, 3, poses),
            temperature=(
                None if temperature is None else _array("temperature", temperature, 1, poses, gaps=True)[:, 0]
            ),
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


def read_readings(
    source: str | Path,
    columns: Sequence[str] | None = None,
    *,
    stdin: BinaryIO | None = None,
    options: ReadOptions = PLAIN,
) -> Readings:
    """Read static readings from a text table or a Parquet file; ``-`` is standard input.

    `columns` names the three output columns, or numbers them from 1; without it their names decide. `options` say what
    the user knows of the form of a text. Rows that share a position label are averaged.

    Raises:
        DataError: a fault of the input, with its place. UsageError: a fault of `columns`.
    """
    table = open_table(source, stdin, options=options)
    try:
        collector = Collector(table.name, choose(table, columns, count=options.count))
        for rows in table.blocks(collector.columns.selection()):
            check_rows(table, collector.columns, rows)
            collector.add(rows)
        collector.notes[:0] = table.notes
        form = InputForm(
            table.source_format, collector.rows, table.rows_skipped, None, collector.columns.unit
        )
        return collector.readings(table.sha256, table.where, form)
    finally:
        table.close()


def check_rows(table: InputTable, columns: Columns, rows: RowBlock) -> None:
    """Refuse counts that are not whole numbers of 1 or more, and standard deviations below zero."""
    for at, column in enumerate(columns.extras, 3):
        counts, values = column == columns.count, rows.numbers[:, at]
        bad = _are_no_counts(values) if counts else values < 0
        if (counts or column in (columns.scatter or ())) and bad.any():
            expected = "count of 1 or more" if counts else "standard deviation of 0 or more"
            where = table.where(rows.start + int(np.argmax(bad)))
            raise DataError(
                f'{table.name}, {where}, column "{(table.names or ())[column]}": a {expected} was expected'
            )


class Collector:
    """Gathers blocks of rows into poses."""

    def __init__(self, source: str, columns: Columns) -> None:
        """Expect rows as `columns.selection()` asks for them."""
        self.source, self.columns = source, columns
        self.notes = list(columns.notes)
        self.store = RowStore()
        self.rows = 0
        self.lower, self.upper = np.full(3, np.inf), np.full(3, -np.inf)
        others = 3 * (columns.reference is not None) + (columns.temperature is not None)
        self._means = None if columns.label is None else LabelledMeans[str](source, 3 + others)
        self._extras: list[Float] | None = [] if columns.extras else None

    def add(self, rows: RowBlock) -> None:
        """Add one block."""
        if not len(rows.numbers):
            return
        output, extras = rows.numbers[:, :3], rows.numbers[:, 3:]
        self.rows += len(output)
        self._widen(output)
        if self.rows >= STUCK:
            self._refuse_equal(f"the first {self.rows:,} readings are all equal")
        if self._means is not None:
            count, scatter, others = self.columns.split(extras)
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
        self, sha256: str, where: Callable[[int], str] | None = None, form: InputForm | None = None
    ) -> Readings:
        """Return the poses of all rows; DataError where they are too few or all the same.

        Args:
            sha256: of the input; where: how to name a row (from 0) to the user; form: how the input is written.
        """
        columns, means = self.columns, self._means
        extras: tuple[Float | None, Float | None, Float | None] = (None, None, None)
        if means is not None:
            extras = means.count(), means.scatter(), means.mean[:, 3:]
            self._take_means(means)
        elif self._extras:
            extras = columns.split(np.concatenate(self._extras))
        count, scatter, others = extras
        self._check()
        _, first = next(self.store.blocks(LOOKED_AT))
        span, timed = float((self.upper - self.lower).max()), columns.time is not None
        log = log_warnings(self.store.rows, first, span, self.source, timed=timed) if means is None else ()
        return Readings(
            self.source,
            sha256,
            columns.names,
            self.store.rows,
            self.lower,
            self.upper,
            None if means is None else tuple(means.index),
            count,
            scatter,
            reference=None if others is None or columns.reference is None else others[:, :3],
            temperature=None if others is None or columns.temperature is None else others[:, -1],
            notes=tuple(self.notes),
            warnings=(*log, *doubts(first, columns.names)),
            form=InputForm(rows=self.rows) if form is None else form,
            _store=self.store,
            _line=where,
        )

    def _take_means(self, means: LabelledMeans[str]) -> None:
        """Let the means of the labels be the poses."""
        if len(means.mean):
            self.store.append(means.mean[:, :3])
            self.lower, self.upper = means.mean[:, :3].min(axis=0), means.mean[:, :3].max(axis=0)
        if means.repeated:
            self.notes.append(f"{self.rows:,} rows averaged into {len(means.rows):,} positions by label")

    def _check(self) -> None:
        if self.store.rows < 2:
            few = "only one pose" if self.store.rows else "no readings"
            if self.store.rows and self.columns.label is not None:
                few += f", for column {self.columns.label + 1} gives all {self.rows:,} rows the same label"
            raise DataError(
                f"{self.source}: holds {few}; turn the sensor between readings, best to twelve poses or more"
            )
        advice = "; the sensor has to be turned between them"
        self._refuse_equal(f"all {self.store.rows:,} readings are equal", advice)

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
        mean: shape (J, width); square: weighted sum of squares about the mean, shape (J, 3).
        spread: standard deviation stated by the label's last row, shape (J, 3), sensor units.
    """

    def __init__(self, source: str, width: int, most: int | None = None) -> None:
        """Average rows of `width` numbers; the first three are the sensor output."""
        self.source = source
        self.most = MOST_LABELS if most is None else most
        self.index: dict[Label, int] = {}
        self.rows, self.weight = np.zeros(0), np.zeros(0)
        self.mean, self.square, self.spread = np.zeros((0, width)), np.zeros((0, 3)), np.zeros((0, 3))
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
        for k in range(rows.shape[1]):
            mean = np.divide(
                _sums(codes, weight * shifted[:, k], len(fresh)),
                fresh,
                out=np.zeros_like(fresh),
                where=present,
            )
            step = np.where(present, origin[k] + mean - self.mean[:, k], 0.0)
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


def number_labels(index: dict[Label, int], labels: Sequence[Label]) -> Int:
    """Return the number of each label, shape (B,), by the index, to which a new one is added with the next number."""
    return np.fromiter((index.setdefault(label, len(index)) for label in labels), np.intp, len(labels))


def log_warnings(rows: int, first: Float, span: float, source: str, *, timed: bool) -> tuple[Notice, ...]:
    """Return a warning for rows that are taken for poses and may be a log: timed, or each much like the one before.

    Args:
        rows: how many; first: the first of them, shape (B, 3), LOOKED_AT at most.
        span: the largest range of an axis; source: of the rows, a path or a name in angle brackets.
        timed: whether they have times.
    """
    if rows < RAW_ROWS or not (timed or np.median(np.abs(np.diff(first, axis=0)).max(axis=1)) < ALIKE * span):
        return ()
    text = (
        f"Each row is taken for a pose at rest. If these {rows:,} rows are a log with moves in it, its static poses "
        "have to be found first; of many readings of one pose, label the poses in a column."
    )
    place = {"<stdin>": "-", "<array>": "LOG"}.get(source, shlex.quote(source))
    return (Notice("log", "warning", text, f"{COMMAND}calibrate {place} --raw"),)


def doubts(output: Float, names: Sequence[str]) -> list[Notice]:
    """Return what is doubtful about poses.

    Args:
        output: of the poses, or of many of them, shape (J, 3), sensor units.
        names: of the three columns.
    """
    dead = [
        f'Column "{name}" is {output[0, i]:g} in every pose: its axis is dead or was never turned.'
        for i, name in enumerate(names)
        if (output[:, i] == output[0, i]).all()
    ]
    dead += [
        f'Columns "{names[i]}" and "{names[j]}" are equal in every pose: they show one axis.'
        for i, j in PAIRS
        if (output[:, i] == output[:, j]).all()
    ]
    notices = [Notice("dead-axis", "warning", text, LIVE) for text in dead]
    copies = len(output) - len({row.tobytes() for row in output})
    if copies >= MANY_COPIES * len(output):
        text = (
            f"{copies:,} of {len(output):,} poses repeat another to the last digit. Sigma counts them as independent "
            "measurements."
        )
        notices.append(Notice("duplicate-rows", "warning", text, "Leave copies out."))
    return notices


def may_be_doubtful(output: Float, poses: Int) -> Bool:
    """Return which of R sensors to ask `doubts` about, shape (R,): all of those of which it has something to say.

    Args:
        output: their poses, shape (R, J, 3), whatever follows the last; poses: of each, shape (R,).
    """
    real = np.arange(output.shape[1]) < poses[:, None]
    dead = ((output == output[:, :1]) | ~real[..., None]).all(axis=1).any(axis=1)
    axes = np.moveaxis(output, 2, 0)
    equal = [((axes[i] == axes[j]) | ~real).all(axis=1) for i, j in PAIRS]
    # Mixed into one number, rows that are equal stay equal; NaN comes last.
    mixed = np.sort(np.where(real, axes[0] + np.pi * axes[1] + np.e * axes[2], np.nan), axis=1)
    copies = (mixed[:, 1:] == mixed[:, :-1]).sum(axis=1)
    many = copies >= MANY_COPIES * np.minimum(poses, LOOKED_AT)
    return np.asarray(dead | np.logical_or.reduce(equal) | many)


def _sums(codes: Int, values: Float, size: int) -> Float:
    return np.bincount(codes, weights=values, minlength=size).astype(np.float64, copy=False)


def _are_no_counts(count: Float) -> Bool:
    return np.asarray((count < 1) | (count != np.round(count)))


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
