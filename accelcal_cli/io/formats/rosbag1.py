"""Bags of ROS 1 (.bag)."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import TYPE_CHECKING

from accelcal_cli.io.formats.base import LOG_FORMATS
from accelcal_cli.io.formats.ros import RosBag

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader


@LOG_FORMATS.register("rosbag1")
class Rosbag1(RosBag):
    """A bag of ROS 1."""

    title = "a ROS 1 bag"
    suffix = ".bag"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it begins with the version line of bags."""
        return head.startswith(b"#ROSBAG V2")

    def _open(self, path: Path) -> Reader:
        from rosbags.rosbag1 import Reader

        reader = Reader(path)
        reader.open()
        return reader

    def _split(self, raw: bytes) -> tuple[int, bytes]:
        """Return stamp, ns, and the numbers of a message in the serialisation of ROS 1."""
        seconds, rest, size = struct.unpack_from("<4xIII", raw)
        return seconds * 1_000_000_000 + rest, self._tail(raw, 16 + size)
