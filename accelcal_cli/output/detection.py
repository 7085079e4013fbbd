"""A detection on the terminal."""

from __future__ import annotations

from dataclasses import replace

from accelcal_cli.calibration.detected import candidates_table, poses_table
from accelcal_cli.calibration.detection import Detection
from accelcal_cli.output import console as rich_console

MOST = 60
"""Poses printed; more are in the file of -o."""


def show_detection(found: Detection) -> None:
    """Print the poses, the thresholds tried and the notes to standard output."""
    out = rich_console.console()
    poses = poses_table(found)
    if len(poses.rows) > MOST:
        note = f"{len(poses.rows) - MOST:,} more poses are not shown; -o writes them all"
        poses = replace(poses, rows=poses.rows[:MOST], notes=(note,))
    for table in (poses, candidates_table(found)):
        rich_console.show_split(table, out)
    for note in (*found.notes, found.summary()):
        out.print(f"Note: {note}")
