"""SimulatedReadings raw logs for the tests."""

from __future__ import annotations

import io

import numpy as np

from accelcal_cli.detection.rawlog import RawLog, open_raw_log
from accelcal_cli.sensor.poses import directions
from accelcal_cli.sensor.simulation import Handling, load_sensor, simulate_log

G = 9.80665


def simulated(positions=14, *, seed=1, noise=0.03, gyro=True, timed=True, **handling):
    """Rows of a log, shape (n, 3 to 7), and first and last row of each hold, from 1."""
    parts, holds, row = [], [], 0
    u = directions(positions, "fibonacci", np.empty((0, 3)))
    for part in simulate_log(load_sensor("mems"), u, G, Handling(**handling), noise, seed):
        columns = [part.output] + [part.gyro] * gyro + [part.time[:, None]] * timed
        parts.append(np.hstack(columns))
        if part.pose:
            holds.append((row + 1, row + len(part.time)))
        row += len(part.time)
    return np.concatenate(parts), np.array(holds)


def in_blocks(numbers, sizes):
    """The rows in blocks of the given sizes, over and over."""
    at, k = 0, 0
    while at < len(numbers):
        size = sizes[k % len(sizes)]
        yield numbers[at : at + size]
        at, k = at + size, k + 1


def text(numbers, names="ax,ay,az,wx,wy,wz,t"):
    """A log as CSV bytes."""
    file = io.StringIO()
    if names:
        file.write(names + "\n")
    np.savetxt(file, numbers, fmt="%.8g", delimiter=",")
    return file.getvalue().encode()


def opened(data, *columns, **more) -> RawLog:
    """A log read from bytes."""
    return open_raw_log("-", *columns, stdin=io.BytesIO(data), **more)
