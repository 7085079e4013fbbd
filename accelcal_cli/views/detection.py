"""A detection as tables and as a record."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from accelcal_cli.detection.detect import Detection
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.views.blocks import BLANK, Block, Column, Paragraph, Table, notes

SCHEMA = "accelcal/detection/1"
"""Name and version of the record."""


MOST = 24
"""Poses that one screen shows; all with --verbose, and in the file of -o."""


def blocks(detection: Detection, verbose: bool = False) -> list[Block]:
    """Return what a detection shows: poses, notes, and with `verbose` the thresholds tried."""
    poses = shown_poses(detection)
    if len(poses.rows) > MOST and not verbose:
        note = f"{len(poses.rows) - MOST:,} more poses are not shown; --verbose shows them, -o writes them."
        poses = replace(poses, rows=poses.rows[:MOST], notes=(*poses.notes, note))
    tried = [candidates_table(detection)] if verbose else []
    last = Paragraph(detection.summary())
    return [poses, *([] if poses.notes else [BLANK]), *tried, *notes(detection.notes), last]


def shown_poses(detection: Detection) -> Table:
    """Return one row per pose for people: from when to when, rows, mean, noise, temperature."""
    poses = detection.intervals
    timed = poses.time is not None
    edges = np.stack([poses.start, poses.end], axis=1) if poses.time is None else poses.time
    columns = [
        Column("pose", format="d"),
        Column("start", "" if timed else "row", ".8g" if timed else ","),
        Column("end", "" if timed else "row", ".8g" if timed else ","),
        Column("rows", format=","),
        *(Column(f"N{axis}", format=".7g") for axis in "xyz"),
        Column("sd", format=".3g"),
    ]
    spread = np.sqrt((poses.scatter**2).mean(axis=1))
    numbers = [edges, poses.n[:, None], poses.mean, spread[:, None]]
    if poses.temperature is not None:
        columns.append(Column("T", format=".6g"))
        numbers.append(poses.temperature[:, None])
    kinds = [int] * 2 if not timed else [float] * 2
    rows = tuple(
        (k, kinds[0](row[0]), kinds[1](row[1]), int(row[2]), *row[3:])
        for k, row in enumerate(np.hstack(numbers).tolist(), 1)
    )
    unit = "start and end in the unit of the time column, " if timed else ""
    note = f"{unit}N: mean output; sd: standard deviation of one reading, rms of the axes."
    return Table(f"Static poses of {detection.source}", tuple(columns), rows, (note[:1].upper() + note[1:],))


def poses_table(detection: Detection) -> Table:
    """Return one row per pose: rows, count, mean, standard deviation, times, temperature, as `calibrate` reads it."""
    poses = detection.intervals
    columns = [
        Column("pose", format="d"),
        *(Column(name, format=",") for name in ("start", "end", "n")),
        *(Column(f"N{axis}", format=".8g") for axis in "xyz"),
        *(Column(f"s{axis}", format=".3g") for axis in "xyz"),
    ]
    rows = (
        np.column_stack([np.arange(1, len(poses.n) + 1), poses.start, poses.end, poses.n])
        .astype(int)
        .tolist()
    )
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
        Column("threshold", "output^2", ".4g"),
        Column("poses", format=","),
        Column("attitudes", format=","),
        Column("rms", unit, ".4g"),
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
    at = f", at g = {STANDARD_GRAVITY} m/s^2" if detection.settings.g == STANDARD_GRAVITY else ""
    notes = (f"rms: of |f| - g of a quick calibration{at}; worst sigma: of its parameters, at 1 g.",)
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
