"""The pictures of reports and certificates: residuals, the sphere of poses, dilution, convergence, intervals, a fleet.

Each function returns one SVG picture (see `svg`). A mark carries the key of its pose, parameter or sensor, so that the
same pose is found in every picture and table of the page.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import UNDETERMINED, WEAK
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.output import svg
from accelcal_cli.output.svg import Scale, element, line, mark, number, picture, words
from accelcal_cli.views.comparison import Row
from accelcal_cli.views.report import pose_key, pose_names

WIDTH, LEFT, RIGHT = 380.0, 62.0, 8.0
"""Of a picture with an upright axis: about what a telephone shows as large as it is."""

PANEL = 96.0
"""Height of one panel of residuals."""

MOST_NUMBERED = 40
"""Poses that are numbered on the sphere; more would cover one another."""

BINS = 24
"""Of a histogram, at most."""

NAMED = 6
"""Sensors that a bar of a histogram names."""


def residuals(result: Calibration, name: str = "residuals", of: str = "") -> str:
    """Return |f| - g of every kept pose before and after calibration, one panel each."""
    fits, titles = result.poses_fit, pose_names(result)
    x = Scale(min(p.pose for p in fits) + 0.4, max(p.pose for p in fits) + 1.6, LEFT, WIDTH - RIGHT)
    panels = (
        ("before calibration", "before", [p.residual_before for p in fits]),
        ("after calibration", "after", [p.residual for p in fits]),
    )
    tops, parts, marks = (22.0, 22.0 + PANEL + 26.0), [], [""] * len(fits)
    reach = 0.5 * (x(2.0) - x(1.0))
    for top, (title, style, values) in zip(tops, panels, strict=True):
        y = svg.around(values, top + PANEL, top, zero=True)
        parts += [
            words(LEFT, top - 7, f"{title} [{result.unit}]", style="heading"),
            svg.down_axis(y, LEFT, WIDTH - RIGHT),
        ]
        parts.append(line(LEFT, y(0.0), WIDTH - RIGHT, y(0.0), "axis"))
        for i, value in enumerate(values):
            if math.isfinite(value):
                marks[i] += _stem(
                    x(fits[i].pose + 1.0), y(0.0), y(value), style, fits[i].pose in result.outliers
                )
    bottom = tops[1] + PANEL
    for i, fit in enumerate(fits):
        zone = element(
            "rect",
            x=x(fit.pose + 1.0) - reach,
            y=tops[0],
            width=2 * reach,
            height=bottom - tops[0],
            class_="zone",
        )
        parts.append(mark(pose_key(fit.pose, of), titles[i], zone, marks[i]))
    numbers = [t for t in x.ticks() if t == round(t) and t >= 1] or [fits[0].pose + 1.0]
    parts += [words(x(t), bottom + 14, f"{t:.0f}", anchor="middle") for t in numbers]
    parts.append(words(WIDTH - RIGHT, bottom + 28, "pose", anchor="end"))
    return picture(name, WIDTH, bottom + 34, _said_residuals(result, panels), *parts, kind="Pose")


def _stem(x: float, zero: float, y: float, style: str, outlier: bool) -> str:
    head = (
        svg.cross(x, y, 3.6, "cross")
        if outlier
        else element("circle", cx=x, cy=y, r=2.6, class_=f"dot {style}")
    )
    return line(x, zero, x, y, f"stem {style}") + head


def _said_residuals(result: Calibration, panels: Sequence[tuple[str, str, list[float]]]) -> str:
    before, after = (max((abs(v) for v in values if math.isfinite(v)), default=0.0) for *_, values in panels)
    kept = {p.pose for p in result.poses_fit}
    named = sum(pose in kept for pose in result.outliers)
    outliers = f"; outliers (with a cross): {named}" if named else ""
    return (
        f"Residuals of {len(result.poses_fit)} poses: at most {before:.3g} {result.unit} before calibration, "
        f"{after:.3g} {result.unit} after it{outliers}."
    )


RADIUS = 82.0
CENTRES = ((100.0, 106.0), (306.0, 106.0))
"""Of the two hemispheres."""

NEAR_RIM = 0.7
"""Square of the distance from the centre of a hemisphere, beyond which a number stands on the inner side."""


def sphere(result: Calibration, name: str = "sphere", of: str = "") -> str:
    """Return the poses on two hemispheres in an equal-area projection: +z up and -z up."""
    fits, titles = result.poses_fit, pose_names(result)
    parts = [_hemisphere(*centre, title) for centre, title in zip(CENTRES, ("+z up", "-z up"), strict=True)]
    numbered: dict[tuple[int, float, float], list[str]] = {}
    for fit, title in zip(fits, titles, strict=True):
        half, x, y = projected(fit.direction)
        cx, cy = CENTRES[half][0] + RADIUS * x, CENTRES[half][1] - RADIUS * y
        if fit.pose in result.outliers:
            dot = svg.cross(cx, cy, 4.4, "cross")
        else:
            dot = element("circle", cx=cx, cy=cy, r=3.6, class_="dot after")
        zone = element("circle", cx=cx, cy=cy, r=7.0, class_="zone")
        parts.append(mark(pose_key(fit.pose, of), title, zone, dot))
        numbered.setdefault((half, round(x, 1), round(y, 1)), []).append(str(fit.pose + 1))
    if len(fits) <= MOST_NUMBERED:
        parts += [_numbers(*place, numbers) for place, numbers in numbered.items()]
    upper = sum(fit.direction[2] >= 0 for fit in fits)
    said = (
        f"Attitudes of {len(fits)} poses on the sphere, as the direction that points up in the sensor's axes: {upper} "
        f"with +z up or level, {len(fits) - upper} with -z up."
    )
    return picture(name, 406, 210, said, *parts, kind="Pose")


def projected(direction: Sequence[float]) -> tuple[int, float, float]:
    """Return hemisphere (0: +z up) and place in the unit disc, Lambert's azimuthal projection.

    Equal areas: sqrt(2) sin(tilt / 2) from the centre.
    """
    x, y, z = direction
    half = 0 if z >= 0 else 1
    size = math.sqrt(1.0 + abs(z))
    return half, x / size, y / size


def _hemisphere(cx: float, cy: float, title: str) -> str:
    """Return the rim and the circles of 30 and 60 degrees, with the names of the axes."""
    rings = [
        element("circle", cx=cx, cy=cy, r=RADIUS * math.sqrt(2.0) * math.sin(math.radians(t) / 2), class_=c)
        for t, c in ((30.0, "grid"), (60.0, "grid"), (90.0, "axis"))
    ]
    arms = [line(cx - RADIUS, cy, cx + RADIUS, cy, "grid"), line(cx, cy - RADIUS, cx, cy + RADIUS, "grid")]
    names = [
        words(cx + RADIUS + 3, cy + 3.5, "+x"),
        words(cx - RADIUS - 3, cy + 3.5, "-x", anchor="end"),
        words(cx, cy - RADIUS - 5, "+y", anchor="middle"),
        words(cx, cy + RADIUS + 13, "-y", anchor="middle"),
        words(cx - RADIUS - 12, 14, title, style="heading"),
    ]
    return "".join([*rings, *arms, *names])


def _numbers(half: int, x: float, y: float, numbers: Sequence[str]) -> str:
    """Return the numbers of the poses at a place, inwards near the rim, where the names of the axes are not."""
    inwards = x * x + y * y > NEAR_RIM
    dx, dy = (-9 * x, 9 * y) if inwards else (6.0, -5.0)
    anchor = ("middle" if abs(x) <= 0.5 else "end" if x > 0 else "start") if inwards else "start"
    cx, cy = CENTRES[half]
    text = ", ".join(numbers[:4]) + (" ..." if len(numbers) > 4 else "")
    return words(
        cx + RADIUS * x + dx,
        cy - RADIUS * y + dy + (3.0 if inwards else 0.0),
        text,
        anchor=anchor,
        style="small",
    )


def dilution(result: Calibration, name: str = "dilution") -> str:
    """Return the dilution of precision of the parameters that were estimated as bars, with the two thresholds."""
    names = [one for one, held in zip(result.dop.parameters, result.held, strict=True) if not held]
    dop = [result.dop.parameters[one] for one in names]
    known = [d for d in dop if math.isfinite(d)]
    end = 1.3 * max(UNDETERMINED, *known) if known else 1.3 * UNDETERMINED
    start = min([0.1, *(0.5 * d for d in known)])
    left, top, row = 100.0, 34.0, 19.0
    bottom = top + row * len(names)
    x = Scale(start, end, left, WIDTH - 46, log=True)
    parts = [svg.across_axis(x, top, bottom)]
    for limit, word, style in ((WEAK, "weak", "doubt"), (UNDETERMINED, "undetermined", "bad")):
        parts.append(line(x(limit), top - 5, x(limit), bottom, f"limit {style}"))
        at, y = (x(limit), top - 20) if style == "doubt" else (x(limit) + 18, top - 8)
        parts.append(words(at, y, f"{word} above {limit:g}", anchor="end"))
    for k, (one, value) in enumerate(zip(names, dop, strict=True)):
        style = "bad" if value > UNDETERMINED else "doubt" if value > WEAK else "after"
        place, y = x(min(value, end)), top + row * k
        shown = f"{value:.3g}" if math.isfinite(value) else "infinite"
        parts.append(words(left - 6, y + 13, one, anchor="end"))
        bar = element(
            "rect", x=left, y=y + 3, width=max(place - left, 1.0), height=row - 6, class_=f"bar {style}"
        )
        zone = element("rect", x=0.0, y=y, width=WIDTH, height=row, class_="zone")
        parts.append(mark(f"parameter-{k}", f"{one}: {shown}", zone, bar, words(place + 4, y + 13, shown)))
    parts.append(words(left, bottom + 28, "dilution of precision, logarithmic"))
    worst = "infinite" if len(known) < len(dop) else f"{max(dop):.3g}"
    listed = ", ".join(
        f"{n} {d:.3g}" if math.isfinite(d) else f"{n} infinite" for n, d in zip(names, dop, strict=True)
    )
    limits = f"Above {WEAK:g} weak, above {UNDETERMINED:g} undetermined."
    said = f"Dilution of precision, the worst {worst}: {listed}. {limits}"
    return picture(name, WIDTH, bottom + 34, said, *parts)


def convergence(result: Calibration, name: str = "convergence") -> str:
    """Return the best cost so far against the evaluations; empty without a curve."""
    points = [(float(n), cost) for n, cost in result.convergence if cost > 0]
    if len(points) < 2:
        return ""
    polished = result.cost > 0 and result.settings.get("polish", True)
    costs = [cost for _, cost in points] + ([result.cost] if polished else [])
    top, bottom = 22.0, 150.0
    y = Scale(min(costs) / 1.6, max(costs) * 1.6, bottom, top, log=True)
    x = Scale(0.0, points[-1][0] * 1.02, LEFT, WIDTH - RIGHT)
    path = f"M{number(x(points[0][0]))} {number(y(points[0][1]))}"
    path += "".join(f"H{number(x(n))}V{number(y(cost))}" for n, cost in points[1:])
    parts = [
        words(4, 12, f"best cost L [({result.unit})^4]", style="heading"),
        svg.down_axis(y, LEFT, WIDTH - RIGHT),
        line(LEFT, bottom, WIDTH - RIGHT, bottom, "axis"),
        element("path", d=path, class_="curve after"),
        *(words(x(t), bottom + 14, svg.label(t), anchor="middle") for t in x.ticks()),
        words(WIDTH - RIGHT, bottom + 28, "evaluations", anchor="end"),
    ]
    if polished:
        parts.append(line(LEFT, y(result.cost), WIDTH - RIGHT, y(result.cost), "limit before"))
        parts.append(words(WIDTH - RIGHT, y(result.cost) - 4, "after the polish", anchor="end"))
    said = (
        f"Best cost of {result.optimizer} against evaluations: from {points[0][1]:.3g} after {points[0][0]:,.0f} to "
        f"{points[-1][1]:.3g} after {points[-1][0]:,.0f}."
    )
    return picture(name, WIDTH, bottom + 34, said, *parts)


def intervals(title: str, unit: str, rows: Sequence[Row], labels: Sequence[str], name: str) -> str:
    """Return the values of one kind of parameter of several results, with their 95 % intervals.

    Args:
        title, unit: of the kind; rows: one for each parameter, its values and intervals result by result.
        labels: of the results; name: of the picture.
    """
    ends = [
        v + s * w
        for row in rows
        for v, w in zip(row.values, row.intervals, strict=True)
        for s in (-1.0, 1.0)
        if math.isfinite(v)
        for w in [w if math.isfinite(w) else 0.0]
    ]
    left, top, step = 96.0, 22.0, 13.0
    x = svg.around(ends, left, WIDTH - RIGHT)
    height = step * len(labels) + 8.0
    bottom = top + height * len(rows)
    parts = [words(4, 12, f"{title} [{unit}]", style="heading"), svg.across_axis(x, top, bottom)]
    for r, row in enumerate(rows):
        at = top + height * r
        parts.append(words(left - 8, at + 0.5 * height + 3.5, row.name, anchor="end"))
        parts.append(line(left, at, WIDTH - RIGHT, at, "grid"))
        for k, (value, half) in enumerate(zip(row.values, row.intervals, strict=True)):
            if math.isfinite(value):
                parts.append(
                    _interval(
                        x,
                        at + 4.0 + step * (k + 0.5),
                        value,
                        half,
                        k,
                        f"{labels[k]}: {row.name} {row.cells[k]} {unit}",
                    )
                )
    said = f"{title} of {len(labels)} results with their 95 % intervals, in {unit}; the numbers are in the table."
    return picture(name, WIDTH, bottom + 20, said, *parts)


def _interval(x: Scale, y: float, value: float, half: float, k: int, title: str) -> str:
    style = f"series-{k % 4}"
    zone = element("rect", x=x.start, y=y - 6, width=x.end - x.start, height=12, class_="zone")
    bar = line(x(value - half), y, x(value + half), y, f"whisker {style}") if math.isfinite(half) else ""
    shapes = (
        element("circle", cx=x(value), cy=y, r=3.4, class_=f"dot {style}"),
        element("rect", x=x(value) - 3, y=y - 3, width=6, height=6, class_=f"dot {style}"),
        element("path", d=f"M{number(x(value) - 4)} {number(y + 3.4)}h8l-4 -7z", class_=f"dot {style}"),
        element(
            "path",
            d=f"M{number(x(value))} {number(y - 4.4)}l4.4 4.4l-4.4 4.4l-4.4 -4.4z",
            class_=f"dot {style}",
        ),
    )
    return mark(f"{style}-{title}", title, zone, bar, shapes[k % 4])


def histogram(title: str, unit: str, values: Float, labels: Sequence[str], name: str) -> str:
    """Return how one quantity spreads over the sensors of a fleet; a bar names its sensors.

    Args:
        title, unit: of the quantity; values: shape (R,), NaN for sensors left out; labels: of the sensors, R.
        name: of the picture.
    """
    known = np.flatnonzero(np.isfinite(values))
    own = values[known]
    low, high = float(own.min()), float(own.max())
    if not high > low:
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    edges = np.linspace(low, high, min(BINS, max(5, round(2.0 * math.sqrt(len(own))))) + 1)
    which = np.clip(np.searchsorted(edges, own, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(which, minlength=len(edges) - 1)
    top, bottom = 22.0, 104.0
    x, y = Scale(low, high, 34.0, WIDTH - 14), Scale(0.0, float(counts.max()) * 1.05, bottom, top)
    unit_ = f" [{unit}]" if unit else ""
    parts = [words(4, 12, f"{title}{unit_}", style="heading")]
    parts += [
        line(34.0, y(t), WIDTH - 14, y(t), "grid") + words(30.0, y(t) + 3.6, f"{t:.0f}", anchor="end")
        for t in Scale(0.0, float(counts.max()), 0.0, 1.0).ticks()
        if t == round(t)
    ]
    for k, (a, b) in enumerate(pairwise(edges.tolist())):
        if counts[k]:
            sensors = [labels[i] for i in known[which == k].tolist()]
            more = f" and {len(sensors) - NAMED:,} more" if len(sensors) > NAMED else ""
            count = f"{len(sensors):,} of {len(own):,} sensors: {', '.join(sensors[:NAMED])}{more}"
            parts.append(
                _bar(x(a), x(b), y, len(sensors), f"{name}-{k}", f"{a:.4g} to {b:.4g}{unit_}: {count}")
            )
    parts.append(line(34.0, bottom, WIDTH - 14, bottom, "axis"))
    parts += [words(x(t), bottom + 14, svg.label(t), anchor="middle") for t in x.ticks()]
    middle = f"median {np.median(own):.4g}"
    said = f"{title} of {len(own):,} sensors{unit_}: from {own.min():.4g} to {own.max():.4g}, {middle}."
    return picture(name, WIDTH, bottom + 20, said, *parts, kind="Bar")


def _bar(left: float, right: float, y: Scale, count: int, key: str, title: str) -> str:
    """Return a bar of a histogram; all of the height above it can be pointed at."""
    zone = element("rect", x=left, y=y.end, width=right - left, height=y.start - y.end, class_="zone")
    top = y(float(count))
    bar = element(
        "rect", x=left + 0.5, y=top, width=right - left - 1.0, height=y.start - top, class_="bar after"
    )
    return mark(key, title, zone, bar)
