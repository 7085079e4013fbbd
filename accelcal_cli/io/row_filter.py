"""Rows of a table that meet conditions such as ``device=0``: what `--where COLUMN=VALUE` means.

A `RowFilter` goes before the parser: rows that do not meet the conditions are never parsed, so that they may hold what
no reading may. It remembers where the rows that stay came from, so that messages name the lines of the input.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.arrays import Bool, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import Dialect, is_blank, split_cells
from accelcal_cli.io.reader import LineMap

if TYPE_CHECKING:
    import polars as pl

SHOWN = 8
"""Values of a column that a message shows at most."""

SMALL = 1 << 18
"""Bytes: a block up to this size does not need polars."""


@dataclass(frozen=True)
class Condition:
    """A column, counted from 0 and by name, and the value that a row must have there, as text."""

    column: int
    name: str
    value: str

    def holds(self, cell: str) -> bool:
        """Return whether a cell has the value: as text, or as number."""
        if cell == self.value:
            return True
        try:
            return float(cell) == float(self.value)
        except ValueError:
            return False

    def mask(self, cells: pl.Series) -> pl.Series:
        """Return which cells have the value."""
        import polars as pl

        text = cells.cast(pl.String).str.strip_chars(" \t\r")
        met = text == self.value
        try:
            number = float(self.value)
        except ValueError:
            return met.fill_null(False)
        return (met | (text.cast(pl.Float64, strict=False) == number)).fill_null(False)


@dataclass(eq=False)
class RowFilter:
    """Keeps the lines, or the rows of a frame, that meet all conditions.

    Attributes:
        source: named in messages; conditions: at least one.
        lines: line, or row from 1, of the input for each one that stays, from 1.
    """

    source: str
    conditions: Sequence[Condition]
    lines: LineMap = field(default_factory=LineMap)
    _seen: dict[str, None] = field(default_factory=dict)  # values of the first condition's column
    _read: int = 0
    _kept: int = 0
    _met: bool = False

    def keep_all(self, block: bytes) -> bytes:
        """Keep the lines of the top of a table: its header and what is above."""
        count = block.count(b"\n") + (not block.endswith(b"\n"))
        self._note(np.arange(count), count)
        return block

    def keep(self, block: bytes, dialect: Dialect) -> bytes:
        """Return the lines of a block of whole lines that meet the conditions, blank lines and comments left out."""
        mask = self._fast(block, dialect) if len(block) > SMALL else None
        if mask is None:
            mask = np.array([self._meets(raw, dialect) for raw in io.BytesIO(block)], dtype=bool)
        self._met |= bool(mask.any())
        self._note(np.flatnonzero(mask), len(mask))
        if mask.all():
            return block
        ends = np.flatnonzero(np.frombuffer(block, np.uint8) == ord("\n")) + 1
        ends = ends if len(ends) == len(mask) else np.append(ends, len(block))
        chosen = np.repeat(mask, np.diff(ends, prepend=0))
        return np.frombuffer(block, np.uint8)[chosen].tobytes()

    def rows(self, frame: pl.DataFrame) -> pl.DataFrame:
        """Return the rows of a frame that meet the conditions."""
        import polars as pl

        met = pl.Series([True]).new_from_index(0, frame.height)
        for condition in self.conditions:
            met &= condition.mask(frame[condition.name])
        mask = met.to_numpy()
        self._see(frame[self.conditions[0].name])
        self._met |= bool(mask.any())
        self._note(np.flatnonzero(mask), len(mask))
        return frame.filter(met)

    def check(self) -> None:
        """Raise DataError where no row has met the conditions; to be called at the end of the table."""
        if self._met:
            return
        wanted = " and ".join(f'column "{c.name}" = {c.value}' for c in self.conditions)
        values = list(self._seen)
        held = ", ".join(values[:SHOWN]) + (" and others" if len(values) > SHOWN else "")
        raise DataError(
            f'{self.source}: no row has {wanted} (--where); column "{self.conditions[0].name}" holds {held}'
        )

    def _note(self, kept: Int, read: int) -> None:
        """Note which of the next `read` lines stay."""
        self.lines.add_many(self._kept + 1 + np.arange(len(kept)), self._read + 1 + kept)
        self._kept += len(kept)
        self._read += read

    def _meets(self, raw: bytes, dialect: Dialect) -> bool:
        """Return whether a line meets the conditions; one that is too short does, for the parser to find fault with."""
        line = raw.decode(errors="replace")
        if is_blank(line) or line.lstrip().startswith("#"):
            return False
        cells = split_cells(line.rstrip("\r\n"), dialect.separator)
        if len(cells) <= max(condition.column for condition in self.conditions):
            return True
        if len(self._seen) <= SHOWN:
            self._seen[cells[self.conditions[0].column]] = None
        return all(condition.holds(cells[condition.column]) for condition in self.conditions)

    def _fast(self, block: bytes, dialect: Dialect) -> Bool | None:
        """Return which lines meet the conditions, None where polars may see other lines than are there."""
        import polars as pl

        odd = (
            b'"' in block
            or b"#" in block
            or dialect.separator == " "
            or b"\n\n" in block
            or b"\n\r\n" in block
        )
        if odd or block[:1] in b"\r\n" or not block.endswith(b"\n"):
            return None
        schema = {str(k): pl.String for k in range(dialect.width)}
        try:
            frame = pl.read_csv(
                block,
                has_header=False,
                schema=schema,
                separator=dialect.separator,
                quote_char=None,
                columns=sorted({condition.column for condition in self.conditions}),
            )
        except pl.exceptions.PolarsError:
            return None
        if len(frame) != block.count(b"\n"):
            return None
        self._see(frame[str(self.conditions[0].column)])
        met = [condition.mask(frame[str(condition.column)]).to_numpy() for condition in self.conditions]
        return np.asarray(np.logical_and.reduce(met))

    def _see(self, cells: pl.Series) -> None:
        if len(self._seen) <= SHOWN:
            self._seen.update(
                dict.fromkeys(str(value) for value in cells.unique(maintain_order=True)[: SHOWN + 1])
            )
