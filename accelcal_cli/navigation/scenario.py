"""What a filter is given: indicated trajectory, measured gravity, map and INS grade, for R runs at K epochs.

A scenario is simulated here, or comes from a recorded voyage (`recording`).

The map must cover the trajectory: beyond its edge, or beside a hole, a filter could only be confidently wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import DataError
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.ins import (
    STATES,
    InsGrade,
    Motion,
    discretise,
    dynamics,
    metres_per_radian,
    process_noise,
    to_metric,
    turn_biases,
)
from accelcal_cli.navigation.noise import EXTRA, Disturbance, NoiseModel, eotvos, eotvos_slope
from accelcal_cli.navigation.voyage import (
    SECONDS_PER_HOUR,
    PlannedVoyage,
    Trajectory,
    aligned_covariance,
    ins_errors,
)
from accelcal_cli.notices import Notice
from accelcal_cli.rng import Purpose, Streams

VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA = 0.6, 1e-4, 1e-3
"""Of the prior, chosen: m/s, rad, rad."""


@dataclass(frozen=True)
class Scenario:
    """R runs of K epochs.

    Attributes:
        gravity_map: the map.
        grade: of the INS.
        noise: sigma of the gravimeter, mGal.
        initial: sqrt(3) sigma of the position error at the start on either axis, m; a run further off is astray.
        ins: the indicated trajectory, its fields of shape (R, K).
        measured: gravity anomaly, mGal, shape (R, K); NaN where there is none.
        prior: covariance of the metric states at the start, shape (12, 12): what the filters are told.
        error: true position error of the INS, m north and east, shape (R, K, 2); None when it is not known.
        models: what a robust filter weighs, the nominal noise first; a filter that runs by one sees it alone.
        notices: of the record.
        true: the true trajectory, shape (K,), or the indicated one when the true one is not known.
        turns: changes of the indicated heading between epochs, clockwise, rad, shape (K - 1,). Of the heading, not of
            the course by the indicated velocity: half a metre per second across 8 m/s would turn the biases by 4 deg.
    """

    gravity_map: GravityMap
    grade: InsGrade
    noise: float
    initial: float
    ins: Trajectory
    measured: Float
    prior: Float
    error: Float | None
    true: Trajectory
    turns: Float
    models: tuple[NoiseModel, ...] = (NoiseModel(),)
    notices: tuple[Notice, ...] = ()

    @property
    def seconds(self) -> Float:
        """Times of the epochs since the start of the voyage, shape (K,). Units: s."""
        return self.ins.seconds

    @property
    def runs(self) -> int:
        """R."""
        return len(self.measured)

    @property
    def epochs(self) -> int:
        """K."""
        return len(self.seconds)

    @property
    def period(self) -> float:
        """Time between epochs. Units: s."""
        return self.ins.step

    def epochs_in(self, span: float) -> int:
        """Return the number of epochs in a span of seconds, at least 1."""
        return max(1, round(span / self.period))

    @cached_property
    def scale(self) -> tuple[Float, Float]:
        """Metres per radian of latitude and of longitude at the indicated positions, shape (R, K)."""
        return metres_per_radian(self.ins.latitude)

    def transitions(self, first: int, last: int) -> Float:
        """Return the metric transitions from epoch k to k + 1, first <= k < last, shape (R, last - first, 12, 12).

        At the indicated latitude and velocity, which is what a real filter has.
        """
        motion = Motion(*(values[..., first:last] for values in vars(self.ins.motion).values()))
        F = discretise(dynamics(motion), self.period)
        if self.grade.mounting == "strapdown":
            F = turn_biases(F, np.append(self.turns, 0.0)[first:last])
        after = np.minimum(np.arange(first + 1, last + 1), self.epochs - 1)
        return to_metric(F, self.ins.latitude[..., first:last], self.ins.latitude[..., after])

    def under(self, model: NoiseModel) -> Scenario:
        """Return the scenario of a filter that believes in one noise model, and may leave measurements out."""
        return replace(self, models=(model,), measured=np.array(self.measured))

    @property
    def model(self) -> NoiseModel:
        """The noise model that a filter runs by."""
        return self.models[0]

    @cached_property
    def decay(self) -> Float:
        """Factor of the map's error from one epoch to the next, shape (R, K)."""
        return self.model.decay(np.hypot(self.ins.east, self.ins.north) * self.period)

    @cached_property
    def coupling(self) -> Float:
        """Measured gravity by east and north velocity error, mGal per m/s, shape (R, K, 2)."""
        ins = self.ins
        if not self.model.eotvos:
            return np.zeros((*ins.latitude.shape, 2))
        return eotvos_slope(ins.latitude, ins.east, ins.north)

    def steps(self, first: int, last: int) -> Float:
        """Return the transitions of all errors, with the two of the measurement, shape (R, last - first, 14, 14)."""
        F = np.zeros((self.runs, last - first, STATES + EXTRA, STATES + EXTRA))
        F[..., :STATES, :STATES] = self.transitions(first, last)
        F[..., STATES, STATES] = 1.0
        F[..., STATES + 1, STATES + 1] = self.decay[:, first:last]
        return F

    def full_prior(self) -> Float:
        """Return the covariance of all errors at the start, with the two of the measurement, shape (14, 14)."""
        P = np.zeros((STATES + EXTRA, STATES + EXTRA))
        P[:STATES, :STATES] = self.prior
        P[range(STATES, STATES + EXTRA), range(STATES, STATES + EXTRA)] = self.model.prior
        return P

    def step_noise(self, k: int) -> Float:
        """Return the variances of the noise of all errors from epoch k to the next, shape (R, 14)."""
        Q = np.zeros((self.runs, STATES + EXTRA))
        Q[:, :STATES] = process_noise(self.grade, self.period)
        Q[:, STATES + 1] = self.model.prior[1] * (1.0 - self.decay[:, k] ** 2)
        return Q

    def part(self, rows: Int, first: int, last: int) -> Scenario:
        """Return epochs `first` to `last` - 1 of some runs."""
        ins = self.ins
        fields = (v[rows, first:last] for v in (ins.latitude, ins.longitude, ins.east, ins.north))
        ins = Trajectory(ins.seconds[first:last], *fields)
        return replace(self, ins=ins, measured=self.measured[rows, first:last], error=None)

    def anomaly(self, k: int, north: Float, east: Float) -> Float:
        """Return the map's anomaly in mGal at epoch k for position errors in m, shape (R, ...); NaN off the map."""
        shape = (self.runs,) + (1,) * (north.ndim - 1)
        latitude, longitude, meridian, parallel = (
            v[:, k].reshape(shape) for v in (self.ins.latitude, self.ins.longitude, *self.scale)
        )
        return self.gravity_map.at(latitude - north / meridian, longitude - east / parallel)


