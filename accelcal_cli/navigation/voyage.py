"""A voyage: the true trajectory, and the errors of the inertial navigation system (INS) along it.

The planned voyage lasts eight hours at constant speed, with a turn at hour four [depf2015] section 4. The INS errors
follow the error model of that trajectory, integrated at 1 s by the midpoint rule. They begin in one of two ways:

- independent: at the start of the filter all twelve are drawn from the prior that the filters are given;
- tied: biases are drawn at the start of the voyage, the tilts are those that a self-alignment leaves with such biases,
  and both grow until the filter starts. The prior is the covariance of that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.navigation.ins import (
    EARTH_RATE,
    STATES,
    InsGrade,
    Motion,
    cholesky,
    dynamics,
    metres_per_radian,
    specific_force,
    turn_biases,
)
from accelcal_cli.rng import Streams
from accelcal_cli.schema import check, setting

SECONDS_PER_HOUR = 3600.0
NOISE_CHUNK = 600
"""Seconds of noise that are drawn at once."""

TRIES = 10_000
UNLIMITED = 1e6
"""A drift that is not limited. Units: m."""


@dataclass(frozen=True)
class PlannedVoyage:
    """A planned voyage.

    Attributes:
        latitude, longitude: start, degrees.
        heading: degrees clockwise from north; speed: m/s.
        hours: duration; filtered: hour at which the filter starts.
        turn: degrees, at the middle of the voyage; turning: its duration, s.
        drift: limits of the INS error at the start of the filter, m: draws beyond them are repeated. With other limits
            than 0 and UNLIMITED the errors are no draws from the prior, and the bound is none.
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
        (0.0, UNLIMITED),
        "limits of the INS error at the start of the filter, m, with prior tied; the paper's error is 1.35 km",
        low=0.0,
        high=UNLIMITED,
    )

    def __post_init__(self) -> None:
        """Refuse values out of range."""
        check(self)
        if self.filtered >= self.hours:
            raise ConfigError(
                f"filtered: {self.filtered:g} h; expected less than the {self.hours:g} h of the voyage"
            )

    @property
    def start(self) -> int:
        """Second at which the filter starts."""
        return round(self.filtered * SECONDS_PER_HOUR)

    @property
    def seconds(self) -> int:
        """Time for which the filter runs. Definition: hours - filtered, each in whole seconds. Units: s."""
        return round(self.hours * SECONDS_PER_HOUR) - self.start

    def trajectory(self) -> Trajectory:
        """Return the true trajectory, once per second."""
        seconds = np.arange(round(self.hours * SECONDS_PER_HOUR) + 1.0)
        part = np.clip((seconds - 0.5 * self.hours * SECONDS_PER_HOUR) / self.turning, 0.0, 1.0)
        heading = np.radians(self.heading + self.turn * part)
        east, north = self.speed * np.sin(heading), self.speed * np.cos(heading)
        latitude = np.full_like(seconds, math.radians(self.latitude))
        for _ in range(3):  # R_M and R_N depend on the latitude: fixed-point iteration
            meridian, parallel = metres_per_radian(latitude)
            latitude = math.radians(self.latitude) + _integral(north / meridian)
        longitude = math.radians(self.longitude) + _integral(east / parallel)
        return Trajectory(seconds, latitude, longitude, east, north)


@dataclass(frozen=True)
class Trajectory:
    """Positions and velocities at regular times.

    Attributes:
        seconds: since the start of the voyage, shape (K,).
        latitude, longitude: rad; east, north: velocity, m/s; shape (K,), or (R, K) for R runs.
    """

    seconds: Float
    latitude: Float
    longitude: Float
    east: Float
    north: Float

    @property
    def step(self) -> float:
        """Time between epochs. Units: s."""
        return float(self.seconds[1] - self.seconds[0])

    def at(self, epochs: Int | slice) -> Trajectory:
        """Return the trajectory at some of its epochs."""
        return Trajectory(*(getattr(self, f.name)[..., epochs] for f in fields(self)))

    def turns(self) -> Float:
        """Return the changes of heading between epochs, clockwise, rad, shape (..., K - 1)."""
        return wrap_angle(np.diff(np.arctan2(self.east, self.north), axis=-1))

    @cached_property
    def motion(self) -> Motion:
        """The motion, with accelerations from differences of the velocities."""
        forces = (np.gradient(velocity, self.step, axis=-1) for velocity in (self.east, self.north))
        return Motion(self.latitude, self.east, self.north, *forces)


def wrap_angle(angle: Float) -> Float:
    """Return angles between -pi and pi, rad."""
    return np.asarray(np.remainder(angle + math.pi, 2.0 * math.pi) - math.pi)


