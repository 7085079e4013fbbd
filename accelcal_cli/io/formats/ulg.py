"""PX4 logs (.ulg), by the ULog format that PX4 publishes (docs.px4.io, ULog File Format): messages one after another.

A message has its size, a letter and its bytes. F defines the fields of a topic, A gives a topic of an instance a
number, D is a row of that number, P a parameter, O a dropout. `_UlogScanner` goes from message to message, block after
block, and keeps the places of the rows of accelerometers; numpy takes them out of a block at once. Where messages do
not make sense it looks for the next one that does.

PX4 logs `sensor_combined` after its own correction, and `sensor_accel` before it since version 1.11.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.io.formats.base import (
    ACCELERATION,
    LOG_FORMATS,
    TURNING,
    LogFormat,
    choose_accelerometer,
    cut_out,
)
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.triad import rotation
from accelcal_cli.sensor.vehicle import VehicleCorrection, as_rows, board_turn

MAGIC = b"ULog\x01\x12\x35"
HEADER = 16
"""Bytes before the first message: magic, version, time of the start."""

KINDS = frozenset(b"BFIMPQARLCSO")
"""Letters of messages other than rows."""

SYNC = b"\x08\x00S\x2f\x73\x13\x20\x25\x0c\xbb\x12"
DATA, FORMAT, ADDED, PARAMETER, DROPOUT, INFO, FLAGS = b"DFAPOIB"

NUMPY = {
    **{f"int{n}_t": f"<i{n // 8}" for n in (8, 16, 32, 64)},
    **{f"uint{n}_t": f"<u{n // 8}" for n in (8, 16, 32, 64)},
    "float": "<f4",
    "double": "<f8",
    "bool": "<u1",
    "char": "<u1",
}
"""Types of fields as numpy calls them."""

COMBINED, ACCEL, SELECTION = "sensor_combined", "sensor_accel", "sensor_selection"
WATCHED = (COMBINED, ACCEL, SELECTION)
"""Topics whose rows are looked at: those of accelerometers, and that which says what is combined."""

OF_DRIVER = {"integral_dt", "x_raw", "x_integral", "scaling"}
"""Fields of `sensor_accel` of versions before 1.11, whose drivers corrected it."""

CHAIN = 4
"""Messages in a row that are none by chance."""

LARGEST = 1 << 16
"""Bytes of a row at most: the size of a message has 16 bits."""

DEEPEST = 8
"""Topics within topics."""

INSTANCES = 4
"""Accelerometers that parameters name."""


@frozen()
class _Place:
    """A field of a topic: where it stands in a row, its type by numpy, how many numbers it has."""

    offset: int
    kind: str
    count: int = 1

    @property
    def end(self) -> int:
        return self.offset + np.dtype(self.kind).itemsize * self.count


@dataclass
class _Topic:
    """A topic of one instance, and where its rows begin in the block that was scanned last.

    `size` is that of a row; one may lack the padding at its end, so that it has `least` bytes.
    """

    name: str
    instance: int
    places: dict[str, _Place]
    size: int
    least: int
    rows: list[int] = field(default_factory=list)

    @property
    def called(self) -> tuple[str, int, int]:
        """What makes it another topic."""
        return self.name, self.instance, self.size

    def cells(self, data: bytes) -> np.ndarray:
        """Return the bytes of all rows of the block, shape (B, least)."""
        return cut_out(data, self.rows, self.least)

    def numbers(self, cells: np.ndarray, name: str, at: int = 0) -> np.ndarray:
        """Return a number of each row, shape (B,), by the rows' bytes: of a field the one at a place."""
        place = self.places[name]
        width = np.dtype(place.kind).itemsize
        start = place.offset + at * width
        return np.ascontiguousarray(cells[:, start : start + width]).view(place.kind)[:, 0]


