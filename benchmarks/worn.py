"""A simulated week of wear at 100 Hz, 60 million rows, beside scikit-digital-health: `python -m benchmarks.worn`.

Both calibrate the same .cwa file as whole processes, in turn; then both correct the rest of two other days of the same
sensor. `python -m benchmarks.worn blocks` asks instead whether sigma is honest: days of a week, each calibrated by
itself, against the truth.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration, load_result
from accelcal_cli.calibration.settings import load_settings
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.detection.worn import RestWindows, Wear, WornSettings, at_usual_temperature, find_wear, join
from accelcal_cli.io.formats.cwa import DEGREE, ZERO_DEGREES
from accelcal_cli.io.readings import InputForm
from accelcal_cli.io.screening import NOTHING
from benchmarks.worn_logs import WornSensor, simulate_worn, write_cwa

RATE, ACTUAL = 100, 98.8
THEIRS = """
import json, sys, warnings
warnings.simplefilter("ignore")
from skdh.io import ReadCwa
from skdh.preprocessing import CalibrateAccelerometer
class Told(CalibrateAccelerometer):
    def _do_iterative_closest_point_fit(self, store):
        self.told = super()._do_iterative_closest_point_fit(store)
        return self.told
log = ReadCwa().predict(file=sys.argv[1])
found = Told()
found.predict(time=log["time"], accel=log["accel"], fs=log["fs"], temperature=log["temperature"], apply=False)
finished, offset, scale, slope, middle = found.told
print(json.dumps([bool(finished), offset.tolist(), scale.tolist(), slope[0].tolist(), float(middle)]))
"""


def main(repeat: int = 1) -> None:
    with tempfile.TemporaryDirectory(dir=os.environ.get("WORN_FOLDER")) as folder:
        week, other, found = (Path(folder) / name for name in ("week.cwa", "other.cwa", "found.json"))
        for path, days, seed in ((week, 7, 2), (other, 2, 3)):
            write_cwa(path, simulate_worn(WornSensor(), days, RATE, seed), RATE, actual=ACTUAL)
        ours = [
            "-m",
            "accelcal_cli",
            "calibrate",
            "--raw",
            "--worn",
            str(week),
            "--format",
            "json",
            "-o",
            str(found),
        ]
        runs = [(process(ours), process(["-c", THEIRS, str(week)])) for _ in range(repeat + 1)][-repeat:]
        for name, at in (("accelcal calibrate --raw --worn", 0), ("scikit-digital-health", 1)):
            seconds = np.median([run[at][1] for run in runs])
            cpu, peak = np.median([run[at][2] for run in runs]), max(run[at][3] for run in runs)
            print(f"{name:34} {seconds:7.1f} s  {cpu:7.1f} s of processor  {peak:7.0f} MiB")
        print(f"ratio of whole processes {np.median([b[1] / a[1] for a, b in runs]):.2f} (aim 3)")
        result, told = load_result(str(found)), json.loads(runs[-1][1][0])
        z = deviations(result, result.temperature.reference if result.temperature else None)
        print(
            f"parameters off the truth by up to {np.abs(z).max():.2f} sigma (at most 4.5), rms {rms(z):.2f}"
        )
        rest = find_wear(open_raw_log(other), WornSettings(g=1.0)).windows
        mine, their_own = held_out(result, rest), held_out_theirs(told, rest)
        print(
            f"mean of ||f| - g| at rest of two other days: {mine:.3f} mg, theirs {their_own:.3f} mg (at most 10)"
        )


def process(arguments: list[str]) -> tuple[str, float, float, float]:
    """Run a whole Python process; return what it prints, wall and processor seconds, and its peak memory, MiB."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    start = time.perf_counter()
    with subprocess.Popen(
        [sys.executable, *arguments], stdout=subprocess.PIPE, text=True, env=environment
    ) as child:
        assert child.stdout is not None
        text = child.stdout.read()
        _, status, usage = os.wait4(child.pid, 0)
        child.returncode = os.waitstatus_to_exitcode(status)
    if child.returncode:
        raise SystemExit(f"{arguments[:4]}: exit code {child.returncode}")
    seconds = time.perf_counter() - start
    return text, seconds, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1024


def held_out(result: Calibration, rest: RestWindows) -> float:
    """Return the mean of | |f| - 1 g | of windows by a result, mg."""
    output = rest.mean
    if result.temperature is not None and rest.temperature is not None:
        output = result.temperature.at_reference(output, rest.temperature, result.D_a)
    force = result.model.specific_force(output) / result.g
    return 1e3 * float(np.abs(np.linalg.norm(force, axis=1) - 1.0).mean())


