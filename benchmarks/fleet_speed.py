"""Calibrating 10,000 sensors of 12 poses from CSV to CSV: `python -m benchmarks.fleet_speed [sensors]`.

The whole process against polars reading the file, and against a loop over scipy.optimize.least_squares
(method lm, analytic Jacobian, closed-form start) on some of the sensors, extrapolated to all.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.problem import compress_each, fit_ellipsoid, pack, unpack
from accelcal_cli.sensor.poses import faces_edges
from accelcal_cli.sensor.simulation import load_sensor, simulate_fleet
from benchmarks.clock import pairs, process, report

G = 9.80665
LOOPED = 300
"""Sensors that the loop over SciPy calibrates."""


def outputs(sensors: int) -> Float:
    """Return readings of simulated sensors, shape (R, 12, 3)."""
    device = load_sensor("mems")
    drawn = simulate_fleet(device, sensors, faces_edges(), G, 1, device.noise, 0)
    return np.stack([readings.output for _, readings in drawn])


def write(path: Path, readings: Float) -> None:
    import polars

    flat = readings.reshape(-1, 3).round(4)
    labels = [f"S{k:05d}" for k in range(len(readings)) for _ in range(readings.shape[1])]
    polars.DataFrame({"sensor": labels, **dict(zip(("Nx", "Ny", "Nz"), flat.T, strict=True))}).write_csv(path)


def loop(readings: Float) -> list[Float]:
    """Calibrate sensor by sensor, as a user of SciPy would who knows the closed form and the Jacobian."""
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

    return [
        least_squares(residuals, start[r], jac=jacobian, method="lm", args=(x[r],)).x for r in range(len(x))
    ]


def main(sensors: int = 10_000, repeat: int = 3) -> None:
    readings = outputs(sensors)
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "fleet.csv", Path(folder) / "calibrated.csv"
        write(path, readings)
        read = ["-c", "import polars, sys; polars.read_csv(sys.argv[1])", str(path)]
        fleet = ["-m", "accelcal_cli", "fleet", str(path), "--g", str(G), "-q", "-o", str(out)]
        pair = pairs(process(fleet), process(read), repeat)
        report(f"fleet of {sensors:,} sensors x 12, CSV to CSV / polars reads", pair, 6.0, 4.0)
        peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
        few = readings[:LOOPED]
        loop(few[:10])
        pair = pairs(process(fleet), lambda: loop(few), repeat)
    whole = pair.theirs * sensors / len(few)
    print(f"loop over SciPy, {sensors:,} sensors, extrapolated from {len(few)}: {whole:.3g} s")
    print(f"the whole process takes 1/{whole / pair.ours:.1f} of it, reading and writing included")
    print(f"largest peak memory of the processes: {peak:.0f} MiB")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
