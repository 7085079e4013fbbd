"""Do two halves of a real recording agree? `python -m benchmarks.halves DATA`: random splits, one table.

DATA is a folder with the recordings of `imu_tk_xsens`, `mikoff_mpu9150` and `ctu_innalabs`. A split deals out whole
poses, or whole blocks of 20 rows, at random; both halves are calibrated, and

    z = (a - b) / sqrt(sigma_a^2 + sigma_b^2)

of each parameter of K and D in gauge `lower` has an rms of 1 where the sigma are honest. Where a half has fewer than
ten degrees of freedom, Welch's 95 % interval has to hold the difference instead. A split of which a half is
undetermined is left out and counted.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.distributions import student_quantile
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.io.readings import Readings, read_readings

BLOCK = 20
"""Rows that stay together."""

STEADY = 0.13
"""Rate of turn, rad/s, below which a hand-held sensor counts as steady."""

LOWER = np.tril_indices(3)


@dataclass
class Splits:
    """What the halves of a recording say: z of the parameters, whether Welch's interval holds, splits left out."""

    z: list[Float] = field(default_factory=list)
    inside: list[Float] = field(default_factory=list)
    freedom: float = np.inf
    left_out: int = 0

    def add(self, a: Calibration, b: Calibration) -> None:
        """Add the two halves of a split."""
        if "undetermined" in (a.verdict, b.verdict):
            self.left_out += 1
            return
        difference = _nine(a.K_a, a.D_a) - _nine(b.K_a, b.D_a)
        squares = [_nine(one.sigma.K_a, one.sigma.D_a) ** 2 for one in (a, b)]
        own = a.sigma_freedom, b.sigma_freedom
        self.freedom = min(self.freedom, *own)
        total = squares[0] + squares[1]
        welch = total**2 / (squares[0] ** 2 / own[0] + squares[1] ** 2 / own[1])
        factor = np.array([student_quantile(0.975, max(n, 1.0)) for n in welch])
        self.z.append(difference / np.sqrt(total))
        self.inside.append(np.abs(difference) <= factor * np.sqrt(total))

    def row(self) -> list[str]:
        """Return rms z, the share inside Welch's interval, the least degrees of freedom, and how many were left out."""
        if not self.z:
            return ["-", "-", "-", str(self.left_out)]
        rms, share = np.sqrt(np.mean(np.square(self.z))), np.mean(self.inside)
        return [f"{rms:.2f}", f"{share:.1%}", f"{self.freedom:.1f}", str(self.left_out)]


def _nine(K: Float, D: Float) -> Float:
    return np.concatenate([K[LOWER], D])


def _of_poses(readings: Readings, g: float) -> tuple[int, Callable[[Float], Readings], Settings]:
    """Return how many poses there are, what makes readings of some of them, and settings that use what they tell."""
    output, count, scatter = readings.output(), readings.count, readings.scatter
    weights = "none" if scatter is None else "auto"

    def some(index: Float) -> Readings:
        own = {} if scatter is None else {"count": count[index], "scatter": scatter[index]}
        return Readings.from_array(output[index], **own)

    return len(output), some, Settings("levenberg-marquardt", g=g, weights=weights)


def _of_rows(rows: Float, g: float) -> tuple[int, Callable[[Float], Readings], Settings]:
    blocks = rows[: len(rows) // BLOCK * BLOCK].reshape(-1, BLOCK, 3)
    settings = Settings("levenberg-marquardt", g=g)
    return len(blocks), lambda index: Readings.from_array(blocks[np.sort(index)].reshape(-1, 3)), settings


def _steady(log: Path) -> Float:
    """Return the rows of a hand-held log in which the sensor hardly turns, by its gyroscope."""
    rows = np.loadtxt(log)
    return rows[np.linalg.norm(rows[:, 3:6], axis=1) < STEADY, :3]


def recordings(data: Path) -> dict[str, tuple[int, Callable[[Float], Readings], Settings]]:
    """Return what the recordings are split into: poses, or blocks of rows."""
    xsens, mikoff = data / "imu_tk_xsens", data / "mikoff_mpu9150"
    poses = detect(open_raw_log(xsens / "xsens_acc.txt"), DetectSettings(g=9.81744)).readings()
    log = np.loadtxt(xsens / "xsens_acc.txt")
    ends = np.loadtxt(xsens / "static_means.csv", delimiter=",", skiprows=1)[:, :2]
    held = np.concatenate([log[(log[:, 0] >= first) & (log[:, 0] <= last), 1:4] for first, last in ends])
    return {
        "xsens, poses of detect": _of_poses(poses, 9.81744),
        "xsens, means": _of_poses(read_readings(xsens / "static_means.csv"), 9.81744),
        "xsens, rows of the poses": _of_rows(held, 9.81744),
        "imu0, means": _of_poses(read_readings(mikoff / "imu0_static_means.csv"), 9.81),
        "imu1, means": _of_poses(read_readings(mikoff / "imu1_static_means.csv"), 9.81),
        "imu0, hand-held rows": _of_rows(_steady(mikoff / "imu0.log"), 9.81),
        "imu1, hand-held rows": _of_rows(_steady(mikoff / "imu1.log"), 9.81),
        "innalabs, means": _of_poses(read_readings(data / "ctu_innalabs" / "static_24.csv"), 1.0),
    }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--splits", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print("| recording | parts | rms z | inside Welch's 95 % | least freedom | left out |")
    print("| --- | --- | --- | --- | --- | --- |")
    for name, (parts, some, settings) in recordings(arguments.data).items():
        rng = np.random.default_rng(arguments.seed)
        splits = Splits()
        for _ in range(arguments.splits):
            order = rng.permutation(parts)
            splits.add(*(calibrate(some(half), settings) for half in np.array_split(order, 2)))
        print("| " + " | ".join([name, str(parts), *splits.row()]) + " |", flush=True)


if __name__ == "__main__":
    main()
