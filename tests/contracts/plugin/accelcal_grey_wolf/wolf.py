"""Logs of the wolf: four doubles a row, time and acceleration."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.io.formats.base import LogFormat
from accelcal_cli.io.stream import ByteSource

MAGIC = b"WOLF\0\0\0\0"


class Wolf(LogFormat):
    """A wolf log."""

    title = "a wolf log"
    names = ("time", "ax", "ay", "az")
    units = ("s", "m/s^2", "m/s^2", "m/s^2")

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it begins with the magic."""
        return head.startswith(MAGIC)

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:
        """Take over the bytes behind the magic."""
        self._bytes = chain([source.head[len(MAGIC) :]], source.rest())

    def blocks(self) -> Iterator[Float]:
        """Yield the rows."""
        rest = b""
        for fresh in self._bytes:
            data = rest + fresh
            whole = len(data) // 32 * 32
            rest = data[whole:]
            yield np.frombuffer(data[:whole], "<f8").reshape(-1, 4)
