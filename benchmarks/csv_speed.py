"""Calibrating a CSV of ten million readings against polars reading it: `python -m benchmarks.csv_speed [rows]`."""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

import numpy as np

from accelcal_cli.sensor.simulation import load_sensor, simulate
from benchmarks.clock import pairs, process, report

G = 9.80665


def write(path: Path, rows: int) -> None:
    """Write noisy readings at random attitudes, as a long hand-held log without labels would have them."""
    import polars

    rng = np.random.default_rng(5)
    sensor = load_sensor("mems")
    with path.open("wb") as file:
        for first in range(0, rows, 1_000_000):
            u = rng.standard_normal((min(1_000_000, rows - first), 3))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            output = simulate(sensor, u, G, samples=1, noise=0.01, seed=first).output.round(4)
            polars.DataFrame(output, schema=["Nx", "Ny", "Nz"]).write_csv(file, include_header=first == 0)


def main(rows: int = 10_000_000, repeat: int = 3) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "readings.csv"
        write(path, rows)
        size = path.stat().st_size / 1e6
        read = ["-c", "import polars, sys; polars.read_csv(sys.argv[1])", str(path)]
        calibrate = ["-m", "accelcal_cli", "calibrate", str(path), "--g", str(G), "--format", "json"]
        pair = pairs(process(calibrate), process(read), repeat)
        report(f"calibrate {rows:,} rows ({size:.0f} MB) / polars reads", pair, 4.0, 2.0)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"largest peak memory of the processes above (polars' reading included): {peak:.0f} MiB")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
