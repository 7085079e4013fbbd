"""The curves of a navigation study's records: errors, corrected place and claimed sigma of a run against time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.filters import Track
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.navigation.scores import Scores
from accelcal_cli.streams import Float
from accelcal_cli.studies.study import Record

EVERY = 300.0
"""Seconds between the points of a record's curves."""

AXES = ("north", "east", "latitude", "longitude", "sigma")
OFFSET = 10_000_000
"""A record's curve holds one block for each of AXES, its seconds moved by so much."""


def curve_of(i: int, scenario: Scenario, track: Track, scores: Scores) -> tuple[tuple[int, float], ...]:
    """Return errors north and east, corrected place (degrees) and claimed sigma of a run, block by block."""
    stride = stride_of(scenario)
    seconds = scenario.seconds[::stride]
    latitude = scenario.ins.latitude[i, ::stride]
    meridian, parallel = metres_per_radian(latitude)
    blocks = (
        scores.error[i, ::stride, 0],
        scores.error[i, ::stride, 1],
        np.degrees(latitude - track.mean[i, ::stride, 0] / meridian),
        np.degrees(scenario.ins.longitude[i, ::stride] - track.mean[i, ::stride, 1] / parallel),
        np.sqrt(np.einsum("kii->k", track.covariance[i, ::stride])),
    )
    return tuple(
        (round(second) + OFFSET * axis, float(value))
        for axis, block in enumerate(blocks)
        for second, value in zip(seconds, block, strict=True)
        if np.isfinite(value)
    )


def stride_of(scenario: Scenario) -> int:
    """Return the epochs between the points of a curve."""
    return max(1, round(EVERY / scenario.period))


def axis_of(record: Record, axis: str) -> tuple[Float, Float]:
    """Return seconds and one of AXES of a record's curve, both of shape (points,)."""
    first = AXES.index(axis) * OFFSET
    points = [(n - first, value) for n, value in record.curve if first <= n < first + OFFSET]
    seconds, values = np.array(points).T if points else (np.empty(0), np.empty(0))
    return seconds, values


def mean_squares(records: Sequence[Record], axis: str) -> dict[float, float]:
    """Return the mean square over runs at each second."""
    total: dict[float, list[float]] = {}
    for record in records:
        for second, value in zip(*axis_of(record, axis), strict=True):
            total.setdefault(float(second), []).append(float(value) ** 2)
    return {second: float(np.mean(values)) for second, values in total.items()}