def independent_prior(grade: InsGrade, initial: float) -> Float:
    """Return the covariance of the metric states of which none tells of another, shape (12, 12); initial: m."""
    sigma = np.empty(STATES)
    sigma[:2] = initial / math.sqrt(3.0)
    sigma[2:4], sigma[4:6], sigma[6] = VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA
    sigma[7:] = grade.biases()
    return np.diag(sigma**2)


NOTHING = Disturbance()
"""No disturbance."""

Prior = Literal["independent", "tied"]


def simulate(
    gravity_map: GravityMap,
    plan: PlannedVoyage,
    grade: InsGrade,
    *,
    runs: range,
    seed: int,
    period: float = 10.0,
    noise: float = 1.0,
    initial: float = 2000.0,
    prior: Prior = "independent",
    disturbance: Disturbance = NOTHING,
    corrected: bool = False,
) -> Scenario:
    """Return simulated runs: each draws its own INS errors and its own gravimeter noise.

    Args:
        gravity_map: both the true field and the map, as in [depf2015] section 4.
        plan: the voyage; grade: of the INS.
        runs: their numbers; seed: of all random numbers.
        period: between measurements, whole seconds; noise: sigma, mGal; initial: see `Scenario`.
        prior: how the INS errors begin, see `voyage`.
        disturbance: of the measurements, which the filters are not told.
        corrected: the Eoetvoes effect is computed from the velocity of the INS, and the filters know.
    """
    every = round(period)
    start = plan.trajectory().at(slice(plan.start, plan.start + 1)).latitude
    metres = np.append(np.concatenate(metres_per_radian(start)), np.ones(STATES - 2))
    if prior == "tied":
        radian_prior, told = None, aligned_covariance(plan, grade) * np.outer(metres, metres)
    else:
        told = independent_prior(grade, initial)
        radian_prior = told / np.outer(metres, metres)
    x = ins_errors(plan, grade, radian_prior, Streams(seed, runs, Purpose.INS), every)
    true = plan.trajectory().at(plan.start + every * np.arange(x.shape[1]))
    ins = Trajectory(
        true.seconds,
        true.latitude + x[:, :, 0],
        true.longitude + x[:, :, 1],
        true.east + x[:, :, 2],
        true.north + x[:, :, 3],
    )
    meridian, parallel = metres_per_radian(ins.latitude)
    error = np.stack([x[:, :, 0] * meridian, x[:, :, 1] * parallel], axis=-1)
    measured = measure(gravity_map, true, noise, runs, seed)
    measured += disturbance.added(true.latitude, true.longitude, true.seconds, gravity_map, seed)
    if corrected or disturbance.eotvos:
        measured += eotvos(ins.latitude, ins.east, ins.north) - eotvos(true.latitude, true.east, true.north)
    # The INS knows its heading to within the azimuth error, a milliradian.
    turns = true.turns()
    return Scenario(
        gravity_map, grade, noise, initial, ins, measured, told, error, true, turns,
        models=(NoiseModel(eotvos=corrected),),
    )  # fmt: skip


