"""What to say when a raw log has too few still poses: what was seen, and what would change it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.sensor.intervals import Found
from accelcal_cli.sensor.spans import Rows
from accelcal_cli.sensor.static import Level

if TYPE_CHECKING:
    from accelcal_cli.calibration.detection import Candidate


def too_few(
    name: str, found: Sequence[Found], candidates: Sequence[Candidate], level: Level, rows: Rows, least: int
) -> DataError:
    """Return the error of a log in which no multiplier finds `least` attitudes."""
    best = max(range(len(found)), key=lambda k: (candidates[k].attitudes, candidates[k].poses))
    seen, count = found[best], candidates[best]
    threshold = seen.multiplier * level.variance
    parts = [
        f"{name}: {count.poses} still poses in {count.attitudes} attitudes, fewer than {least}",
        f"quietest variance {level.quietest:.4g}, threshold {threshold:.4g} (multiplier {seen.multiplier:g})",
        _lengths(seen, rows),
        _advice(seen, count, [f.multiplier for f in found], least),
    ]
    return DataError("; ".join(parts))


def _lengths(seen: Found, rows: Rows) -> str:
    longest = max([0, *seen.intervals.n.tolist(), *seen.short.tolist()])
    text = f"longest still stretch {longest:,} rows after trimming {rows.trim} off each end"
    if not len(seen.short):
        return text
    low, high = int(seen.short.min()), int(seen.short.max())
    span = f"{low:,}" if low == high else f"{low:,} to {high:,}"
    return f"{text}, and {len(seen.short):,} stretches of {span} rows are below the least length of {rows.least:,}"


def _advice(seen: Found, count: Candidate, multipliers: Sequence[float], least: int) -> str:
    """Name the setting, or the handling, that most likely helps."""
    long_enough = int(np.count_nonzero(seen.short > 0))
    if count.poses >= least:
        return "turn the sensor to more attitudes, or accept fewer with --min-poses"
    if count.poses + long_enough >= least:
        return "hold each pose longer, or lower --min-length or --trim"
    if count.poses == 0 and seen.multiplier == max(multipliers):
        return (
            f"hold the sensor stiller, or try --multiplier above {max(multipliers):g} or a shorter --window"
        )
    return (
        f"record more poses held still; if there were more, try --multiplier above {max(multipliers):g}, a shorter "
        "--window or --min-length"
    )
