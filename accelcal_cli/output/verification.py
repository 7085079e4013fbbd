"""A verification on the terminal: verdict first, then what it rests on."""

from __future__ import annotations

from accelcal_cli.calibration.verify import Verification
from accelcal_cli.calibration.verify_tables import differences, evidence
from accelcal_cli.output import console as rich_console


def show_verification(result: Verification) -> None:
    """Print a verification to standard output."""
    out = rich_console.console()
    rich_console.verdict(result.verdict, result.reasons, out, result.cautions)
    out.print()
    rich_console.show_split(differences(result), out)
    rich_console.show([evidence(result)], out)
