"""ActiGraph logs, .gt3x: a zip archive, as the maker publishes it (GT3X-File-Format) [actigraph2015].

`info.txt` states rate and serial number. `log.bin` is a chain of records with a checksum each: a second of acceleration
as 12-bit or 16-bit numbers, parameters, events. While the device is idle it writes no acceleration: a gap in time. The
files of old firmware have `activity.bin` instead, the packed numbers alone.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO
from zipfile import BadZipFile, ZipFile

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import LOG_FORMATS, LogFormat, RandomAccess
from accelcal_cli.io.pages import PageClock, fill_times, plural
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts

LOG, OLD, INFO = "log.bin", "activity.bin", "info.txt"
"""Members of the archive."""

PART = 1 << 20
"""Bytes of the records that are decoded at once."""

RECORD, HEAD = 0x1E, 8
"""What a record begins with, and bytes before its payload: mark, kind, time, length of the payload."""

YXZ, EVENT, PARAMETERS, XYZ16, XYZ = 0x00, 0x03, 0x15, 0x1A, 0x1B
"""Kinds of record: acceleration of 12 bits in the order y, x, z; of 16 bits; of 12 bits in the order x, y, z."""

ASLEEP = b"\x08"
"""Payload of the event by which idle sleep mode begins."""

LARGEST = 1 << 12
"""Bytes of the payload of a second of acceleration at most."""

SCALES = {"NEO": 341.0, "CLE": 341.0, "MRA": 341.0, "MOS": 256.0, "TAS": 256.0}
"""Counts per g by the first letters of the serial number, where no parameter states it."""

SCALE_KEY = 0x00370000
"""The parameter ACCEL_SCALE, counts per g."""

TICKS, YEAR_1970 = 10_000_000, 62_135_596_800
"""Ticks of a second, and seconds from the year 1 to 1970."""

_LOCAL = b"PK\x03\x04"
_PAIR = re.compile(r"^([^:\r\n]+):[ \t]*([^\r\n]*)", re.MULTILINE)


@LOG_FORMATS.register("gt3x")
class Gt3x(LogFormat):
    """An ActiGraph log."""

    title = "an ActiGraph log (.gt3x)"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Tell by the names of the first members of a zip archive."""
        if not head.startswith(_LOCAL):
            return False
        names, at = set(), 0
        while at >= 0:
            length = int.from_bytes(head[at + 26 : at + 28], "little")
            names.add(head[at + 30 : at + 30 + length])
            at = head.find(_LOCAL, at + 4)
        return (
            not names.isdisjoint({LOG.encode(), OLD.encode()}) or {b"autorun.inf", b"gt3xplus.ico"} <= names
        )

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:
        """Read info.txt, and the scale from the first parameters.

        Raises:
            DataError: no archive, or one without acceleration. UsageError: another accelerometer than the one there is.
        """
        self._name = source.name
        if accelerometer is not None:
            raise UsageError(
                f'--accelerometer "{accelerometer}": {source.name} has one accelerometer; leave it out'
            )
        self._access = RandomAccess(source, path, ".gt3x")
        self._archive: ZipFile | None = None
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        self.names = ("time", "ax", "ay", "az")
        self.units = ("s", "g", "g", "g")

    def _open(self) -> None:
        try:
            archive = self._archive = ZipFile(self._access.path)
            members = archive.namelist()
            info = dict(_PAIR.findall(archive.read(INFO).decode("utf-8-sig", errors="replace")))
            if not {LOG, OLD} & set(members):
                raise DataError(f"{self._name}: is an ActiGraph log without {LOG}; copy the file anew")
        except (BadZipFile, KeyError, OSError) as problem:
            raise DataError(
                f"{self._name}: is an ActiGraph log whose archive is damaged or ends early; copy the file anew"
            ) from problem
        self._old = LOG not in members
        rate, serial = _number(info.get("Sample Rate", "")), info.get("Serial Number", "").strip()
        if not 1 <= rate <= 10_000:
            raise DataError(f"{self._name}: {INFO} states no sample rate")
        stated = _number(info.get("Acceleration Scale", ""))
        self._scale = stated if stated > 0 else SCALES.get(serial[:3], 256.0)
        self._unstated = not stated > 0
        self._clock = PageClock(rate)
        self._broken, self._asleep, self._late = 0, 0, 0
        start = _number(info.get("Start Date", ""))
        self._start = start / TICKS - YEAR_1970 if start > 0 else 0.0
        low, high = info.get("Acceleration Min", ""), info.get("Acceleration Max", "")
        self.facts = Facts(
            rate=rate,
            start=str(np.datetime64(int(self._start), "s")).replace("T", " ") if start > 0 else "",
            serial=serial,
            range=f"{low} to {high} g" if low and high else "",
            unit="g",
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out."""
        notes = [*self._clock.notes()]
        if self._broken:
            notes.append(f"{plural(self._broken, 'broken record')} left out")
        if self._late:
            notes.append(f"{plural(self._late, 'record')} of a second that was read already left out")
        if self._asleep:
            notes.append(f"idle sleep mode began {self._asleep:,} times")
        if self._clock.gaps:
            longest = f"the longest {self._clock.longest:,.4g} s"
            notes.append(f"acceleration is missing at {plural(self._clock.gaps, 'place')}, {longest}")
        return tuple(notes)

    def close(self) -> None:
        """Close the archive and remove the copy."""
        if self._archive is not None:
            self._archive.close()
        self._access.close()

    def blocks(self) -> Iterator[Float]:
        """Yield the rows of about a megabyte of records after the other."""
        assert self._archive is not None
        with self._archive.open(OLD if self._old else LOG) as file:
            yield from self._packed(file) if self._old else self._records(file)
        self._access.wait()

    def _packed(self, file: IO[bytes]) -> Iterator[Float]:
        """Yield the rows of activity.bin: counts in g, to three decimals as the maker's software writes them."""
        row, rest, rate = 0, b"", self._clock.rate
        while part := _some(file):
            data = rest + part
            whole = len(data) // 9 * 9  # nine bytes are two rows
            last, rest = data[:whole], data[whole:]
            if last:
                numbers = _twelve_bits(np.frombuffer(last, np.uint8).reshape(1, -1))[0]
                yield self._old_rows(numbers, row, rate)
                row += len(numbers)
        if len(rest) >= 5:
            numbers = _twelve_bits(np.frombuffer(rest[:5] + b"\0", np.uint8).reshape(1, -1))[0]
            yield self._old_rows(numbers[:1], row, rate)

    def _old_rows(self, numbers: Int, row: int, rate: float) -> Float:
        time = (row + np.arange(len(numbers))) / rate
        return np.column_stack([time, np.round(numbers[:, [1, 0, 2]] / SCALES["NEO"], 3)])

    def _records(self, file: IO[bytes]) -> Iterator[Float]:
        """Yield the rows of log.bin."""
        rest, last = b"", -1
        while True:
            part = _some(file)
            data = rest + part
            records, end = self._chain(data, final=not part)
            seconds = []
            for record in self._sound(data, records):
                if record[1] > last:
                    seconds.append(record)
                    last = record[1]
                else:
                    self._late += 1
            for run in _runs(seconds):
                yield self._seconds(data, run)
            rest = data[end:]
            if not part:
                return

    def _chain(self, data: bytes, *, final: bool) -> tuple[list[tuple[int, int, int, int]], int]:
        """Return the records of some bytes, (kind, time, place and length of the payload), and where they end."""
        records, at, size = [], 0, len(data)
        unpack, broken = struct.Struct("<BBIH").unpack_from, False
        while at + HEAD < size:
            mark, kind, time, length = unpack(data, at)
            if mark != RECORD:
                broken |= mark != 0  # zeros between records are no fault
                at += 1
                continue
            if at + HEAD + length >= size:
                if not final and length <= LARGEST:
                    break
                at, broken = at + 1, True
                continue
            records.append((kind, time, at + HEAD, length))
            at += HEAD + length + 1
        self._broken += broken
        return records, at if not final else size

    def _sound(
        self, data: bytes, records: list[tuple[int, int, int, int]]
    ) -> list[tuple[int, int, int, int]]:
        """Return the records of acceleration whose checksum is right, and note what the others say."""
        if not records:
            return []
        raw = np.frombuffer(data, np.uint8)
        edges = np.array([(place - HEAD, place + length + 1) for _, _, place, length in records]).ravel()
        total = np.bitwise_xor.reduceat(np.append(raw, 0), edges)[::2]
        sound = (total == 0xFF).tolist()
        self._broken += sound.count(False)
        kept = []
        for record, whole in zip(records, sound, strict=True):
            kind, _, place, length = record
            if not whole:
                continue
            if kind in (YXZ, XYZ16, XYZ):
                if 1 < length <= LARGEST:
                    kept.append(record)
            elif kind == EVENT and data[place : place + length] == ASLEEP:
                self._asleep += 1
            elif kind == PARAMETERS and self._unstated:
                self._take_scale(data[place : place + length])
        return kept

    def _take_scale(self, payload: bytes) -> None:
        for key, value in struct.iter_unpack("<II", payload[: len(payload) // 8 * 8]):
            scale = _ssp(value) if key == SCALE_KEY else 0.0
            if 1.0 <= scale <= 1e6:
                self._scale = scale

    def _seconds(self, data: bytes, run: list[tuple[int, int, int, int]]) -> Float:
        """Return the rows of records of one kind and length, shape (B, 4)."""
        kind, _, _, length = run[0]
        place = np.array([record[2] for record in run])
        raw = np.frombuffer(data, np.uint8)[place[:, None] + np.arange(length)]
        if kind == XYZ16:
            numbers = raw[:, : length // 6 * 6].copy().view("<i2").reshape(len(run), -1, 3)
        else:
            numbers = _twelve_bits(np.pad(raw, ((0, 0), (0, -length % 3))))[:, : length * 2 // 9]
        count = np.full(len(run), numbers.shape[1])
        begin, step = self._clock.steps(np.array([float(r[1]) for r in run]), count, None)
        columns = np.empty((4, len(run), numbers.shape[1]))
        fill_times(columns[0], begin, np.minimum(step, 1.0 / numbers.shape[1]))
        order = (1, 0, 2) if kind == YXZ else (0, 1, 2)
        for k in range(3):
            np.divide(numbers[:, :, order[k]], self._scale, out=columns[1 + k])
        return columns.reshape(4, -1).T


def _runs(seconds: list[tuple[int, int, int, int]]) -> Iterator[list[tuple[int, int, int, int]]]:
    """Cut records of acceleration into runs of one kind and length."""
    run: list[tuple[int, int, int, int]] = []
    for record in seconds:
        if run and (record[0] != run[0][0] or record[3] != run[0][3]):
            yield run
            run = []
        run.append(record)
    if run:
        yield run


def _some(file: IO[bytes]) -> bytes:
    return file.read(PART)


def _twelve_bits(raw: NDArray[np.uint8]) -> Int:
    """Return signed numbers of 12 bits, most significant first, of shape (P, rows, 3) for bytes (P, 3 n).

    What does not fill three numbers at the end is left out.
    """
    b = raw.reshape(len(raw), -1, 3).astype(np.int16)
    numbers = np.empty((len(raw), b.shape[1], 2), np.int16)
    numbers[..., 0] = b[..., 0] << 4 | b[..., 1] >> 4
    numbers[..., 1] = (b[..., 1] & 15) << 8 | b[..., 2]
    signed = ((numbers ^ 0x800) - 0x800).reshape(len(raw), -1)
    return signed[:, : signed.shape[1] // 3 * 3].reshape(len(raw), -1, 3)


def _ssp(value: int) -> float:
    """Return a number with 24 bits of fraction and 8 of exponent, both signed."""
    fraction = (value & 0xFFFFFF ^ 0x800000) - 0x800000
    exponent = (value >> 24 ^ 0x80) - 0x80
    return fraction / float(1 << 23) * 2.0**exponent


def _number(text: str) -> float:
    """Return a number, NaN for none."""
    try:
        return float(text.replace(",", "."))
    except ValueError:
        return float("nan")
