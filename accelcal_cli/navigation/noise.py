"""What measured gravity holds beside the anomaly of the map: what a simulation adds, and what filters believe.

Filters weigh noise models by the evidence of the innovations [magill1965]: the nominal one, white noise alone; one with
the bias of the gravimeter as a state; with it, one with the Eoetvoes effect of the velocity error; and one with the
error of the map, as correlated noise: a first-order Gauss-Markov process along the track [bryson1968]. Size and length
of the map's error are taken from the map when nobody states them.

The Eoetvoes effect is computed from the velocity of the INS. With E = 2 w cos L v_E + v_E^2 / R_N + v_N^2 / R_M its
error is dE/dv times the velocity error, which is a state.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.gravity_map import GravityMap, RandomField, generate
from accelcal_cli.navigation.ins import EARTH_RATE, radii
from accelcal_cli.schema import check, setting

EXTRA = 2
"""States of the measurement: bias of the gravimeter and error of the map, mGal."""

MGAL = 1e-5
"""Units: m/s^2."""

MAP_ERROR = 0.08
"""Error of a map as a part of its standard deviation, when nothing states it [chosen]."""

MAP_LENGTH = 1.0
"""Length of that error as a part of the map's own [chosen]."""


@dataclass(frozen=True)
class NoiseModel:
    """What a filter believes of the measured gravity.

    Attributes:
        bias: sigma of a constant bias, mGal.
        map_error: sigma of the correlated error of the map, mGal; distance: its correlation length, m.
        gate: innovations beyond so many sigma are left out; 0: none.
        eotvos: whether the Eoetvoes effect was computed from the velocity of the INS, and holds its error.
    """

    bias: float = 0.0
    map_error: float = 0.0
    distance: float = 10_000.0
    gate: float = 0.0
    eotvos: bool = False

    @property
    def prior(self) -> Float:
        """Variances of the two states, mGal^2, shape (2,)."""
        return np.array([self.bias, self.map_error]) ** 2

    def decay(self, metres: Float) -> Float:
        """Return the factor by which the error of the map decays over a distance, any shape."""
        return np.asarray(np.exp(-metres / self.distance))


@dataclass(frozen=True)
class Disturbance:
    """What a simulation adds to the measured gravity, and does not tell the filters.

    Attributes:
        bias: of the gravimeter, mGal.
        map_error: sigma of a correlated error of the map, mGal; map_length: its correlation length D, km.
        jump: mGal; it lasts from `jump_hour` after the start of the filter for `jump_minutes`.
        eotvos: whether the Eoetvoes effect of the INS's velocity error is in the measurements.
    """

    bias: float = setting(0.0, "of the gravimeter, mGal", low=-1000.0, high=1000.0)
    map_error: float = setting(0.0, "sigma of a correlated error of the map, mGal", low=0.0, high=1000.0)
    map_length: float = setting(5.0, "correlation length of that error, km", above=0.0, high=1000.0)
    jump: float = setting(0.0, "added for a while, mGal", low=-1000.0, high=1000.0)
    jump_hour: float = setting(3.0, "hours from the filter's start to the jump", low=0.0, high=48.0)
    jump_minutes: float = setting(10.0, "duration of the jump", low=0.0, high=2880.0)
    eotvos: bool = setting(False, "the Eotvos effect of the velocity error is in the measurements")

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)
        if self.map_error and self.map_length < 0.1:
            raise ConfigError(
                f"map_length: {self.map_length:g} km is below the map's grid; expected 0.1 or more"
            )

    def added(
        self, latitude: Float, longitude: Float, seconds: Float, gravity_map: GravityMap, seed: int
    ) -> Float:
        """Return what the true track's measurements hold too much, mGal, shape (K,), without the Eoetvoes effect."""
        since = seconds - seconds[0] - 3600.0 * self.jump_hour
        jump = (since >= 0.0) & (since < 60.0 * self.jump_minutes)
        extra: Float = self.bias + self.jump * jump
        if self.map_error:
            edges = (gravity_map.south, gravity_map.north, gravity_map.west, gravity_map.east)
            south, north, west, east = np.degrees(edges).tolist()
            step = 3600.0 * float(np.degrees(gravity_map.step_north))
            field = RandomField(self.map_error, self.map_length, south, north, west, east, step)
            extra = extra + generate(field, seed + ERROR_SEED).at(latitude, longitude)
        return extra


