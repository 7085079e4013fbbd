"""What bags of ROS 1 and 2 have in common: topics of sensor_msgs/Imu, whose messages end in 37 doubles.

rosbags finds the messages (extra ``accelcal[ros]``); numpy reads them by the layout that ROS publishes for
sensor_msgs/Imu: a header (stamp and frame), then orientation (4), angular velocity (3) and linear acceleration (3),
each with a covariance (9). In both serialisations the numbers of fixed size end the message, so that no types have to
be known: many ROS 2 bags hold none.
"""

from __future__ import annotations

import io
import struct
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, ClassVar

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.formats.base import (
    ACCELERATION,
    TURNING,
    LogFormat,
    RandomAccess,
    check_extra,
    choose_accelerometer,
)
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts

if TYPE_CHECKING:
    from rosbags.rosbag1 import Reader as Reader1
    from rosbags.rosbag2 import Reader as Reader2

IMU = "sensor_msgs/msg/Imu"
NUMBERS = 4 + 9 + 3 + 9 + 3 + 9
BYTES = 8 * NUMBERS
"""Numbers at the end of a message, and their bytes."""

FORCE, TURN = 25, 13
"""Where acceleration and angular velocity begin among the numbers."""

ROWS = 50_000
"""Rows of a block."""

STORAGE = (".db3", ".mcap")
"""Endings of the files that a folder of ROS 2 holds."""


class RosBag(LogFormat):
    """Base of the bags of ROS: the messages of one topic in the order in which they were recorded."""

    suffix: ClassVar[str]
    """By which rosbags knows what a file is."""

    names = ("time", *ACCELERATION, *TURNING)
    units = ("s", *["m/s^2"] * 3, *["rad/s"] * 3)

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:
        """Open the bag and choose the topic."""
        check_extra("rosbags", "ros", source.name, self.title)
        self._files = ExitStack()
        try:
            file = RandomAccess(source, path, self.suffix)
            self._files.callback(file.close)
            self._reader = self._open(self._named(file.path))
            self._files.callback(self._reader.close)
            topics = {link.topic for link in self._reader.connections if link.msgtype == IMU}
            if not topics:
                raise DataError(f"{source.name}: is {self.title} without a topic of sensor_msgs/Imu")
            self._topic = choose_accelerometer(source.name, sorted(topics), accelerometer)
        except BaseException:
            self._files.close()
            raise
        others = ", ".join(sorted(topics - {self._topic}))
        self._notes = [f"{self._topic} taken" + f"; --accelerometer takes {others}" * bool(others)]
        self._origin: int | None = None
        self._stamped = True
        self.facts = Facts(unit="m/s^2")

    def _open(self, path: Path) -> Reader1 | Reader2:
        """Return a reader of rosbags that has been opened."""
        from rosbags.rosbag2 import Reader as Reader2

        reader = Reader2(path)
        reader.open()
        return reader

    def _named(self, path: Path) -> Path:
        """Return a path to the same file whose name ends as rosbags expects."""
        if path.is_dir() or path.suffix == self.suffix:
            return path
        folder = tempfile.TemporaryDirectory(prefix="accelcal-")
        link = Path(self._files.enter_context(folder)) / f"bag{self.suffix}"
        link.symlink_to(path.absolute())
        return link

    @property
    def notes(self) -> tuple[str, ...]:
        """Which topic was taken, and what its time is."""
        times = [] if self._stamped else ["its messages have no stamps: time is that of the recording"]
        return (*self._notes, *times)

    def blocks(self) -> Iterator[Float]:
        """Yield time, acceleration and turning rate of the topic's messages."""
        links: Any = [link for link in self._reader.connections if link.topic == self._topic]
        times: list[int] = []
        tails: list[bytes] = []
        try:
            for _, recorded, raw in self._reader.messages(connections=links):
                stamp, tail = self._split(bytes(raw))
                if self._origin is None:
                    self._stamped = stamp != 0
                    self._origin = stamp or recorded
                times.append((stamp if self._stamped else recorded) - self._origin)
                tails.append(tail)
                if len(times) == ROWS:
                    yield self._rows(times, tails)
                    times, tails = [], []
        except GeneratorExit:
            raise
        except Exception:
            if times:  # those before the fault
                yield self._rows(times, tails)
            raise
        yield self._rows(times, tails)

    @staticmethod
    def _rows(times: list[int], tails: list[bytes]) -> Float:
        numbers = np.frombuffer(b"".join(tails), "<f8").reshape(-1, NUMBERS)
        columns = [numbers[:, FORCE : FORCE + 3], numbers[:, TURN : TURN + 3]]
        return np.hstack([np.array(times, dtype=np.int64)[:, None] / 1e9, *columns])

    def _split(self, raw: bytes) -> tuple[int, bytes]:
        """Return stamp, ns, and the numbers of a message in the serialisation of ROS 2, little-endian."""
        order = "<" if raw[1] & 1 else ">"
        seconds, rest, size = struct.unpack_from(f"{order}iII", raw, 4)
        start = 4 + (12 + size + 7) // 8 * 8
        return seconds * 1_000_000_000 + rest, self._tail(raw, start, order)

    @staticmethod
    def _tail(raw: bytes, start: int, order: str = "<") -> bytes:
        if not start + BYTES <= len(raw) < start + BYTES + 8:
            raise ValueError(f"a message of {len(raw)} bytes is no sensor_msgs/Imu")
        tail = raw[start : start + BYTES]
        return tail if order == "<" else np.frombuffer(tail, ">f8").astype("<f8").tobytes()

    def close(self) -> None:
        """Close the bag."""
        self._files.close()


class BagFolder(io.RawIOBase):
    """The data files of a folder that ROS 2 recorded, one after another, as one stream of bytes."""

    def __init__(self, folder: Path) -> None:
        """Open the first file; DataError where there is none."""
        super().__init__()
        files = [file for file in folder.iterdir() if file.suffix in STORAGE]
        if not files:
            raise DataError(f"{folder}: is a folder of ROS 2 without a .db3 or .mcap file")
        self._left = sorted(files, key=lambda file: (len(file.name), file.name))
        self._file: IO[bytes] = self._left.pop(0).open("rb")

    def readable(self) -> bool:
        """Return that it can be read."""
        return True

    def readinto(self, buffer: Any, /) -> int:
        """Read the next bytes."""
        data = self._file.read(len(buffer))
        while not data and self._left:
            self._file.close()
            self._file = self._left.pop(0).open("rb")
            data = self._file.read(len(buffer))
        buffer[: len(data)] = data
        return len(data)

    def close(self) -> None:
        """Close the file that is being read."""
        self._file.close()
        super().close()
