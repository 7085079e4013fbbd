"""A sensor of known errors, and the readings it would give."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.errors import ConfigError
from accelcal_cli.registry import check, setting
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.streams import Float, Purpose, Streams

"""Streams of the noise, of random attitudes and of sensors drawn from their type."""

Row = tuple[float, float, float]


@dataclass(frozen=True)
class Spread:
    """How sensors of one type differ: one-sigma of their errors."""

    scale: float = setting(0.0, "scale factor, part of nominal", low=0, high=0.2)
    misalignment: float = setting(0.0, "misalignment, rad", low=0, high=0.2)
    bias: float = setting(0.0, "bias, m/s^2", low=0, high=50)

    def __post_init__(self) -> None:
        """Refuse a spread outside its range."""
        check(self)


@dataclass(frozen=True)
class Sensor:
    """A sensor configuration: its true errors, its noise, and how its type spreads."""

    name: str = setting("", "what it is")
    source: str = setting("", "where the numbers come from")
    unit: str = setting("", "unit of the output")
    K_a: tuple[Row, Row, Row] = setting(None, "pulse-equivalent matrix, output units per m/s^2")
    D_a: Row = setting((0.0, 0.0, 0.0), "bias, output units")
    noise: float = setting(0.0, "noise of one sample and axis, one sigma, m/s^2", low=0, high=100)
    spread: Spread = Spread()

    def __post_init__(self) -> None:
        """Refuse a sensor without an invertible matrix."""
        check(self)
        if self.K_a is None:
            raise ConfigError("K_a: missing; expected three rows of three numbers")
        if not np.isfinite(self.K_a).all() or abs(np.linalg.det(np.array(self.K_a))) == 0:
            raise ConfigError("K_a: singular; expected an invertible matrix of finite numbers")

    @property
    def model(self) -> ErrorModel:
        """Its error model."""
        return ErrorModel(np.array(self.K_a), np.array(self.D_a))


@dataclass(frozen=True)
class Simulated:
    """Simulated static samples.

    Attributes:
        pose: number of the pose of each sample, from 1, shape (n,).
        output: N, output units, shape (n, 3).
        force: true specific force, m/s^2, shape (n, 3).
    """

    pose: Float
    output: Float
    force: Float


def draw(sensor: Sensor, runs: Sequence[int], seed: int) -> ErrorModel:
    """Return sensors of one type, one a run: K of shape (R, 3, 3), D of shape (R, 3).

    Around the ideal sensor of the type (its mean scale factor, no misalignment, no bias) with its spread.

    Args:
        sensor: the type.
        runs: numbers of the runs; run r draws the same sensor in any company.
        seed: of all draws.
    """
    z = Streams(seed, runs, Purpose.SENSOR).normal(4, 3)
    nominal = float(np.trace(np.array(sensor.K_a))) / 3.0
    scale = nominal * (1.0 + sensor.spread.scale * z[:, 0])
    turned = np.broadcast_to(np.eye(3), (len(z), 3, 3)).copy()
    turned[:, [0, 0, 1, 1, 2, 2], [1, 2, 0, 2, 0, 1]] = sensor.spread.misalignment * z[:, 1:3].reshape(-1, 6)
    return ErrorModel(scale[..., None] * turned, scale * sensor.spread.bias * z[:, 3])


def simulate(sensor: Sensor, u: Float, g: float, samples: int, noise: float, seed: int) -> Simulated:
    """Return what a sensor at rest reads.

    Args:
        sensor: the sensor.
        u: unit directions of the specific force, shape (J, 3).
        g: local gravity, m/s^2.
        samples: samples of each pose.
        noise: one sigma of one sample and axis, m/s^2.
        seed: of the noise.
    """
    return _readings(sensor.model, u, g, samples, noise, Streams(seed, [0], Purpose.NOISE))


def simulate_fleet(
    sensor: Sensor, sensors: int, u: Float, g: float, samples: int, noise: float, seed: int
) -> Iterator[tuple[ErrorModel, Simulated]]:
    """Yield sensors of one type, drawn with its spread, and what each reads at rest; see `simulate` and `draw`."""
    drawn = draw(sensor, range(sensors), seed)
    for run in range(sensors):
        model = ErrorModel(drawn.K[run], drawn.D[run])
        yield model, _readings(model, u, g, samples, noise, Streams(seed, [run], Purpose.NOISE))


def _readings(
    model: ErrorModel, u: Float, g: float, samples: int, noise: float, random: Streams
) -> Simulated:
    force = np.repeat(g * u, samples, axis=0)
    output = model.output(force + noise * random.normal(len(force), 3)[0])
    return Simulated(np.repeat(np.arange(1, len(u) + 1), samples), output, force)
