"""The poses of a calibration on the sphere, as a picture of a report."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from accelcal_cli.calibration.parts import PoseFit
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.output import svg
from accelcal_cli.streams import Float

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MOST_NUMBERED = 40
"""Poses that are numbered on the sphere; more would cover one another."""

NEAR_RIM = 0.7
"""Square of the distance from the centre of a hemisphere, beyond which a number stands on the inner side."""


def sphere(result: Calibration) -> str:
    """Return the poses on two hemispheres in an equal-area projection: +z up and -z up."""
    u = np.array([p.direction for p in result.poses_fit]).reshape(-1, 3)
    with svg.figure(2.9) as (figure, drawn):
        for axes, sign in zip(figure.subplots(1, 2), (1.0, -1.0), strict=True):
            _hemisphere(axes, sign)
            here = [i for i in range(len(u)) if u[i, 2] * sign >= 0]
            _points(axes, u[here], sign, [result.poses_fit[i] for i in here], set(result.outliers), len(u))
    upper = int((u[:, 2] >= 0).sum())
    return svg.inline(
        drawn,
        "sphere",
        f"Attitudes of {len(u)} poses on the sphere, as the direction that points up in the sensor's axes: {upper} "
        f"with +z up or level, {len(u) - upper} with -z up.",
    )


def _hemisphere(axes: Axes, sign: float) -> None:
    """Draw the rim and the circles of 30 and 60 degrees, with the names of the axes."""
    turn = np.linspace(0.0, 2.0 * np.pi, 181)
    for tilt in (30.0, 60.0, 90.0):
        r = np.sqrt(2.0) * np.sin(np.radians(tilt) / 2.0)
        rim = tilt == 90.0
        axes.plot(
            r * np.cos(turn),
            r * np.sin(turn),
            color=svg.INK if rim else svg.FAINT,
            linewidth=1.0 if rim else 0.6,
        )
    for (x, y), name in zip(((1, 0), (-1, 0), (0, 1), (0, -1)), ("+x", "-x", "+y", "-y"), strict=True):
        axes.plot([0, x], [0, y], color=svg.FAINT, linewidth=0.6)
        axes.text(1.14 * x, 1.14 * y, name, ha="center", va="center")
    axes.set_title("+z up" if sign > 0 else "-z up", loc="center", pad=10)
    axes.set_xlim(-1.25, 1.25)
    axes.set_ylim(-1.25, 1.25)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _points(axes: Axes, u: Float, sign: float, poses: list[PoseFit], outliers: set[int], of_all: int) -> None:
    """Draw the directions of one hemisphere, Lambert's azimuthal projection: r = sqrt(2) sin(tilt / 2)."""
    if not len(u):
        return
    place = u[:, :2] / np.sqrt(1.0 + sign * u[:, 2:])
    bad = np.array([pose.pose in outliers for pose in poses])
    axes.plot(*place[~bad].T, "o", color=svg.AFTER, markersize=5)
    axes.plot(*place[bad].T, "X", color=svg.BAD, markersize=8)
    if of_all > MOST_NUMBERED:
        return
    at: dict[tuple[float, float], list[str]] = {}
    for (x, y), pose in zip(place.round(1), poses, strict=True):
        at.setdefault((x, y), []).append(str(pose.pose + 1))
    for (x, y), numbers in at.items():
        beside: dict[str, Any] = {"xytext": (4, 4)}
        if x * x + y * y > NEAR_RIM:  # inwards, where the names of the axes are not
            beside = {
                "xytext": (-6 * x, -6 * y),
                "ha": _side(x, "left", "right"),
                "va": _side(y, "bottom", "top"),
            }
        axes.annotate(", ".join(numbers), (x, y), textcoords="offset points", fontsize=7, **beside)


def _side(value: float, low: str, high: str) -> str:
    return high if value > 0.5 else low if value < -0.5 else "center"
