"""The frame that the pictures of a report share: inline SVG, no font, no file, no background of their own.

Colours are written as marks and replaced by `currentColor` and CSS variables of the page, so that one picture
serves a light and a dark page, and paper.
"""

from __future__ import annotations

import html
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


class Drawn:
    """The SVG text of a figure, once it is drawn."""

    text = ""


@contextmanager
def figure(height: float) -> Iterator[tuple[Figure, Drawn]]:
    """Open a figure of the page's style; its SVG is there when it is left."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    drawn, file = Drawn(), io.StringIO()
    style: Any = STYLE
    with rc_context(style):
        canvas = Figure(figsize=(WIDTH, height), layout="constrained")
        yield canvas, drawn
        canvas.savefig(file, format="svg", transparent=True, metadata={"Date": None})
    drawn.text = file.getvalue()


def inline(drawn: Drawn, name: str, alternative: str) -> str:
    """Return SVG to stand in a page: ids of its own, colours of the page, a text for those who cannot see it."""
    svg = drawn.text[drawn.text.index("<svg") :]
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
