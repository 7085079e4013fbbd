"""The picture of a benchmark: distributions of running times, data profiles, running time over dimension, boxes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.output.plot import line_style, picture
from accelcal_cli.views.runtimes import Profiles

if TYPE_CHECKING:
    from matplotlib.axes import Axes

ACROSS = 3
LEAST = 1e-300
"""Costs below it are drawn as it: a logarithm has no 0."""


def plot_profiles(title: str, shown: Profiles, path: str) -> None:
    """Write the picture, whole or not at all.

    Args:
        title: over all panels.
        shown: what it shows.
        path: ends in .png or .svg.
    """
    from matplotlib.lines import Line2D

    labels = list(shown.distribution)
    count = 2 + len(shown.scaling) + len(shown.costs)
    across = min(ACROSS, count)
    down = math.ceil(count / across)
    handles = [Line2D([], [], label=label, **line_style(i)) for i, label in enumerate(labels)]
    with picture(path, 4.4 * across, 3.4 * down + 1.1) as figure:
        figure.suptitle(title, fontsize=11)
        panels = iter(figure.subplots(down, across, squeeze=False).ravel())
        _shares(next(panels), shown.distribution, "running times of all targets (ECDF)", "evaluations / D")
        _shares(next(panels), shown.profile, f"data profile, tau = {shown.tau:g}", "evaluations / (D + 1)")
        for function, lines in shown.scaling.items():
            _scaling(next(panels), function, lines, labels, shown.target)
        for name, costs in shown.costs.items():
            _boxes(next(panels), name, costs)
        for axes in panels:
            axes.set_axis_off()
        figure.legend(handles=handles, loc="outside lower center", ncols=min(len(labels), 5), frameon=False)


def _shares(axes: Axes, lines: Mapping[str, tuple[Float, Float]], title: str, unit: str) -> None:
    for number, (budgets, shares) in enumerate(lines.values()):
        axes.step(budgets, shares, where="post", **line_style(number))
    axes.set_title(title, fontsize=10)
    axes.set(xscale="log", ylim=(0.0, 1.02), xlabel=unit, ylabel="share solved")
    axes.grid(True, color="0.9", linewidth=0.6)


def _scaling(
    axes: Axes,
    function: str,
    lines: Mapping[str, tuple[list[int], list[float]]],
    labels: list[str],
    target: float,
) -> None:
    for label, (dimensions, times) in lines.items():
        axes.plot(dimensions, times, marker="o", markersize=3, **line_style(labels.index(label)))
    axes.set_title(f"{function}: ERT to {target:g} over D", fontsize=10)
    axes.set(xscale="log", yscale="log", xlabel="D", ylabel="ERT / D")
    axes.grid(True, color="0.9", linewidth=0.6)


def _boxes(axes: Axes, name: str, costs: Mapping[str, list[float]]) -> None:
    """Draw box, median, whiskers to 1.5 times the box and outliers of the best costs, as logarithms."""
    values = [
        np.log10(np.maximum([c for c in own if np.isfinite(c)] or [math.nan], LEAST))
        for own in costs.values()
    ]
    axes.boxplot(values, widths=0.6, medianprops={"color": "black"}, flierprops={"markersize": 3})
    axes.set_xticks(range(1, len(costs) + 1), list(costs), rotation=30, fontsize=7)
    axes.set_title(f"{name}: best cost", fontsize=10)
    axes.set_ylabel("log10 cost")
    axes.grid(True, axis="y", color="0.9", linewidth=0.6)
