"""A benchmark on the terminal: a table and a convergence plot for every function, then the ranks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.console import Console
from rich.text import Text

from accelcal_cli.output import console as rich_console
from accelcal_cli.output.curve import draw_several
from accelcal_cli.streams import Float
from accelcal_cli.table import Table

NARROWEST_CURVE = 48
"""Columns of the narrowest terminal that gets a plot."""

BELOW = 1e-4
"""Part of the tolerance where the plots have their floor."""

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]


def show_benchmark(
    title: str, rows: Table, curves: Curves, tolerance: float, further: Sequence[Table]
) -> None:
    """Print a benchmark to standard output.

    Args:
        title: what was run.
        rows: the summary, its first column the function.
        curves: evaluations and median cost by function and optimizer.
        tolerance: costs far below it are not told apart in the plots.
        further: tables that follow, such as ranks.
    """
    out = rich_console.console()
    out.print(Text(title, "bold"))
    out.print()
    for function, plotted in curves.items():
        rich_console.show_split(_of_function(rows, function), out)
        if plotted and out.width >= NARROWEST_CURVE:
            show_curves(function, plotted, out, least=tolerance * BELOW)
    rich_console.show(further, out)


def show_curves(
    name: str, panel: Mapping[str, tuple[Float, Float]], out: Console, least: float = 0.0
) -> None:
    """Print the curves of one function or problem; costs below `least` lie on the floor."""
    points = {
        label: [(float(n), float(c)) for n, c in zip(*curve, strict=True)] for label, curve in panel.items()
    }
    out.print(Text(f"{name}: median cost so far, logarithmic"))
    text = draw_several(points, width=min(60, out.width - 22), least=least)
    out.print(Text(text), crop=False, overflow="ignore", soft_wrap=True)
    out.print()


def _of_function(rows: Table, function: str) -> Table:
    """Return the rows of one function, without what the heading says, nor failures where there are none."""
    own = [row for row in rows.rows if row[0] == function]
    keys = [column.key or column.name for column in rows.columns]
    failed = keys.index("failures")
    hidden = {"function", "runs"} | ({"failures"} if not any(row[failed] for row in own) else set())
    keep = [i for i, key in enumerate(keys) if key not in hidden]
    return Table(function, tuple(rows.columns[i] for i in keep), tuple([row[i] for i in keep] for row in own))