ERROR_SEED = 1_000_003
"""Added to the study's seed for the field of the map's error."""


def eotvos(latitude: Float, east: Float, north: Float) -> Float:
    """Return the Eoetvoes effect in mGal; latitude in rad, velocity in m/s, of one shape."""
    meridian, prime = radii(latitude)
    effect = 2.0 * EARTH_RATE * np.cos(latitude) * east + east**2 / prime + north**2 / meridian
    return np.asarray(effect / MGAL)


def eotvos_slope(latitude: Float, east: Float, north: Float) -> Float:
    """Return the derivative of the Eoetvoes effect by east and north velocity, mGal per m/s, shape (..., 2)."""
    meridian, prime = radii(latitude)
    by_east = 2.0 * (EARTH_RATE * np.cos(latitude) + east / prime)
    return np.stack([by_east, 2.0 * north / meridian], axis=-1) / MGAL


def noise_models(
    gravity_map: GravityMap,
    bias: float,
    map_error: float | None,
    map_length: float | None,
    gate: float,
    effect: bool = False,
) -> tuple[NoiseModel, ...]:
    """Return the noise models: nominal; with a bias of the gravimeter; with it, one of Eoetvoes and one of the map.

    Args:
        gravity_map: which gives the error's size and length where they are None.
        bias: sigma of the gravimeter's bias in the disturbed model, mGal.
        map_error: mGal; map_length: km; gate: in sigma.
        effect: whether the Eoetvoes effect is known to be computed from the velocity of the INS.
    """
    size = MAP_ERROR * float(np.nanstd(gravity_map.values)) if map_error is None else map_error
    length = MAP_LENGTH * correlation_length(gravity_map) if map_length is None else 1e3 * map_length
    models = [NoiseModel(0.0, 0.0, length, gate)]
    if bias:
        models += [NoiseModel(bias, 0.0, length, gate), NoiseModel(bias, 0.0, length, gate, eotvos=True)]
    if size:
        models.append(NoiseModel(bias, size, length, gate))
    return tuple(dict.fromkeys(replace(model, eotvos=model.eotvos or effect) for model in models))


def correlation_length(gravity_map: GravityMap) -> float:
    """Return the distance along meridians at which the map's covariance has fallen to 1/e of its variance. Units: m."""
    values = gravity_map.values - np.nanmean(gravity_map.values)
    variance, step = float(np.nanmean(values**2)), gravity_map.step_north * EARTH_RADIUS
    for lag in range(1, len(values)):
        if float(np.nanmean(values[lag:] * values[:-lag])) <= variance / np.e:
            return lag * step
    return len(values) * step


EARTH_RADIUS = 6.371e6
"""Mean radius. Units: m."""


@dataclass(frozen=True)
class Offset:
    """Bias and map error of R runs, given the position: the same covariance at every particle.

    Attributes:
        covariance: mGal^2, shape (R, 2, 2).
    """

    covariance: Float

    @classmethod
    def start(cls, model: NoiseModel, runs: int) -> Offset:
        """Return what is known before the first measurement."""
        return cls(np.tile(np.diag(model.prior), (runs, 1, 1)))

    @property
    def variance(self) -> Float:
        """Of the sum of both, mGal^2, shape (R,)."""
        return np.asarray(self.covariance.sum(axis=(1, 2)))

    def predict(self, model: NoiseModel, decay: Float) -> Offset:
        """Return it one step on; decay: of the map error, shape (R,)."""
        P = self.covariance.copy()
        P[:, 0, 1] *= decay
        P[:, 1, 0] *= decay
        P[:, 1, 1] = decay**2 * P[:, 1, 1] + model.prior[1] * (1.0 - decay**2)
        return Offset(P)

    def gain(self, variance: Float) -> Float:
        """Return the Kalman gain, shape (R, 2), of a measurement with a white noise of `variance`, shape (R,)."""
        return np.asarray(self.covariance.sum(axis=2) / (self.variance + variance)[:, None])

    def update(self, variance: Float, used: Float) -> Offset:
        """Return it after a measurement, in the runs that used it, shape (R,)."""
        gain = self.gain(variance) * used[:, None]
        return Offset(self.covariance - gain[:, :, None] * self.covariance.sum(axis=1)[:, None, :])
