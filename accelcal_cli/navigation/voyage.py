"""A voyage: the true track, and the errors of the inertial navigation system on it.

The planned voyage is eight hours at constant speed with a turn at four [depf2015] section 4. The INS errors follow the
error model of that track, integrated at 1 s with a midpoint rule; biases are drawn, the tilts are those that an
alignment leaves with such biases, and draws are repeated until the error after two hours is like the paper's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.navigation.ins import (
    EARTH_RATE,
    STATES,
    Grade,
    Motion,
    dynamics,
    metres_per_radian,
    specific_force,
    turned,
)
from accelcal_cli.rng import Streams
from accelcal_cli.schema import check, setting

SECONDS_PER_HOUR = 3600.0
CHUNK = 600
"""Seconds of noise that are drawn together."""

TRIES = 10_000


@dataclass(frozen=True)
class Plan:
    """A planned voyage.

    Attributes:
        latitude, longitude: start, degrees.
        heading: degrees clockwise from north; speed: m/s.
        hours: duration; filtered: hour at which the filter starts.
        turn: degrees, at the middle of the voyage; turning: its duration, s.
        drift: the INS error at the filter's start lies between these, m.
    """

    latitude: float = setting(20.2, "of the start, degrees", low=-80.0, high=80.0)
    longitude: float = setting(115.2, "of the start, degrees", low=-360.0, high=360.0)
    heading: float = setting(70.0, "clockwise from north, degrees", low=-360.0, high=360.0)
    speed: float = setting(8.0, "over ground, m/s", low=0.0, high=300.0)
    hours: float = setting(8.0, "duration, h", above=0.0, high=48.0)
    filtered: float = setting(2.0, "hour at which the filter starts", low=0.0, high=47.0)
    turn: float = setting(-90.0, "in the middle of the voyage, degrees", low=-360.0, high=360.0)
    turning: float = setting(600.0, "duration of the turn, s", above=0.0, high=36000.0)
    drift: tuple[float, float] = setting(
        (1000.0, 1700.0), "limits of the INS error at the filter's start, m; like the paper's 1.35 km"
    )

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)
        if self.filtered >= self.hours:
            raise ConfigError(
                f"filtered: {self.filtered:g} h; expected less than the voyage's {self.hours:g} h"
            )

    @property
    def seconds(self) -> int:
        """Time that the filter runs. Definition: hours - filtered, each in whole seconds. Units: s."""
        return round(self.hours * SECONDS_PER_HOUR) - round(self.filtered * SECONDS_PER_HOUR)


@dataclass(frozen=True)
class Route:
    """A track at regular times.

    Attributes:
        seconds: since the voyage began, shape (K,).
        latitude, longitude: rad, shape (..., K).
        east, north: velocity, m/s, shape (..., K).
    """

    seconds: Float
    latitude: Float
    longitude: Float
    east: Float
    north: Float

    @property
    def step(self) -> float:
        """Time between points. Units: s."""
        return float(self.seconds[1] - self.seconds[0])

    def turns(self) -> Float:
        """Return the changes of the heading between points, clockwise, rad, shape (..., K - 1)."""
        return wrapped(np.diff(np.arctan2(self.east, self.north), axis=-1))

    def motion(self) -> Motion:
        """Return the motion with the accelerations that the velocities give."""
        return Motion(
            self.latitude,
            self.east,
            self.north,
            np.gradient(self.east, self.step, axis=-1),
            np.gradient(self.north, self.step, axis=-1),
        )


def wrapped(angle: Float) -> Float:
    """Return angles between -pi and pi, rad."""
    nearest: Float = np.remainder(angle + math.pi, 2.0 * math.pi) - math.pi
    return nearest


def planned(plan: Plan) -> Route:
    """Return the true track of a plan every second."""
    seconds = np.arange(round(plan.hours * SECONDS_PER_HOUR) + 1.0)
    part = np.clip((seconds - 0.5 * plan.hours * SECONDS_PER_HOUR) / plan.turning, 0.0, 1.0)
    heading = np.radians(plan.heading + plan.turn * part)
    east, north = plan.speed * np.sin(heading), plan.speed * np.cos(heading)
    latitude = np.full_like(seconds, math.radians(plan.latitude))
    for _ in range(3):  # R_M and R_N follow the latitude: a fixed point
        meridian, parallel = metres_per_radian(latitude)
        latitude = math.radians(plan.latitude) + _integral(north / meridian)
    longitude = math.radians(plan.longitude) + _integral(east / parallel)
    return Route(seconds, latitude, longitude, east, north)


def _integral(rate: Float) -> Float:
    """Return the trapezoidal integral over seconds, from 0."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))])


