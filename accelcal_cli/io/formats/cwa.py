"""Axivity logs, .cwa: AX3 and AX6, as Open Movement publishes the format (Docs/ax3/cwa.h) [openmovement2022].

A header of 1024 bytes, then blocks of 512: acceleration packed, three times 10 bits with a common exponent, or as
16-bit numbers, with the gyroscope of an AX6 before it. Each block has a time stamp, the temperature, and a sum of its
words that must be zero: a block whose sum is not is left out. Blocks are decoded thousands at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import LOG_FORMATS, LogFormat
from accelcal_cli.io.pages import PageClock, fill_times, plural
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts

HEADER, BLOCK = 1024, 512
"""Bytes of the header, and of a block."""

BATCH = 2048
"""Blocks that are decoded at once, a quarter of a million rows."""

PACKED, WIDE = 0, 2
"""How a block is packed: 10 bits with an exponent, or 16 bits."""

PACKED_UNIT, TURN_UNIT = 1.0 / 256.0, 1.0 / 32768.0
"""g for 1 in packed numbers; part of the range of the gyroscope for 1."""

DEGREE, ZERO_DEGREES = 75.0 / 256.0, -50.0
"""Degrees Celsius: temperature = DEGREE * raw + ZERO_DEGREES."""

NAMED = 5
"""Broken blocks that a note names at most."""

LAYOUT = np.dtype(
    [
        ("kind", "<u2"),
        ("length", "<u2"),
        ("fraction", "<u2"),
        ("session", "<u4"),
        ("sequence", "<u4"),
        ("stamp", "<u4"),
        ("light", "<u2"),
        ("temperature", "<u2"),
        ("events", "u1"),
        ("battery", "u1"),
        ("rate", "u1"),
        ("packing", "u1"),
        ("offset", "<i2"),
        ("count", "<u2"),
        ("samples", "V480"),
        ("checksum", "<u2"),
    ]
)
"""A block of data; `packing`: number of axes in the upper half, PACKED or WIDE in the lower."""

DATA, EMPTY = 0x5841, 0xFFFF
"""Kinds of block: "AX", and memory that was never written."""

Blocks = NDArray[np.void]


@LOG_FORMATS.register("cwa")
class Cwa(LogFormat):
    """An Axivity log."""

    title = "an Axivity log (.cwa)"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Tell by "MD" and the length of the header."""
        return head.startswith(b"MD\xfc\x03")

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:  # noqa: ARG002
        """Read the header, and what is measured from the first sound block.

        Raises:
            DataError: no block of acceleration. UsageError: another accelerometer than the one there is.
        """
        self._name, self._source = source.name, source
        if accelerometer is not None:
            raise UsageError(
                f'--accelerometer "{accelerometer}": {source.name} has one accelerometer; leave it out'
            )
        self._cut = 0
        self._batches = self._cut_up(chain([source.head[HEADER:]], source.rest()))
        self._read, self._broken, self._others, self._named = 0, 0, 0, list[int]()
        self._first = self._sound(next(self._batches, np.empty(0, LAYOUT)))
        while not len(self._first) and (batch := next(self._batches, None)) is not None:
            self._first = self._sound(batch)
        if not len(self._first):
            raise DataError(
                f"{self._name}: is an Axivity log without a sound block of data; copy the file anew"
            )
        first = self._first[0]
        self._code, self._axes = int(first["packing"]), int(first["packing"]) >> 4
        if (self._code & 15 not in (PACKED, WIDE)) or self._axes not in (3, 6, 9):
            raise DataError(
                f"{self._name}: its blocks have {self._axes} axes, packed as {self._code & 15}; 3, 6 or 9 axes and "
                f"packing {PACKED} or {WIDE} were expected"
            )
        rate = _rate(int(first["rate"]))
        self._clock = PageClock(rate)
        gyro = ("gx", "gy", "gz") if self._axes > 3 else ()
        self.names = ("time", "ax", "ay", "az", *gyro, "temperature")
        self.units = ("s", "g", "g", "g", *("deg/s" for _ in gyro), "degC")
        self.facts = Facts(
            rate=rate,
            start=_written(_seconds(first["stamp"][None])[0]),
            serial=_serial(source.head),
            range=f"+-{16 >> (int(first['rate']) >> 6)} g",
            unit="g",
        )

    @property
    def notes(self) -> tuple[str, ...]:
        """What was left out."""
        notes = [*self._clock.notes()]
        if self._broken:
            shown = ", ".join(f"{number:,}" for number in self._named)
            more = ", ..." if self._broken > len(self._named) else ""
            notes.append(
                f"{plural(self._broken, 'broken block')} left out: number {shown}{more} of {self._read:,}"
            )
        if self._others:
            notes.append(f"{plural(self._others, 'block')} of another rate or packing left out")
        if self._cut:
            notes.append(f"the file is cut: {plural(self._cut, 'byte')} at its end are no whole block")
        if self._clock.gaps:
            longest = f"the longest {self._clock.longest:,.4g} s"
            notes.append(f"blocks are missing at {plural(self._clock.gaps, 'place')}, {longest}")
        return tuple(notes)

    def blocks(self) -> Iterator[Float]:
        """Yield the rows of some thousand blocks after the other."""
        held = self._first
        for batch in chain(self._batches, [None]):
            sound = None if batch is None else self._sound(batch)
            if sound is not None and not len(sound):
                continue
            alike = (held["packing"] == self._code) & (held["rate"] & 15 == self._first["rate"][0] & 15)
            alike &= (held["count"] > 0) & (held["count"] <= self._most)
            self._others += int(np.count_nonzero(~alike))
            held = held if alike.all() else held[alike]
            if len(held):
                yield self._rows(held, None if sound is None else float(self._starts(sound[:1])[0]))
            held = held[:0] if sound is None else sound

    def _cut_up(self, parts: Iterator[bytes]) -> Iterator[Blocks]:
        """Cut bytes into batches of blocks; what is left at the end is no block."""
        rest = b""
        for part in parts:
            data = rest + part if rest else part
            whole = len(data) // BLOCK * BLOCK
            blocks = np.frombuffer(data, LAYOUT, whole // BLOCK)
            for first in range(0, len(blocks), BATCH):
                yield blocks[first : first + BATCH]
            rest = data[whole:]
        self._cut = len(rest)

    @property
    def _most(self) -> int:
        """Rows of a block at most."""
        return 120 if self._code & 15 == PACKED else 480 // (2 * self._axes)

    def close(self) -> None:
        """Nothing is held besides the source."""

    def _sound(self, batch: Blocks) -> Blocks:
        """Return the blocks of data that are whole, and count the others."""
        words = np.ascontiguousarray(batch).view("<u2").reshape(-1, BLOCK // 2)
        whole = (batch["kind"] == DATA) & (batch["length"] == BLOCK - 4)
        whole &= np.add.reduce(words, axis=1, dtype=np.uint16) == 0
        bad = np.flatnonzero(~whole & (batch["kind"] != EMPTY))
        if len(bad):
            self._broken += len(bad)
            self._named += (self._read + bad[: NAMED - len(self._named)] + 1).tolist()
        self._read += len(batch)
        return batch if whole.all() else batch[whole]

    def _starts(self, held: Blocks) -> Float:
        """Return the time of the first row of blocks, s since 1970 as local time, NaN where it is unknown, shape (P,).

        The stamp is that of the row `offset`. With its upper bit `fraction` is that of a second, in 1/32768; `offset`
        was then moved to the row nearest to the whole second, which is undone.
        """
        fine = held["fraction"] >> 15 != 0
        fraction = np.where(fine, held["fraction"] & 0x7FFF, 0) / 32768.0
        rate = self._clock.rate
        offset = held["offset"] + np.floor(fraction * rate)
        return _seconds(held["stamp"]) + fraction - offset / rate

    def _rows(self, held: Blocks, following: float | None) -> Float:
        """Return the rows of blocks, shape (B, k)."""
        count = held["count"].astype(np.intp)
        begin, step = self._clock.steps(self._starts(held), count, following)
        width = int(count.max())
        columns = np.empty((len(self.names), len(held), width))
        fill_times(columns[0], begin, step)
        samples = held["samples"]
        if self._code & 15 == PACKED:
            _unpack(samples, columns[1:4])
        else:
            numbers = np.ascontiguousarray(samples).view("<i2").reshape(len(held), -1)
            numbers = numbers[:, : width * self._axes]
            axes = [numbers[:, k :: self._axes] for k in range(self._axes)]
            unit = (2.0 ** -(8.0 + (held["light"] >> 13)))[:, None]
            at = 0 if self._axes == 3 else 3
            for k in range(3):
                np.multiply(axes[at + k], unit, out=columns[1 + k])
            if self._axes > 3:
                turn = (8000.0 / (1 << ((held["light"] >> 10) & 7)) * TURN_UNIT)[:, None]
                for k in range(3):
                    np.multiply(axes[k], turn, out=columns[4 + k])
        columns[-1] = (DEGREE * (held["temperature"] & 0x3FF) + ZERO_DEGREES)[:, None]
        flat = columns.reshape(len(self.names), -1)
        if (count < width).any():
            flat = flat[:, (np.arange(width) < count[:, None]).ravel()]
        return flat.T


def _unpack(samples: NDArray[np.void], out: Float) -> None:
    """Fill `out`, shape (3, P, rows), with packed samples in g: eezzzzzz zzzzyyyy yyyyyyxx xxxxxxxx, e the exponent."""
    bits = np.ascontiguousarray(samples).view("<u4").reshape(len(samples), -1)[:, : out.shape[2]]
    exponent = bits >> 30
    even = not exponent.any()  # below 2 g
    unit = None if even else np.ldexp(PACKED_UNIT, exponent.astype(np.int32))
    for k, shift in enumerate((22, 12, 2)):
        signed = (bits << shift).view(np.int32) >> 22
        np.multiply(signed, PACKED_UNIT if unit is None else unit, out=out[k])


def _rate(code: int) -> float:
    """Return the nominal rate, Hz, of a code of rate and range."""
    return 3200.0 / (1 << (15 - (code & 15)))


def _seconds(stamp: NDArray[np.uint32]) -> Float:
    """Return packed time stamps as seconds since 1970, NaN where they are no time, shape (P,)."""
    stamp = stamp.astype(np.int64)
    month, day = (stamp >> 22) & 15, (stamp >> 17) & 31
    clock = ((stamp >> 12) & 31) * 3600 + ((stamp >> 6) & 63) * 60 + (stamp & 63)
    months = ((stamp >> 26) + 30) * 12 + month - 1
    days = months.astype("datetime64[M]").astype("datetime64[D]").astype(np.int64) + day - 1
    known: Bool = (month >= 1) & (month <= 12) & (day >= 1)
    return np.where(known, days * 86400.0 + clock, np.nan)


def _written(seconds: float) -> str:
    """Return a time as text, "" where it is unknown."""
    return "" if np.isnan(seconds) else str(np.datetime64(int(seconds), "s")).replace("T", " ")


def _serial(header: bytes) -> str:
    """Return the number of the device; its upper half is empty on old ones."""
    lower, upper = int.from_bytes(header[5:7], "little"), int.from_bytes(header[11:13], "little")
    return str(lower | (0 if upper == 0xFFFF else upper << 16))
