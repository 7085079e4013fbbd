"""GENEActiv logs, .bin: text, as the maker's operating instructions say, "Decoding .bin files" [geneactiv2012].

Lines of a header with the gain and the offset of each axis, then pages of 300 rows: nine lines, with the time and the
temperature of the page, and one of 12 hexadecimal digits a row: three numbers of 12 bits, 10 bits of light, the button.
"""

from __future__ import annotations

import re
from binascii import Error, unhexlify
from collections.abc import Iterator
from datetime import datetime
from itertools import chain
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import LOG_FORMATS, LogFormat
from accelcal_cli.io.pages import PageClock, fill_times, plural
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.io.vocabulary import Facts

PAGE = b"Recorded Data"
"""What a page begins with."""

ROWS, DIGITS = 300, 12
"""Rows of a page, and hexadecimal digits of a row."""

BATCH = 256
"""Pages that are decoded at once."""

LONGEST = 1 << 16
"""Bytes of a page at most."""

NAMED = 5
"""Broken pages that a note names at most."""

_TIME = re.compile(rb"Page Time:(\d{4}-\d\d-\d\d \d\d:\d\d:\d\d):(\d{3})")
_DEGREES = re.compile(rb"Temperature:([-+]?[\d.,]+)")
_RATE = re.compile(rb"Measurement Frequency:\s*([\d.,]+)")
_AXIS = re.compile(rb"([xyz]) (gain|offset):\s*(-?\d+)")
_PAGES = re.compile(rb"Number of Pages:\s*(\d+)")
_SERIAL = re.compile(rb"Device Unique Serial Code:\s*(\S+)")
_RANGE = re.compile(rb"Accelerometer Range:\s*([^\r\n]+)")