def measure(gravity_map: GravityMap, true: Trajectory, noise: float, runs: range, seed: int) -> Float:
    """Return measured anomalies, shape (R, K): the map along the true trajectory plus the noise of the gravimeter."""
    drawn = Streams(seed, runs, Purpose.GRAVIMETER).normal(1, len(true.seconds))[:, 0]
    return gravity_map.at(true.latitude, true.longitude) + noise * drawn


DIRECTIONS = 8


def check_coverage(gravity_map: GravityMap, trajectory: Trajectory, initial: float) -> None:
    """Refuse a map that ends, or has cells without a value, within the initial error of a trajectory.

    Args:
        gravity_map: the map; trajectory: fields of shape (K,).
        initial: m.

    Raises:
        DataError: with the place and the time where the map ends.
    """
    meridian, parallel = metres_per_radian(trajectory.latitude)
    for turn in np.arange(DIRECTIONS) * 2.0 * np.pi / DIRECTIONS:
        for reach in (0.0, 0.5 * initial, initial):
            latitude = trajectory.latitude + reach * np.cos(turn) / meridian
            longitude = trajectory.longitude + reach * np.sin(turn) / parallel
            unknown = np.isnan(gravity_map.at(latitude, longitude))
            if unknown.any():
                k = int(np.argmax(unknown))
                raise DataError(_uncovered(gravity_map, latitude[k], longitude[k], trajectory.seconds[k]))


def _uncovered(gravity_map: GravityMap, latitude: float, longitude: float, seconds: float) -> str:
    """Return the message for a map without a value at a place in rad, some seconds into the voyage."""
    edges = (gravity_map.south, gravity_map.north, gravity_map.west, gravity_map.east)
    south, north, west, east, latitude, longitude = np.degrees([*edges, latitude, longitude])
    inside = south <= latitude <= north and west <= longitude <= east
    return (
        f"{gravity_map.source}: the map {'has a cell without a value' if inside else 'ends'} at {latitude:.4f} N "
        f"{longitude:.4f} E, within the position error of the track at hour {seconds / SECONDS_PER_HOUR:.2f}; it "
        f"covers {south:.3f} to {north:.3f} N and {west:.3f} to {east:.3f} E"
    )
