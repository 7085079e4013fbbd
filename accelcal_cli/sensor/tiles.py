"""A raw log reduced, in one pass, to short tiles of rows: their means and the squares about them.

Everything that comes later (windows, thresholds, intervals) is computed from the tiles, so that a log is read once
whatever is tried. Tiles are counted from the first row of the log and squares are taken about each tile's own mean:
the result does not depend on the blocks that the rows come in, to the last bit, and nothing cancels.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from accelcal_cli.sensor.envelope import Envelope
from accelcal_cli.sensor.gaps import Gaps, Limit
from accelcal_cli.sensor.rawlog import RawLog, RawRows
from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.spool import RowStore
from accelcal_cli.streams import Float

NO_GAP = Limit()

IN_MEMORY = 1_000_000
"""Tiles kept in memory: a day of 100 Hz with windows of 1 s; more go to a temporary file."""

BLOCK = 65536
"""Tiles worked on at a time."""


class Tiles:
    """Means and squares of tiles of `size` rows; a rest shorter than a tile is left out.

    Attributes:
        size: rows of a tile.
        gyro, timed: whether the log has a gyroscope and time.
        rows: rows of the log, those left out included.
        gaps: those of the time column.
    """

    def __init__(self, size: int, gyro: bool, timed: bool, limit: Limit = NO_GAP) -> None:
        """Start without tiles; `limit` says what is a gap."""
        self.size, self.gyro, self.timed = size, gyro, timed
        self.gaps = Gaps(limit)
        self.rows = 0
        self._store = RowStore(6 + 6 * gyro + 2 * timed, IN_MEMORY)
        self._rest: Float | None = None

    @property
    def count(self) -> int:
        """Number of tiles."""
        return self._store.rows

    def add(self, raw: RawRows, envelope: Envelope | None = None) -> None:
        """Take in the next rows; an `envelope` sees them too."""
        block = np.ascontiguousarray(raw.numbers.T)  # (k, B): one column after the other
        self.rows += block.shape[1]
        if self._rest is not None and self._rest.shape[1]:
            need = self.size - self._rest.shape[1]
            self._rest = np.concatenate([self._rest, block[:, :need]], axis=1)
            block = block[:, need:]
            if self._rest.shape[1] < self.size:
                return
            self._reduce(self._rest, envelope)
        whole = block.shape[1] // self.size * self.size
        self._reduce(block[:, :whole], envelope)
        self._rest = block[:, whole:].copy()

    def _reduce(self, block: Float, envelope: Envelope | None) -> None:
        """Store the tiles of a block of whole tiles, shape (k, m size)."""
        tiles = block.shape[1] // self.size
        if not tiles:
            return
        sensors = 6 if self.gyro else 3
        out = np.empty((tiles, self._store.width))
        for k in range(sensors):
            part = block[k].reshape(tiles, self.size)
            at = k if k < 3 else k + 3  # mean, squares, mean of the gyroscope, its squares
            mean = np.add.reduce(part, axis=1) / self.size
            off = part - mean[:, None]
            out[:, at] = mean
            out[:, at + 3] = np.einsum("ij,ij->i", off, off)
        if self.timed:
            time = block[-1].reshape(tiles, self.size)
            out[:, -2], out[:, -1] = time[:, 0], time[:, -1]
            self.gaps.see(time)
        self._store.append(out)
        if envelope is not None:
            envelope.add(block[:3].reshape(3, tiles, self.size), block[-1] if self.timed else None)

    def blocks(self, overlap: int = 0) -> Iterator[tuple[int, Float]]:
        """Yield (first tile, block (B, width)); each block begins with the last `overlap` tiles of the one before."""
        tail: Float | None = None
        for first, block in self._store.blocks(BLOCK):
            joined = block if tail is None else np.concatenate([tail, block])
            yield first - (0 if tail is None else len(tail)), joined
            tail = joined[max(0, len(joined) - overlap) :] if overlap else None


def read_tiles(log: RawLog, rows: Rows, envelope: Envelope | None = None) -> Tiles:
    """Read a log to its end and return its tiles."""
    gyro, timed = log.columns.gyro is not None, log.columns.time is not None
    tiles = Tiles(rows.tile, gyro, timed, Limit.of(log.clock, rows))
    for raw in log.blocks():
        tiles.add(raw, envelope)
    return tiles
