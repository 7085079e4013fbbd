"""A detection as tables and as a record."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from accelcal_cli.detection.detect import Detection
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.views.blocks import Block, Column, Table, notes

SCHEMA = "accelcal/detection/1"
"""Name and version of the record."""


MOST = 60
"""Poses that are shown to people; more are in the file of -o."""


def blocks(detection: Detection) -> list[Block]:
    """Return what a detection shows: poses, the thresholds tried, notes."""
    poses = poses_table(detection)
    if len(poses.rows) > MOST:
        note = f"{len(poses.rows) - MOST:,} more poses are not shown; -o writes them all"
        poses = replace(poses, rows=poses.rows[:MOST], notes=(note,))
    return [poses, candidates_table(detection), *notes((*detection.notes, detection.summary()))]


def poses_table(detection: Detection) -> Table:
    """Return one row per pose: rows, count, mean, standard deviation, times, temperature, as `calibrate` reads it."""
    poses = detection.intervals
    columns = [
        *(Column(name, format=",") for name in ("start", "end", "n")),
        *(Column(f"N{axis}", format=".8g") for axis in "xyz"),
        *(Column(f"s{axis}", format=".3g") for axis in "xyz"),
    ]
    rows = np.column_stack([poses.start, poses.end, poses.n]).astype(int).tolist()
    values = [poses.mean, poses.scatter]
    if poses.time is not None:
        columns += [Column("t_start", format=".10g"), Column("t_end", format=".10g")]
        values.append(poses.time)
    if poses.temperature is not None:
        columns.append(Column("T", format=".6g"))
        values.append(poses.temperature[:, None])
    numbers = np.hstack(values).tolist()
    whole = tuple((*row, *cells) for row, cells in zip(rows, numbers, strict=True))
    return Table(f"Static poses of {detection.source}", tuple(columns), whole)


def candidates_table(detection: Detection) -> Table:
    """Return what each multiplier leads to."""
    unit = "g" if detection.settings.g == 1.0 else "m/s^2"
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
            c.multiplier * detection.level.variance,
            c.poses,
            c.attitudes,
            c.rms,
            c.sigma if math.isfinite(c.sigma) else None,
            c.verdict,
            "kept" if c.multiplier == detection.multiplier else "",
        )
        for c in detection.candidates
    )
    notes = () if detection.settings.g != STANDARD_GRAVITY else (f"at g = {STANDARD_GRAVITY}",)
    return Table("Thresholds tried", columns, rows, notes)


def record(detection: Detection) -> dict[str, Any]:
    """Return the detection as plain mappings, lists, numbers and text; what is not known is None."""
    rows, level = detection.rows, detection.level
    keys = ("multiplier", "poses", "attitudes", "rms", "sigma", "verdict")
    return to_mapping(
        {
            "schema": SCHEMA,
            "data": {
                "source": detection.source,
                "sha256": detection.sha256,
                "columns": detection.columns,
                **asdict(detection.form),
            },
            "rows": detection.log_rows,
            "rate": detection.rate,
            "window": rows.window,
            "still": rows.still,
            "min_length": rows.least,
            "trim": rows.trim,
            "variance": level.variance,
            "quietest": level.quietest,
            "turning": level.turning,
            "multiplier": detection.multiplier,
            "threshold": detection.multiplier * level.variance,
            "candidates": [{key: getattr(one, key) for key in keys} for one in detection.candidates],
            "poses": poses_table(detection).records(),
            "notes": [*detection.notes, detection.summary()],
            "warnings": [asdict(notice) for notice in detection.warnings],
        }
    )