@LOG_FORMATS.register("geneactiv")
class GeneActiv(LogFormat):
    """A GENEActiv log."""

    title = "a GENEActiv log (.bin)"

    @classmethod
    def recognises(cls, head: bytes) -> bool:
        """Tell by the first lines, and by the gain of an axis."""
        return head.startswith(b"Device Identity") and b"\nx gain:" in head[:8192]

    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:  # noqa: ARG002
        """Read the header.

        Raises:
            DataError: no gain, no offset or no rate, or no page. UsageError: another accelerometer than its only one.
        """
        self._name = source.name
        if accelerometer is not None:
            raise UsageError(
                f'--accelerometer "{accelerometer}": {source.name} has one accelerometer; leave it out'
            )
        top = source.head.find(PAGE)
        header = source.head[: max(top, 0)]
        stated = {(axis, what): int(number) for axis, what, number in _AXIS.findall(header)}
        missing = [
            f"{a} {w}" for a in "xyz" for w in ("gain", "offset") if (a.encode(), w.encode()) not in stated
        ]
        rate = _RATE.search(source.head)
        if top < 0 or missing or rate is None or not _number(rate[1]) > 0:
            what = "page of data" if top < 0 else ", ".join(missing) or "measurement frequency"
            raise DataError(f"{self._name}: is a GENEActiv log without {what}; copy the file anew")
        self._gain = [float(stated[a, b"gain"]) for a in (b"x", b"y", b"z")]
        self._offset = [float(stated[a, b"offset"]) for a in (b"x", b"y", b"z")]
        if not all(self._gain):
            raise DataError(
                f"{self._name}: states a gain of 0 for an axis; numbers other than 0 were expected"
            )
        self._clock = PageClock(_number(rate[1]))
        pages = _PAGES.search(header)
        self._stated = 0 if pages is None else int(pages[1])
        self._pages = _pages(chain([source.head[top:]], source.rest()))
        self._read, self._broken, self._short, self._named = 0, 0, 0, list[int]()
        self.names = ("time", "ax", "ay", "az", "temperature")
        self.units = ("s", "g", "g", "g", "degC")
        first, serial, span = (pattern.search(source.head) for pattern in (_TIME, _SERIAL, _RANGE))
        self.facts = Facts(
            rate=self._clock.rate,
            start="" if first is None else first[1].decode(),
            serial="" if serial is None else serial[1].decode(errors="replace"),
            range="" if span is None else f"{span[1].decode(errors='replace').strip()} g",
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
                f"{plural(self._broken, 'broken page')} left out: number {shown}{more} of {self._read:,}"
            )
        if self._read < self._stated:
            notes.append(f"the file is cut: it has {self._read:,} of {self._stated:,} pages")
        if self._clock.gaps:
            longest = f"the longest {self._clock.longest:,.4g} s"
            notes.append(f"pages are missing at {plural(self._clock.gaps, 'place')}, {longest}")
        return tuple(notes)

    def blocks(self) -> Iterator[Float]:
        """Yield the rows of some hundred pages after the other."""
        held: list[_Page] = []
        for page in self._pages:
            self._read += 1
            parsed = _parse(page, self._clock.rate)
            if parsed is None:
                self._broken += 1
                self._named += [self._read] * (len(self._named) < NAMED)
                continue
            if len(held) >= BATCH or (held and parsed.rows != held[0].rows):
                yield self._rows(held, parsed.start)
                held = []
            held.append(parsed)
        if held:
            yield self._rows(held, None)

    def _rows(self, pages: list[_Page], following: float | None) -> Float:
        """Return the rows of pages that have the same number of them, shape (B, 5)."""
        rows = pages[0].rows
        start = np.array([page.start for page in pages])
        begin, step = self._clock.steps(start, np.full(len(pages), rows), following)
        columns = np.empty((5, len(pages), rows))
        fill_times(columns[0], begin, step)
        raw = np.frombuffer(b"".join(page.samples for page in pages), np.uint8).reshape(-1, DIGITS // 2)
        b = raw.T.astype(np.int16)
        numbers = (b[0] << 4 | b[1] >> 4, (b[1] & 15) << 8 | b[2], b[3] << 4 | b[4] >> 4)
        for k, number in enumerate(numbers):
            signed = (number ^ 0x800) - 0x800
            np.multiply(signed.reshape(len(pages), rows), 100.0, out=columns[1 + k])
            columns[1 + k] -= self._offset[k]
            columns[1 + k] /= self._gain[k]
        columns[4] = np.array([page.degrees for page in pages])[:, None]
        return columns.reshape(5, -1).T


class _Page:
    """A page: time of its first row, s since 1970, temperature, number of rows, and six bytes for each."""

    __slots__ = ("degrees", "rows", "samples", "start")

    def __init__(self, start: float, degrees: float, samples: bytes) -> None:
        self.start, self.degrees, self.samples = start, degrees, samples
        self.rows = len(samples) // (DIGITS // 2)


def _parse(page: bytes, rate: float) -> _Page | None:
    """Return a page of that rate, None for one that is broken or holds no row."""
    lines = page.split(b"\n", 9)
    if len(lines) < 10:
        return None
    header = b"\n".join(lines[:9])
    time, degrees, own = (pattern.search(header) for pattern in (_TIME, _DEGREES, _RATE))
    digits = lines[9].strip()
    if time is None or own is None or _number(own[1]) != rate or not digits:
        return None
    try:
        samples = unhexlify(digits)
        start = (datetime.fromisoformat(time[1].decode()) - EPOCH).total_seconds() + int(time[2]) / 1000.0
    except (Error, ValueError):
        return None
    if len(samples) % (DIGITS // 2) or len(samples) > ROWS * DIGITS // 2:
        return None
    return _Page(start, np.nan if degrees is None else _number(degrees[1]), samples)


EPOCH = datetime(1970, 1, 1)
"""Where times count from; pages state local time."""


def _number(text: bytes) -> float:
    """Return a number that may have a decimal comma, NaN for none."""
    try:
        return float(text.replace(b",", b"."))
    except ValueError:
        return np.nan


def _pages(parts: Iterator[bytes]) -> Iterator[bytes]:
    """Cut bytes, which begin with a page, into pages."""
    rest = b""
    for part in parts:
        pages = (rest + part).split(PAGE)
        rest = PAGE + pages.pop()[-LONGEST:]
        yield from pages[1:]
    yield rest.removeprefix(PAGE)
