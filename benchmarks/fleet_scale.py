"""Fleets of any size: `python -m benchmarks.fleet_scale [sizes|jobs|kills|logs] ...`, all of them without a name.

    sizes   10,000, 100,000 and 1,000,000 sensors of 12 poses, Parquet to Parquet: time, its exponent, peak memory
            (`--sensors N` for other sizes)
    jobs    100,000 sensors with one process and with two: seconds, and that the files are the same
    kills   a run of two processes killed 20 times at random moments and resumed: the same file (`--kills N`)
    logs    raw logs of 20,000 rows with two processes against one log of as many rows (`--logs N`, 300 of 10,000)

Times are of the whole process, start-up included; beside them is its processor time, which a busy machine does not
change. Nothing else should run meanwhile.
"""

from __future__ import annotations

import argparse
import math
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accelcal_cli.output.machine import write_log
from accelcal_cli.sensor.poses import edges, fibonacci
from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate_log

G = 9.80665
AT_ONCE = 100_000
"""Sensors that are made at once."""

ROWS, RATE = 20_000, 100.0
"""Rows of a log, and rows per second."""


@dataclass(frozen=True)
class Cost:
    """What a process took: seconds, seconds of processors, and MiB at its peak, or of the largest of its workers."""

    wall: float
    cpu: float
    peak: float

    def __str__(self) -> str:
        """All three."""
        return f"{self.wall:8.2f} s  {self.cpu:8.2f} s of processors  {self.peak:6.0f} MiB"


