"""The pictures of a report: residuals, poses on the sphere, convergence, dilution of precision.

Each is inline SVG without a font, a file or a background of its own. Colours are written as marks and replaced by
`currentColor` and CSS variables of the page, so that one picture serves a light page, a dark page and paper.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import UNDETERMINED, WEAK
from accelcal_cli.calibration.result import Calibration, PoseFit

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def residuals(result: Calibration) -> str:
    """Return |f| - g of every kept pose before and after calibration, one panel each."""
    x = np.array([p.pose + 1 for p in result.poses_fit])
    named = np.isin(x - 1, result.outliers)
    panels = (
        ("before calibration", BEFORE, np.array([p.residual_before for p in result.poses_fit])),
        ("after calibration", AFTER, np.array([p.residual for p in result.poses_fit])),
    )
    with canvas(3.4) as (figure, svg):
        for axes, (title, colour, y) in zip(figure.subplots(2, 1, sharex=True), panels, strict=True):
            axes.vlines(x, 0.0, y, color=colour, linewidth=1.0)
            axes.plot(x[~named], y[~named], "o", color=colour, markersize=3.2)
            axes.plot(x[named], y[named], "X", color=BAD, markersize=7)
            axes.axhline(0.0, color=INK, linewidth=0.8)
            axes.set(title=title, ylabel=f"|f| - g [{result.unit}]")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set(xlim=(x.min() - 0.7, x.max() + 0.7), xlabel="pose")
        _whole_numbers(axes)
    largest = [np.abs(y).max(initial=0.0) for *_, y in panels]
    outliers = f"; outliers (with a cross): {named.sum()}" if named.any() else ""
    return inline(
        svg,
        "residuals",
        f"Residuals of {len(x)} poses: at most {largest[0]:.3g} {result.unit} before calibration, "
        f"{largest[1]:.3g} {result.unit} after it{outliers}.",
    )


def convergence(result: Calibration) -> str:
    """Return the best cost so far against the evaluations; empty without a curve."""
    points = [(n, cost) for n, cost in result.convergence if cost > 0]
    if len(points) < 2:
        return ""
    with canvas(2.6) as (figure, svg):
        axes = figure.subplots()
        axes.step(*zip(*points, strict=True), where="post", color=AFTER)
        if result.cost > 0 and result.settings.get("polish", True):
            axes.axhline(result.cost, color=BEFORE, linestyle="--", linewidth=1.0, label="after the polish")
            axes.legend(frameon=False, loc="upper right")
        axes.set(yscale="log", xlabel="evaluations", ylabel=f"best cost L [({result.unit})^4]")
        axes.xaxis.set_major_formatter(lambda n, _: f"{n:,.0f}")
    first, last = points[0], points[-1]
    return inline(
        svg,
        "convergence",
        f"Best cost of {result.optimizer} against evaluations: from {first[1]:.3g} after {first[0]:,} to {last[1]:.3g} "
        f"after {last[0]:,}.",
    )


def dilution(result: Calibration) -> str:
    """Return the dilution of precision of the parameters that were estimated as bars, with the two thresholds."""
    names = [name for name, held in zip(result.dop.parameters, result.held, strict=True) if not held]
    dop = np.array([result.dop.parameters[name] for name in names])
    known = np.isfinite(dop)
    end = 1.3 * max(UNDETERMINED, dop[known].max(initial=0.0))
    start = min(0.1, 0.5 * dop[known].min(initial=1.0))
    colours = [BAD if d > UNDETERMINED else DOUBT if d > WEAK else AFTER for d in dop]
    with canvas(3.0) as (figure, svg):
        axes = figure.subplots()
        axes.barh(names, np.where(known, dop, end) - start, left=start, color=colours, height=0.62)
        for row, value in enumerate(dop):
            text = f"{value:.3g}" if np.isfinite(value) else "infinite"
            inside = value > 0.5 * end
            axes.annotate(
                text, (end if inside else value, row), (4, 0), textcoords="offset points", va="center"
            )
        for limit, name, colour in ((WEAK, "weak", DOUBT), (UNDETERMINED, "undetermined", BAD)):
            label = f"{name} above {limit:g}"
            axes.axvline(limit, color=colour, linestyle="--", linewidth=1.0, label=label)
        axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        _log_bars(axes, start, end)
    worst = "infinite" if not known.all() else f"{dop.max():.3g}"
    words = [f"{n} {d:.3g}" if np.isfinite(d) else f"{n} infinite" for n, d in zip(names, dop, strict=True)]
    return inline(
        svg,
        "dilution",
        f"Dilution of precision, the worst {worst}: {', '.join(words)}. Above {WEAK:g} weak, above {UNDETERMINED:g} "
        "undetermined.",
    )


def _log_bars(axes: Axes, start: float, end: float) -> None:
    axes.set(xscale="log", xlim=(start, end))
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda *_: "")
    axes.set_xlabel("dilution of precision", loc="left")


def _whole_numbers(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))


MOST_NUMBERED = 40
"""Poses that are numbered on the sphere; more would cover one another."""

NEAR_RIM = 0.7
"""Square of the distance from the centre of a hemisphere, beyond which a number stands on the inner side."""


def sphere(result: Calibration) -> str:
    """Return the poses on two hemispheres in an equal-area projection: +z up and -z up."""
    u = np.array([p.direction for p in result.poses_fit]).reshape(-1, 3)
    with canvas(2.9) as (figure, svg):
        for axes, sign in zip(figure.subplots(1, 2), (1.0, -1.0), strict=True):
            _hemisphere(axes, sign)
            here = [i for i in range(len(u)) if u[i, 2] * sign >= 0]
            _points(axes, u[here], sign, [result.poses_fit[i] for i in here], set(result.outliers), len(u))
    upper = int((u[:, 2] >= 0).sum())
    return inline(
        svg,
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
            color=INK if rim else FAINT,
            linewidth=1.0 if rim else 0.6,
        )
    for (x, y), name in zip(((1, 0), (-1, 0), (0, 1), (0, -1)), ("+x", "-x", "+y", "-y"), strict=True):
        axes.plot([0, x], [0, y], color=FAINT, linewidth=0.6)
        axes.text(1.14 * x, 1.14 * y, name, ha="center", va="center")
    axes.set_title("+z up" if sign > 0 else "-z up", loc="center", pad=10)
    axes.set(xlim=(-1.25, 1.25), ylim=(-1.25, 1.25), aspect="equal")
    axes.set_axis_off()


def _points(axes: Axes, u: Float, sign: float, poses: list[PoseFit], outliers: set[int], of_all: int) -> None:
    """Draw the directions of one hemisphere, Lambert's azimuthal projection: r = sqrt(2) sin(tilt / 2)."""
    if not len(u):
        return
    place = u[:, :2] / np.sqrt(1.0 + sign * u[:, 2:])
    bad = np.array([pose.pose in outliers for pose in poses])
    axes.plot(*place[~bad].T, "o", color=AFTER, markersize=5)
    axes.plot(*place[bad].T, "X", color=BAD, markersize=8)
    if of_all > MOST_NUMBERED:
        return
    at: dict[tuple[float, float], list[str]] = {}
    for (x, y), pose in zip(place.round(1), poses, strict=True):
        at.setdefault((x, y), []).append(str(pose.pose + 1))
    for (x, y), numbers in at.items():
        placing: dict[str, Any] = {"xytext": (4, 4)}
        if x * x + y * y > NEAR_RIM:  # inwards, where the names of the axes are not
            placing = {
                "xytext": (-6 * x, -6 * y),
                "ha": _side(x, "left", "right"),
                "va": _side(y, "bottom", "top"),
            }
        axes.annotate(", ".join(numbers), (x, y), textcoords="offset points", fontsize=7, **placing)


