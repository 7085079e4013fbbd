"""Static readings of an accelerometer: read from any table, one row a pose."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import BinaryIO, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.cells import LIMIT, Rows
from accelcal_cli.sensor.collect import Collector, Extras
from accelcal_cli.sensor.columns import Columns, choose
from accelcal_cli.sensor.spool import RowStore
from accelcal_cli.sensor.tabular import Table, open_table
from accelcal_cli.streams import Float


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