def accelcal(folder: Path, *arguments: str) -> Cost:
    """Run a command line, whatever its verdict."""
    start = time.monotonic()
    process = subprocess.Popen(
        [sys.executable, "-m", "accelcal_cli", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OPENBLAS_NUM_THREADS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    errors = process.stderr.read() if process.stderr else ""
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(arguments)}: {errors}")
    return Cost(time.monotonic() - start, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024)


def write_fleet(path: Path, sensors: int, seed: int = 1) -> None:
    """Write readings of random sensors in the twelve edges as Parquet, a part at a time."""
    import polars

    from accelcal_cli.io.parquet import sink

    def parts():
        for start in range(0, sensors, AT_ONCE):
            rng = np.random.default_rng([seed, start])
            count, u = min(AT_ONCE, sensors - start), edges()
            K = 1670.0 * (np.eye(3) * (1.0 + 0.02 * rng.standard_normal((count, 1, 3))))
            K += np.tril(rng.standard_normal((count, 3, 3)) * 5.0, -1)
            force = G * u + 0.01 * rng.standard_normal((count, len(u), 3))
            output = np.einsum("nij,nkj->nki", K, force) + 300.0 * rng.standard_normal((count, 1, 3))
            flat = output.reshape(-1, 3).round(4)
            labels = [f"S{k:07d}" for k in range(start, start + count)]
            named = polars.Series("sensor", labels).gather(np.repeat(np.arange(count), len(u)))
            yield polars.DataFrame(
                [named, *(polars.Series(n, flat[:, i]) for i, n in enumerate(("ax", "ay", "az")))]
            )

    sink(parts(), str(path))


def make_fleet(path: Path, sensors: int) -> None:
    """Write a fleet in another process: what this one has in memory would count as the peak of those it starts."""
    line = f"from benchmarks.fleet_scale import *; write_fleet(Path({str(path)!r}), {sensors})"
    subprocess.run([sys.executable, "-c", line], check=True, cwd=Path(__file__).parents[1])


def sizes(folder: Path, sensors: Sequence[int]) -> None:
    """Print time and memory by the number of sensors."""
    costs = []
    for count in sensors:
        make_fleet(folder / "fleet.parquet", count)
        cost = accelcal(folder, "fleet", "fleet.parquet", "--g", str(G), "-q", "-o", "out.parquet")
        costs.append(cost)
        print(f"{count:9,} sensors  {cost}  {1e6 * cost.cpu / count:6.1f} us of processors each", flush=True)
    for (few, one), (many, other) in zip(
        zip(sensors, costs, strict=True), zip(sensors[1:], costs[1:], strict=True), strict=False
    ):
        exponent = math.log(other.cpu / one.cpu) / math.log(many / few)
        print(f"exponent of processor time, {few:,} to {many:,} sensors: {exponent:.3f}")


def jobs(folder: Path, sensors: int) -> None:
    """Print what a second process is worth."""
    make_fleet(folder / "fleet.parquet", sensors)
    line = ("fleet", "fleet.parquet", "--g", str(G), "-q", "-o")
    one = accelcal(folder, *line, "one.parquet")
    two = accelcal(folder, *line, "two.parquet", "--jobs", "2")
    same = (folder / "one.parquet").read_bytes() == (folder / "two.parquet").read_bytes()
    print(f"--jobs 1  {one}\n--jobs 2  {two}")
    print(f"{one.wall / two.wall:.2f} times as fast; the same bytes: {same}")


def kills(folder: Path, times: int, sensors: int) -> None:
    """Kill a run at random moments, resume it, and compare."""
    make_fleet(folder / "fleet.parquet", sensors)
    line = ("fleet", "fleet.parquet", "--g", str(G), "-q", "--jobs", "2", "-o")
    whole = accelcal(folder, *line, "whole.parquet")
    rng, killed, finished = random.Random(7), 0, False
    while killed < times:
        run = subprocess.Popen(
            [sys.executable, "-m", "accelcal_cli", *line, "out.parquet", "--resume"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            run.wait(rng.uniform(0.2, max(2.0, 0.4 * whole.wall)))
            finished = True  # it was faster: begin anew
            os.unlink(folder / "out.parquet")
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            killed += 1
    accelcal(folder, *line, "out.parquet", "--resume")
    same = (folder / "whole.parquet").read_bytes() == (folder / "out.parquet").read_bytes()
    again = ", begun anew where it had finished between two kills" if finished else ""
    print(f"killed {killed} times at random moments and resumed{again}; the same bytes: {same}")


def write_one_log(path: Path, rows: int, seed: int) -> int:
    """Write a raw log of about so many rows as text, 24 poses; return its rows."""
    device, positions, move = load_sensor("mems"), 24, 2.0
    hold = (rows / RATE - (positions - 1) * move) / positions
    handling = Handling(rate=RATE, hold=hold, move=move)
    with path.open("w") as file:
        holds = write_log(simulate_log(device, fibonacci(positions), G, handling, 0.02, seed), False, file)
    return holds[-1][1]


def logs(folder: Path, count: int) -> None:
    """Compare many raw logs with two processes with one log of as many rows."""
    rows = sum(write_one_log(folder / f"log{k:05d}.csv", ROWS, k) for k in range(count))
    one = write_one_log(folder / "whole.csv", min(count * ROWS, 10_000_000), 1)
    names = sorted(path.name for path in folder.glob("log*.csv"))
    alone = accelcal(
        folder, "calibrate", "--raw", "whole.csv", "--g", str(G), "-q", "--optimizer", "levenberg-marquardt"
    )
    print(f"one log of {one:,} rows    {alone}  {one / alone.wall:,.0f} rows a second", flush=True)
    fleet = ("fleet", "--raw", "--g", str(G), "-q", "-o", "out.parquet", *names)
    for processes in ("1", "2"):
        many = accelcal(folder, *fleet, "--jobs", processes)
        print(
            f"{count:,} logs, --jobs {processes}  {many}  {rows / many.wall:,.0f} rows a second: "
            f"{rows / many.wall / (int(processes) * one / alone.wall):.2f} of {processes} times one log; by processor "
            f"time {rows / many.cpu / (one / alone.cpu):.2f}",
            flush=True,
        )


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet_scale", description=__doc__)
    parser.add_argument("what", nargs="*", choices=["sizes", "jobs", "kills", "logs", []], default=[])
    parser.add_argument("--sensors", type=int, nargs="+")
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--logs", type=int, default=300)
    asked = parser.parse_args(arguments)
    what = asked.what or ["sizes", "jobs", "kills", "logs"]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if "sizes" in what:
            sizes(folder, asked.sensors or [10_000, 100_000, 1_000_000])
        if "jobs" in what:
            jobs(folder, (asked.sensors or [100_000])[0])
        if "kills" in what:
            kills(folder, asked.kills, (asked.sensors or [50_000])[0])
        if "logs" in what:
            logs(folder, asked.logs)


if __name__ == "__main__":
    main()
