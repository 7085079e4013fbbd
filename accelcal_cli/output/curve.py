"""A convergence curve in the terminal, drawn with Braille dots on a logarithmic axis."""

from __future__ import annotations

import math
from collections.abc import Sequence

DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""Bits of the dots of a Braille cell: left column from above, right column from above."""


def draw(points: Sequence[tuple[float, float]], width: int = 60, height: int = 8) -> str:
    """Return a plot of (evaluations, cost) with log10 of the cost upwards.

    Args:
        points: at least one; costs of zero are drawn on the floor.
        width, height: of the plot in characters, labels come on top of that.
    """
    positive = [cost for _, cost in points if cost > 0]
    if not positive:
        return "cost 0 from the first evaluation on"
    low, high = math.log10(min(positive)), math.log10(max(positive))
    span = max(high - low, 1e-9)
    first, last = points[0][0], points[-1][0]
    cells = [[0] * width for _ in range(height)]
    previous = None
    for evaluations, cost in points:
        column = round((evaluations - first) / max(last - first, 1) * (2 * width - 1))
        level = math.log10(cost) if cost > 0 else low
        row = round((high - level) / span * (4 * height - 1))
        for r in range(min(row, previous if previous is not None else row), row + 1):
            cells[r // 4][column // 2] |= DOTS[column % 2][r % 4]
        previous = row
    label = [f"{10**high:.0e}", *[""] * (height - 2), f"{10**low:.0e}"]
    lines = [
        f"{text:>7} |" + "".join(chr(0x2800 + bits) if bits else " " for bits in row)
        for text, row in zip(label, cells, strict=True)
    ]
    foot = f"{first:,.0f}".ljust(width - 12) + f"{last:,.0f}".rjust(12)
    return "\n".join([*lines, " " * 8 + "+" + "-" * width, " " * 9 + foot + "  evaluations"])
