"""How often `accelcal verify` calls sensors changed: `python -m benchmarks.verify_level [sensors] [pairs]`.

First of estimates drawn from their distribution, which is quick and shows many cases; then of pairs of simulated
readings that are calibrated and verified as the command does it.
"""

from __future__ import annotations

import sys

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.distributions import Noise, Pair, combined
from accelcal_cli.calibration.observability import design
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.verification import verify

LEVEL = 0.05
G, NOISE = 9.80665, 2e-3
"""Local gravity and the noise of one pose, m/s^2, of the simulated readings."""
SETS = {
    "12": poses.faces_edges(),
    "24": poses.turns(),
    "12 twice": np.repeat(poses.faces_edges(), 2, axis=0),
    "60": poses.fibonacci(60),
}
CASES = (
    *(
        (old, new, 1.0, 0.0)
        for old, new in (("12", "12"), ("24", "12"), ("24", "24"), ("12 twice", "12 twice"))
    ),
    ("60", "12", 1.0, 0.0),
    *((old, new, 2.0, 0.0) for old, new in (("24", "24"), ("24", "12"), ("60", "12"))),
    *(
        (old, new, 1.0, 5.0)
        for old, new in (("12", "12"), ("24", "24"), ("12 twice", "12 twice"), ("60", "24"))
    ),
)
"""Poses of the old readings and the new, noise of the new over the old, shift of one bias in sigma."""


def cofactor(u: Float) -> Float:
    A = design(u)
    return np.linalg.inv(A.T @ A)


def rate(old: str, new: str, ratio: float, shift: float, sensors: int) -> float:
    """Return the part that is called changed, of estimates drawn from their distribution."""
    A, B, n_a, n_b = cofactor(SETS[old]), cofactor(SETS[new]), len(SETS[old]) - 9, len(SETS[new]) - 9
    z = Streams(5, [0], purpose=3).normal(sensors, 9 + n_a + n_b)[0]
    V = A + ratio**2 * B
    d = z[:, :9] @ np.linalg.cholesky(V).T
    d[:, 8] += shift * np.sqrt(V[8, 8])
    a, b = (z[:, 9 : 9 + n_a] ** 2).mean(axis=1), ratio**2 * (z[:, 9 + n_a :] ** 2).mean(axis=1)
    changed = 0
    for j in range(sensors):
        pair = Pair.of(Noise(float(a[j]), n_a), Noise(float(b[j]), n_b))
        single = [pair.chance(d[j, [p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)]
        changed += combined(np.array([*single, pair.chance(d[j], A, B)])) < LEVEL
    return changed / sensors


WHOLE = (("24", "24", 0.0), ("24", "12", 0.0), ("12", "12", 0.0), ("24", "24", 5.0))
"""Poses of the old readings and the new, shift of one bias in sigma."""


def whole(old: str, new: str, shift: float, pairs: int) -> float:
    """Return the part that is called changed, of simulated sensors that are calibrated and then read again."""
    u, v = SETS[old], SETS[new]
    z = Streams(6, range(pairs), purpose=4).normal(1, 12 + 3 * (len(u) + len(v)))[:, 0]
    moved = shift * NOISE * np.sqrt(cofactor(u)[8, 8] + cofactor(v)[8, 8])
    changed = 0
    for draw in z:
        K = np.eye(3) + 0.01 * draw[:9].reshape(3, 3)
        D, noise = 0.2 * draw[9:12], NOISE * draw[12:].reshape(-1, 3)
        later = D + np.array([0.0, 0.0, moved * K[2, 2]])
        before = Readings.from_array(ErrorModel(K, D).output(G * u + noise[: len(u)]))
        after = Readings.from_array(ErrorModel(K, later).output(G * v + noise[len(u) :]))
        result = calibrate(before, Settings(g=G, optimizer="levenberg-marquardt"))
        changed += verify(result, after, LEVEL).verdict == "changed"
    return changed / pairs


def main(sensors: int = 4000, pairs: int = 1000) -> None:
    print("| old poses | new poses | noise, new / old | shift of one bias | called changed |")
    print("| --- | --- | --- | --- | --- |")
    for old, new, ratio, shift in CASES:
        share = rate(old, new, ratio, shift, sensors)
        print(f"| {old} | {new} | {ratio:g} | {shift:g} sigma | {share:.1%} |", flush=True)
    print(f"\nFrom readings, {pairs:,} sensors each:\n")
    print("| old poses | new poses | shift of one bias | called changed |")
    print("| --- | --- | --- | --- |")
    for old, new, shift in WHOLE:
        print(f"| {old} | {new} | {shift:g} sigma | {whole(old, new, shift, pairs):.1%} |", flush=True)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:3]))
