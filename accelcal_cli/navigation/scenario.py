"""What a filter is given: indicated track, measured gravity, map and INS grade, for R runs at K epochs."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.error_model import STATES, Grade, discretise, dynamics, metric, turned
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.navigation.voyage import SECONDS_PER_HOUR, Plan, Route, ins_errors, planned
from accelcal_cli.streams import Float, Int, Purpose, Streams

VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA = 0.6, 1e-4, 1e-3
"""Of the prior, chosen: m/s, rad, rad."""


@dataclass(frozen=True)
class Scenario:
    """R runs of K epochs.

    Attributes:
        gravity_map: the map.
        grade: of the INS.
        noise: sigma of the gravimeter, mGal.
        initial: the position error at the start is within this on either axis, m.
        seconds: of the epochs since the voyage began, shape (K,).
        ins: the indicated track, its fields of shape (R, K).
        measured: gravity anomaly, mGal, shape (R, K); NaN where there is none.
        error: true position error of the INS, m north and east, shape (R, K, 2); None when it is not known.
        route: the true track, shape (K,), or the indicated one when it is not known.
        turns: changes of the indicated heading from epoch to epoch, clockwise, rad, shape (K - 1,). Of the heading, not
            of the course by the indicated velocity: half a metre a second across 8 m/s would turn the biases by 4 deg.
    """

    gravity_map: GravityMap
    grade: Grade
    noise: float
    initial: float
    seconds: Float
    ins: Route
    measured: Float
    error: Float | None
    route: Route
    turns: Float

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
        return float(self.seconds[1] - self.seconds[0])

    @cached_property
    def scale(self) -> tuple[Float, Float]:
        """Metres of one radian of latitude and of longitude at the indicated places, shape (R, K)."""
        return metres_per_radian(self.ins.latitude)

    def transitions(self, first: int, last: int) -> Float:
        """Return the metric transitions from epoch k to k + 1, first <= k < last, shape (R, last - first, 12, 12).

        At the indicated latitude and velocity, as a real filter has it.
        """
        return transitions(self.ins, self.turns, (first, last), self.period, self.grade)

    def prior(self) -> Float:
        """Return the variances of the metric states at the start, shape (12,)."""
        sigma = np.empty(STATES)
        sigma[:2] = self.initial / math.sqrt(3.0)
        sigma[2:4], sigma[4:6], sigma[6] = VELOCITY_SIGMA, TILT_SIGMA, AZIMUTH_SIGMA
        sigma[7:] = self.grade.biases()
        return sigma**2

    def instant(self, rows: Int, first: int, last: int) -> Scenario:
        """Return epochs `first` to `last` - 1 of some runs."""
        ins = Route(
            self.seconds[first:last],
            *(
                v[rows, first:last]
                for v in (self.ins.latitude, self.ins.longitude, self.ins.east, self.ins.north)
            ),
        )
        return replace(
            self, seconds=ins.seconds, ins=ins, measured=self.measured[rows, first:last], error=None
        )

    def anomaly(self, k: int, north: Float, east: Float) -> Float:
        """Return the map's anomaly in mGal at epoch k for position errors in m, shape (R, ...); NaN off the map."""
        shape = (self.runs,) + (1,) * (north.ndim - 1)
        latitude, longitude, meridian, parallel = (
            v[:, k].reshape(shape) for v in (self.ins.latitude, self.ins.longitude, *self.scale)
        )
        return self.gravity_map.at(latitude - north / meridian, longitude - east / parallel)


def transitions(route: Route, turns: Float, span: tuple[int, int], period: float, grade: Grade) -> Float:
    """Return the metric transitions along a track with these changes of heading; see `Scenario.transitions`."""
    first, last = span
    motion = route.motion()
    part = {name: getattr(motion, name)[..., first:last] for name in motion.__dataclass_fields__}
    F = discretise(dynamics(type(motion)(**part)), period)
    if grade.mounting == "strapdown":
        F = turned(F, np.append(turns, 0.0)[first:last])
    after = np.minimum(np.arange(first + 1, last + 1), len(route.seconds) - 1)
    return metric(F, route.latitude[..., first:last], route.latitude[..., after])


def simulate(
    gravity_map: GravityMap,
    plan: Plan,
    grade: Grade,
    *,
    runs: range,
    seed: int,
    period: float = 10.0,
    noise: float = 1.0,
    initial: float = 2000.0,
    believed: Grade | None = None,
) -> Scenario:
    """Return simulated runs: each draws its own INS errors and its own gravimeter noise.

    Args:
        gravity_map: true field and map at once, as in [depf2015] section 4.
        plan: the voyage; grade: of the INS; believed: what the filters take it for, the same when None.
        runs: their numbers; seed: of all random numbers.
        period: between measurements, whole seconds; noise: sigma, mGal; initial: see `Scenario`.
    """
    route = planned(plan)
    every = round(period)
    x = ins_errors(plan, route, grade, Streams(seed, runs, Purpose.INS), every)
    start = round(plan.filtered * SECONDS_PER_HOUR)
    keep = start + every * np.arange(x.shape[1])
    true = Route(
        route.seconds[keep], *(v[keep] for v in (route.latitude, route.longitude, route.east, route.north))
    )
    ins = Route(
        true.seconds,
        true.latitude + x[:, :, 0],
        true.longitude + x[:, :, 1],
        true.east + x[:, :, 2],
        true.north + x[:, :, 3],
    )
    meridian, parallel = metres_per_radian(ins.latitude)
    error = np.stack([x[:, :, 0] * meridian, x[:, :, 1] * parallel], axis=-1)
    anomaly = gravity_map.at(true.latitude, true.longitude)
    drawn = Streams(seed, runs, Purpose.GRAVIMETER).normal(1, len(keep))[:, 0]
    return Scenario(
        gravity_map,
        believed or grade,
        noise,
        initial,
        true.seconds,
        ins,
        anomaly + noise * drawn,
        error,
        true,
        true.turns(),  # the INS has its heading to the azimuth error, a milliradian
    )
