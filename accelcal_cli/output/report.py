"""The report: one self-contained page of a calibration, with pictures, for the screen and for paper.

Each picture is inline SVG without a font, a file or a background of its own. Colours are written as marks and replaced
by `currentColor` and CSS variables of the page, so that one picture serves a light page, a dark page and paper.
"""

from __future__ import annotations

import html
import importlib.util
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import UNDETERMINED, WEAK
from accelcal_cli.calibration.result import Calibration, PoseFit, load_result
from accelcal_cli.config import dump
from accelcal_cli.errors import UsageError
from accelcal_cli.output.files import whole_file
from accelcal_cli.views import calibration as tables

if TYPE_CHECKING:
    from jinja2 import Environment
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

NEEDS = ("jinja2", "matplotlib")
TEMPLATE = "report.html.jinja"
RAISED = (("m/s^2", "m/s\u00b2"), (")^4", ")\u2074"), ("(g)\u2074", "g\u2074"))


def check_packages() -> None:
    """Raise UsageError when a package that only reports need is missing."""
    if any(importlib.util.find_spec(name) is None for name in NEEDS):
        raise UsageError("a report needs jinja2 and matplotlib: python -m pip install jinja2 matplotlib")


def report(
    result: Calibration | str | Path, output: str | Path | None = None, *, title: str | None = None
) -> str:
    """Return a report of a result, one HTML page with pictures, and write it where a name is given.

    Args:
        result: the calibration, or its file; output: file to write, whole or not at all; title: heading of the page.

    Raises:
        UsageError: jinja2 or matplotlib is missing. OutputError: it cannot be written.

    Examples:
        >>> from accelcal_cli import calibrate, report, simulate
        >>> page = report(calibrate(simulate("mems", positions=24).output), title="Desk 1")
        >>> "Desk 1" in page
        True
    """
    check_packages()
    calibration = result if isinstance(result, Calibration) else load_result(result)
    source = Path(str(calibration.data.get("source", "the readings"))).name
    text = page(calibration, title or f"Calibration of {source}")
    if output is not None:
        with whole_file(str(output), binary=True) as file:
            file.write(text.encode())  # the page says that it is UTF-8, whatever the terminal takes
    return text


def page(result: Calibration, title: str) -> str:
    """Return the page as HTML; the same result gives the same text.

    Args:
        result: what is reported.
        title: heading of the page.
    """
    from markupsafe import Markup

    text = (
        _environment()
        .get_template(TEMPLATE)
        .render(
            result=result,
            title=title,
            accuracy=tables.accuracy(result),
            headline=tables.headline(result),
            parameters=tables.parameter_tables(result),
            fit=tables.fit(result),
            worst=tables.worst_poses(result).filled(),
            poses=tables.pose_residuals(result),
            observability=tables.observability(result),
            pictures={name: Markup(draw(result)) for name, draw in PICTURES.items()},
            settings=dump(result.record()["settings"]),
            origin=_origin(result),
        )
    )
    return typeset(text)


def typeset(text: str) -> str:
    """Return text with the powers of units raised."""
    for plain, raised in RAISED:
        text = text.replace(plain, raised)
    return text


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("accelcal_cli.output", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Which columns hold numbers, and stand to the right.
    environment.filters["numeric"] = lambda table: [bool(column.format) for column in table.columns]
    return environment


def _origin(result: Calibration) -> list[tuple[str, str]]:
    """Return where the numbers come from, name and value."""
    return [
        ("readings", str(result.data.get("source", "-"))),
        ("SHA-256 of the readings", str(result.data.get("sha256", "-"))),
        ("columns", ", ".join(map(str, result.data.get("columns", [])))),
        ("poses", f"{result.poses:,}"),
        ("schema of the result", result.schema),
        ("calibrated with", f"accelcal {result.version}"),
        ("reported with", f"accelcal {__version__}"),
    ]


def residuals(result: Calibration) -> str:
    """Return |f| - g of every kept pose before and after calibration, one panel each."""
    from matplotlib.ticker import MaxNLocator

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
        axes.xaxis.set_major_locator(MaxNLocator(integer=True))
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