def held_out_theirs(told: list[object], rest: RestWindows) -> float:
    """Return the same by what scikit-digital-health found; its degrees are others for the same raw numbers."""
    finished, offset, scale, slope, middle = told
    assert finished
    assert rest.temperature is not None
    raw = (rest.temperature - ZERO_DEGREES) / DEGREE
    warm = ((raw - 171.0) / 3.142 - float(middle))[:, None]  # type: ignore[arg-type]
    force = (rest.mean + np.array(offset)) * np.array(scale) + warm * np.array(slope)
    return 1e3 * float(np.abs(np.linalg.norm(force, axis=1) - 1.0).mean())


def deviations(result: Calibration, degrees: float | None) -> Float:
    """Return by how many sigma the parameters of a result are off the truth at some temperature, shape (9,)."""
    sensor = WornSensor()
    t = (sensor.reference if degrees is None else degrees) - sensor.reference
    K = (1 + sensor.scale_slope * t)[:, None] * sensor.K
    below = np.tril_indices(3)
    scale = (result.K_a - K)[below] / result.sigma.K_a[below]
    return np.concatenate([scale, (result.D_a - sensor.D - sensor.bias_slope * t) / result.sigma.D_a])


def rms(z: Float) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(z * z)))


def blocks(hours: int = 24, weeks: int = 2) -> Float:
    """Calibrate each block of hours of some simulated weeks by itself; print and return its deviations in sigma."""
    settings = load_settings(None, {"g": 1.0, "weights": "auto", "optimizer": "levenberg-marquardt"})
    found = []
    for seed in range(11, 11 + weeks):
        wear = simulated_wear(7 * 24, seed)
        for first in range(0, 7 * 24 - hours + 1, hours):
            part = between(wear, first * 360, (first + hours) * 360)
            result = calibrate(part.readings(), settings)
            slopes, intervals = result.temperature, part.intervals
            assert intervals.temperature is not None
            usual = float(intervals.n @ intervals.temperature / intervals.n.sum())
            found.append(deviations(result, usual if slopes is None else slopes.reference))
            print(f"week {seed} hour {first:3}: {result.verdict:8} rms z {rms(found[-1]):.2f}", flush=True)
    z = np.array(found)
    print(f"{len(z)} blocks of {hours} h: rms z {rms(z):.2f} (0.8 to 1.3), largest {np.abs(z).max():.2f}")
    return z


def simulated_wear(hours: int, seed: int, rate: int = 20) -> Wear:
    """Return the rest of simulated wear without a file; fewer rows a second with as much less noise are as good."""
    sensor = replace(WornSensor(), noise=WornSensor().noise * np.sqrt(rate / RATE))
    means, squares, warm = [], [], []
    for chunk in simulate_worn(sensor, hours / 24, rate, seed):
        windows = chunk.output.reshape(-1, 10 * rate, 3)
        means.append(windows.mean(axis=1))
        squares.append(((windows - means[-1][:, None]) ** 2).sum(axis=1))
        warm.append(chunk.temperature.reshape(-1, 10).mean(axis=1))
    mean, square = np.concatenate(means), np.concatenate(squares)
    degrees = DEGREE * np.round(np.concatenate(warm) / DEGREE)
    number = np.flatnonzero(square.max(axis=1) < 10 * rate * 0.013**2)
    time_ = np.stack([number * 10.0, number * 10.0 + 10.0], axis=1)
    rest = RestWindows(number, mean[number], square[number], time_, degrees[number], 10 * rate)
    names, form = ("ax", "ay", "az"), InputForm(unit="g", rate_hz=float(rate))
    settings = WornSettings(g=1.0)
    poses, _ = at_usual_temperature(join(rest, 1.0, 1.0), slopes=True)
    return Wear(
        "worn", "0" * 64, names, (), form, (), settings, 0.013, 1.0, rest, poses, float(hours), NOTHING
    )


def between(wear: Wear, first: int, last: int) -> Wear:
    """Return the part of wear between two numbers of windows."""
    rest = wear.windows
    here = (rest.number >= first) & (rest.number < last)
    time_ = None if rest.time is None else rest.time[here]
    degrees = None if rest.temperature is None else rest.temperature[here]
    part = RestWindows(rest.number[here], rest.mean[here], rest.square[here], time_, degrees, rest.rows)
    return replace(wear, windows=part, intervals=at_usual_temperature(join(part, 1.0, 1.0), slopes=True)[0])


if __name__ == "__main__":
    if sys.argv[1:2] == ["blocks"]:
        blocks(*map(int, sys.argv[2:]))
    else:
        main(*map(int, sys.argv[1:2]))
