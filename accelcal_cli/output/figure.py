"""Pictures in files: one style, and the same data give the same file."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from accelcal_cli.output.files import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, which the colour-blind tell apart; a second round is dashed, a third dotted."""

DASHES = ("-", "--", ":")
DOTS_PER_INCH = 150


@contextmanager
def picture(path: str, width: float, height: float) -> Iterator[Figure]:
    """Give a figure of a size in inches to draw on, and write it, whole or not at all.

    Args:
        path: ends in .png or .svg.
        width, height: inches.

    Raises:
        OutputError: it cannot be written.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context({"svg.hashsalt": "accelcal", "axes.spines.top": False, "axes.spines.right": False}):
        figure = Figure(figsize=(width, height), layout="constrained")
        yield figure
        svg = Path(path).suffix == ".svg"
        metadata: dict[str, Any] = {"Date": None} if svg else {}
        with whole_file(path, binary=True) as file:
            figure.savefig(file, format="svg" if svg else "png", dpi=DOTS_PER_INCH, metadata=metadata)


def line_style(number: int) -> dict[str, Any]:
    """Return how matplotlib draws line `number`, from 0: a colour of its own, then a dash of its own."""
    dashes = DASHES[number // len(COLOURS) % len(DASHES)]
    return {"color": COLOURS[number % len(COLOURS)], "linestyle": dashes, "linewidth": 1.6}
