"""What the poses that a threshold finds are worth: a calibration with each, and the threshold to keep."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.calibration.attitudes import attitudes, directions_of
from accelcal_cli.calibration.screening import screen
from accelcal_cli.sensor.intervals import Found, Intervals
from accelcal_cli.sensor.readings import Readings

DISTINCT = 5.0
"""Degrees between attitudes that count as two."""

TIE = 1.05
"""Sigmas up to this factor apart are the same: the smallest multiplier, the stillest poses, then decides."""

ORDER = ("good", "weak", "undetermined")


@dataclass(frozen=True)
class Candidate:
    """What a multiplier leads to.

    Attributes:
        multiplier: of the level; poses: intervals found; attitudes: how many of them differ.
        rms: of |f| - g of a calibration with them, m/s^2; NaN where there are too few.
        sigma: of its worst parameter, as m/s^2 at 1 g, as if each attitude counted once; inf where there are too few.
        verdict: good, weak or undetermined.
    """

    multiplier: float
    poses: int
    attitudes: int
    rms: float = float("nan")
    sigma: float = float("inf")
    verdict: str = "undetermined"


def judge(found: Found, g: float) -> Candidate:
    """Calibrate with what a multiplier found, at local gravity g, m/s^2."""
    intervals = found.intervals
    seen = Candidate(found.multiplier, len(intervals), min(len(intervals), 1))
    if len(intervals) < 2 or not np.ptp(intervals.mean, axis=0).any():
        return seen
    fit = screen(readings_of(intervals, "log"), g)
    distinct = len(attitudes(directions_of(intervals.mean, fit.model), intervals.n, DISTINCT))
    sigma = fit.s * fit.dop * np.sqrt(len(intervals) / distinct)
    return replace(
        seen,
        attitudes=distinct,
        rms=fit.rms,
        sigma=float(sigma) if np.isfinite(sigma) else float("inf"),
        verdict=fit.verdict,
    )


def best(enough: Sequence[int], candidates: Sequence[Candidate]) -> int:
    """Return which of the candidates numbered in `enough` to keep: best verdict, then least sigma, then stillest."""
    verdict = min(ORDER.index(candidates[k].verdict) for k in enough)
    enough = [k for k in enough if candidates[k].verdict == ORDER[verdict]]
    least = min(candidates[k].sigma for k in enough)
    return min(
        (k for k in enough if candidates[k].sigma <= TIE * least), key=lambda k: candidates[k].multiplier
    )


def readings_of(intervals: Intervals, source: str) -> Readings:
    """Return the intervals as readings: mean, count and scatter of each."""
    return Readings.from_array(intervals.mean, source=source, count=intervals.n, scatter=intervals.scatter)
