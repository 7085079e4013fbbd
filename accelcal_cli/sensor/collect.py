"""Rows of a table gathered into poses: one a row, or one a label."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.cells import Rows
from accelcal_cli.sensor.columns import Columns
from accelcal_cli.sensor.doubts import LOOKED_AT, doubts, log_cautions
from accelcal_cli.sensor.repeats import LabelledMeans
from accelcal_cli.sensor.spool import IN_MEMORY, RowStore
from accelcal_cli.streams import Float

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
