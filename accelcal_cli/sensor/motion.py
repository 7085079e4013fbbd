"""A simulated raw log: poses held by a hand, and moves between them, as a calibration at a desk goes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from accelcal_cli.registry import check, setting
from accelcal_cli.sensor.simulation import Sensor
from accelcal_cli.streams import Float, Purpose, Streams

HOLD_SPREAD = 0.2
"""Holds last up to this part longer or shorter than stated."""

SHAKE = 2.0
"""m/s^2 that a hand adds while it moves the sensor."""

TREMOR_RATE = 9.0
"""Hz: a hand trembles at 8 to 12 Hz."""

GYRO_BIAS = np.array([0.012, -0.008, 0.005])
"""rad/s, of the simulated gyroscope."""

GYRO_NOISE = 0.002
"""rad/s, one sigma of one sample and axis."""


@dataclass(frozen=True)
class Handling:
    """How the sensor is held and moved."""

    rate: float = setting(100.0, "rows a second, Hz", low=1, high=1e5)
    hold: float = setting(5.0, "seconds that a pose is held, within a fifth", above=0, high=1e5)
    move: float = setting(2.0, "seconds of a move", above=0, high=1e5)
    tremor: float = setting(0.0, "trembling of a hand that holds it, m/s^2 rms", low=0, high=10)

    def __post_init__(self) -> None:
        """Refuse a value outside its range."""
        check(self)


@dataclass(frozen=True)
class Stretch:
    """A hold or a move.

    Attributes:
        pose: number of the pose that is held, from 1; 0 in a move.
        time: s, shape (n,); output: N, output units, shape (n, 3); gyro: rad/s, shape (n, 3).
    """

    pose: int
    time: Float
    output: Float
    gyro: Float


def handled(
    sensor: Sensor, u: Float, g: float, handling: Handling, noise: float, seed: int
) -> Iterator[Stretch]:
    """Yield a raw log stretch by stretch: a hold for every direction, a move between two.

    Args:
        sensor: the sensor.
        u: unit directions of the specific force, shape (J, 3).
        g: local gravity, m/s^2.
        handling: times and tremor.
        noise: one sigma of one sample and axis, m/s^2.
        seed: of everything random; a stretch draws from a stream of its own.
    """
    row = 0
    for k in range(2 * len(u) - 1):
        streams = Streams(seed, [k], Purpose.RAW_LOG)
        lottery = streams.uniform(1, 8)[0, 0]
        at, still = k // 2, k % 2 == 0
        seconds = handling.hold * (1 + HOLD_SPREAD * (2 * lottery[0] - 1)) if still else handling.move
        n = max(2, round(seconds * handling.rate))
        phase = (np.arange(n) + 0.5) / n
        if still:
            force, rate = _held(g * u[at], phase * n / handling.rate, handling.tremor, lottery[1:4])
        else:
            force, rate = _moved(u[at], u[at + 1], g, phase, n / handling.rate, lottery[1:4])
        force = force + noise * streams.normal(n, 3)[0]
        rate = rate + GYRO_BIAS + GYRO_NOISE * streams.normal(n, 3)[0]
        time = (row + np.arange(n)) / handling.rate
        yield Stretch(at + 1 if still else 0, time, sensor.model.output(force), rate)
        row += n


def _held(f: Float, t: Float, tremor: float, lottery: Float) -> tuple[Float, Float]:
    """Return specific force and turning rate of a hold, both (n, 3): a tilt that swings moves gravity."""
    angle = 2 * math.pi * (TREMOR_RATE * t[:, None] + lottery)
    force = f + math.sqrt(2.0) * tremor * np.sin(angle)
    swing = math.sqrt(2.0) * tremor / float(np.linalg.norm(f)) * 2 * math.pi * TREMOR_RATE
    return force, swing * np.cos(angle)


def _moved(a: Float, b: Float, g: float, phase: Float, seconds: float, lottery: Float) -> tuple[Float, Float]:
    """Return specific force and turning rate, both (n, 3), of a turn from direction a to b with a shake."""
    axis = np.cross(a, b)
    if np.linalg.norm(axis) < 1e-9:  # the same direction, or the opposite one
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
    axis = axis / np.linalg.norm(axis)
    angle = math.acos(float(np.clip(a @ b, -1.0, 1.0)))
    # A turn without a jerk: 10 p^3 - 15 p^4 + 6 p^5 and its derivative.
    turned = angle * (phase**3 * (10 - 15 * phase + 6 * phase**2))[:, None]
    rate = angle / seconds * (30 * phase**2 * (1 - phase) ** 2)[:, None]
    u = a * np.cos(turned) + np.cross(axis, a) * np.sin(turned)
    shake = SHAKE * np.sin(np.pi * phase[:, None]) * np.sin(2 * np.pi * (3 * phase[:, None] + lottery))
    return g * u + shake, -axis * rate  # the world turns against the body
