"""ArduPilot logs (.BIN, dataflash): messages that begin with two magic bytes and their number, as FMT messages define.

`_FlashScanner` goes from message to message, block after block, and keeps the places of the rows of accelerometers;
numpy takes them out of a block at once. A message is trusted when another one begins behind it. The parameters in the
log say how ArduPilot had corrected the readings (INS_ACC*, AHRS_ORIENTATION). The text logs of ArduPilot are read in
`lines.py`, which chooses among accelerometers in the same words.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.formats.base import ACCELERATION, LOG_FORMATS, TURNING, LogFormat, cut_out
from accelcal_cli.io.lines import FORCE_COLUMNS, choose_message
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts
from accelcal_cli.sensor.vehicle import VehicleCorrection, as_rows, board_turn

MAGIC = b"\xa3\x95"
FMT = 128
"""Number of the message that defines messages, itself included."""

OWN = struct.Struct("<3xBB4s16s64s")
"""A FMT message: number, length, name, types and names of the columns."""

NUMPY = {
    **dict(zip("bBMhHiIL", ("i1", "u1", "u1", "<i2", "<u2", "<i4", "<u4", "<i4"), strict=True)),
    **dict(zip("qQfdgcCeE", ("<i8", "<u8", "<f4", "<f8", "<f2", "<i2", "<u2", "<i4", "<u4"), strict=True)),
    **dict(zip("nNZa", ("S4", "S16", "S64", "32<i2"), strict=True)),
}
"""Letters of types as numpy calls them."""

PER_UNIT = dict.fromkeys("cCeE", 100.0)
"""What whole numbers of a type are divided by."""

TIMES = {"TimeUS": 1e6, "TimeMS": 1e3}
"""Columns of time, and how many of each are a second."""

NAME = re.compile(r"(IMU|ACC)\d?")
"""Messages of accelerometers."""

INSTANCES = 3
"""Accelerometers that parameters name."""


@dataclass
class _Message:
    """A kind of message, and where its rows begin in the block that was scanned last."""

    name: str
    size: int
    row: np.dtype[np.void]  # after the three bytes of the header
    types: Mapping[str, str]
    rows: list[int] = field(default_factory=list)

    @property
    def is_force(self) -> bool:
        """Whether it has acceleration and time."""
        return set(FORCE_COLUMNS) <= self.types.keys() and bool(TIMES.keys() & self.types.keys())

    def take(self, data: bytes) -> np.ndarray:
        """Return all rows of the block, a structured array of shape (B,)."""
        cells = cut_out(data, self.rows, self.size)[:, 3:]
        return np.ascontiguousarray(cells).view(self.row)[:, 0]

    def numbers(self, rows: np.ndarray, column: str) -> Float:
        """Return a column of some rows in its unit, shape (B,)."""
        return rows[column].astype(np.float64) / PER_UNIT.get(self.types[column], 1.0)


class _FlashScanner:
    """Goes through the messages of a log, and keeps what they say.

    Attributes:
        kinds: messages by number; parameters: their first values; changed: those that change in the log.
        lost: bytes that made no sense.
    """

    def __init__(self) -> None:
        self.kinds: dict[int, _Message] = {}
        self.parameters: dict[str, float] = {}
        self.changed: set[str] = set()
        self.lost = 0
        self._sizes = [0] * 256
        self._sizes[FMT] = OWN.size
        self._lists: list[list[int] | None] = [None] * 256
        self._parameter = -1

    def scan(self, data: bytes) -> int:
        """Find the messages of a block; return where the first one begins that is not whole."""
        for message in self.kinds.values():
            message.rows.clear()
        sizes, lists, end, at, before = self._sizes, self._lists, len(data), 0, -1
        while at + 3 <= end:
            kind = data[at + 2]
            if data[at] != 0xA3 or data[at + 1] != 0x95 or not sizes[kind]:
                self._forget(before)
                found = self._next_message(data, at + 1)
                self.lost += found - at
                at, before = found, -1
                continue
            stop = at + sizes[kind]
            if stop > end:
                break
            rows = lists[kind]
            if rows is not None:
                rows.append(at)
            elif kind == FMT:
                self._define(data[at:stop])
            elif kind == self._parameter:
                self._note_parameter(data[at:stop])
            at, before = stop, at
        return at

    def _forget(self, at: int) -> None:
        """Drop the row that begins at a place: no message follows it."""
        for message in self.kinds.values():
            if message.rows and message.rows[-1] == at:
                message.rows.pop()

    def _next_message(self, data: bytes, start: int) -> int:
        """Return where a message of a known kind begins."""
        while (at := data.find(MAGIC, start)) >= 0 and at + 2 < len(data) and not self._sizes[data[at + 2]]:
            start = at + 2
        return at if at >= 0 else max(start, len(data) - 1)

    def _define(self, body: bytes) -> None:
        """Take the definition of a kind of message; one that makes no sense is none."""
        number, size, name, types, columns = OWN.unpack(body)
        called, letters = (text.rstrip(b"\0").decode("latin-1") for text in (name, types))
        names = columns.rstrip(b"\0").decode("latin-1").split(",")
        if number == FMT or len(names) != len(letters) or len(set(names)) != len(names):
            return
        if not set(letters) <= NUMPY.keys():
            return
        row = np.dtype([(label, NUMPY[letter]) for label, letter in zip(names, letters, strict=True)])
        known = self.kinds.get(number)
        if row.itemsize + 3 != size or (known and (known.name, known.row) == (called, row)):
            return
        message = _Message(called, size, row, dict(zip(names, letters, strict=True)))
        self.kinds[number], self._sizes[number] = message, size
        self._lists[number] = message.rows if NAME.fullmatch(called) and message.is_force else None
        if called == "PARM" and {"Name", "Value"} <= message.types.keys():
            self._parameter = number

    def _note_parameter(self, body: bytes) -> None:
        (row,) = np.frombuffer(body[3:], self.kinds[self._parameter].row)
        name, value = bytes(row["Name"]).decode("latin-1"), float(row["Value"])
        if name in self.parameters and self.parameters[name] != value:
            self.changed.add(name)
        self.parameters.setdefault(name, value)


@LOG_FORMATS.register("ardupilot")
class ArduPilotLog(LogFormat):
    """An ArduPilot log."""

    title = "an ArduPilot log (.BIN)"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it begins with a FMT message."""
        return head.startswith(MAGIC + bytes([FMT]))

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:  # noqa: ARG002
        """Scan the head, which holds the definitions and the first rows, and choose the accelerometer."""
        self._scanner, self._cut = _FlashScanner(), 0
        self._origin: float | None = None
        self._scanned = self._scan(source)
        self._first = next(self._scanned, b"")
        able = self._accelerometers()
        if not able:
            raise DataError(
                f"{source.name}: is an ArduPilot log without messages of acceleration (IMU or ACC); log them with "
                "LOG_BITMASK"
            )
        chosen = choose_message(source.name, list(able), accelerometer)
        self._message, self._number = able[chosen]
        others = ", ".join(name for name in able if name != chosen)
        self._taken = f"{chosen} taken" + f"; --accelerometer takes {others}" * bool(others)
        self._name_columns()
        self.facts = Facts(unit="m/s^2")

    def _accelerometers(self) -> dict[str, tuple[_Message, int | None]]:
        """Return message and value of the column I of each accelerometer in the head, by name, IMU first."""
        able: dict[str, tuple[_Message, int | None]] = {}
        messages = (message for message in self._scanner.kinds.values() if message.rows)
        for message in sorted(messages, key=lambda message: (message.name[0] != "I", message.name)):
            if "I" not in message.types:
                able[message.name] = message, None
                continue
            for number in np.unique(message.take(self._first)["I"]).tolist():
                able[f"{message.name}[{number}]"] = message, number
        return able

    def _name_columns(self) -> None:
        """Name the columns, and those of the message that they are taken from."""
        types = self._message.types
        self._time = next(name for name in TIMES if name in types)
        self._columns = list(FORCE_COLUMNS)
        names, units = ["time", *ACCELERATION], ["s", *["m/s^2"] * 3]
        turning = ("GyrX", "GyrY", "GyrZ")
        if set(turning) <= types.keys():
            self._columns += turning
            names, units = [*names, *TURNING], [*units, *["rad/s"] * 3]
        if warm := next((name for name in ("T", "Temp") if name in types), None):
            self._columns.append(warm)
            names, units = [*names, "temperature"], [*units, "degC"]
        self.names, self.units = tuple(names), tuple(units)

    def blocks(self) -> Iterator[Float]:
        """Yield time, acceleration, turning rate and temperature of the accelerometer's rows."""
        message = self._message
        for data in chain([self._first], self._scanned):
            rows = message.take(data)
            rows = rows if self._number is None else rows[rows["I"] == self._number]
            times = message.numbers(rows, self._time) / TIMES[self._time]
            if len(times) and self._origin is None:
                self._origin = float(times[0])
            yield np.column_stack(
                [times - (self._origin or 0.0), *(message.numbers(rows, name) for name in self._columns)]
            )

    def _scan(self, source: ByteSource) -> Iterator[bytes]:
        """Scan the log; yield each block, whose rows the messages know until the next is asked for."""
        rest = b""
        for fresh in chain([source.head], source.rest()):
            data = rest + fresh
            rest = data[self._scanner.scan(data) :]
            yield data
        self._cut = len(rest)

    @property
    def notes(self) -> tuple[str, ...]:
        """What was taken, what was lost, and what ArduPilot had done to the readings."""
        notes = [self._taken]
        if self._scanner.lost:
            notes.append(f"{self._scanner.lost:,} damaged bytes passed over")
        if self._cut:
            notes.append("the last message is cut off and left out")
        return (*notes, self.correction.in_words())

    @property
    def correction(self) -> VehicleCorrection:
        """What ArduPilot had done to the readings, by the parameters in the log."""
        number = self._number
        if number is None:
            digits = self._message.name[3:]
            number = int(digits) - 1 if digits else 0
        return correction_by(self._scanner.parameters, self._scanner.changed, number)


