"""Fleets of sensors of 12 poses on one processor: `python -m benchmarks.fleet_speed [sensors] [--sizes]`.

Processor time per sensor, from arrays to arrays (sigma, intervals, dilution of precision, verdict, warnings), and of
the whole process from Parquet to Parquet, less that of a fleet of ten sensors: start-up. Beside it loops over
`scipy.optimize.least_squares` (method lm, closed-form start), two-point and with the analytic Jacobian, on some of the
sensors, in turn with ours; and how far the parameters are apart. With `--sizes` a tenth of the sensors and ten times as
many, for the exponent of the time.

Two sets of poses: evenly spread ones, and six faces with six edges, two of which no other pose checks, so that a
sentence is said of every sensor.
"""

from __future__ import annotations

import os

for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "POLARS_MAX_THREADS"):
    os.environ.setdefault(name, "1")

import resource  # noqa: E402
import statistics  # noqa: E402
import subprocess  # noqa: E402
import sys  # noqa: E402
import tempfile  # noqa: E402
import time  # noqa: E402
from collections.abc import Callable  # noqa: E402
from pathlib import Path  # noqa: E402

import numpy as np  # noqa: E402

from accelcal_cli.arrays import Float  # noqa: E402
from accelcal_cli.calibration.fleet import Fleet, calibrate_fleet  # noqa: E402
from accelcal_cli.calibration.problem import compress_each, fit_ellipsoid, pack, unpack  # noqa: E402
from accelcal_cli.calibration.settings import Settings  # noqa: E402
from accelcal_cli.io.fleet import read_fleet  # noqa: E402
from accelcal_cli.sensor.poses import faces_edges, fibonacci  # noqa: E402
from accelcal_cli.sensor.simulation import load_sensor, simulate_fleet  # noqa: E402

G = 9.80665
LOOPED = 200
"""Sensors that the loops over SciPy calibrate."""

REPEAT = 5
SETTINGS = Settings(optimizer="levenberg-marquardt", g=G)
POSES = {"12 poses evenly spread": fibonacci(12), "6 faces and 6 edges": faces_edges()}


def outputs(sensors: int, u: Float | None = None) -> Float:
    """Return readings of simulated sensors in directions u, six faces and six edges by default, shape (R, J, 3)."""
    device = load_sensor("mems")
    u = faces_edges() if u is None else u
    drawn = simulate_fleet(device, sensors, u, G, 1, device.noise, 0)
    return np.stack([readings.output for _, readings in drawn])


def write(path: Path, readings: Float) -> None:
    """Write readings, shape (R, J, 3), with a label for each sensor as Parquet."""
    import polars

    sensors, poses, _ = readings.shape
    label = polars.Series("sensor", [f"S{k:07d}" for k in range(sensors)])
    columns = dict(zip(("Nx", "Ny", "Nz"), readings.reshape(-1, 3).T, strict=True))
    number = np.repeat(np.arange(sensors), poses)
    polars.DataFrame({"sensor": label.gather(number), **columns}).write_parquet(path)


def loop(readings: Float, *, analytic: bool = True, tight: bool = False) -> list[Float]:
    """Calibrate sensor by sensor, as a user of SciPy would who knows the closed form, and perhaps the Jacobian."""
    from scipy.optimize import least_squares

    triangle = compress_each(readings)
    K, d = fit_ellipsoid(triangle)
    start = pack(K, d, 9)
    x = (readings - triangle.centre[:, None]) / triangle.scale[:, None, None]
    rows, columns = np.array([0, 1, 2, 1, 2, 2]), np.array([0, 1, 2, 0, 0, 1])

    def force(theta: Float, own: Float) -> tuple[Float, Float]:
        K, d = unpack(theta)
        A = np.linalg.inv(K)
        return (own - d) @ A.T, A

    def residuals(theta: Float, own: Float) -> Float:
        f, _ = force(theta, own)
        return 1.0 - np.einsum("ji,ji->j", f, f)

    def jacobian(theta: Float, own: Float) -> Float:
        f, A = force(theta, own)
        h = 2.0 * f @ A  # of |f|^2 by -d, and by K_ik through f_k
        return np.concatenate([h[:, rows] * f[:, columns], h], axis=1)

    jac = jacobian if analytic else "2-point"
    stop = 1e-15 if tight else 1e-8
    found = []
    for r in range(len(x)):
        stated = {"jac": jac, "method": "lm", "xtol": stop, "ftol": stop, "gtol": stop}
        theta = least_squares(residuals, start[r], args=(x[r],), **stated).x
        K, d = unpack(theta)
        K, d = K * triangle.scale[r] / G, d * triangle.scale[r] + triangle.centre[r]
        found.append(np.concatenate([K.ravel(), d]))
    return found


