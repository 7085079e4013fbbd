"""Live streams: lines of text as they arrive from a serial port or an open file, and the readings in them."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from itertools import chain, islice, pairwise
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, OutputError, UsageError
from accelcal_cli.io.lines import LineFilter, find_filter
from accelcal_cli.io.vocabulary import recognise

if TYPE_CHECKING:
    from serial import Serial


LONGEST = 4096
"""Bytes of a line at most: more without a line end is not text."""

PATIENCE = 100
"""Consecutive lines without the wanted numbers after which the stream is refused."""

SHOWN = 60
"""Characters of a line that a message shows."""

FEWEST, EVEN = 6, 4.0
"""Readings that show whether the first number is time, and the ratio of its steps at most."""

FIRST = 24
"""Lines that show whether they are of several kinds."""

_CLOCK = re.compile(r"(?<![\w.:])\d{1,2}:\d\d:\d\d(?:[.,]\d+)?(?:\s*->)?(?![\w:])")
"""The time that a terminal program writes before each line."""

_LEAD = re.compile(r"[^\d\s]*[A-Za-z][^\d]*?(?=[-+.]?\d)")
_BETWEEN = re.compile(r"[\s,;:=|()\[\]{}<>\"']+")


def file_lines(file: BinaryIO) -> Iterator[bytes]:
    """Return the lines of an open file as they arrive."""
    return iter(lambda: file.readline(LONGEST), b"")


def recorded_lines(path: str) -> Iterator[bytes]:
    """Return the lines of a file, the recording of a capture or of any program that prints readings.

    Raises:
        DataError: it cannot be read.
    """
    try:
        with open(path, "rb") as file:
            yield from file_lines(file)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {(error.strerror or str(error)).lower()}") from None


def in_time(readings: Iterable[Float], rate: float) -> Iterator[Float]:
    """Yield readings as a sensor would send them, `rate` a second; none is left out where the reader is slow."""
    start = time.monotonic()
    for number, reading in enumerate(readings):
        wait = start + number / rate - time.monotonic()
        if wait > 0:
            time.sleep(wait)
        yield reading


def copied(lines: Iterable[bytes], path: str) -> Iterator[bytes]:
    """Yield lines and write each to a file, from which they replay; it holds those so far, whatever ends them.

    Raises:
        OutputError: it cannot be written.
    """
    with _refusal_told(path):
        file = open(path, "wb", buffering=0)  # noqa: SIM115  # closed below
    with file:
        for line in lines:
            with _refusal_told(path):
                file.write(line.rstrip(b"\r\n") + b"\n")
            yield line


@contextmanager
def _refusal_told(path: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise OutputError(f"{path}: cannot be written: {(error.strerror or str(error)).lower()}") from None


def port_lines(name: str, baud: int, timeout: float) -> Iterator[bytes]:
    """Open a serial port and return the lines that it sends, from the first whole one on.

    Args:
        name: of the port: /dev/ttyUSB0, COM3.
        baud: its speed, bits per second; timeout: longest silence, s.

    Raises:
        UsageError: pyserial is missing.
        DataError: the port cannot be opened, falls silent, or disappears.
    """
    return _lines(_open(name, baud, timeout), name, timeout)


def _lines(port: Serial, name: str, timeout: float) -> Iterator[bytes]:
    with port:
        rest, started = b"", False
        while True:
            try:
                chunk: bytes = port.read(max(1, port.in_waiting))
            except OSError:
                raise DataError(f"{name}: the port is gone") from None
            if not chunk:
                raise DataError(f"{name}: no data for {timeout:g} s")
            *lines, rest = (rest + chunk).replace(b"\r", b"\n").split(b"\n")
            if len(rest) > LONGEST:
                raise DataError(
                    f"{name}: {LONGEST} bytes without a line end; is --baud {port.baudrate} right?"
                )
            yield from lines if started else lines[1:]
            started = started or bool(lines)


def _open(name: str, baud: int, timeout: float) -> Serial:
    try:
        import serial
    except ImportError:
        raise UsageError("a serial port needs pyserial: python -m pip install pyserial") from None
    try:
        return serial.Serial(name, baud, timeout=timeout)
    except (OSError, ValueError) as error:  # a SerialException is an OSError
        reason = str(error).rpartition("]")[2].strip() or str(error)
        raise DataError(f"{name}: cannot be opened: {reason.lower()}") from None


def readings(
    lines: Iterable[bytes],
    columns: Sequence[int] | None,
    source: str,
    prefix: str | None = None,
    tell: Callable[[str], None] = lambda _: None,
) -> Iterator[Float]:
    """Yield three numbers of each line, shape (3,); lines without them, such as headers, are skipped.

    Where the first lines are of several kinds, those of acceleration are read, as from files.

    Args:
        lines: as they arrive; source: named in messages.
        columns: which numbers, from 0; None for those that their words name, else the first three.
        prefix: what the lines of readings begin with, None to find them by their words.
        tell: is told which kind of lines is taken.

    Raises:
        DataError: line after line without the numbers, or lines of several kinds of which none is known.
    """
    texts = (line.decode("utf-8", errors="replace").strip() for line in lines)
    texts = (text for text in texts if text)
    first = list(islice(texts, FIRST))
    kinds = find_filter(first, source, prefix) if prefix is not None or _are_mixed(first) else None
    if kinds is None and columns is None:
        kinds = _named(first, source)
    named = _axes(kinds) if columns is None else None
    if columns is None and _are_timed(first, kinds):
        columns = range(1, 4)
        tell(f"{source}: the first number of each line taken as time: it increases")
    columns = columns or range(3)
    for note in () if kinds is None else kinds.notes():
        tell(f"{source}: {note}")
    unread = 0
    for text in chain(first, texts):
        if kinds is not None:
            values = kinds.values(text)
            if values is None:
                unread += 1
                _check_unread(unread, source, columns, text)
                continue
            chosen = values if named is None else [values[k] for k in named]
            text = " ".join(value for value in chosen if ":" not in value)
        elif text.startswith("#"):
            continue
        else:
            text = _CLOCK.sub("", text)
        reading = pick(text, columns)
        unread = 0 if reading is not None else unread + 1
        if reading is not None:
            yield reading
        _check_unread(unread, source, columns, text)


def _are_mixed(lines: Sequence[str]) -> bool:
    """Return whether words at their beginning tell lines of several kinds apart, or all seem to be comments."""
    bare = (_CLOCK.sub("", line).lstrip() for line in lines)
    found = [line for line in bare if _LEAD.match(line)]
    leads = {_LEAD.match(line)[0] for line in found}  # type: ignore[index]
    return len(leads) > 1 or (bool(found) and all(line.startswith("#") for line in lines))


def _named(lines: Sequence[str], source: str) -> LineFilter | None:
    """Return the kind of lines whose words name x, y, z, None where there is none."""
    with suppress(DataError):  # then they are read as numbers in a row
        kinds = find_filter(lines, source)
        return kinds if _axes(kinds) else None
    return None


def _are_timed(lines: Sequence[str], kinds: LineFilter | None) -> bool:
    """Return whether the first of four or seven numbers is time: it increases, in steps of about one size."""
    if kinds is not None:
        lines = [" ".join(kinds.values(line) or ()) for line in lines]
    rows = [row for line in lines if (row := numbers(_CLOCK.sub("", line)))]
    steps = [other[0] - one[0] for one, other in pairwise(rows)]
    even = len(rows) >= FEWEST and 0 < max(steps) <= EVEN * min(steps)
    return even and all(len(row) in (4, 7) for row in rows)


def _axes(kinds: LineFilter | None) -> Sequence[int] | None:
    """Return which numbers of a line are acceleration by their names, None where these do not say."""
    if kinds is None or kinds.kind.names is None:
        return None
    roles = recognise(kinds.kind.names)
    families = list((roles.families or roles.described).values())
    return families[0] if len(families) == 1 else None


def _check_unread(unread: int, source: str, columns: Sequence[int], text: str) -> None:
    if unread == PATIENCE:
        raise DataError(
            f"{source}: {PATIENCE} lines in a row without {max(columns) + 1} numbers, as "
            f'"{text[:SHOWN]}"; are --columns, --line and --baud right?'
        )


def pick(line: str, columns: Sequence[int]) -> Float | None:
    """Return three numbers of a line, counted from 0, shape (3,); None when one is missing or not finite."""
    values = numbers(line)
    chosen = [values[column] for column in columns if column < len(values)]
    return np.array(chosen) if len(chosen) == len(columns) and all(map(math.isfinite, chosen)) else None


def numbers(line: str) -> list[float]:
    """Return the numbers of a line in their order, whatever is between them; words are skipped."""
    values = []
    for word in _BETWEEN.split(line):
        with suppress(ValueError):
            values.append(float(word))
    return values