def _side(value: float, low: str, high: str) -> str:
    return high if value > 0.5 else low if value < -0.5 else "center"


INK, FAINT, BEFORE, AFTER, DOUBT, BAD = "#010203", "#010204", "#010205", "#010206", "#010207", "#010208"
VARIABLES = {
    INK: "currentColor",
    FAINT: "var(--faint)",
    BEFORE: "var(--before)",
    AFTER: "var(--after)",
    DOUBT: "var(--doubt)",
    BAD: "var(--bad)",
}
"""Marks in the drawing, and what stands for them in the page."""

WIDTH = 5.0
"""Inches: a page on a telephone shows the picture as large as it was drawn."""

STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "accelcal",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.linewidth": 0.6,
    "grid.color": FAINT,
    "lines.linewidth": 1.4,
    **dict.fromkeys(("text.color", "axes.edgecolor", "axes.labelcolor", "xtick.color", "ytick.color"), INK),
}


@contextmanager
def canvas(height: float) -> Iterator[tuple[Figure, io.StringIO]]:
    """Open a figure of the page's style, and the file that holds its SVG once the figure is left."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    svg = io.StringIO()
    style: Any = STYLE
    with rc_context(style):
        figure = Figure(figsize=(WIDTH, height), layout="constrained")
        yield figure, svg
        figure.savefig(svg, format="svg", transparent=True, metadata={"Date": None})


def inline(file: io.StringIO, name: str, alternative: str) -> str:
    """Return SVG to stand in a page: ids of its own, colours of the page, a text for those who cannot see it."""
    svg = "<svg" + file.getvalue().partition("<svg")[2]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", svg)
    svg = re.sub(r"<defs>\s*<style.*?</style>\s*</defs>", "", svg, flags=re.DOTALL)
    svg = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font-size: \1", svg)
    svg = re.sub(r"font-family: [^;\"]*;? ?", "", svg)
    for mark, colour in VARIABLES.items():
        svg = svg.replace(mark, colour)
    opening = svg[: svg.index(">") + 1]
    (box,) = re.findall(r'viewBox="[^"]*"', opening)
    head = f'<svg xmlns:xlink="http://www.w3.org/1999/xlink" {box} role="img" aria-labelledby="{name}-alt">'
    return f'{head}<title id="{name}-alt">{html.escape(alternative)}</title>{svg[len(opening) :]}'


PICTURES = {"residuals": residuals, "sphere": sphere, "convergence": convergence, "dilution": dilution}
"""The pictures of a report by name."""
