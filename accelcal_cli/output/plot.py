"""Pictures in PNG or SVG files: convergence, a raw log with its static poses, a navigation study.

All have one style, and the same data give the same file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import BIAS, MISALIGNMENT, SCALE
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.detection.detect import Detection
from accelcal_cli.io.clock import UNITS
from accelcal_cli.navigation.study import BOUND, INS
from accelcal_cli.output.files import whole_file
from accelcal_cli.studies.study import Curves
from accelcal_cli.views.blocks import Table
from accelcal_cli.views.navigation import Chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


ACROSS = 3
"""Panels side by side at most."""


def plot_convergence(
    title: str, curves: Curves, tolerance: float, path: str, bands: tuple[Curves, Curves] | None = None
) -> None:
    """Write one panel per function with one line per optimizer, whole or not at all.

    Args:
        title: over all panels.
        curves: evaluations and median cost by function and optimizer.
        tolerance: drawn as a thin line.
        path: ends in .png or .svg.
        bands: lower and upper quartile of the same curves, drawn as a shade.
    """
    from matplotlib.lines import Line2D

    across = min(ACROSS, math.ceil(math.sqrt(len(curves))))
    down = -(-len(curves) // across)
    labels = list(dict.fromkeys(label for panel in curves.values() for label in panel))
    handles = [Line2D([], [], label=label, **line_style(i)) for i, label in enumerate(labels)]
    with picture(path, max(4.2 * across, 6.0), 3.2 * down + 1.1) as figure:
        figure.suptitle(title, fontsize=11)
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for axes, (name, panel) in zip(panels, curves.items(), strict=False):
            _panel(axes, name, panel, labels, tolerance)
            if bands is not None:
                _band(axes, labels, *(band[name] for band in bands))
        for axes in panels[len(curves) :]:
            axes.set_axis_off()
        figure.legend(handles=handles, loc="outside lower center", ncols=min(len(labels), 5), frameon=False)


def _band(
    axes: Axes,
    labels: list[str],
    lower: Mapping[str, tuple[Float, Float]],
    upper: Mapping[str, tuple[Float, Float]],
) -> None:
    """Shade what lies between two curves of each optimizer."""
    floor = axes.get_ylim()[0]
    for label, (evaluations, low) in lower.items():
        colour = line_style(labels.index(label))["color"]
        high = upper[label][1]
        axes.fill_between(
            evaluations,
            np.maximum(low, floor),
            np.maximum(high, floor),
            color=colour,
            alpha=0.15,
            linewidth=0,
        )


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
    axes.set_title(name, fontsize=10)
    axes.set(xscale="log", yscale="log", xlabel="evaluations", ylabel="median best cost")
    axes.grid(True, which="major", color="0.9", linewidth=0.6)


COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which the colour-blind tell apart; a second round is dashed, a third dotted."""

DASHES = ("-", "--", ":")
DOTS_PER_INCH = 150


