"""Finding the poses of a day at 100 Hz against polars scanning the file: `python -m benchmarks.detect_speed [rows]`."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from accelcal_cli.rng import Streams
from accelcal_cli.sensor.poses import directions
from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate_log
from benchmarks.clock import pairs, process, report

G = 9.80665
DAY = 8_640_000
"""Rows of a day at 100 Hz."""

SCAN = "import polars, sys; polars.scan_csv(sys.argv[1]).select(polars.all().sum()).collect()"
PEAK = (
    "import resource, subprocess, sys; subprocess.run([sys.executable, *sys.argv[1:]], check=True, "
    "stdout=subprocess.DEVNULL); print(resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024)"
)


def write(path: Path, rows: int) -> None:
    """Write a simulated log: poses of 55 s and moves of 5 s in random attitudes."""
    import polars

    count = rows // 6000 + 2
    u = directions(count, "random", Streams(4, [0]).normal(count, 3)[0])
    stretches = simulate_log(load_sensor("mems"), u, G, Handling(hold=55, move=5, tremor=0.01), 0.05, seed=4)
    with path.open("wb") as file:
        written = 0
        for stretch in stretches:
            block = np.column_stack([stretch.time.round(3), stretch.output.round(2)])[: rows - written]
            polars.DataFrame(block, schema=["t", "ax", "ay", "az"]).write_csv(
                file, include_header=not written
            )
            written += len(block)
            if written >= rows:
                return


def main(rows: int = DAY, repeat: int = 3) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "day.csv"
        write(path, rows)
        size = path.stat().st_size / 1e6
        detect = ["-m", "accelcal_cli", "detect", str(path), "--format", "csv", "-q"]
        pair = pairs(process(detect), process(["-c", SCAN, str(path)]), repeat)
        report(f"detect in {rows:,} rows ({size:.0f} MB) / polars scans", pair, 3.0)
        peak = subprocess.run(
            [sys.executable, "-c", PEAK, *detect], check=True, capture_output=True, text=True
        )
    print(f"peak memory of detect: {int(peak.stdout)} MiB (at most 1024)")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
