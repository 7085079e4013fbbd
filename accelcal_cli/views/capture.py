"""A capture as it runs, for whatever draws it: what the sensor does at a moment, and what has become of the poses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.detection.capture import NEAR, Capture, CaptureStatus, State
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.poses import describe
from accelcal_cli.views.blocks import Table
from accelcal_cli.views.quoted import engineering, fit, parameters, quote

Direction = tuple[float, float, float]

STATES: dict[State, str] = {
    "moving": "moving: hold it still",
    "still": "still",
    "taken": "taken: go on to another pose",
    "again": "taken already: go on to another pose",
}
"""What the sensor does, and what to do."""

FEWEST = 9
"""Poses below which nothing is determined: the parameters to estimate."""

DONE = "all poses are taken"
"""What to say of a sensor that is still in place of going on to another pose."""

UNKNOWN = "-"
"""What stands for a number that is not there."""


@frozen()
class Moment:
    """What the sensor does now.

    Attributes:
        reading: output units; length: of the specific force, g.
        state: one of STATES; words: what it means; progress: part of the hold that is complete.
        spread: largest standard deviation of an axis in the window, output units; limit: what counts as still.
        direction: of the specific force, a unit vector.
        held: number of the planned pose that is held, None beside all; hold: in words how it is held.
        next: number of the pose to take next, None when all are there.
    """

    reading: Direction
    length: float
    state: State
    words: str
    progress: float
    spread: float
    limit: float
    direction: Direction
    held: int | None
    hold: str
    next: int | None


@frozen()
class Summary:
    """The calibration of the poses so far, in the words and digits that people read.

    Attributes:
        verdict: its word.
        bias: of each axis, value and half-width of its 95 % interval (empty without one), output units.
        noise: standard deviation of one pose, with its unit; dop: dilution of precision by kind.
    """

    verdict: str
    bias: tuple[tuple[str, str], ...]
    noise: str
    dop: tuple[tuple[str, str], ...]


@frozen()
class Progress:
    """What has become of the poses; it changes with each that is taken.

    Attributes:
        planned: directions; words: how to hold each; numbers: of the captured pose that each is, None for missing.
        taken: directions of the captured poses; others: how many of them are not in the plan.
        summary: of their calibration, None while there is none.
        sentences: what the poses leave open, and what speaks against them.
    """

    planned: tuple[Direction, ...]
    words: tuple[str, ...]
    numbers: tuple[int | None, ...]
    taken: tuple[Direction, ...]
    others: int
    summary: Summary | None
    sentences: tuple[str, ...]

    @property
    def missing(self) -> int:
        """How many planned poses are missing."""
        return self.numbers.count(None)

    @property
    def count(self) -> str:
        """How far it is, in words."""
        beside = f" and {self.others} not in the plan" if self.others else ""
        return f"{len(self.planned) - self.missing} of {len(self.planned)} poses taken{beside}"

    @property
    def outlook(self) -> str:
        """What the calibration so far is, or what it waits for."""
        if self.summary is not None:
            return self.summary.verdict
        return f"after {FEWEST} poses; {len(self.taken)} so far"


def moment(capture: Capture, status: CaptureStatus) -> Moment:
    """Return what the sensor does now."""
    held = status.nearest if status.angle <= NEAR else None
    missing = capture.missing()
    further = [index for index in missing if index != held] or missing
    near = describe(capture.planned[status.nearest])
    return Moment(
        _numbers(status.reading),
        capture.length(status.reading),
        status.state,
        DONE if status.state in ("taken", "again") and not missing else STATES[status.state],
        status.progress,
        status.spread,
        status.limit,
        _numbers(status.direction),
        held,
        f"{status.angle:.0f} degree{'s' * (round(status.angle) != 1)} from {near}",
        further[0] if further else None,
    )


def progress(capture: Capture) -> Progress:
    """Return what has become of the poses."""
    recognised = capture.recognised()
    at = {index: number for number, index in enumerate(recognised, 1) if index is not None}
    enough = capture.calibration if len(capture.poses) >= FEWEST else None
    notices = capture.notices() if enough is None else enough.warnings
    reasons = () if enough is None else enough.reasons
    return Progress(
        tuple(map(_numbers, capture.planned)),
        tuple(map(describe, capture.planned)),
        tuple(at.get(index) for index in range(len(capture.planned))),
        tuple(map(_numbers, capture.directions())),
        recognised.count(None),
        None if enough is None else summary(enough),
        (*reasons, *(f"{notice.severity.capitalize()}: {notice}" for notice in notices)),
    )


def summary(result: Calibration) -> Summary:
    """Return a calibration in few words."""
    lost = result.lost_entries[3]
    pairs = zip(result.D_a.tolist(), result.interval.D_a.tolist(), strict=True)
    bias = (
        (UNKNOWN, "") if gone else quote(value, spread)
        for gone, (value, spread) in zip(lost, pairs, strict=True)
    )
    dop = {"scale": result.dop.scale, "misalignment": result.dop.misalignment, "bias": result.dop.bias}
    return Summary(
        result.verdict,
        tuple(bias),
        f"{result.s:.3g} {result.unit}" if result.freedom > 0 else UNKNOWN,
        tuple((kind, f"{size:.3g}" if math.isfinite(size) else "infinite") for kind, size in dop.items()),
    )


def final_tables(result: Calibration) -> list[dict[str, Any]]:
    """Return the tables of a finished calibration as text: title, headings, rows and notes of each."""
    return [_as_text(table) for table in (parameters(result), engineering(result), fit(result))]


def _as_text(table: Table) -> dict[str, Any]:
    return {
        "title": table.title,
        "heads": [column.name for column in table.columns],
        "rows": [
            [column.text(cell) for column, cell in zip(table.columns, row, strict=True)] for row in table.rows
        ],
        "notes": list(table.notes),
    }


def _numbers(vector: Any) -> Direction:
    x, y, z = np.asarray(vector, dtype=float).tolist()
    return x, y, z
