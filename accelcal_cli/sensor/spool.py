"""A store of rows that moves to a temporary file when it outgrows memory."""

from __future__ import annotations

import os
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from typing import BinaryIO

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.beside import Beside
from accelcal_cli.streams import Float

IN_MEMORY = 1_000_000  # rows


class RowStore:
    """Rows of `width` numbers, appended once and read back in blocks as often as needed.

    Beyond `limit` rows they live as float64 in an unlinked temporary file, so that memory stays constant;
    it is read with ordinary reads, because mapped pages would count as the process's own.
    """

    def __init__(self, width: int = 3, limit: int = IN_MEMORY) -> None:
        """Keep up to `limit` rows in memory."""
        self.rows = 0
        self.width = width
        self._limit = limit
        self._parts: list[Float] = []
        self._file: BinaryIO | None = None
        self._writing = Beside()

    def append(self, rows: Float) -> None:
        """Add rows (B, width)."""
        if not len(rows):
            return
        self._parts.append(np.array(rows, dtype=np.float64, order="C"))
        self.rows += len(rows)
        if self.rows > self._limit:
            parts, self._parts = self._parts, []
            with _named_disk_errors():
                self._writing.start(lambda: self._spill(parts))

    def blocks(self, rows: int = 65536) -> Iterator[tuple[int, Float]]:
        """Yield (first row, block) with blocks of up to `rows` rows; blocks are read-only or private."""
        self._settle()
        if self._file is None:
            whole = self._in_memory()
            for start in range(0, self.rows, rows):
                yield start, whole[start : start + rows]
            return
        for start in range(0, self.rows, rows):
            self._settle()  # a writer that came between two blocks moves the file's position
            block = np.empty((min(rows, self.rows - start), self.width))
            with _named_disk_errors():
                self._file.seek(start * self.width * 8)
                self._fill(block)
            yield start, block

    def all(self) -> Float:
        """Every row, (rows, width)."""
        self._settle()
        if self._file is None:
            return self._in_memory()
        return np.concatenate([block for _, block in self.blocks()])

    def _in_memory(self) -> Float:
        if len(self._parts) != 1:
            self._parts = [np.concatenate([np.empty((0, self.width)), *self._parts])]
        self._parts[0].flags.writeable = False
        return self._parts[0]

    def _settle(self) -> None:
        with _named_disk_errors():
            self._writing.wait()

    def _spill(self, parts: list[Float]) -> None:
        if self._file is None:
            import tempfile  # costs as much as reading a small table

            self._file = tempfile.TemporaryFile(prefix="accelcal-", buffering=0)  # noqa: SIM115
            weakref.finalize(self, self._file.close)
        self._file.seek(0, os.SEEK_END)
        for part in parts:
            view = part.data.cast("B")
            while view:  # an unbuffered write may take less than all
                view = view[self._file.write(view) :]

    def _fill(self, block: Float) -> None:
        view = block.data.cast("B")
        while view:
            got = self._file.readinto(view) if self._file is not None else 0  # type: ignore[attr-defined]
            if not got:
                raise OSError("the temporary file is shorter than it was written")
            view = view[got:]


@contextmanager
def _named_disk_errors() -> Iterator[None]:
    try:
        yield
    except OSError as problem:
        from tempfile import gettempdir

        raise DataError(
            f"{gettempdir()}: the temporary file for more than {IN_MEMORY:,} readings failed "
            f"({problem.strerror or problem}); free some space, or set TMPDIR to a larger folder"
        ) from problem
