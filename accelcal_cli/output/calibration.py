"""A calibration on the terminal: verdict first, tables, convergence, notes."""

from __future__ import annotations

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.tables import tables
from accelcal_cli.output import console as rich_console
from accelcal_cli.output.curve import draw

NARROWEST_CURVE = 40


def show_calibration(result: Calibration) -> None:
    """Print a calibration to standard output."""
    out = rich_console.console()
    rich_console.verdict(result.verdict, result.reasons, out, result.cautions)
    out.print()
    rich_console.show(tables(result), out)
    for note in result.notes:
        out.print(f"Note: {note}")
    if len(result.convergence) > 1 and out.width >= NARROWEST_CURVE and out.encoding.startswith("utf"):
        out.print(f"Convergence of {result.optimizer} (best cost L so far, logarithmic)")
        out.print(draw(result.convergence, width=min(60, out.width - 22)), crop=False, overflow="ignore")
