"""What every native log format is, how one is found, and how its rows become a table like any other.

A format is one file: a class derived from `LogFormat` and entered in `LOG_FORMATS`. `recognise` asks the formats by the
first bytes of an input; `NativeTable` makes an `InputTable` of the one that knows them, so that calibrations and all
else take native logs without knowing it. A format that reads its bytes once, in order, takes `source.head` and
`source.rest()`; one that has to jump takes a `RandomAccess`. What a damaged file makes a reader or a library raise
becomes one message, or ends the rows before the fault with a note (`NativeTable`), so that formats need not guard
every step.
"""

from __future__ import annotations

import tempfile
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property, partial
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import AccelcalError, DataError, UsageError, did_you_mean
from accelcal_cli.io.reader import LIMIT, NO_LABEL, PLAIN, ReadOptions, Selection
from accelcal_cli.io.rows import RowBlock, RowFilter, kept_row
from accelcal_cli.io.stream import BackgroundThread, ByteSource
from accelcal_cli.io.vocabulary import Facts
from accelcal_cli.registry import Registry
from accelcal_cli.sensor.vehicle import VehicleCorrection

if TYPE_CHECKING:
    import polars as pl

PREVIEW = 2000
"""Rows that the columns are told by where their names do not."""

SHOWN = 12
"""Accelerometers that a message lists at most."""

ACCELERATION = ("ax", "ay", "az")
TURNING = ("gx", "gy", "gz")
"""Names of the columns that native logs share, beside ``time`` and ``temperature``."""


class LogFormat(ABC):
    """A native log format: found by content, read in blocks and constant memory.

    Attributes:
        name: registry key, and ``source_format`` of records: ``ulg``, ``cwa``, ...
        title: as in messages: "a PX4 log (.ulg)".
        names: of the columns: ``time`` first where there is one, ``ax``, ``ay``, ``az``, then ``gx``, ``gy``, ``gz``
            and ``temperature`` where the log has them. Time is in seconds from the first row; a temperature that a
            row lacks is NaN.
        units: of the columns, in words of `vocabulary.UNITS`: ``s``, ``g``, ``m/s^2``, ``rad/s``, ``degC``.
        facts: rate, start, serial number, range as the log states them, and the unit of the acceleration.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    names: tuple[str, ...]
    units: tuple[str, ...] | None = None
    facts: Facts = Facts()

    @classmethod
    @abstractmethod
    def recognises(cls, head: bytes) -> bool:
        """Return whether an input that begins with `head`, up to 64 KiB or more, is of this format."""

    @abstractmethod
    def __init__(self, source: ByteSource, path: Path | None, accelerometer: str | None) -> None:
        """Read what stands before the rows.

        Args:
            source: the input, unpacked where it was packed, its head read.
            path: of the input, None where it is standard input or was packed.
            accelerometer: the one whose rows are wanted, None where the user did not say.

        Raises:
            DataError: damaged, or without acceleration. UsageError: no such accelerometer, or an extra is missing.
        """

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know, in sentences; complete once all blocks have been read."""
        return ()

    @property
    def correction(self) -> VehicleCorrection | None:
        """What a vehicle had done to the readings, None where it is none; complete once all blocks have been read."""
        return None

    @abstractmethod
    def blocks(self) -> Iterator[Float]:
        """Yield the rows, shape (B, len(names)), block after block in constant memory; called once."""

    def close(self) -> None:  # noqa: B027  # most formats hold nothing beside the source
        """Release what the format itself holds, not the source."""


LOG_FORMATS: Registry[LogFormat] = Registry(
    LogFormat, "accelcal_cli.io.formats", "log format", "accelcal.formats"
)


def recognise(head: bytes) -> type[LogFormat] | None:
    """Return the format of an input that begins with `head`, None where none knows it."""
    formats = (LOG_FORMATS.get(name) for name in LOG_FORMATS.names())
    return next((cls for cls in formats if cls.recognises(head)), None)


def choose_accelerometer(
    source: str, names: Sequence[str], wanted: str | None, default: str | None = None
) -> str:
    """Return the accelerometer to read.

    Args:
        source: named in messages; names: of the accelerometers that the log has.
        wanted: option --accelerometer; default: taken without it, where the log has it.

    Raises:
        DataError: none, or several and none wanted. UsageError: no such one.
    """
    if not names:
        raise DataError(f"{source}: has no accelerometer")
    listed = ", ".join(names[:SHOWN]) + (f" and {len(names) - SHOWN} more" if len(names) > SHOWN else "")
    if wanted is not None:
        word = wanted.strip().lower()
        bare = word.removesuffix("[0]")
        found = [name for name in names if name.lower() == word]
        alike = [name for name in names if name.lower().partition("[")[0] == bare]
        if not found and len(alike) == 1 and (word == bare or "[" not in alike[0]):
            found = alike  # the only one goes by its name with a number or without
        if not found:
            hint = did_you_mean(wanted, names)
            raise UsageError(
                f'--accelerometer "{wanted}": {source} has none of that name{hint}; it has {listed}'
            )
        return found[0]
    if len(names) == 1 or default in names:
        return default if default in names and default is not None else names[0]
    raise DataError(
        f"{source}: has several accelerometers ({listed}); choose one, as in --accelerometer '{names[0]}'"
    )


