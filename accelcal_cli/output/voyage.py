"""Pictures of a navigation study: the tracks over the map, and RMSE against time on either axis and in position."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from accelcal_cli.output.figure import line_style, picture
from accelcal_cli.studies.navigation_tables import BOUND, INS
from accelcal_cli.studies.voyage_chart import Chart
from accelcal_cli.table import Table

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
        aspect="auto",
        interpolation="bilinear",
    )
    axes.figure.colorbar(picture, ax=axes, label="gravity anomaly, mGal", shrink=0.8)
    axes.plot(*chart.truth, color="black", lw=6.0, alpha=0.25, label="true")  # a band below the lines
    axes.plot(*chart.indicated, label=INS, **LIMITS[INS])
    for cell, (label, track) in enumerate(chart.tracks.items()):
        axes.plot(*track, label=label, **line_style(cell))
    for name, values in zip("xy", chart.truth, strict=True):
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