def _integral(rate: Float) -> Float:
    """Return the trapezoidal integral over seconds, from 0."""
    return np.concatenate([[0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]))])


def ins_errors(
    plan: PlannedVoyage, grade: InsGrade, prior: Float | None, streams: Streams, every: int
) -> Float:
    """Return the INS errors of each run every `every` seconds from the start of the filter, shape (R, K, 12), rad.

    Args:
        plan: the voyage; grade: of the INS.
        prior: covariance of the errors at the start of the filter, rad, shape (12, 12), which they are drawn from.
            None: they are those of a self-alignment at the start of the voyage and grow until the filter starts.
        streams: of the runs; every: s.

    Raises:
        DataError: no draw drifts as the plan states: the INS is too good or too poor for it.
    """
    trajectory, start = plan.trajectory(), plan.start
    F = transitions(trajectory, grade)
    first = 0 if prior is None else start
    x = (
        _aligned_errors(plan, trajectory, grade, streams, F[:start])
        if prior is None
        else (cholesky(prior) * streams.normal(1, STATES)).sum(axis=2)
    )[:, :, None]
    white = grade.white()
    errors = np.empty((len(streams), (len(F) - start) // every + 1, STATES))
    for second in range(first, len(F)):
        if second >= start and (second - start) % every == 0:
            errors[:, (second - start) // every] = x[:, :, 0]
        if (second - first) % NOISE_CHUNK == 0:
            noise = streams.normal(5, min(NOISE_CHUNK, len(F) - second)) * white[:, None]
        x = F[second] @ x
        x[:, 2:7, 0] += noise[:, :, (second - first) % NOISE_CHUNK]
    if (len(F) - start) % every == 0:
        errors[:, -1] = x[:, :, 0]
    return errors


def transitions(trajectory: Trajectory, grade: InsGrade) -> Float:
    """Return the one-step transitions of the INS errors, rad, shape (K - 1, 12, 12), by the midpoint rule."""
    A = dynamics(trajectory.motion)
    middle = 0.5 * (A[1:] + A[:-1])
    h = trajectory.step
    F = np.eye(STATES) + h * middle + 0.5 * h * h * middle @ A[:-1]
    return turn_biases(F, trajectory.turns()) if grade.mounting == "strapdown" else F


def aligned_covariance(plan: PlannedVoyage, grade: InsGrade) -> Float:
    """Return the covariance of the INS errors at the start of the filter, rad, shape (12, 12).

    Definition: that of the biases, through the self-alignment and the voyage until then; nothing is known of a draw.
    """
    trajectory = plan.trajectory().at(slice(0, plan.start + 2))
    F = transitions(trajectory, grade)[: plan.start]
    align = alignment(float(specific_force(trajectory.motion)[2][0]), float(trajectory.latitude[0]))
    root = align * grade.biases()
    P = root @ root.T
    noise = np.zeros((STATES, STATES))
    noise[range(2, 7), range(2, 7)] = grade.white() ** 2
    for step in F:
        P = step @ P @ step.T + noise
    return np.asarray(0.5 * (P + P.T))


def alignment(up: float, latitude: float) -> Float:
    """Return the errors that a self-alignment leaves of five biases, shape (12, 5); up: m/s^2; latitude: rad."""
    out = np.zeros((STATES, 5))
    out[4, 1], out[5, 0], out[6, 2] = -1.0 / up, 1.0 / up, 1.0 / (EARTH_RATE * math.cos(latitude))
    out[7:] = np.eye(5)
    return out


def _aligned_errors(
    plan: PlannedVoyage, trajectory: Trajectory, grade: InsGrade, streams: Streams, F: Float
) -> Float:
    """Return errors of an alignment, shape (R, 12), whose drift over the transitions F is within the plan's limits."""
    transition = np.eye(STATES)
    for step in F:
        transition = step @ transition
    scale = metres_per_radian(trajectory.latitude[len(F)])
    align = alignment(float(specific_force(trajectory.motion)[2][0]), float(trajectory.latitude[0]))
    low, high = plan.drift
    errors = np.empty((len(streams), STATES))
    for run in range(len(streams)):
        stream = streams.take(np.array([run]))
        for _ in range(TRIES):
            x = align @ (stream.normal(1, 5)[0, 0] * grade.biases())
            after = transition @ x
            if low <= math.hypot(after[0] * scale[0], after[1] * scale[1]) <= high:
                break
        else:
            raise DataError(
                f"no INS of {grade.accelerometer:g} micro-g and {grade.gyro:g} deg/h drifts between {low:g} and "
                f"{high:g} m in {plan.filtered:g} h; set other limits (plan: drift)"
            )
        errors[run] = x
    return errors