@contextmanager
def picture(path: str, width: float, height: float) -> Iterator[Figure]:
    """Give a figure of a size in inches to draw on, and write it, whole or not at all.

    Args:
        path: ends in .png or .svg.
        width, height: inches.

    Raises:
        OutputError: it cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "accelcal", "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        svg = Path(path).suffix == ".svg"
        metadata: dict[str, Any] = {"Date": None} if svg else {}
        with whole_file(path, binary=True) as file:
            figure.savefig(file, format="svg" if svg else "png", dpi=DOTS_PER_INCH, metadata=metadata)


def line_style(number: int) -> dict[str, Any]:
    """Return how matplotlib draws line `number`, from 0: a colour of its own, then a dash of its own."""
    dashes = DASHES[number // len(COLOURS) % len(DASHES)]
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": dashes, "linewidth": 1.6}


SHADE = "#F0E442"
MOST_NUMBERS = 110
"""An interval carries its number when it is at least as wide as this many side by side."""


def plot_log(detection: Detection, path: str) -> None:
    """Write the three axes of a log and the intervals taken for static poses, whole or not at all.

    Args:
        detection: with its envelope.
        path: ends in .png or .svg.
    """
    with picture(path, 12.0, 4.8) as figure:
        axes = figure.subplots()
        poses = detection.intervals  # first and last abscissa of each, shape (I, 2)
        edges: Float = np.stack([poses.start, poses.end], axis=1) if poses.time is None else poses.time
        label, place = _abscissa(detection)
        edges = place(edges)
        _log(axes, detection, place)
        _shade(axes, edges)
        if label == CLOCK:
            _date_ticks(axes)
        axes.set_title(
            f"{Path(detection.source).name}: {len(edges)} static poses, multiplier {detection.multiplier:g}",
            fontsize=11,
            pad=14,
        )
        axes.set(xlabel=label, ylabel=f"output [{detection.form.unit or 'output units'}]")
        axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


CLOCK = "time of day"
EPOCH = (1e9, 4e9)
"""Seconds since 1970 that are a date of our time rather than the age of a log."""

SCALES = ((7200.0, 3600.0, "h"), (300.0, 60.0, "min"), (0.0, 1.0, "s"))
"""Seconds that a log lasts at least, and the unit that its time is drawn in."""


def _abscissa(detection: Detection) -> tuple[str, Callable[[Float], Float]]:
    """Return what the horizontal axis shows, and how times of the log become places on it.

    Rows where there is no time, the time of day where there are dates, else seconds, minutes or hours.
    """
    time = detection.intervals.time
    if time is None:
        return "row", lambda rows: rows
    unit = UNITS[detection.time_unit]
    at = time.ravel() if len(time) or detection.envelope is None else detection.envelope.bins()[0]
    first, last = (float(at[0]) * unit, float(at[-1]) * unit) if len(at) else (0.0, 0.0)
    began = detection.began
    if began is None and EPOCH[0] < first < EPOCH[1]:
        began = np.datetime64(0, "s")
    if began is not None:
        start = began.astype("datetime64[us]").astype(np.int64) / 86400e6  # days, as matplotlib counts them
        return CLOCK, lambda times: np.asarray(start + times * (unit / 86400.0))
    size, name = next((size, name) for least, size, name in SCALES if last - first >= least)
    return f"time [{name}]", lambda times: times * (unit / size)


def _date_ticks(axes: Axes) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    locator = AutoDateLocator()  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator))  # type: ignore[no-untyped-call]


def _shade(axes: Axes, edges: Float) -> None:
    """Mark the intervals, and number those that have room for it."""
    for k, (start, end) in enumerate(edges):
        label = "" if k else "static pose"
        axes.axvspan(start, end, color=SHADE, alpha=0.45, linewidth=0, zorder=0, label=label)
        if (end - start) * MOST_NUMBERS > edges[-1, 1] - edges[0, 0]:
            place = ((start + end) / 2, 1.0)
            at = ("data", "axes fraction")
            axes.annotate(str(k + 1), place, xycoords=at, ha="center", va="bottom", fontsize=6)


def _log(axes: Axes, detection: Detection, place: Callable[[Float], Float]) -> None:
    """Draw each axis as the band between its least and greatest value in each bin."""
    if detection.envelope is None:
        return
    at, low, high = detection.envelope.bins()
    at = place(at)
    for k, axis in enumerate("xyz"):
        name = detection.columns[k]
        label = axis if name.isdigit() else name
        axes.fill_between(
            at, low[:, k], high[:, k], step="post", color=COLOURS[k], alpha=0.9, linewidth=0.6, label=label
        )
    axes.margins(x=0.01)


def _axes(axes: Axes | None) -> Axes:
    """Return axes to draw on: those given, or those of a new figure that notebooks show."""
    if axes is not None:
        return axes
    from matplotlib import pyplot

    _, new = pyplot.subplots(layout="constrained")
    new.spines[["top", "right"]].set_visible(False)
    return new


def residuals(result: Calibration, axes: Axes | None = None) -> Axes:
    """Draw |f| - g of every kept pose before and after calibration; poses are numbered from 1, as in tables."""
    axes = _axes(axes)
    poses = [fit.pose + 1 for fit in result.poses_fit]
    for colour, label, values in (
        (COLOURS[1], "before", [fit.residual_before for fit in result.poses_fit]),
        (COLOURS[0], "after", [fit.residual for fit in result.poses_fit]),
    ):
        axes.plot(poses, values, "o", color=colour, markersize=4, label=label)
    named = [fit for fit in result.poses_fit if fit.pose in result.outliers]
    if named:
        places = [fit.pose + 1 for fit in named], [fit.residual for fit in named]
        axes.plot(*places, "X", color=COLOURS[6], markersize=8, label="outlier")
    axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    axes.set(xlabel="pose", ylabel=f"|f| - g [{result.unit}]")
    axes.margins(y=0.1)
    axes.set_yscale("symlog", linthresh=max(result.s, 1e-12) if result.freedom > 0 else 1e-3)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return axes


def search(result: Calibration, axes: Axes | None = None) -> Axes:
    """Draw the best cost so far against the evaluations, on logarithmic axes."""
    axes = _axes(axes)
    points = [(evaluations, cost) for evaluations, cost in result.convergence if cost > 0]
    if points:
        axes.plot(*zip(*points, strict=True), **line_style(0))
        axes.set(xscale="log", yscale="log")
    axes.set(xlabel="evaluations", ylabel=f"best cost L [({result.unit})^4]", title=result.optimizer)
    return axes


def intervals(result: Calibration, axes: Axes | None = None) -> Axes:
    """Draw the nine parameters with their 95 % intervals, each divided by the largest of its kind."""
    axes = _axes(axes)
    values, sigma = result.engineering
    half = result.interval_of(sigma)
    for k, (name, part) in enumerate((("scale", SCALE), ("misalignment", MISALIGNMENT), ("bias", BIAS))):
        largest = float(np.abs(values[part]).max()) or 1.0
        at = np.arange(3) + 4 * k
        spread = np.nan_to_num(half[part]) / largest
        axes.errorbar(at, values[part] / largest, spread, color=COLOURS[k], capsize=3, fmt="o", label=name)
    axes.axhline(0.0, color="0.6", linewidth=0.8, zorder=0)
    axes.set_xticks([k for k in range(11) if k % 4 < 3], ["x", "y", "z", "xy", "xz", "yz", "x", "y", "z"])
    axes.set(ylabel="value / largest of its kind")
    axes.margins(y=0.1)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
    return axes


HOUR = 3600.0
PANELS = (
    ("rmse_latitude_m", "latitude"),
    ("rmse_longitude_m", "longitude"),
    ("rmse_position_m", "position"),
)
LEGEND = 125
"""Characters across the picture."""

LIMITS: dict[object, dict[str, Any]] = {
    INS: {"color": "0.35", "lw": 1.2, "ls": ":"},
    BOUND: {"color": "black", "lw": 1.0, "ls": "--"},
}


def plot_voyage(chart: Chart, path: str) -> None:
    """Write the picture, whole or not at all: run 0's tracks, and the RMSE of all runs as [depf2015] figures 2 to 4.

    Args:
        chart: what it shows.
        path: ends in .png or .svg.
    """
    with picture(path, 11.0, 8.5) as figure:
        panels = figure.subplots(2, 2).ravel()
        _draw_map(panels[0], chart)
        _draw_errors(panels[1:], chart.curves)
        handles, names = panels[0].get_legend_handles_labels()
        columns = max(1, min(len(names), LEGEND // (max(map(len, names)) + 6)))
        figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)


def _draw_map(axes: Any, chart: Chart) -> None:
    """Draw the anomaly, the true and the indicated track, and where each filter puts run 0."""
    picture = axes.imshow(
        chart.anomaly,
        origin="lower",
        extent=chart.edges,
        cmap="Greys",
        alpha=0.6,
        aspect=1.0
        / math.cos(math.radians(float(chart.indicated[1].mean()))),  # a kilometre is one either way
        interpolation="bilinear",
    )
    axes.figure.colorbar(picture, ax=axes, label="gravity anomaly, mGal", shrink=0.8)
    if chart.truth is not None:
        axes.plot(*chart.truth, color="black", lw=6.0, alpha=0.25, label="true")  # a band below the lines
    axes.plot(*chart.indicated, label=INS, **LIMITS[INS])
    for cell, (label, track) in enumerate(chart.tracks.items()):
        axes.plot(*track, label=label, **line_style(cell))
    middle = chart.indicated if chart.truth is None else chart.truth
    for name, values in zip("xy", middle, strict=True):
        getattr(axes, f"set_{name}lim")(values.min() - 0.12, values.max() + 0.12)
    axes.set(title="Run 0 over the map", xlabel="longitude, deg", ylabel="latitude, deg")


def _draw_errors(panels: Any, curves: Table) -> None:
    """Draw RMSE against time of every cell, with the bound and the INS alone."""
    lines: dict[tuple[object, ...], list[Mapping[str, Any]]] = {}
    for row in curves.records():
        lines.setdefault((row["filter"], row["mode"], row["accelerometer_ug"]), []).append(row)
    for axes, (key, name) in zip(panels, PANELS, strict=True):
        for cell, ((kind, _, _), rows) in enumerate(lines.items()):
            points = [(row["seconds"] / HOUR, row[key]) for row in rows if row[key] is not None]
            if points:
                axes.plot(*zip(*points, strict=True), **LIMITS.get(kind, line_style(cell)))
            if kind == BOUND:
                axes.annotate("bound", points[-1], fontsize=8, ha="right", va="top")
        axes.set(title=f"RMSE of {name}", xlabel="hour of the voyage", ylabel="m", yscale="log")
        axes.grid(True, color="0.9", linewidth=0.6)
