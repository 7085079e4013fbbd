"""Does choosing the threshold by the fit make sigma too small? `python -m benchmarks.detect_choice [logs]`."""

from __future__ import annotations

import io
import sys

import numpy as np

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import Detection, DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.rng import Streams
from accelcal_cli.sensor.poses import directions
from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate_log

G, POSES, MODEL_ERROR = 9.80665, 18, 0.003
"""m/s^2, poses of a log, and the error that each keeps beside its noise, m/s^2."""


def log(seed: int) -> bytes:
    """Return a simulated log in random attitudes."""
    sensor = load_sensor("mems")
    u = directions(POSES, "random", Streams(seed, [0], purpose=7).normal(POSES, 3)[0])
    lines = []
    for part in simulate_log(sensor, u, G, Handling(hold=4, move=1.5, tremor=0.03), 0.05, seed):
        own = MODEL_ERROR * sensor.K_a[0][0] * Streams(seed, [part.pose], purpose=9).normal(1, 3)[0]
        lines += [",".join(f"{cell:.8g}" for cell in row) + "\n" for row in part.output + own]
    return "".join(lines).encode()


def normalised(found: Detection) -> np.ndarray:
    """Return the errors of the parameters over their sigma, shape (9,)."""
    truth = load_sensor("mems").model.in_gauge("lower")
    result = calibrate(found.readings(), Settings(optimizer="ellipsoid", weights="auto"))
    lower = np.tril_indices(3)
    K = (result.K_a - truth.K)[lower] / result.sigma.K_a[lower]
    return np.concatenate([K, (result.D_a - truth.D) / result.sigma.D_a])


def main(logs: int = 60) -> None:
    for name, settings in {
        "chosen": DetectSettings(),
        "always 6": DetectSettings(multipliers=(6.0,)),
    }.items():
        z = []
        for seed in range(logs):
            raw = open_raw_log("-", stdin=io.BytesIO(log(seed)))
            z.append(normalised(detect(raw, settings)))
        rms = float(np.sqrt(np.mean(np.square(z))))
        print(f"multiplier {name:9} rms of error / sigma {rms:.3f} over {logs} logs of {POSES} poses")
    expected = np.sqrt((POSES - 9) / (POSES - 11))
    print(f"Student's distribution with {POSES - 9} degrees of freedom: {expected:.3f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:2]))