class _UlogScanner:
    """Goes through the messages of a log, and keeps what they say.

    Attributes:
        topics: by number; parameters: with which the log begins; changed: those that change in it.
        dropouts: durations, s; lost: bytes that made no sense; info: texts by name.
    """

    def __init__(self) -> None:
        self.formats: dict[str, str] = {}
        self.topics: dict[int, _Topic] = {}
        self.parameters: dict[str, float] = {}
        self.changed: set[str] = set()
        self.info: dict[str, str] = {}
        self.dropouts: list[float] = []
        self.lost = 0
        self._lost_way = False

    def scan(self, data: bytes) -> int:
        """Find the messages of a block; return where the first one begins that is not whole."""
        topics, end = self.topics, len(data)
        for topic in topics.values():
            topic.rows.clear()
        at, last = self._next_message(data, 0) if self._lost_way else 0, None
        while at + 5 <= end and not self._lost_way:
            size, kind = data[at] | data[at + 1] << 8, data[at + 2]
            stop = at + 3 + size
            if kind == DATA:
                row = topics.get(data[at + 3] | data[at + 4] << 8)
                if row is not None:
                    sound = row.least <= size - 2 <= row.size
                else:  # of a topic whose number was lost
                    sound = size > 2 and (stop + 3 > end or data[stop + 2] in KINDS or data[stop + 2] == DATA)
            else:
                row, sound = None, kind in KINDS and size > 0
            if sound and stop > end:
                break
            if row is not None and sound:
                row.rows.append(at + 5)
            elif sound and not self._take(kind, data[at + 3 : stop]):
                self.lost += stop - at
            if not sound:
                if last is not None:  # a row that no message follows is damaged, too
                    last.rows.pop()
                row, stop = None, self._next_message(data, at + 1)
            at, last = stop, row
        return at

    def _next_message(self, data: bytes, start: int) -> int:
        """Return where a message begins that makes sense beyond doubt, or where to look on in the next block."""
        needles = {SYNC}
        for number, topic in self.topics.items():
            if topic.name in WATCHED:
                needles |= {struct.pack("<HBH", s + 2, DATA, number) for s in (topic.least, topic.size)}
        found = [at for needle in needles if (at := data.find(needle, start)) >= 0]
        if len(needles) == 1:  # among the definitions
            found += islice((at for at in range(start, len(data)) if self._is_chain(data, at)), 1)
        place = min(found, default=max(start, len(data) - len(SYNC) + 1))
        self.lost += place - start + (not self._lost_way)
        self._lost_way = not found
        return place

    @staticmethod
    def _is_chain(data: bytes, at: int) -> bool:
        """Return whether several messages follow one another from a place on."""
        for _ in range(CHAIN):
            if at + 3 > len(data) or data[at + 2] not in KINDS or not (size := data[at] | data[at + 1] << 8):
                return False
            at += 3 + size
        return True

    def _take(self, kind: int, body: bytes) -> bool:
        """Take what a message says; return False for one that makes no sense."""
        try:
            if kind == FORMAT:
                name, _, fields = body.decode().partition(":")
                self.formats[name] = fields
            elif kind == ADDED:
                self._add(body)
            elif kind == PARAMETER:
                self._note_parameter(body)
            elif kind == DROPOUT:
                self.dropouts.append(struct.unpack("<H", body)[0] / 1000.0)
            elif kind == INFO:
                key, value = body[1 : 1 + body[0]].decode(), body[1 + body[0] :]
                self.info[key.split(" ")[-1]] = value.decode(errors="replace") if "char" in key else ""
        except (ValueError, KeyError, IndexError, struct.error):
            return False
        return True

    def _add(self, body: bytes) -> None:
        (number,), name = struct.unpack("<H", body[1:3]), body[3:].decode()
        places, size = self._layout(name)
        least = max(place.end for label, place in places.items() if not label.startswith("_padding"))
        topic = _Topic(name, body[0], places, size, least)
        if number not in self.topics or self.topics[number].called != topic.called:
            self.topics[number] = topic

    def _layout(self, name: str, depth: int = 0) -> tuple[dict[str, _Place], int]:
        """Return the fields of a topic, and the size of a row."""
        places: dict[str, _Place] = {}
        end = 0
        for text in filter(None, self.formats[name].split(";")):
            kind, label = text.split(" ")
            kind, _, count = kind.partition("[")
            number = int(count.rstrip("]") or 1)
            if kind in NUMPY:
                places[label] = _Place(end, NUMPY[kind], number)
            elif depth >= DEEPEST:
                raise ValueError(name)
            else:
                places[label] = _Place(end, "<u1", self._layout(kind, depth + 1)[1] * number)
            end = places[label].end
            if not 0 < end < LARGEST:
                raise ValueError(name)
        return places, end

    def _note_parameter(self, body: bytes) -> None:
        kind, name = body[1 : 1 + body[0]].decode().split(" ")
        (value,) = struct.unpack({"float": "<f", "int32_t": "<i"}[kind], body[1 + body[0] :])
        if name in self.parameters and self.parameters[name] != value:
            self.changed.add(name)
        self.parameters.setdefault(name, value)