def steps_of(route: Route, grade: Grade) -> Float:
    """Return the one-step matrices of the INS errors on a track, shape (K - 1, 12, 12), by the midpoint rule."""
    A = dynamics(route.motion())
    middle = 0.5 * (A[1:] + A[:-1])
    h = route.step
    steps: Float = np.eye(STATES) + h * middle + 0.5 * h * h * middle @ A[:-1]
    return turned(steps, route.turns()) if grade.mounting == "strapdown" else steps


def ins_errors(plan: Plan, route: Route, grade: Grade, streams: Streams, every: int) -> Float:
    """Return the INS errors of each run every `every` seconds from the filter's start, shape (R, K, 12), rad.

    Raises:
        DataError: no draw gives a drift like the paper's: the INS is too good or too bad for the plan.
    """
    steps = steps_of(route, grade)
    start = round(plan.filtered * SECONDS_PER_HOUR)
    x = _aligned(plan, route, grade, streams, steps[:start])[:, :, None]
    white = grade.white()
    out = np.empty((len(streams), (len(steps) - start) // every + 1, STATES))
    for second in range(len(steps)):
        if second >= start and (second - start) % every == 0:
            out[:, (second - start) // every] = x[:, :, 0]
        if second % CHUNK == 0:
            noise = streams.normal(5, min(CHUNK, len(steps) - second)) * white[:, None]
        x = steps[second] @ x
        x[:, 2:7, 0] += noise[:, :, second % CHUNK]
    if (len(steps) - start) % every == 0:
        out[:, -1] = x[:, :, 0]
    return out


def _aligned(plan: Plan, route: Route, grade: Grade, streams: Streams, steps: Float) -> Float:
    """Return initial errors, shape (R, 12), whose drift over `steps` is within the plan's limits."""
    transition = np.eye(STATES)
    for step in steps:
        transition = step @ transition
    scale = metres_per_radian(route.latitude[len(steps)])
    level = float(specific_force(route.motion())[2][0]), float(route.latitude[0])
    found = np.empty((len(streams), STATES))
    for run in range(len(streams)):
        stream = streams.take(np.array([run]))
        for _ in range(TRIES):
            x = _alignment(level, stream.normal(1, 5)[0, 0] * grade.biases())
            after = transition @ x
            if plan.drift[0] <= math.hypot(after[0] * scale[0], after[1] * scale[1]) <= plan.drift[1]:
                break
        else:
            low, high = plan.drift
            raise DataError(
                f"no INS of {grade.accelerometer:g} micro-g and {grade.gyro:g} deg/h drifts between {low:g} and "
                f"{high:g} m in {plan.filtered:g} h; state other limits (voyage: drift)"
            )
        found[run] = x
    return found


def _alignment(level: tuple[float, float], biases: Float) -> Float:
    """Return the errors, shape (12,), that self-alignment leaves; `level`: force up (m/s^2), latitude (rad)."""
    up, latitude = level
    x = np.zeros(STATES)
    x[7:] = biases
    x[4], x[5] = -biases[1] / up, biases[0] / up
    x[6] = biases[2] / (EARTH_RATE * math.cos(latitude))
    return x