def correction_by(parameters: Mapping[str, float], changed: set[str], instance: int) -> VehicleCorrection:
    """Return what ArduPilot had done to the readings of an accelerometer, numbered from 0.

    Args:
        parameters: with which the log begins; changed: names of those that change in it.
    """
    word = "" if instance == 0 else str(instance + 1)
    names = [f"INS_ACC{word}{part}_{axis}" for part in ("OFFS", "SCAL") for axis in "XYZ"]
    device = int(parameters.get(f"INS_ACC{word}_ID", 0)) or None
    orientation = int(parameters.get("AHRS_ORIENTATION", 0))
    turn = board_turn(orientation)
    missing = not set(names) <= parameters.keys()
    doubt = ""
    if missing or instance >= INSTANCES:
        doubt = f"the log has no {names[0]}"
    elif turned := changed.intersection([*names, "AHRS_ORIENTATION"]):
        doubt = f"{min(turned)} changes in the log"
    elif turn is None:
        doubt = f"AHRS_ORIENTATION {orientation} has no known rotation"
    if doubt or turn is None:
        return VehicleCorrection("ardupilot", instance, device, doubt=doubt)
    numbers = [parameters[name] for name in names]
    scale = numbers[3:] if all(numbers[3:]) else [1.0] * 3  # a sensor that was never calibrated has none
    return VehicleCorrection(
        "ardupilot",
        instance,
        device,
        (numbers[0], numbers[1], numbers[2]),
        (scale[0], scale[1], scale[2]),
        as_rows(turn),
        parameters.get(f"INS_TCAL{instance + 1}_ENABLE", 0) == 1,
    )