def check_extra(module: str, extra: str, source: str, title: str) -> None:
    """Raise UsageError, naming the extra, where the module that reads a format is not installed."""
    if find_spec(module) is None:
        raise UsageError(
            f"{source}: is {title}; to read it, install the extra {extra}: python -m pip install {module}"
        )


class RandomAccess:
    """An input as a file that can be read at any place: itself, or a copy of standard input or of what was packed.

    Attributes:
        path: of the file. Its bytes are hashed in the background where they are to be.
    """

    def __init__(self, source: ByteSource, path: Path | None, suffix: str = "") -> None:
        """Make a copy, whose name ends in `suffix`, unless there is a `path`; DataError where there is no room."""
        self._source, self._files, self._hashing = source, ExitStack(), BackgroundThread()
        if path is not None:
            self.path = path
            if source.hashed:
                self._hashing.start(lambda: deque(source.rest(), maxlen=0))
            return
        try:
            copy = tempfile.NamedTemporaryFile(prefix="accelcal-", suffix=suffix)  # noqa: SIM115
            self._files.enter_context(copy)
            for block in chain([source.head], source.rest()):
                copy.write(block)
            copy.flush()
        except OSError as problem:
            self._files.close()
            raise no_room(source.name, problem) from problem
        self.path = Path(copy.name)

    def wait(self) -> None:
        """Wait until every byte is hashed."""
        self._hashing.wait()

    def close(self) -> None:
        """Remove the copy."""
        self._source.stop()
        self._hashing.wait()
        self._files.close()


def cut_out(data: bytes, starts: Sequence[int], size: int) -> np.ndarray:
    """Return the pieces of some bytes that begin at `starts` (B,), each of `size` bytes, shape (B, size), uint8."""
    if not len(starts):
        return np.empty((0, size), dtype=np.uint8)
    windows = np.lib.stride_tricks.sliding_window_view(np.frombuffer(data, np.uint8), size)
    return np.asarray(windows[np.asarray(starts, dtype=np.intp)])


def no_room(name: str, problem: OSError) -> DataError:
    """Return what to raise where a working copy of an input cannot be written."""
    return DataError(f"{name}: no room for a working copy in {tempfile.gettempdir()} ({problem.strerror})")


