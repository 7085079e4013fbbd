"""What to say when a raw log has too few still poses: what was seen, and what would change it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from accelcal_cli.calibration.candidates import Candidate
from accelcal_cli.sensor.intervals import Found, Ints
from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.static import Level

MOVING = 0.05
"""A quietest window that scatters by more than this part of the range of the readings is not still."""


def nearest(found: Sequence[Found], candidates: Sequence[Candidate]) -> int:
    """Return which of several multipliers comes nearest to poses enough."""
    return max(
        range(len(found)), key=lambda k: (candidates[k].attitudes, candidates[k].poses, len(found[k].turning))
    )


def too_few(
    found: Sequence[Found], candidates: Sequence[Candidate], level: Level, rows: Rows, least: int
) -> str:
    """Say why no multiplier finds `least` attitudes, and what would help."""
    best = nearest(found, candidates)
    seen, count = found[best], candidates[best]
    threshold = seen.multiplier * level.variance
    poses, alike = _counted(count.poses, "still pose"), _counted(count.attitudes, "attitude")
    parts = [
        f"{poses} in {alike}, fewer than {least}" if count.poses else f"no still pose, {least} are needed",
        f"quietest variance {level.quietest:.4g}, threshold {threshold:.4g} (multiplier {seen.multiplier:g})",
        _lengths(seen, rows),
        _advice(seen, count, level, rows, [f.multiplier for f in found], least),
    ]
    return "; ".join(parts)


def _counted(number: int, what: str) -> str:
    plural = "" if number == 1 else "es" if what.endswith("ch") else "s"
    return f"{number:,} {what}{plural}"


def _lengths(seen: Found, rows: Rows) -> str:
    whole = [n + 2 * rows.trim for n in seen.intervals.n.tolist()] + seen.short.tolist()
    if not whole and not len(seen.turning):
        return "no window is below it"
    parts = []
    if whole:
        parts.append(
            f"longest still stretch {max(whole):,} rows, of which {rows.trim:,} are trimmed off each end"
        )
    if len(seen.short):
        parts.append(f"{_stretches(seen.short)} too short for a least length of {rows.least:,}")
    if len(seen.turning):
        parts.append(f"{_stretches(seen.turning)} left out because the sensor turns while they last")
    return "; ".join(parts)


def _stretches(lengths: Ints) -> str:
    low, high = int(lengths.min()), int(lengths.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{_counted(len(lengths), 'stretch')} of {span} rows"


def _advice(
    seen: Found, count: Candidate, level: Level, rows: Rows, multipliers: Sequence[float], least: int
) -> str:
    """Name the setting, or the handling, that most likely helps."""
    restless = math.sqrt(level.quietest) > MOVING * level.extent
    if count.poses >= least and not (restless and len(seen.turning)):
        return "turn the sensor to more attitudes, or accept fewer with --min-poses"
    if restless:
        scatter = f"{math.sqrt(level.quietest):.3g} where the readings change by {level.extent:.3g}"
        return f"no part of the log is still: even its quietest window scatters by {scatter}"
    if len(seen.turning) > count.poses:
        return "put the sensor down, or hold it against something, in each pose: it turns slowly all the time"
    if count.poses + np.count_nonzero(seen.short > 1.5 * rows.window) >= least:
        return "hold each pose longer, or lower --min-length or --trim"
    beyond = f"--multiplier above {max(multipliers):g}, a shorter --window or a lower --min-length"
    return f"record more poses held still; if the log has more, try {beyond}"
