"""The charts of a report: residuals, convergence, dilution of precision."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.calibration.quality import UNDETERMINED, WEAK
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.output import svg

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def residuals(result: Calibration) -> str:
    """Return |f| - g of every kept pose before and after calibration, one panel each."""
    x = np.array([p.pose + 1 for p in result.poses_fit])
    named = np.isin(x - 1, result.outliers)
    panels = (
        ("before calibration", svg.BEFORE, np.array([p.residual_before for p in result.poses_fit])),
        ("after calibration", svg.AFTER, np.array([p.residual for p in result.poses_fit])),
    )
    with svg.figure(3.4) as (figure, drawn):
        for axes, (title, colour, y) in zip(figure.subplots(2, 1, sharex=True), panels, strict=True):
            axes.vlines(x, 0.0, y, color=colour, linewidth=1.0)
            axes.plot(x[~named], y[~named], "o", color=colour, markersize=3.2)
            axes.plot(x[named], y[named], "X", color=svg.BAD, markersize=7)
            axes.axhline(0.0, color=svg.INK, linewidth=0.8)
            axes.set_title(title)
            axes.set_ylabel(f"|f| - g [{result.unit}]")
            axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
        axes.set_xlim(x.min() - 0.7, x.max() + 0.7)
        _whole_numbers(axes)
        axes.set_xlabel("pose")
    largest = [np.abs(y).max(initial=0.0) for *_, y in panels]
    outliers = f"; outliers (with a cross): {named.sum()}" if named.any() else ""
    return svg.inline(
        drawn,
        "residuals",
        f"Residuals of {len(x)} poses: at most {largest[0]:.3g} {result.unit} before calibration, "
        f"{largest[1]:.3g} {result.unit} after it{outliers}.",
    )


def convergence(result: Calibration) -> str:
    """Return the best cost so far against the evaluations; empty without a curve."""
    points = [(n, cost) for n, cost in result.convergence if cost > 0]
    if len(points) < 2:
        return ""
    with svg.figure(2.6) as (figure, drawn):
        axes = figure.subplots()
        axes.step(*zip(*points, strict=True), where="post", color=svg.AFTER)
        if result.cost > 0 and result.settings.get("polish", True):
            axes.axhline(
                result.cost, color=svg.BEFORE, linestyle="--", linewidth=1.0, label="after the polish"
            )
            axes.legend(frameon=False, loc="upper right")
        axes.set_yscale("log")
        axes.set_xlabel("evaluations")
        axes.set_ylabel(f"best cost L [({result.unit})^4]")
        axes.xaxis.set_major_formatter(lambda n, _: f"{n:,.0f}")
    first, last = points[0], points[-1]
    return svg.inline(
        drawn,
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
    colours = [svg.BAD if d > UNDETERMINED else svg.DOUBT if d > WEAK else svg.AFTER for d in dop]
    with svg.figure(3.0) as (figure, drawn):
        axes = figure.subplots()
        axes.barh(names, np.where(known, dop, end) - start, left=start, color=colours, height=0.62)
        for row, value in enumerate(dop):
            text = f"{value:.3g}" if np.isfinite(value) else "infinite"
            inside = value > 0.5 * end
            axes.annotate(
                text, (end if inside else value, row), (4, 0), textcoords="offset points", va="center"
            )
        for limit, name, colour in ((WEAK, "weak", svg.DOUBT), (UNDETERMINED, "undetermined", svg.BAD)):
            label = f"{name} above {limit:g}"
            axes.axvline(limit, color=colour, linestyle="--", linewidth=1.0, label=label)
        axes.legend(frameon=False, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0))
        _log_bars(axes, start, end)
    worst = "infinite" if not known.all() else f"{dop.max():.3g}"
    words = [f"{n} {d:.3g}" if np.isfinite(d) else f"{n} infinite" for n, d in zip(names, dop, strict=True)]
    return svg.inline(
        drawn,
        "dilution",
        f"Dilution of precision, the worst {worst}: {', '.join(words)}. Above {WEAK:g} weak, above {UNDETERMINED:g} "
        "undetermined.",
    )


def _log_bars(axes: Axes, start: float, end: float) -> None:
    axes.set_xscale("log")
    axes.set_xlim(start, end)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.xaxis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.xaxis.set_minor_formatter(lambda *_: "")
    axes.set_xlabel("dilution of precision", loc="left")


def _whole_numbers(axes: Axes) -> None:
    from matplotlib.ticker import MaxNLocator

    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