@LOG_FORMATS.register("ulg")
class Px4Log(LogFormat):
    """A PX4 log."""

    title = "a PX4 log (.ulg)"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether it begins with the magic of ULog."""
        return head.startswith(MAGIC)

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:  # noqa: ARG002
        """Scan the head, which holds the definitions and the first rows, and choose the topic."""
        self._scanner, self._cut = _UlogScanner(), 0
        self._origin: int | None = None
        self._devices: set[int] = set()
        self._warm: Float = np.empty((0, 2))  # time and temperature that were logged last
        self._scanned = self._scan(source)
        self._first = next(self._scanned, b"")
        able = {self._called(topic): topic for topic in self._accelerometers()}
        if not able:
            raise DataError(
                f"{source.name}: is a PX4 log without {COMBINED} or {ACCEL}; log them (SDLOG_PROFILE) and record again"
            )
        chosen = choose_accelerometer(source.name, sorted(able), accelerometer, COMBINED)
        self._topic = able[chosen]
        others = ", ".join(name for name in sorted(able) if name != chosen)
        self._taken = f"{chosen} taken" + f"; --accelerometer takes {others}" * bool(others)
        self._name_columns()
        self.facts = Facts(serial=self._scanner.info.get("sys_uuid", ""), unit="m/s^2")

    def _accelerometers(self) -> list[_Topic]:
        """Return the topics that have time and acceleration."""
        needed = {COMBINED: {"timestamp", "accelerometer_m_s2"}, ACCEL: {"timestamp", "x", "y", "z"}}
        topics = self._scanner.topics.values()
        return [topic for topic in topics if needed.get(topic.name, {""}) <= topic.places.keys()]

    def _called(self, topic: _Topic) -> str:
        single = sum(other.name == topic.name for other in self._accelerometers()) == 1
        return topic.name if single else f"{topic.name}[{topic.instance}]"

    def _name_columns(self) -> None:
        """Name the columns, and the fields that they are taken from."""
        combined = self._topic.name == COMBINED
        self._columns = [("accelerometer_m_s2", k) if combined else ("xyz"[k], 0) for k in range(3)]
        names, units = ["time", *ACCELERATION], ["s", *["m/s^2"] * 3]
        if combined and "gyro_rad" in self._topic.places:
            self._columns += [("gyro_rad", k) for k in range(3)]
            names, units = [*names, *TURNING], [*units, *["rad/s"] * 3]
        own = "temperature" in self._topic.places
        self._columns += [("temperature", 0)] * own
        self._thermometers = [
            topic
            for topic in (self._accelerometers() if combined else [])
            if topic.name == ACCEL and {"temperature", "device_id"} <= topic.places.keys()
        ]
        if own or self._thermometers:
            names, units = [*names, "temperature"], [*units, "degC"]
        self.names, self.units = tuple(names), tuple(units)

    def blocks(self) -> Iterator[Float]:
        """Yield time, acceleration, turning rate and temperature of the topic's rows."""
        for data in chain([self._first], self._scanned):
            self._watch(data)
            cells = self._topic.cells(data)
            times: Int = self._topic.numbers(cells, "timestamp").astype(np.int64)
            if len(times) and self._origin is None:
                self._origin = int(times[0])
            columns = [self._topic.numbers(cells, name, at) for name, at in self._columns]
            if self._thermometers:
                columns.append(self._temperature(data, times))
            yield np.column_stack([(times - (self._origin or 0)) / 1e6, *columns])

    def _temperature(self, data: bytes, times: Int) -> Float:
        """Return the temperature of the combined device at some times, (B,): the last before them, NaN without one."""
        device, known = self._device(), [self._warm]
        for topic in self._thermometers:
            cells = topic.cells(data)
            parts = [topic.numbers(cells, name).astype(float) for name in ("timestamp", "temperature")]
            known.append(np.column_stack(parts)[topic.numbers(cells, "device_id") == device])
        rows = np.concatenate(known)
        rows = rows[np.argsort(rows[:, 0], kind="stable")]
        self._warm = rows[-1:]
        return np.append(np.nan, rows[:, 1])[np.searchsorted(rows[:, 0], times, side="right")]

    def _scan(self, source: ByteSource) -> Iterator[bytes]:
        """Scan the log; yield each block, whose rows the scanner's topics know until the next is asked for.

        A log may be continued behind a message that power-off cut: its first message says where.
        """
        first = source.head[HEADER : HEADER + 43]
        flags = len(first) == 43 and first[2] == FLAGS
        resumed = [place for place in struct.unpack("<3Q", first[19:43]) if place > HEADER] if flags else []
        rest, position = b"", 0
        for fresh in chain([source.head], source.rest()):
            stops = [place - position for place in resumed if 0 < place - position < len(fresh)]
            for start, stop in zip([0, *stops], [*stops, len(fresh)], strict=True):
                data = fresh[max(start, HEADER) if position == 0 else start : stop]
                data = data if position + start in resumed else rest + data
                rest = data[self._scanner.scan(data) :]
                yield data
            position += len(fresh)
        self._cut = len(rest)

    def _watch(self, data: bytes) -> None:
        """Note the device whose rows these are: of the topic itself, or what was selected to be combined."""
        field_name = "device_id" if self._topic.name == ACCEL else "accel_device_id"
        for topic in self._scanner.topics.values():
            own = topic is self._topic if self._topic.name == ACCEL else topic.name == SELECTION
            if own and field_name in topic.places and topic.rows:
                ids = topic.numbers(topic.cells(data), field_name)
                self._devices |= {int(number) for number in np.unique(ids)[:INSTANCES] if number}

    @property
    def notes(self) -> tuple[str, ...]:
        """What was taken, what was lost, and what PX4 had done to the readings."""
        notes, scanner = [self._taken], self._scanner
        if scanner.dropouts:
            total = sum(scanner.dropouts)
            plural = "s" * (len(scanner.dropouts) != 1)
            notes.append(
                f"{len(scanner.dropouts)} dropout{plural} of {total:.3g} s in total: the logger fell behind"
            )
        if scanner.lost:
            notes.append(f"{scanner.lost:,} damaged bytes passed over")
        if self._cut:
            notes.append("the last message is cut off and left out")
        return (*notes, self.correction.in_words())

    @property
    def correction(self) -> VehicleCorrection:
        """What PX4 had done to the readings, by the parameters in the log."""
        parameters, topic = self._scanner.parameters, self._topic
        device = self._device()
        known = {int(parameters.get(f"CAL_ACC{n}_ID", 0)): n for n in reversed(range(INSTANCES))}
        number = topic.instance if device is None else known.get(device, topic.instance)
        if topic.name == ACCEL and not OF_DRIVER & topic.places.keys():
            return VehicleCorrection("px4", number, device)
        names = [f"CAL_ACC{number}_{axis}{part}" for part in ("OFF", "SCALE") for axis in "XYZ"]
        turn = np.eye(3) if topic.name == ACCEL else self._turn(number)
        if (doubt := self._doubt(names, turn)) or turn is None:
            return VehicleCorrection("px4", number, device, doubt=doubt)
        numbers = [float("SCALE" in name) for name in names]
        if device in known:  # others have not been calibrated
            numbers = [parameters.get(name, value) for name, value in zip(names, numbers, strict=True)]
        offset, scale = (numbers[0], numbers[1], numbers[2]), (numbers[3], numbers[4], numbers[5])
        thermal = parameters.get("TC_A_ENABLE", 0) == 1
        return VehicleCorrection("px4", number, device, offset, scale, as_rows(turn), thermal)

    def _device(self) -> int | None:
        """Return the device id of the accelerometer, None where it is not known to be one."""
        parameters = self._scanner.parameters
        if self._topic.name == COMBINED and not self._devices:
            return int(parameters.get("CAL_ACC_PRIME", 0) or parameters.get("CAL_ACC0_ID", 0)) or None
        return next(iter(self._devices)) if len(self._devices) == 1 else None

    def _turn(self, number: int) -> Float | None:
        """Return the turn of the accelerometer: its own where it is external, else that of the board."""
        parameters = self._scanner.parameters
        own = int(parameters.get(f"CAL_ACC{number}_ROT", -1))
        if own >= 0:
            return board_turn(own)
        board = board_turn(int(parameters.get("SENS_BOARD_ROT", 0)))
        offsets = [parameters.get(f"SENS_BOARD_{axis}_OFF", 0.0) for axis in "XYZ"]
        return None if board is None else rotation(*offsets) @ board

    def _doubt(self, names: list[str], turn: Float | None) -> str:
        """Return why the correction is not known, "" where it is."""
        scanner = self._scanner
        if not any(name.startswith("CAL_ACC") for name in scanner.parameters):
            return "the log has no such parameters"
        if self._device() is None:
            return "several accelerometers were selected in turn" if self._devices else "no device is named"
        turned = (name for name in scanner.changed if name.startswith("SENS_BOARD_"))
        if changed := [*turned, *scanner.changed.intersection(names)]:
            return f"{changed[0]} changes in the log"
        return "the rotation has no known number" if turn is None else ""