def processor(call: Callable[[], object]) -> float:
    """Return the processor seconds of one call, children included."""

    def spent() -> float:
        own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
        return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime

    start = spent()
    call()
    return spent() - start


def command(path: Path, out: Path) -> Callable[[], object]:
    """Return a call of `accelcal fleet` from a file to a file; the sensors that are not good make its exit code 1."""
    arguments = [
        sys.executable,
        "-m",
        "accelcal_cli",
        "fleet",
        str(path),
        "--g",
        str(G),
        "-q",
        "-o",
        str(out),
    ]
    return lambda: subprocess.run(arguments, check=False, capture_output=True)


def compare(name: str, u: Float, sensors: int, folder: Path) -> None:
    """Print the times of a fleet with these poses, and those of the loops."""
    readings, few = outputs(sensors, u), folder / "few.parquet"
    path, out = folder / f"{sensors}.parquet", folder / "out.parquet"
    write(path, readings)
    write(few, readings[:10])
    table = read_fleet([str(path)])
    some = readings[:LOOPED]
    fleet = calibrate_fleet(table, SETTINGS)
    times: dict[str, list[float]] = {}
    for _ in range(REPEAT):  # in turn: a machine with other work moves all alike
        for what, call, each in (
            ("arrays to arrays", lambda: calibrate_fleet(table, SETTINGS), sensors),
            ("loop, two-point", lambda: loop(some, analytic=False), LOOPED),
            ("loop, analytic Jacobian", lambda: loop(some), LOOPED),
            ("whole process", command(path, out), sensors),
            ("start-up", command(few, folder / "few_out.parquet"), sensors),
        ):
            times.setdefault(what, []).append(1e6 * processor(call) / each)
    ours = times["arrays to arrays"]
    print(
        f"{name}, {sensors:,} sensors: microseconds of processor time per sensor, median of {REPEAT} (least)"
    )
    for what, own in times.items():
        if what == "whole process":
            own = [a - b for a, b in zip(own, times["start-up"], strict=True)]
            what = "Parquet to Parquet, start-up taken off"
        if what == "start-up":
            continue
        ratio = statistics.median(a / b for a, b in zip(own, ours, strict=True))
        print(
            f"  {what:40} {statistics.median(own):9.1f} ({min(own):.1f})   {ratio:6.1f} times arrays to arrays"
        )
    print(f"  largest relative difference of the parameters: {apart(fleet, loop(some, tight=True)):.1e}")


def apart(fleet: Fleet, found: list[Float]) -> float:
    """Return the largest difference to the parameters of the loop, as a part of the matrix or of g in its units."""
    ours = np.concatenate([fleet.K_a[: len(found)].reshape(-1, 9), fleet.D_a[: len(found)]], axis=1)
    size = np.abs(fleet.K_a[: len(found)]).max(axis=(1, 2))[:, None] * np.repeat([1.0, G], [9, 3])
    return float((np.abs(ours - np.array(found)) / size).max())


def sizes(sensors: int, folder: Path) -> None:
    """Print the times of a tenth of the sensors, of all and of ten times as many, and the exponent."""
    readings = outputs(sensors // 10, fibonacci(12))
    times, counts = [], (sensors // 10, sensors, 10 * sensors)
    for count in counts:
        path = folder / "sized.parquet"
        write(path, np.tile(readings, (count // len(readings), 1, 1)))
        call = command(path, folder / "sized_out.parquet")
        before = time.perf_counter()
        times.append(processor(call))
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        wall = time.perf_counter() - before
        print(
            f"{count:>10,} sensors: {times[-1]:8.1f} s processor, {wall:8.1f} s, peak memory {peak:.0f} MiB"
        )
    slope = np.polyfit(np.log(counts), np.log(times), 1)[0]
    print(f"exponent of the processor time: {slope:.3f}")


def main(sensors: int = 100_000, more: bool = False) -> None:
    """Print everything."""
    with tempfile.TemporaryDirectory() as folder:
        for name, u in POSES.items():
            compare(name, u, sensors, Path(folder))
        if more:
            sizes(sensors, Path(folder))


if __name__ == "__main__":
    numbers = [int(word) for word in sys.argv[1:] if word.isdigit()]
    main(*numbers[:1], more="--sizes" in sys.argv)
