"""Whole processes against importing what they need: `python -m benchmarks.startup`."""

from __future__ import annotations

import tempfile
from pathlib import Path

from benchmarks.clock import pairs, process, report

IMPORTS = ["-c", "import numpy, typer, rich.table, yaml"]


def main(repeat: int = 11) -> None:
    with tempfile.TemporaryDirectory() as folder:
        sample = str(Path(folder) / "sample.csv")
        process(["-m", "accelcal_cli", "simulate", "--positions", "12", "--noise", "1e-3", "-o", sample])()
        calibrate = process(["-m", "accelcal_cli", "calibrate", sample])
        report("accelcal calibrate / imports", pairs(calibrate, process(IMPORTS), repeat), 2.0, 1.5)
    help_page = process(["-m", "accelcal_cli", "--help"])
    report("accelcal --help / imports", pairs(help_page, process(IMPORTS), repeat), 1.0)


if __name__ == "__main__":
    main()
