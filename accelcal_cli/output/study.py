"""Studies on the terminal: tables, each as wide as fits, and convergence plots."""

from __future__ import annotations

from collections.abc import Iterable

from rich.text import Text

from accelcal_cli.output import console as rich_console
from accelcal_cli.output.benchmark import NARROWEST_CURVE, Curves, show_curves
from accelcal_cli.table import Table


def show_study(title: str, tables: Iterable[Table], curves: Curves, note: str = "") -> None:
    """Print a study to standard output.

    Args:
        title: what was run; note: what to know when reading it.
        tables: its tables, each with its title and notes.
        curves: evaluations and median cost, by what they belong to and optimizer.
    """
    out = rich_console.console()
    out.print(Text(title, "bold"))
    if note:
        out.print(Text(note.strip()))
    out.print()
    for table in tables:
        rich_console.show_split(table, out)
    if out.width < NARROWEST_CURVE:
        return
    for name, panel in curves.items():
        show_curves(name, panel, out)
