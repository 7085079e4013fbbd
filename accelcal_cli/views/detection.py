"""A detection as tables and as a record."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from accelcal_cli.detection.detect import Detection
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.table import Column, Table

SCHEMA = "accelcal/detection/1"
"""Name and version of the record."""


def poses_table(found: Detection) -> Table:
    """Return one row a pose: rows, count, mean, standard deviation, times. `accelcal calibrate` reads it as CSV."""
    poses = found.intervals
    columns = [Column("start", key="start", format=","), Column("end", format=","), Column("n", format=",")]
    columns += [Column(f"N{axis}", format=".8g") for axis in "xyz"]
    columns += [Column(f"s{axis}", format=".3g") for axis in "xyz"]
    parts = [poses.start[:, None], poses.end[:, None], poses.n[:, None]]
    rows = [list(map(int, row)) for row in np.hstack(parts)]
    values = [poses.mean, poses.scatter]
    if poses.time is not None:
        columns += [Column("t_start", format=".10g"), Column("t_end", format=".10g")]
        values.append(poses.time)
    numbers = np.hstack(values).tolist()
    whole = tuple((*row, *cells) for row, cells in zip(rows, numbers, strict=True))
    return Table(f"Static poses of {found.source}", tuple(columns), whole)


def candidates_table(found: Detection) -> Table:
    """Return what each multiplier leads to."""
    unit = "g" if found.settings.g == 1.0 else "m/s^2"
    columns = (
        Column("multiplier", format="g"),
        Column("threshold", "(output units)^2", ".4g"),
        Column("poses", format=","),
        Column("attitudes", format=","),
        Column("rms of |f| - g", unit, ".4g", key="rms"),
        Column("worst sigma", unit, ".4g", key="sigma"),
        Column("verdict"),
        Column(""),
    )
    rows = tuple(
        (
            c.multiplier,
            c.multiplier * found.level.variance,
            c.poses,
            c.attitudes,
            c.rms,
            c.sigma if math.isfinite(c.sigma) else None,
            c.verdict,
            "kept" if c.multiplier == found.multiplier else "",
        )
        for c in found.candidates
    )
    notes = () if found.settings.g != STANDARD_GRAVITY else (f"at g = {STANDARD_GRAVITY}",)
    return Table("Thresholds tried", columns, rows, notes)


def record(found: Detection) -> dict[str, Any]:
    """Return the detection as plain mappings, lists, numbers and text; what is not known is None."""
    rows, level = found.rows, found.level
    return {
        "schema": SCHEMA,
        "data": {"source": found.source, "sha256": found.sha256, "columns": list(found.columns)},
        "rows": found.log_rows,
        "rate": found.rate,
        "window": rows.window,
        "still": rows.still,
        "min_length": rows.least,
        "trim": rows.trim,
        "variance": level.variance,
        "quietest": level.quietest,
        "turning": _finite(level.turning),
        "multiplier": found.multiplier,
        "threshold": found.multiplier * level.variance,
        "candidates": [
            {
                "multiplier": c.multiplier,
                "poses": c.poses,
                "attitudes": c.attitudes,
                "rms": _finite(c.rms),
                "sigma": _finite(c.sigma),
                "verdict": c.verdict,
            }
            for c in found.candidates
        ],
        "poses": [dict(pose) for pose in poses_table(found).records()],
        "notes": [*found.notes, found.summary()],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
