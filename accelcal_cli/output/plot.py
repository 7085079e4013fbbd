"""Convergence as a picture: one panel a function, one line an optimizer, in PNG or SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from accelcal_cli.output.figure import line_style, picture
from accelcal_cli.streams import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACROSS = 3
"""Panels side by side at most."""

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]


def plot_convergence(title: str, curves: Curves, tolerance: float, path: str) -> None:
    """Write the picture, whole or not at all; the same data give the same file.

    Args:
        title: over all panels.
        curves: evaluations and median cost by function and optimizer.
        tolerance: drawn as a thin line.
        path: ends in .png or .svg.
    """
    across = min(ACROSS, math.ceil(math.sqrt(len(curves))))
    down = -(-len(curves) // across)
    labels = list(dict.fromkeys(label for panel in curves.values() for label in panel))
    with picture(path, max(4.2 * across, 6.0), 3.2 * down + 1.1) as figure:
        figure.suptitle(title, fontsize=11)
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for axes, (name, panel) in zip(panels, curves.items(), strict=False):
            _panel(axes, name, panel, labels, tolerance)
        for axes in panels[len(curves) :]:
            axes.set_axis_off()
        figure.legend(
            handles=_legend(labels), loc="outside lower center", ncols=min(len(labels), 5), frameon=False
        )


def _legend(labels: list[str]) -> list[Any]:
    from matplotlib.lines import Line2D

    return [Line2D([], [], label=label, **line_style(i)) for i, label in enumerate(labels)]


def _panel(
    axes: Axes, name: str, panel: Mapping[str, tuple[Float, Float]], labels: list[str], tolerance: float
) -> None:
    """Draw the curves of one function; a cost of zero leaves the axis at its floor."""
    positive = [cost[cost > 0] for _, cost in panel.values()]
    costs = np.concatenate([*positive, [tolerance]]) if tolerance > 0 else np.concatenate([*positive])
    floor = float(costs.min()) if costs.size else 1.0
    for label, (evaluations, cost) in panel.items():
        dot = "o" if np.ptp(evaluations) == 0 else ""  # a single evaluation has no line
        style = line_style(labels.index(label))
        axes.plot(evaluations, np.maximum(cost, floor / 10), marker=dot, markevery=[0], **style)
    if tolerance > 0:
        axes.axhline(tolerance, color="0.6", linewidth=0.8, zorder=0)
        axes.annotate(
            "tolerance",
            (0.01, tolerance),
            xycoords=("axes fraction", "data"),
            fontsize=7,
            color="0.4",
            va="bottom",
        )
    axes.set_yscale("log")
    axes.set_title(name, fontsize=10)
    axes.set_xlabel("evaluations")
    axes.set_ylabel("median best cost")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)
    axes.ticklabel_format(axis="x", style="plain")
    axes.locator_params(axis="x", integer=True)
    axes.xaxis.set_major_formatter(lambda n, _: f"{n:,.0f}")
