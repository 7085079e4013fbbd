"""One cost evaluation of 100 particles at a million readings against a hundred: `python -m benchmarks.compression`."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.problem import Box, Loetters, compress, pack
from accelcal_cli.sensor.poses import fibonacci
from accelcal_cli.sensor.simulation import load_sensor, simulate
from benchmarks.clock import pairs, report

G = 9.80665
EVALUATIONS = 2000


def problem(readings: int) -> Loetters:
    sensor = load_sensor("mems")
    N = simulate(sensor, fibonacci(readings), G, samples=1, noise=0.01, seed=1).output
    K = np.diag(np.diagonal(sensor.model.K))
    half = np.concatenate([0.05 * np.diagonal(K), np.full(3, 0.06 * K.mean()), np.full(3, 0.1 * G * K.max())])
    blocks = ((N[first : first + 65536], None) for first in range(0, readings, 65536))
    triangle = compress(blocks, N.mean(axis=0)[None], np.array([np.ptp(N) / 2]), np.array([len(N)]))
    return Loetters(triangle, G, Box(pack(K, np.zeros(3), 9)[None], half[None]))


def main(repeat: int = 11) -> None:
    x = np.random.default_rng(0).uniform(-1, 1, (1, 9, 100)).transpose(0, 2, 1)
    many, few = problem(1_000_000), problem(100)

    def evaluate(which: Loetters) -> None:
        for _ in range(EVALUATIONS):
            which.cost(x)

    pair = pairs(lambda: evaluate(many), lambda: evaluate(few), repeat)
    report(f"{EVALUATIONS} x cost of 100 points: 1e6 / 100 readings", pair, 1.2)


if __name__ == "__main__":
    main()
