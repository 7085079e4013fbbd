"""Raw logs of many sensors: the static poses of each are found and calibrated by the worker that reads it."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from accelcal_cli.calibration.fleet import Fleet, calibrate_each
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.detection.detect import Detection, DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log, sensors_of
from accelcal_cli.detection.worn import Wear, WornSettings, find_wear
from accelcal_cli.errors import AccelcalError, UsageError
from accelcal_cli.fleets.blocks import (
    Block,
    Gravity,
    Outcome,
    Supply,
    Work,
    expanded,
    joined,
    known,
    labelled,
    reason_of,
    state_of,
    stretches,
)
from accelcal_cli.io.fleet import file_names
from accelcal_cli.io.reader import PLAIN, ReadOptions

TOGETHER, BLOCKS = 16, 64
"""Most logs of a block, and the blocks from which on they have more than one."""

MANY = 16
"""Logs from which on reading short texts with polars makes up for loading it."""


@dataclass(frozen=True)
class LogForm:
    """How raw logs are read, and how their poses are found.

    Attributes:
        columns, gyro, time, options: see `open_raw_log`.
        detect: how poses are found; worn: how rest in days of wear is found, if that is what the logs are of.
        sensor: the column that labels the sensor, in logs of several; None to find it in a single log.
    """

    columns: tuple[str, ...] | None = None
    gyro: tuple[str, ...] | None = None
    time: str | None = None
    options: ReadOptions = PLAIN
    detect: DetectSettings = field(default_factory=DetectSettings)
    worn: WornSettings | None = None
    sensor: str | None = None

    def find(self, source: str, options: ReadOptions, gravity: Gravity) -> Detection | Wear:
        """Find the static poses of a log.

        Raises:
            DataError: it is broken, or has too few. UsageError: options that do not fit it.
        """
        log = open_raw_log(
            source, self.columns, self.gyro, self.time, stdin=sys.stdin.buffer, options=options
        )
        try:
            g = gravity(log.columns.unit)
            if self.worn is not None:
                return find_wear(log, replace(self.worn, g=g))
            return detect(log, replace(self.detect, g=g))
        finally:
            log.close()

    def sensors(self, source: str, name: str, *, alone: bool) -> list[tuple[str, ReadOptions]]:
        """Return the sensors of a log, and the rows to read of each: of several files each is one, unless told.

        Raises:
            DataError: it cannot be read. UsageError: several sensors of standard input, which is read once.
        """
        if self.sensor is None and (source == "-" or not alone):
            return [(name, self.options)]
        if source == "-":
            raise UsageError(
                "-: standard input is read once; --sensor-column with --raw needs the name of a file"
            )
        found = sensors_of(source, self.sensor, options=self.options)
        if self.sensor is None and len(found) < 2:
            return [(name, self.options)]
        return [
            (
                label if alone else f"{name}/{label}",
                replace(self.options, where=(*self.options.where, condition)),
            )
            for label, condition in found
        ]


@dataclass(frozen=True, kw_only=True)
class LogsBlock(Block):
    """Raw logs, with their names; `alone`: there is no other log."""

    sources: tuple[str, ...]
    names: tuple[str, ...]
    form: LogForm
    gravity: Gravity
    alone: bool

    def read(self) -> list[tuple[str, Detection | Wear | str, str]]:
        """Return label and poses of each sensor, or why there are none, and what is wrong with the options."""
        return list(self._found())

    def _found(self) -> Iterator[tuple[str, Detection | Wear | str, str]]:
        for source, name in zip(self.sources, self.names, strict=True):
            try:
                parts = self.form.sensors(source, name, alone=self.alone)
            except AccelcalError as error:
                yield name, reason_of(error, source), _misuse(error)
                continue
            for label, options in parts:
                try:
                    yield label, self.form.find(source, options, self.gravity), ""
                except AccelcalError as error:
                    yield label, reason_of(error, source), _misuse(error)

    def calibrate(self, work: Work) -> Outcome:
        """Find the poses of all logs and calibrate each; one that is broken or too poor has failed."""
        fleets, gravity, misuses = list[Fleet](), list[float](), list[str]()
        notes, texts = Counter[str](), list[tuple[str, str]]()
        for label, found, misuse in self._found() if self.content is None else self.content:
            lost = isinstance(found, str)
            g = np.nan if isinstance(found, str) else found.settings.g
            settings = work.settings if lost else replace(work.settings, g=g)
            readings = found if isinstance(found, str) else found.readings()
            fleet = calibrate_each([readings], settings, _keeper(work, label, texts))
            fleets.append(labelled(fleet, [label], np.array([len(fleets)])))
            gravity.append(g)
            notes.update(() if isinstance(found, str) else found.notes)
            misuses.append(misuse)
        return Outcome(joined(fleets), np.array(gravity), texts, notes, misuses[0] if all(misuses) else "")


def _keeper(
    work: Work, label: str, texts: list[tuple[str, str]]
) -> Callable[[int, Calibration], None] | None:
    """Return what adds the result file of a sensor to `texts`; None where none are wanted."""
    text = work.text
    return None if text is None else lambda _, one: texts.append((label, text(one)))


def _misuse(error: AccelcalError) -> str:
    return str(error) if isinstance(error, UsageError) else ""


def supply_logs(sources: Sequence[str], form: LogForm, gravity: Gravity) -> Supply:
    """Return the blocks of a fleet of raw logs; patterns stand for files.

    Raises:
        UsageError: a file twice, or a pattern without files.
    """
    files, _ = expanded(sources)
    names, size = file_names(files), max(1, min(TOGETHER, len(files) // BLOCKS))
    if len(files) >= MANY:
        form = replace(form, options=replace(form.options, many=True))

    def blocks(done: frozenset[int]) -> Iterator[tuple[int, Block]]:
        for at, own in stretches(len(files), size, done):
            yield (
                at,
                LogsBlock(
                    len(files[own]),
                    known(files[own]),
                    sources=tuple(files[own]),
                    names=tuple(names[own]),
                    form=form,
                    gravity=gravity,
                    alone=len(files) == 1,
                ),
            )

    identity = [[form], *([source, *state_of(source)] for source in files)]
    name = files[0] if len(files) == 1 else f"{len(files):,} logs"
    return Supply(name, len(files), -(-len(files) // size), identity, (), blocks, "-" in files)
