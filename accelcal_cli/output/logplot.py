"""A raw log as a picture: the three axes, and the intervals that were taken for static poses."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.calibration.detection import Detection
from accelcal_cli.output.figure import COLOURS, picture
from accelcal_cli.streams import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHADE = "#F0E442"
MOST_NUMBERS = 110
"""An interval carries its number when it is at least as wide as this many side by side."""


def plot_log(found: Detection, path: str) -> None:
    """Write the picture, whole or not at all; the same log gives the same file.

    Args:
        found: a detection with its envelope.
        path: ends in .png or .svg.
    """
    with picture(path, 12.0, 4.8) as figure:
        axes = figure.subplots()
        edges = _spans(found)
        _log(axes, found)
        _shade(axes, edges)
        axes.set_title(
            f"{Path(found.source).name}: {len(edges)} static poses, multiplier {found.multiplier:g}",
            fontsize=11,
            pad=14,
        )
        axes.set_xlabel("row" if found.intervals.time is None else "time")
        axes.set_ylabel("output, sensor units")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def _spans(found: Detection) -> Float:
    """Return first and last abscissa of each interval, shape (I, 2)."""
    poses = found.intervals
    return np.stack([poses.start, poses.end], axis=1) if poses.time is None else poses.time


def _shade(axes: Axes, edges: Float) -> None:
    """Mark the intervals, and number those that have room for it."""
    for k, (start, end) in enumerate(edges):
        label = "" if k else "static pose"
        axes.axvspan(start, end, color=SHADE, alpha=0.45, linewidth=0, zorder=0, label=label)
        if (end - start) * MOST_NUMBERS > edges[-1, 1] - edges[0, 0]:
            place = ((start + end) / 2, 1.0)
            at = ("data", "axes fraction")
            axes.annotate(str(k + 1), place, xycoords=at, ha="center", va="bottom", fontsize=6)


def _log(axes: Axes, found: Detection) -> None:
    """Draw each axis as the band between its least and greatest value in each bin."""
    if found.envelope is None:
        return
    at, low, high = found.envelope.bins()
    for k, axis in enumerate("xyz"):
        name = found.columns[k]
        label = axis if name.isdigit() else name
        axes.fill_between(
            at, low[:, k], high[:, k], step="post", color=COLOURS[k], alpha=0.9, linewidth=0.6, label=label
        )
    axes.margins(x=0.01)