class NativeTable:
    """A native log as an `InputTable`."""

    rows_skipped = 0
    lenient = False  # its cells are numbers: none is broken

    def __init__(self, source: ByteSource, path: Path | None, options: ReadOptions = PLAIN) -> None:
        """Open the log by the format that the source was found to be of."""
        assert source.native is not None
        self.name = source.name
        self.filter: RowFilter | None = None
        self._source, self._cls = source, source.native
        self._end = ""
        with self._named_faults("cannot be read"):
            self._log = self._cls(source, path, options.accelerometer)
        self.names, self.units, self.facts = self._log.names, self._log.units, self._log.facts
        self.numeric = (True,) * len(self.names)
        self.source_format = self._cls.name
        self._rows = self._sound_blocks()

    @property
    def correction(self) -> VehicleCorrection | None:
        """What a vehicle had done to the readings."""
        return self._log.correction

    @property
    def notes(self) -> tuple[str, ...]:
        """What was read and what was left out; complete once all blocks have been read."""
        forms = self._source.forms
        packed = [f"unpacked from {' in '.join(reversed(forms))}"] * bool(forms)
        stated = [f"{self._cls.title}: {self.facts}"] * bool(str(self.facts))
        return (*packed, *stated, *self._log.notes, *([self._end] if self._end else ()))

    @property
    def sha256(self) -> str:
        """SHA-256 of the file."""
        deque(self._source.rest(), maxlen=0)
        return self._source.sha256

    def leave_out(self, row: int) -> None:
        """Never called: no row is broken."""

    @cached_property
    def _first(self) -> Float:
        """The first rows, of as many blocks as it takes to have some."""
        rows = next((rows for rows in self._rows if len(rows)), np.empty((0, len(self.names))))
        self._rows = chain([rows], self._rows)
        return rows

    @property
    def has_rows(self) -> bool:
        """Whether there are rows."""
        return bool(len(self._first))

    def preview(self) -> list[list[str]]:
        """Return the cells of those of the first rows that are read."""
        rows = ([_cell(v) for v in row] for row in self._first[:PREVIEW].tolist())
        return [cells for cells in rows if self.filter is None or self.filter.meets(cells)]

    def keep_only(self, rows: RowFilter) -> None:
        """Read only those rows."""
        self.filter = rows

    def blocks(self, selection: Selection) -> Iterator[RowBlock]:
        """Read the selected columns."""
        return (rows for _, rows in self._pairs(selection))

    def pairs(self, selection: Selection) -> Iterator[tuple[pl.DataFrame, RowBlock]]:
        """Read blocks of all columns, each with the selected columns of its rows."""
        import polars as pl

        for whole, rows in self._pairs(selection):
            columns = np.ascontiguousarray(whole.T)
            yield pl.DataFrame([pl.Series(n, c) for n, c in zip(self.names, columns, strict=True)]), rows

    def _pairs(self, selection: Selection) -> Iterator[tuple[Float, RowBlock]]:
        start, last = 0, dict.fromkeys(selection.carried, np.nan)
        _ = self._first
        for whole in self._rows:
            kept = whole if self.filter is None else whole[self.filter.keep_numbers(whole)]
            numbers = kept.T[list(selection.numbers)].T  # column after column: faster to reduce
            for k, column in enumerate(selection.numbers):
                if column in last:
                    numbers[:, k] = _carried(numbers[:, k], last[column])
                    last[column] = float(numbers[-1, k]) if len(numbers) else last[column]
                self._check(numbers[:, k], start, column, column in selection.gaps)
            texts = tuple(self._labels(kept[:, k], start, k, k in selection.gaps) for k in selection.texts)
            yield kept, RowBlock(start, numbers, texts)
            start += len(kept)
        if self.filter is not None:
            self.filter.check()

    def _sound_blocks(self) -> Iterator[Float]:
        """Yield the rows up to a fault; one before the first row is an error."""
        rows, blocks = 0, self._log.blocks()
        while True:
            try:
                with self._named_faults("is damaged"):
                    block = next(blocks, None)
            except DamagedError as fault:
                if not rows:
                    raise
                self._end = f"damaged behind row {rows:,} ({fault.reason}): the rows before it are used"
                return
            if block is None:
                return
            rows += len(block)
            yield block

    @contextmanager
    def _named_faults(self, what: str) -> Iterator[None]:
        """Raise whatever a reader meets in a damaged file as DamagedError."""
        try:
            yield
        except (AccelcalError, GeneratorExit):
            raise
        except Exception as problem:  # there is no end to what damaged bytes make a library raise
            reason = (" ".join(str(problem).split()) or type(problem).__name__)[:200]
            message = f"{self.name}: is {self._cls.title}, which {what} ({reason}); copy the file anew"
            raise DamagedError(message, reason) from problem

    @property
    def where(self) -> Callable[[int], str]:
        """Row number, counted from 1."""
        if self.filter is None:
            return _row
        return partial(kept_row, self.filter.lines)

    def close(self) -> None:
        """Close the log and the file."""
        self._log.close()
        self._source.close()

    def _check(self, numbers: Float, start: int, column: int, gaps: bool) -> None:
        if not len(numbers) or (numbers.min() >= -LIMIT and numbers.max() <= LIMIT):  # nan fails both
            return
        bad = ~(np.abs(numbers) <= LIMIT) & ~(np.isnan(numbers) & gaps)
        if bad.any():
            row, value = int(np.argmax(bad)), numbers[np.argmax(bad)]
            what = "is missing or nan" if np.isnan(value) else f"{value:g} is too large or infinite"
            raise DataError(f"{self._place(start + row, column)}: {what}; a finite number was expected")

    def _labels(self, values: Float, start: int, column: int, gaps: bool) -> list[str]:
        labels = [_cell(value) for value in values.tolist()]
        if "" in labels and not gaps:
            raise DataError(f"{self._place(start + labels.index(''), column)}: {NO_LABEL}")
        return labels

    def _place(self, row: int, column: int) -> str:
        return f'{self.name}, {self.where(row)}, column "{self.names[column]}"'


class DamagedError(DataError):
    """A file whose bytes make no sense to its reader; `reason` is what the reader found."""

    def __init__(self, message: str, reason: str) -> None:
        """Keep the reason apart from the whole message."""
        super().__init__(message)
        self.reason = reason


def _row(row: int) -> str:
    return f"row {row + 1:,}".replace(",", "")


def _cell(value: float) -> str:
    """Return a number as text, whole ones without a point, nothing for NaN."""
    if value != value:
        return ""
    return str(int(value)) if value == int(value) and abs(value) < 1e15 else repr(value)


def _carried(values: Float, last: float) -> Float:
    """Return values with each NaN replaced by the last number before it, at first `last`."""
    if not np.isnan(values).any():
        return values
    known = np.append(last, values)
    at = np.maximum.accumulate(np.where(np.isnan(known), 0, np.arange(len(known))))
    return known[at][1:]
