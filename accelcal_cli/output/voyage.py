"""Pictures of a navigation study: the tracks over the map, and RMSE against time on either axis and in position."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.output.files import whole_file
from accelcal_cli.output.plot import line_style
from accelcal_cli.studies.navigation import Navigation
from accelcal_cli.studies.navigation_tables import BOUND, INS, curves, own
from accelcal_cli.studies.study import Record
from accelcal_cli.studies.voyage_curves import axis_of

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


def plot_voyage(study: Navigation, records: Sequence[Record], path: str) -> None:
    """Write the picture, whole or not at all: run 0's tracks, and the RMSE of all runs as [depf2015] figures 2 to 4.

    Args:
        study, records: what was run.
        path: ends in .png or .svg.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "accelcal", "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(11.0, 8.5), layout="constrained")
        panels = figure.subplots(2, 2).ravel()
        labels = [_label(study, cell) for cell in range(study.cells)]
        _draw_map(panels[0], study, records, labels)
        _draw_errors(panels[1:], study, records)
        handles, names = panels[0].get_legend_handles_labels()
        columns = max(1, min(len(names), LEGEND // (max(map(len, names)) + 6)))
        figure.legend(handles, names, loc="outside lower center", ncols=columns, frameon=False)
        svg = Path(path).suffix == ".svg"
        with whole_file(path, binary=True) as file:
            figure.savefig(
                file, format="svg" if svg else "png", dpi=130, metadata={"Date": None} if svg else {}
            )


def _label(study: Navigation, cell: int) -> str:
    names = study.names(cell)
    word = names["filter"] if names["mode"] == "default" else f"{names['filter']} ({names['mode']})"
    return word if len(study.grades) == 1 else f"{word}, {float(names['accelerometer_ug']):.3g} micro-g"


def _draw_map(axes: Any, study: Navigation, records: Sequence[Record], labels: list[str]) -> None:
    """Draw the anomaly, the true and the indicated track, and where each filter puts run 0."""
    scenario = study.waters.scenario(study.grades[0], range(1), study.seed)
    grid = scenario.gravity_map
    route = scenario.route
    edges = np.degrees([grid.west, grid.east, grid.south, grid.north])
    picture = axes.imshow(
        grid.values,
        origin="lower",
        extent=edges,
        cmap="Greys",
        alpha=0.6,
        aspect="auto",
        interpolation="bilinear",
    )
    axes.figure.colorbar(picture, ax=axes, label="gravity anomaly, mGal", shrink=0.8)
    track = np.degrees([route.longitude, route.latitude])
    axes.plot(*track, color="black", lw=6.0, alpha=0.25, label="true")  # a band below the lines
    ins = scenario.ins
    axes.plot(
        np.degrees(ins.longitude[0]),
        np.degrees(ins.latitude[0]),
        label=INS,
        **LIMITS[INS],
    )
    for cell, label in enumerate(labels):
        first = own(records, cell)[0]
        axes.plot(
            axis_of(first, "longitude")[1], axis_of(first, "latitude")[1], label=label, **line_style(cell)
        )
    for name, values in zip("xy", track, strict=True):
        getattr(axes, f"set_{name}lim")(values.min() - 0.12, values.max() + 0.12)
    axes.set(title="Run 0 over the map", xlabel="longitude, deg", ylabel="latitude, deg")


def _draw_errors(panels: Any, study: Navigation, records: Sequence[Record]) -> None:
    """Draw RMSE against time of every cell, with the bound and the INS alone."""
    table = curves(study, records).records()
    lines: dict[tuple[object, ...], list[Mapping[str, Any]]] = {}
    for row in table:
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
