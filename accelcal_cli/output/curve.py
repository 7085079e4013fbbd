"""Convergence curves in the terminal, drawn on a logarithmic axis: one with Braille dots, several with letters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from string import ascii_letters

DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""Bits of the dots of a Braille cell: left column from above, right column from above."""

Points = Sequence[tuple[float, float]]
"""Pairs (evaluations, cost)."""


def draw(points: Points, width: int = 60, height: int = 8) -> str:
    """Return a plot of (evaluations, cost) with log10 of the cost upwards.

    Args:
        points: at least one; costs of zero are drawn on the floor.
        width, height: of the plot in characters, labels come on top of that.
    """
    limits = _limits([points])
    if limits is None:
        return "cost 0 from the first evaluation on"
    high, span = limits
    low = high - span
    first, last = points[0][0], points[-1][0]
    cells = [[0] * width for _ in range(height)]
    previous = None
    for evaluations, cost in points:
        column = round((evaluations - first) / max(last - first, 1) * (2 * width - 1))
        row = _row(cost, limits, 4 * height)
        for r in range(min(row, previous if previous is not None else row), row + 1):
            cells[r // 4][column // 2] |= DOTS[column % 2][r % 4]
        previous = row
    lines = ["".join(chr(0x2800 + bits) if bits else " " for bits in row) for row in cells]
    return _framed(lines, (f"{10**high:.0e}", f"{10**low:.0e}"), (first, last))


def draw_several(curves: Mapping[str, Points], width: int = 60, height: int = 10, least: float = 0.0) -> str:
    """Return one plot of several curves, each of a letter, with a legend of letters and labels under it.

    Args:
        curves: points by label, at least one each.
        width, height: of the plot in characters.
        least: costs below this are drawn on the floor, as those of zero are.
    """
    limits = _limits(curves.values(), least)
    if limits is None:
        return "cost 0 from the first evaluation on"
    high, span = limits
    first = min(points[0][0] for points in curves.values())
    last = max(points[-1][0] for points in curves.values())
    cells: list[list[list[str]]] = [[[] for _ in range(width)] for _ in range(height)]
    for letter, points in zip(ascii_letters, curves.values(), strict=False):
        columns = [round((n - first) / max(last - first, 1) * (width - 1)) for n, _ in points]
        rows = [_row(cost, limits, height) for _, cost in points]
        for column, row in set(_steps(columns, rows)):
            cells[row][column].append(letter)
    # Curves that share a cell take turns along the line.
    lines = ["".join(c[i % len(c)] if c else " " for i, c in enumerate(row)) for row in cells]
    below = any(cost < 10 ** (high - span) * 0.999 for points in curves.values() for _, cost in points)
    floor = f"{'<' * below}{10 ** (high - span):.0e}"
    plot = _framed(lines, (f"{10**high:.0e}", floor), (first, last))
    legend = [f"{letter} {label}" for letter, label in zip(ascii_letters, curves, strict=False)]
    return "\n".join([plot, *_wrapped(legend, width)])


def _steps(columns: Sequence[int], rows: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Yield every cell of a staircase through the points, without gaps in either direction."""
    yield columns[0], rows[0]
    for (left, above), (right, below) in pairwise(zip(columns, rows, strict=True)):
        for column in range(left + 1, right + 1):
            yield column, above
        for row in range(above + 1, below + 1):
            yield right, row


def _limits(curves: Iterable[Points], least: float = 0.0) -> tuple[float, float] | None:
    """Return log10 of the highest positive cost and the span down to the lowest; None when there is none."""
    costs = [cost for points in curves for _, cost in points if 0 < cost < math.inf]
    levels = [math.log10(max(cost, least)) for cost in costs]
    return (max(levels), max(max(levels) - min(levels), 1e-9)) if levels else None


def _row(cost: float, limits: tuple[float, float], height: int) -> int:
    high, span = limits
    if cost <= 0:
        return height - 1
    part = (high - min(math.log10(cost), high)) / span
    return round(min(part, 1.0) * (height - 1))


def _framed(lines: Sequence[str], levels: tuple[str, str], ends: tuple[float, float]) -> str:
    """Return lines of a plot with the costs of its first and last line and the evaluations of its ends."""
    width = len(lines[0])
    labels = [levels[0], *[""] * (len(lines) - 2), levels[1]]
    body = [f"{text:>7} |{line}".rstrip() for text, line in zip(labels, lines, strict=True)]
    foot = f"{ends[0]:,.0f}".ljust(width - 12) + f"{ends[1]:,.0f}".rjust(12)
    return "\n".join([*body, " " * 8 + "+" + "-" * width, " " * 9 + foot + "  evaluations"])


def _wrapped(words: Iterable[str], width: int) -> list[str]:
    """Return words on as few lines as fit into the width of a plot."""
    lines = [""]
    for word in words:
        if lines[-1] and len(lines[-1]) + len(word) + 3 > width:
            lines.append("")
        lines[-1] += ("   " if lines[-1] else "") + word
    return [" " * 9 + line for line in lines]
