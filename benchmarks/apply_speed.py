"""Applying a result to a long CSV against polars reading and writing it: `python -m benchmarks.apply_speed`."""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

import numpy as np

from accelcal_cli.sensor.simulation import load_sensor, simulate
from benchmarks.clock import pairs, process, report

G = 9.80665
POLARS = "import polars, sys; polars.read_csv(sys.argv[1]).write_csv(sys.argv[2])"


def write(path: Path, rows: int) -> None:
    """Write a log at 100 Hz: time and three noisy outputs of a sensor that turns over once an hour."""
    import polars

    sensor = load_sensor("mems")
    with path.open("wb") as file:
        for first in range(0, rows, 1_000_000):
            t = np.arange(first, min(first + 1_000_000, rows)) / 100
            angle = 2 * np.pi * t / 3600
            u = np.stack([np.sin(angle), 0.1 * np.ones_like(t), np.cos(angle)], axis=1)
            output = simulate(sensor, u, G, samples=1, noise=0.02, seed=first).output.round(3)
            table = polars.DataFrame(np.column_stack([t, output]), schema=["t", "Nx", "Ny", "Nz"])
            table.write_csv(file, include_header=first == 0)


def largest(which: int) -> float:
    """Return the peak memory of this process or its children, MiB."""
    return resource.getrusage(which).ru_maxrss / 1024


def main(rows: int = 8_640_000, repeat: int = 3) -> None:
    with tempfile.TemporaryDirectory() as folder:
        log, ours, theirs = (Path(folder) / name for name in ("log.csv", "ours.csv", "theirs.csv"))
        poses, result = Path(folder) / "poses.csv", Path(folder) / "result.yaml"
        program = ["-m", "accelcal_cli"]
        process([*program, "simulate", "--sensor", "mems", "--positions", "24", "-o", str(poses)])()
        process([*program, "calibrate", str(poses), "--g", str(G), "-o", str(result)])()
        write(log, rows)
        apply = process([*program, "apply", str(result), str(log), "-o", str(ours)])
        apply()
        peak = largest(resource.RUSAGE_CHILDREN)
        pair = pairs(apply, process(["-c", POLARS, str(log), str(theirs)]), repeat)
        size = log.stat().st_size / 1e6
        report(f"apply to {rows:,} rows ({size:.0f} MB) / polars reads, writes", pair, 2.0)
    print(f"largest peak memory up to the first apply: {peak:.0f} MiB (at most 1024)")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
