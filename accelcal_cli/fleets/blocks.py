"""The blocks of a fleet: what a worker reads and calibrates by itself.

Blocks are cut by the order of the sensors in the input, never by the number of workers, so that the results are the
same to the last bit whoever makes them. A block names the rows of a Parquet or Arrow table, or files of one sensor
each, which a worker reads itself; or it carries readings, where the input can be read only once or comes in any order.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import partial
from glob import glob
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.fleet import Fleet, calibrate_each, calibrate_part
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import AccelcalError, UsageError
from accelcal_cli.io.batches import FleetReadings, cuts
from accelcal_cli.io.fleet import FleetCollector, Window, check_once, check_poses, file_names, notes_of
from accelcal_cli.io.reader import PLAIN, ReadOptions, open_table
from accelcal_cli.io.stream import open_source
from accelcal_cli.sensor.model import local_gravity

if TYPE_CHECKING:
    import polars

TOGETHER = 256
"""Files of one sensor each that make a block."""

TYPED = (".parquet", ".pq", ".arrow", ".feather", ".ipc")
"""Endings of the files of a folder that is given as a table."""


@dataclass(frozen=True)
class Gravity:
    """Local gravity for readings in a unit.

    Attributes:
        stated: g, latitude and height as far as they were stated; default: without them, m/s^2.
        settled: whether the default holds for every unit, unless g or a latitude is stated.
    """

    stated: Mapping[str, float | None]
    default: float
    settled: bool = False

    def __call__(self, unit: str | None) -> float:
        """Return it in the unit of the readings: 1 for g."""
        own = local_gravity(unit, **self.stated)
        if own is None or (self.settled and local_gravity(None, **self.stated) is None):
            return self.default
        return own


@dataclass(frozen=True)
class Work:
    """What is to be done with every block.

    Attributes:
        settings: of the calibrations; gravity: the g of each, by the unit of its readings.
        text: makes the text of a result file of a sensor; None where none are wanted.
    """

    settings: Settings
    gravity: Gravity
    text: Callable[[Calibration], str] | None = None


@dataclass(frozen=True)
class Outcome:
    """What became of a block.

    Attributes:
        fleet: its sensors, numbered from 0, with their labels; gravity: that each was calibrated with, shape (R,), NaN
            for one that failed.
        texts: label and text of the result file of each sensor that did not fail.
        notes: what there is to say of its files, and of how many.
        misused: what is wrong with the options, where no file of the block could be read for that reason.
    """

    fleet: Fleet
    gravity: Float
    texts: list[tuple[str, str]] = field(default_factory=list)
    notes: Counter[str] = field(default_factory=Counter)
    misused: str = ""


@dataclass(frozen=True)
class Block(ABC):
    """Some sensors, those after the ones of the block before.

    Attributes:
        size: how many sensors or files, for progress.
        files: that it reads, with size and time of change, so that a worker knows them again.
        content: what was read of them, where they are not there for the worker.
    """

    size: int
    files: tuple[tuple[str, int, int], ...] = ()
    content: Any = None

    @abstractmethod
    def read(self) -> Any:
        """Return what the block is calibrated from."""

    @abstractmethod
    def calibrate(self, work: Work) -> Outcome:
        """Read and calibrate the sensors."""

    def loaded(self) -> Block:
        """Return the block with what it reads, for a worker that does not see the files."""
        return replace(self, content=self.read())

    def visible(self) -> bool:
        """Whether the files are here, the same as where the block was made."""
        return self.content is not None or all(state_of(name) == state for name, *state in self.files)


def state_of(name: str) -> list[int]:
    """Return size and time of change of a file, by which it is known again; nothing where there is none."""
    try:
        state = os.stat(name)
    except OSError:
        return []
    return [state.st_size, state.st_mtime_ns]


def known(sources: Sequence[str]) -> tuple[tuple[str, int, int], ...]:
    """Return files with what they are known by; those that are not there by nothing."""
    states = ((source, state_of(source)) for source in sources)
    return tuple((source, state[0], state[1]) for source, state in states if state)


def joined(fleets: Sequence[Fleet]) -> Fleet:
    """Return fleets as one, in the order of the numbers of their sensors."""
    if len(fleets) == 1:
        return fleets[0]
    order = np.argsort(np.concatenate([one.number for one in fleets]), kind="stable")
    return Fleet(
        **{f.name: np.concatenate([getattr(one, f.name) for one in fleets])[order] for f in fields(Fleet)}
    )


def failed(labels: Sequence[str], reasons: Sequence[str], number: Sequence[int] | Int, work: Work) -> Fleet:
    """Return sensors that there is no calibration of, and why."""
    return labelled(calibrate_each(list(reasons), work.settings), labels, np.asarray(number, dtype=np.intp))


def labelled(fleet: Fleet, labels: Sequence[str], number: Int | None = None) -> Fleet:
    """Return a fleet with the labels of its sensors, and with other numbers where they are stated."""
    names = np.array(labels, dtype=object)[fleet.number]
    return replace(fleet, labels=names, number=fleet.number if number is None else number[fleet.number])


def reason_of(error: AccelcalError, source: str) -> str:
    """Return why a file is no sensor, without its name and the stop at the end."""
    return str(error).removeprefix(source).lstrip(":, ").rstrip(".")


# A table with a column that labels the sensor


@dataclass(frozen=True)
class Slice:
    """The rows of some sensors in one table: its name, and the window."""

    source: str
    window: Window


@dataclass(frozen=True, kw_only=True)
class TableBlock(Block):
    """Sensors of one or more tables.

    Attributes:
        name: of the table, or how many tables; sensors: labels; collect: makes what gathers the rows.
        slices: of the tables; none where the block carries its readings.
        g: local gravity; several: whether a broken table is the end of its own sensors alone.
    """

    name: str
    sensors: list[str]
    collect: Callable[[], FleetCollector]
    g: float
    slices: tuple[Slice, ...] = ()
    several: bool = False

    def read(self) -> tuple[FleetReadings, dict[str, str]]:
        """Return the readings, and by label why a sensor has none."""
        opens = [partial(_open, source=one.source, name=None, window=one.window) for one in self.slices]
        collector, faults = gathered(self.collect, opens, strict=not self.several)
        lost = {
            label: reason_of(error, self.slices[k].source)
            for k, error in faults.items()
            for label in self.slices[k].window.sensors
        }
        return collector.readings(self.name), lost

    def calibrate(self, work: Work) -> Outcome:
        """Read and calibrate the sensors; one of which some rows could not be read has failed."""
        readings, lost = self.read() if self.content is None else self.content
        texts: list[tuple[str, str]] = []
        parts = [_calibrated(readings, self.sensors, self.g, work, texts)] if len(readings.sensors) else []
        if lost:
            parts = [_without(part, lost) for part in parts]
            texts = [one for one in texts if one[0] not in lost]
            number = [k for k, label in enumerate(self.sensors) if label in lost]
            names = [self.sensors[k] for k in number]
            parts.append(failed(names, [lost[label] for label in names], number, work))
        return finished(parts, self.g, texts)


def _calibrated(
    readings: FleetReadings, order: Sequence[str], g: float, work: Work, texts: list[tuple[str, str]]
) -> Fleet:
    """Calibrate sensors; they are numbered as in `order`, their result files go to `texts`."""
    text, labels = work.text, readings.sensors

    def keep(number: int, one: Calibration) -> None:
        assert text is not None
        texts.append((labels[number], text(one)))

    fleet = calibrate_part(readings, replace(work.settings, g=g), None if text is None else keep)
    if labels == tuple(order):
        return labelled(fleet, labels)
    place = {label: k for k, label in enumerate(order)}
    return labelled(fleet, labels, np.array([place[label] for label in labels], dtype=np.intp))


def _without(fleet: Fleet, lost: Mapping[str, str]) -> Fleet:
    """Return the sensors of a fleet that are not among those lost."""
    keep = np.array([label not in lost for label in fleet.labels], dtype=bool)
    return Fleet(**{f.name: getattr(fleet, f.name)[keep] for f in fields(Fleet)})


def finished(
    parts: Sequence[Fleet],
    g: float,
    texts: list[tuple[str, str]],
    notes: Counter[str] | None = None,
    misused: str = "",
) -> Outcome:
    """Return the sensors of a block as a part, all calibrated with one g."""
    fleet = joined(parts)
    return Outcome(fleet, np.where(fleet.verdict == "failed", np.nan, g), texts, notes or Counter(), misused)


def _open(collector: FleetCollector, source: str, name: str | None, window: Window | None = None) -> None:
    collector.open(source, name, window=window)


def gathered(
    make: Callable[[], FleetCollector], opens: Sequence[Callable[[FleetCollector], None]], *, strict: bool
) -> tuple[FleetCollector, dict[int, AccelcalError]]:
    """Gather the rows of inputs; without `strict` leave out those that cannot be read.

    Returns:
        What gathered the others, and the errors by the number of the input.

    Raises:
        AccelcalError: an input that cannot be read, with `strict`.
    """
    faults: dict[int, AccelcalError] = {}
    while True:
        collector, before = make(), len(faults)
        for k, open_one in enumerate(opens):
            if k in faults:
                continue
            try:
                open_one(collector)
            except AccelcalError as error:
                if strict:
                    raise
                faults[k] = error
        if len(faults) == before:
            return collector, faults


@dataclass(frozen=True)
class Supply:
    """The blocks of a fleet, to be asked for.

    Attributes:
        name: of the input in messages; size: sensors or files, of all blocks; count: how many blocks.
        identity: what the results depend on, of the data.
        notes: what there is to say of the input, where it is known before the blocks are done.
        blocks: yields the number and the block of those that are not done.
        once: whether they read what only this process can: standard input.
    """

    name: str
    size: int
    count: int
    identity: Sequence[object]
    notes: Sequence[str]
    blocks: Callable[[frozenset[int]], Iterator[tuple[int, Block]]]
    once: bool = False


def expanded(sources: Sequence[str]) -> tuple[list[str], bool]:
    """Return files for folders and patterns, and whether one was a folder: the partitions of a table.

    Raises:
        UsageError: a folder or a pattern without files, or a file twice.
    """
    found: list[str] = []
    for source in sources:
        if os.path.isdir(source):
            files = sorted(str(path) for path in Path(source).rglob("*") if path.suffix.lower() in TYPED)
            if not files:
                raise UsageError(
                    f"{source}: a folder without Parquet or Arrow files; expected the parts of a table"
                )
        elif not os.path.exists(source) and any(mark in source for mark in "*?["):
            files = sorted(glob(source, recursive=True))
            if not files:
                raise UsageError(f"{source}: no file has such a name")
        else:
            files = [source]
        found += files
    check_once(found)
    return found, any(os.path.isdir(source) for source in sources)


def supply(
    sources: Sequence[str],
    work: Work,
    columns: Sequence[str] | None = None,
    sensor: str | None = None,
    *,
    stdin: BinaryIO | None = None,
    options: ReadOptions = PLAIN,
) -> Supply:
    """Return the blocks of a fleet of static readings; arguments as `read_fleet` takes them, and folders.

    A folder is one table in parts, which have a column that labels the sensor.
    """
    files, parted = expanded(sources)
    collect = partial(FleetCollector, columns, sensor, options)
    if len(files) > 1 and sensor is None and not parted:
        return _of_files(files, collect)
    for source in files:  # a table without one of its parts is another table
        if source != "-" and not os.path.exists(source):
            open_source(source)  # says why it cannot
    direct = None if "-" in files or options.where else _direct(files, work, collect)
    return direct or _carried(files, work, collect, stdin)


def _named(files: Sequence[str]) -> str:
    return files[0] if len(files) == 1 else f"{len(files)} files"


def _lost_files(files: Sequence[str], faults: Mapping[int, AccelcalError]) -> list[tuple[str, str]]:
    """Return a label for each table that cannot be read, and why; raise where that is all of them."""
    if len(faults) == len(files):
        raise faults[min(faults)]
    names = file_names(files)
    return [(names[k], reason_of(error, files[k])) for k, error in sorted(faults.items())]


@dataclass(frozen=True, kw_only=True)
class LostBlock(Block):
    """Tables that cannot be read, each a sensor that failed: label and reason."""

    lost: tuple[tuple[str, str], ...]

    def read(self) -> None:
        """Read nothing."""

    def calibrate(self, work: Work) -> Outcome:
        """Say why."""
        labels, reasons = zip(*self.lost, strict=True)
        return finished([failed(labels, reasons, range(len(labels)), work)], np.nan, [])


@dataclass
class _Tables:
    """What the heads and the labels of typed tables tell: name, labels, rows of each, hash; faults by number."""

    found: list[tuple[str, Any, Int, str]] = field(default_factory=list)
    faults: dict[int, AccelcalError] = field(default_factory=dict)
    notes: dict[str, None] = field(default_factory=dict)
    units: set[str | None] = field(default_factory=set)

    def look(self, number: int, source: str, collect: Callable[[], FleetCollector]) -> bool:
        """Look at a table; return whether some of its rows can be read alone."""
        try:
            table = open_table(source)
        except AccelcalError as error:
            self.faults[number] = error
            return True
        try:
            if not getattr(table, "seekable", False):
                return False
            chosen = collect().columns(table, None)
            labels, rows = table.runs(chosen.sensor)  # type: ignore[attr-defined]
            self.found.append((source, labels, rows, table.sha256))
            self.units.add(chosen.unit)
            self.notes.update(dict.fromkeys(notes_of(table, chosen)))
        except AccelcalError as error:
            self.faults[number] = error
        finally:
            table.close()
        return True


def _direct(files: Sequence[str], work: Work, collect: Callable[[], FleetCollector]) -> Supply | None:
    """Return blocks that name rows of typed tables; None where a table is none, or a sensor comes more than once."""
    tables = _Tables()
    if not all(tables.look(k, source, collect) for k, source in enumerate(files)):
        return None
    lost = _lost_files(files, tables.faults) if tables.faults else []
    sensors, slices = _sensors_of(tables.found)
    if sensors.n_unique() < len(sensors):
        return None
    rows = np.bincount(
        np.concatenate([number + np.arange(len(own)) for number, _, _, own, *_ in slices]),
        np.concatenate([own for _, _, _, own, *_ in slices]),
    ).astype(np.intp)
    check_poses(_named(files), len(sensors), int(rows.sum()))
    g = work.gravity(tables.units.pop() if len(tables.units) == 1 else None)
    bounds, states = cuts(rows), known(files)

    def blocks(done: frozenset[int]) -> Iterator[tuple[int, Block]]:
        for at, (low, high) in enumerate(bounds):
            if at not in done:
                own = tuple(_within(slices, low, high))
                yield (
                    at,
                    TableBlock(
                        high - low,
                        tuple(state for state in states if any(state[0] == one.source for one in own)),
                        name=_named(files),
                        sensors=sensors.slice(low, high - low).to_list(),
                        collect=collect,
                        g=g,
                        slices=own,
                        several=len(files) > 1,
                    ),
                )
        if lost and len(bounds) not in done:
            yield len(bounds), LostBlock(len(lost), lost=tuple(lost))

    identity = [[source, sha256] for source, _, _, sha256 in tables.found] + [list(one) for one in lost]
    return Supply(
        _named(files),
        len(sensors) + len(lost),
        len(bounds) + bool(lost),
        identity,
        list(tables.notes),
        blocks,
    )


_Run = tuple[int, str, "polars.Series", Int, Int, str]
"""Number of the first sensor of a table, its name, labels, rows of each and the row behind them, and its hash."""


def _sensors_of(tables: Sequence[tuple[str, Any, Int, str]]) -> tuple[polars.Series, list[_Run]]:
    """Return the labels of all tables, a sensor that goes on in the next table once, and where each table begins."""
    whole, slices = None, list[_Run]()
    for source, labels, rows, sha256 in tables:
        goes_on = whole is not None and whole[-1] == labels[0]
        number = 0 if whole is None else len(whole) - goes_on
        own = labels.slice(int(goes_on))
        whole = own if whole is None else whole.append(own)
        slices.append((number, source, labels, rows, np.cumsum(rows), sha256))
    assert whole is not None
    return whole, slices


def _within(slices: Sequence[_Run], low: int, high: int) -> Iterator[Slice]:
    """Yield the rows of the sensors from `low` to `high` - 1."""
    for number, source, labels, rows, ends, sha256 in slices:
        first, last = max(low - number, 0), min(high - number, len(labels))
        if first < last:
            begin = int(ends[first] - rows[first])
            names = labels.slice(first, last - first).to_list()
            yield Slice(source, Window(begin, names, rows[first:last], int(ends[-1]), sha256))


def _carried(
    files: Sequence[str], work: Work, collect: Callable[[], FleetCollector], stdin: BinaryIO | None
) -> Supply:
    """Return blocks that carry their readings, read from tables of any form, whose rows come in any order."""
    opens = [partial(FleetCollector.open, source=source, name=None, stdin=stdin) for source in files]
    collector, faults = gathered(collect, opens, strict=len(files) == 1 or "-" in files)
    lost = _lost_files(files, faults) if faults else []
    readings = collector.readings(_named(files))
    check_poses(readings.source, len(readings.sensors), int(readings.poses.sum()))
    bounds, g = cuts(readings.poses), work.gravity(readings.unit)

    def blocks(done: frozenset[int]) -> Iterator[tuple[int, Block]]:
        for at, part in enumerate(readings.parts()):
            if at not in done:
                yield (
                    at,
                    TableBlock(
                        len(part.sensors),
                        content=(part, {}),
                        name=part.source,
                        sensors=list(part.sensors),
                        collect=collect,
                        g=g,
                    ),
                )
        if lost and len(bounds) not in done:
            yield len(bounds), LostBlock(len(lost), lost=tuple(lost))

    notes = list(dict.fromkeys(note for origin in readings.origins for note in origin.notes))
    identity = [[origin.name, origin.sha256] for origin in readings.origins] + [list(one) for one in lost]
    return Supply(
        _named(files), len(readings.sensors) + len(lost), len(bounds) + bool(lost), identity, notes, blocks
    )


# One file per sensor


@dataclass(frozen=True, kw_only=True)
class FilesBlock(Block):
    """Files of one sensor each, with their labels; `collect` makes what gathers the rows."""

    sources: tuple[str, ...]
    sensors: tuple[str, ...]
    collect: Callable[[], FleetCollector]

    def read(self) -> tuple[list[FleetReadings], dict[int, AccelcalError]]:
        """Return the readings of all files in one unit each, and the errors of those that cannot be read."""
        opens = [
            partial(_open, source=source, name=label)
            for source, label in zip(self.sources, self.sensors, strict=True)
        ]
        collector, faults = gathered(self.collect, opens, strict=False)
        good = [k for k in range(len(opens)) if k not in faults]
        units = [origin.form.unit for origin in collector.origins]
        if len(set(units)) < 2:
            return [collector.readings(_named(self.sources))] if good else [], faults
        return [
            gathered(
                self.collect,
                [opens[k] for k, own in zip(good, units, strict=True) if own == unit],
                strict=True,
            )[0].readings(_named(self.sources))
            for unit in dict.fromkeys(units)
        ], faults

    def calibrate(self, work: Work) -> Outcome:
        """Read and calibrate the sensors; a file that is broken has failed."""
        groups, faults = self.read() if self.content is None else self.content
        texts: list[tuple[str, str]] = []
        notes: Counter[str] = Counter()
        parts, gravity = [], np.full(len(self.sources), np.nan)
        for readings in groups:
            g = work.gravity(readings.unit)
            parts.append(_calibrated(readings, self.sensors, g, work, texts))
            gravity[parts[-1].number[parts[-1].verdict != "failed"]] = g
            notes.update(note for origin in readings.origins for note in origin.notes)
        if faults:
            reasons = [reason_of(error, self.sources[k]) for k, error in faults.items()]
            parts.append(failed([self.sensors[k] for k in faults], reasons, list(faults), work))
        bad = len(faults) == len(self.sources)
        return Outcome(joined(parts), gravity, texts, notes, str(faults[0]) if bad else "")


def stretches(total: int, size: int, done: frozenset[int]) -> Iterator[tuple[int, slice]]:
    """Yield the number and the files of the blocks of `size` files that are not done."""
    for at, start in enumerate(range(0, total, size)):
        if at not in done:
            yield at, slice(start, start + size)


def _of_files(files: Sequence[str], collect: Callable[[], FleetCollector]) -> Supply:
    """Return blocks of files of one sensor each."""
    names = file_names(files)

    def blocks(done: frozenset[int]) -> Iterator[tuple[int, Block]]:
        for at, own in stretches(len(files), TOGETHER, done):
            known_files, sources, sensors = known(files[own]), tuple(files[own]), tuple(names[own])
            yield (
                at,
                FilesBlock(len(sources), known_files, sources=sources, sensors=sensors, collect=collect),
            )

    identity = [[source, *state_of(source)] for source in files]
    return Supply(_named(files), len(files), -(-len(files) // TOGETHER), identity, (), blocks)
