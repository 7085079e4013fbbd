"""A sensor of known errors, and what it would read: static readings, or a raw log.

The raw log is that of a calibration at a desk: poses held by hand, and moves between them.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import Checked, from_mapping, setting
from accelcal_cli.sensor.model import STANDARD_GRAVITY, ErrorModel
from accelcal_cli.sensor.poses import directions

if TYPE_CHECKING:
    import polars

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

Row = tuple[float, float, float]


@dataclass(frozen=True)
class Spread(Checked):
    """How sensors of one type differ: one sigma of their errors."""

    scale: float = setting(0.0, "scale factor, part of nominal", low=0, high=0.2)
    misalignment: float = setting(0.0, "misalignment, rad", low=0, high=0.2)
    bias: float = setting(0.0, "bias, m/s^2", low=0, high=50)


@dataclass(frozen=True)
class Sensor(Checked):
    """A sensor configuration: its true errors, its noise, and how its type spreads."""

    name: str = setting("", "what it is")
    source: str = setting("", "where the numbers come from")
    unit: str = setting("", "unit of the output")
    K_a: tuple[Row, Row, Row] = setting(None, "pulse-equivalent matrix, output units per m/s^2")
    D_a: Row = setting((0.0, 0.0, 0.0), "bias, output units")
    noise: float = setting(0.0, "noise of one sample and axis, one sigma, m/s^2", low=0, high=100)
    spread: Spread = Spread()

    def __post_init__(self) -> None:
        """Raise ConfigError for a sensor without an invertible matrix."""
        super().__post_init__()
        if self.K_a is None:
            raise ConfigError("K_a: missing; expected three rows of three numbers")
        if not np.isfinite(self.K_a).all() or abs(np.linalg.det(np.array(self.K_a))) == 0:
            raise ConfigError("K_a: singular; expected an invertible matrix of finite numbers")

    @property
    def model(self) -> ErrorModel:
        """Its error model."""
        return ErrorModel(np.array(self.K_a), np.array(self.D_a))


def load_sensor(name: str) -> Sensor:
    """Return a sensor by the name of a shipped configuration or by the path of a file.

    Raises:
        ConfigError: neither such a configuration nor such a file, or one that says something unknown.
    """
    files = shipped("sensors")
    path = files.get(name, Path(name))
    if name not in files and not path.suffix:
        raise ConfigError(
            f'unknown sensor "{name}"{did_you_mean(name, files)}; known: {", ".join(files)}, or the path of a '
            "YAML file"
        )
    return from_mapping(Sensor, load_mapping(path), str(path))


@dataclass(frozen=True)
class SimulatedReadings:
    """Samples of a simulated sensor at rest.

    Attributes:
        pose: number of the pose of each sample, from 1, shape (n,).
        output: N, output units, shape (n, 3).
        force: true specific force, m/s^2, shape (n, 3).
    """

    pose: Float
    output: Float
    force: Float

    def to_frame(self) -> polars.DataFrame:
        """Return the samples as a frame of polars that `calibrate` takes: columns pose, Nx, Ny, Nz."""
        import polars

        columns = dict(zip(("Nx", "Ny", "Nz"), np.ascontiguousarray(self.output.T), strict=True))
        return polars.DataFrame({"pose": self.pose, **columns})


def draw(sensor: Sensor, runs: Sequence[int], seed: int) -> ErrorModel:
    """Return sensors of one type, one per run: K of shape (R, 3, 3), D of shape (R, 3).

    Around the ideal sensor of the type (its mean scale factor, no misalignment, no bias) with its spread.

    Args:
        sensor: the type.
        runs: numbers of the runs; run r draws the same sensor whatever the other runs.
        seed: of all draws.
    """
    z = Streams(seed, runs, Purpose.SENSOR).normal(4, 3)
    nominal = float(np.trace(np.array(sensor.K_a))) / 3.0
    scale = nominal * (1.0 + sensor.spread.scale * z[:, 0])
    turned = np.broadcast_to(np.eye(3), (len(z), 3, 3)).copy()
    turned[:, [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = sensor.spread.misalignment * z[:, 1:3].reshape(-1, 6)
    return ErrorModel(scale[..., None] * turned, scale * sensor.spread.bias * z[:, 3])


@overload
def simulate(
    sensor: Sensor | str = ...,
    u: Float | None = ...,
    g: float = ...,
    samples: int = ...,
    noise: float | None = ...,
    seed: int = ...,
    *,
    positions: int = ...,
    scheme: str | None = ...,
    raw: Literal[False] = ...,
) -> SimulatedReadings: ...


@overload
def simulate(
    sensor: Sensor | str = ...,
    u: Float | None = ...,
    g: float = ...,
    samples: int = ...,
    noise: float | None = ...,
    seed: int = ...,
    *,
    positions: int = ...,
    scheme: str | None = ...,
    raw: Literal[True],
    **handling: float,
) -> polars.DataFrame: ...


def simulate(
    sensor: Sensor | str = "dpso",
    u: Float | None = None,
    g: float = STANDARD_GRAVITY,
    samples: int = 1,
    noise: float | None = None,
    seed: int = 0,
    *,
    positions: int = 12,
    scheme: str | None = None,
    raw: bool = False,
    **handling: float,
) -> SimulatedReadings | polars.DataFrame:
    """Return what a sensor at rest reads, or with `raw` the log of a sensor that is held and turned.

    Args:
        sensor: the sensor, or the name of a shipped one, or the path of its file.
        u: unit directions of the specific force, shape (J, 3); those of `positions` and `scheme` when None.
        g: local gravity, m/s^2.
        samples: samples of each pose.
        noise: one sigma of one sample and axis, m/s^2; the sensor's when None.
        seed: of everything random.
        positions: number of poses J; scheme: where they point, see `directions`.
        raw: return a log as a frame of polars, columns t, ax, ay, az; handling: fields of `Handling`.

    Raises:
        ConfigError: no such sensor. UsageError: no such scheme.

    Examples:
        >>> from accelcal_cli import simulate
        >>> simulate("mems", positions=24, samples=10).output.shape
        (240, 3)
        >>> simulate("mems", positions=3, raw=True, hold=1.0, move=0.5).columns
        ['t', 'ax', 'ay', 'az']
    """
    device = load_sensor(sensor) if isinstance(sensor, str) else sensor
    if u is None:
        u = directions(positions, scheme, Streams(seed, [0], Purpose.ATTITUDE).normal(positions, 3)[0])
    sigma = device.noise if noise is None else noise
    if not raw:
        return _readings(device.model, u, g, samples, sigma, Streams(seed, [0], Purpose.NOISE))
    import polars

    segments = simulate_log(device, u, g, from_mapping(Handling, handling, "simulate"), sigma, seed)
    rows = np.concatenate([np.column_stack([part.time, part.output]) for part in segments])
    return polars.DataFrame(rows, schema=["t", "ax", "ay", "az"])


def simulate_fleet(
    sensor: Sensor, sensors: int, u: Float, g: float, samples: int, noise: float, seed: int
) -> Iterator[tuple[ErrorModel, SimulatedReadings]]:
    """Yield sensors of one type, drawn with its spread, and what each reads at rest; see `simulate` and `draw`."""
    models = draw(sensor, range(sensors), seed)
    for run, (K, D) in enumerate(zip(models.K, models.D, strict=True)):
        model = ErrorModel(K, D)
        yield model, _readings(model, u, g, samples, noise, Streams(seed, [run], Purpose.NOISE))


@dataclass(frozen=True)
class Handling(Checked):
    """How the sensor is held and moved."""

    rate: float = setting(100.0, "rows per second, Hz", low=1, high=1e5)
    hold: float = setting(5.0, "seconds that a pose is held, within a fifth", above=0, high=1e5)
    move: float = setting(2.0, "seconds of a move", above=0, high=1e5)
    tremor: float = setting(0.0, "trembling of a hand that holds it, m/s^2 rms", low=0, high=10)


@dataclass(frozen=True)
class LogSegment:
    """A hold or a move of a simulated raw log.

    Attributes:
        pose: number of the pose that is held, from 1; 0 in a move.
        time: s, shape (n,); output: N, output units, shape (n, 3); gyro: rad/s, shape (n, 3).
    """

    pose: int
    time: Float
    output: Float
    gyro: Float


def simulate_log(
    sensor: Sensor, u: Float, g: float, handling: Handling, noise: float, seed: int
) -> Iterator[LogSegment]:
    """Yield a raw log segment by segment: a hold for every direction, a move between two.

    Args:
        sensor: the sensor.
        u: unit directions of the specific force, shape (J, 3).
        g: local gravity, m/s^2.
        handling: times and tremor.
        noise: one sigma of one sample and axis, m/s^2.
        seed: of everything random; each segment draws from its own stream.
    """
    row = 0
    for k in range(2 * len(u) - 1):
        streams = Streams(seed, [k], Purpose.RAW_LOG)
        draws = streams.uniform(1, 8)[0, 0]
        at, still = k // 2, k % 2 == 0
        seconds = handling.hold * (1 + HOLD_SPREAD * (2 * draws[0] - 1)) if still else handling.move
        n = max(2, round(seconds * handling.rate))
        phase = (np.arange(n) + 0.5) / n
        if still:
            force, rate = _hold(g * u[at], phase * n / handling.rate, handling.tremor, draws[1:4])
        else:
            force, rate = _move(u[at], u[at + 1], g, phase, n / handling.rate, draws[1:4])
        force = force + noise * streams.normal(n, 3)[0]
        rate = rate + GYRO_BIAS + GYRO_NOISE * streams.normal(n, 3)[0]
        time = (row + np.arange(n)) / handling.rate
        yield LogSegment(at + 1 if still else 0, time, sensor.model.output(force), rate)
        row += n


def _readings(
    model: ErrorModel, u: Float, g: float, samples: int, noise: float, random: Streams
) -> SimulatedReadings:
    force = np.repeat(g * u, samples, axis=0)
    output = model.output(force + noise * random.normal(len(force), 3)[0])
    return SimulatedReadings(np.repeat(np.arange(1, len(u) + 1), samples), output, force)


def _hold(f: Float, t: Float, tremor: float, draws: Float) -> tuple[Float, Float]:
    """Return specific force and turning rate of a hold, both (n, 3): a tilt that swings moves gravity."""
    angle = 2 * math.pi * (TREMOR_RATE * t[:, None] + draws)
    force = f + math.sqrt(2.0) * tremor * np.sin(angle)
    swing = math.sqrt(2.0) * tremor / float(np.linalg.norm(f)) * 2 * math.pi * TREMOR_RATE
    return force, swing * np.cos(angle)


def _move(a: Float, b: Float, g: float, phase: Float, seconds: float, draws: Float) -> tuple[Float, Float]:
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
    shake = SHAKE * np.sin(np.pi * phase[:, None]) * np.sin(2 * np.pi * (3 * phase[:, None] + draws))
    return g * u + shake, -axis * rate  # the world turns against the body
