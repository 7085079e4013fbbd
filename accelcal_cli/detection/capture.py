"""Static poses out of a live stream of readings: which pose is held, whether it is still, and which are captured.

Recognising a pose needs a rough sensor before there is a calibration: its output at no acceleration and for 1 g.
What is not stated is estimated from the poses captured so far, as the sphere nearest to them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import HEAD, Readings
from accelcal_cli.io.rows import zero_rows
from accelcal_cli.io.screening import NOTHING, Screened
from accelcal_cli.notices import Notice
from accelcal_cli.sensor.model import check_unit

if TYPE_CHECKING:  # a capture that shows no calibration does not wait for it
    from accelcal_cli.calibration.result import Calibration

STILL = 0.01
"""Standard deviation of each axis, in parts of 1 g, at or below which a sensor counts as still."""

NEAR = 20.0
"""Degrees within which a pose counts as the planned one: faces, edges and corners are 35 or more apart."""

SAME = 10.0
"""Degrees within which a pose counts as one that is captured already."""

SCREENED, NAMES = 3, ("Nx", "Ny", "Nz")
"""Fewest poses that are screened, and the columns of their table."""

SPHERE_PRIOR = 1e-3
"""Weight of the origin as centre of the sphere, relative to that of the poses."""

SPHERE_ROUNDS = 3
"""Steps towards the centre; each goes more than nine tenths of the way, also from far outside the sphere."""

State = Literal["moving", "still", "taken", "again"]


@dataclass(frozen=True)
class CapturedPose:
    """A pose that was held still: n readings, their mean and standard deviation, shapes (3,), output units."""

    n: int
    mean: Float
    spread: Float


@dataclass(frozen=True)
class RoughSensor:
    """A rough sensor, one scale factor for all axes.

    Attributes:
        centre: output at no acceleration, shape (3,).
        scale: output of 1 g.
    """

    centre: Float
    scale: float

    def directions(self, output: Float) -> Float:
        """Return the unit directions of outputs, shape (..., 3)."""
        force = output - self.centre
        length = np.linalg.norm(force, axis=-1, keepdims=True)
        return np.asarray(force / np.where(length > 0, length, 1.0))


def fit_rough_sensor(outputs: Float, scale: float | None, centre: Float | None) -> RoughSensor:
    """Return the rough sensor that fits some poses.

    Args:
        outputs: mean output of each pose, shape (J, 3), at least one.
        scale: output of 1 g, when stated; centre: output at no acceleration, shape (3,), when stated.

    Where the poses do not determine it, the centre is the origin: for a sensor whose output at no acceleration is
    several times that of 1 g, state the centre, or the first poses look alike.
    """
    if centre is None:
        centre = np.zeros(3)
        for _ in range(SPHERE_ROUNDS):
            centre = centre + _towards_sphere(outputs - centre)
    if scale is None:
        scale = float(np.median(np.linalg.norm(outputs - centre, axis=1))) or 1.0
    return RoughSensor(centre, scale)


def _towards_sphere(outputs: Float) -> Float:
    """Return the step to the centre of the sphere nearest to some points, shape (J, 3).

    |x|^2 = 2 c x + (r^2 - |c|^2) is linear in c and the constant; the prior decides what the points do not.
    """
    size = float(np.linalg.norm(outputs, axis=1).max()) or 1.0
    x = outputs / size
    left = np.column_stack([2.0 * x, np.ones(len(x))])
    prior = SPHERE_PRIOR * len(x) * np.diag([1.0, 1.0, 1.0, 0.0])
    c: Float = np.linalg.solve(left.T @ left + prior, left.T @ np.einsum("ij,ij->i", x, x))
    return size * c[:3]


@dataclass(frozen=True)
class CaptureStatus:
    """What the sensor is doing.

    Attributes:
        state: moving; still, and being averaged; taken, just now; again, a pose that is captured already.
        spread: largest standard deviation of the three axes in the window, output units; limit: what counts as still.
        progress: part of the hold that is complete, 0 to 1.
        nearest: number of the nearest planned pose; angle: degrees to it.
        reading: the latest, output units, shape (3,); direction: of the window, a unit vector, shape (3,).
    """

    state: State
    spread: float
    limit: float
    progress: float
    nearest: int
    angle: float
    reading: Float
    direction: Float


class Capture:
    """Watches a stream of readings and captures the poses that are held still.

    Attributes:
        planned: unit directions, shape (P, 3); poses: captured so far; behind: the readings of these.
        calibration: of the poses so far, as of the last call of `calibrate`; None before, or where there is none.
    """

    def __init__(
        self,
        planned: Float,
        window: int,
        hold: int,
        still: float | None = None,
        scale: float | None = None,
        centre: Float | None = None,
        unit: str | None = None,
    ) -> None:
        """Wait for poses.

        Args:
            planned: unit directions of the specific force, shape (P, 3).
            window: readings that decide on stillness; hold: still readings that make a pose.
            still: largest standard deviation of a still axis, output units; 1 % of 1 g when None.
            scale: output of 1 g; centre: output at no acceleration, shape (3,); estimated when None.
            unit: one of OUTPUT_OF_1_G, which the first pose is checked against; None for any other.
        """
        self.planned, self.hold, self.still = planned, max(hold, window), still
        self.stated, self.unit = (scale, centre), unit
        self.poses: list[CapturedPose] = []
        self.behind = NOTHING
        self.window = np.zeros((window, 3))
        self.count = 0
        self.run: list[Float] = []
        self.done_here = False
        self.rough: RoughSensor | None = None
        self.calibration: Calibration | None = None

    def push(self, reading: Float) -> CaptureStatus | None:
        """Add one reading, shape (3,); None while the first window fills.

        Raises:
            DataError: the first pose cannot be 1 g in the stated unit; it is not taken.
        """
        self.window[self.count % len(self.window)] = reading
        self.count += 1
        if self.count < len(self.window):
            return None
        mean = self.window.mean(axis=0)
        rough = self.rough or fit_rough_sensor(mean[None], *self.stated)
        limit = STILL * rough.scale if self.still is None else self.still
        spread = float((self.window - reading).std(axis=0).max())
        state = self._step(reading, mean, rough, quiet=spread <= limit, limit=limit)
        direction = (self.rough or rough).directions(mean)
        nearest, angle = _nearest(direction, self.planned)
        progress = min(len(self.run) / self.hold, 1.0)
        return CaptureStatus(state, spread, limit, progress, nearest, angle, reading, direction)

    def _step(self, reading: Float, mean: Float, rough: RoughSensor, *, quiet: bool, limit: float) -> State:
        if not quiet:
            self.run, self.done_here = [], False
            return "moving"
        known = self.rough is not None and _nearest(rough.directions(mean), self.directions())[1] < SAME
        if self.done_here or known:
            self.run = []
            return "again"
        self.run += [reading] if self.run else list(self.window)
        if len(self.run) < self.hold:
            return "still"
        readings = np.array(self.run)
        if readings.std(axis=0).max() > limit:  # it drifts, too slowly for the window to show
            self.run = self.run[-len(self.window) :]
            return "still"
        self.behind = self.behind.and_also(readings, HEAD)
        away = readings - reading  # so that equal readings have no spread, and their own value as mean
        self._capture(CapturedPose(len(readings), reading + away.mean(axis=0), away.std(axis=0, ddof=1)))
        return "taken"

    def _capture(self, pose: CapturedPose) -> None:
        if self.unit is not None and not self.poses:
            check_unit(pose.mean - (0.0 if self.stated[1] is None else self.stated[1]), self.unit)
        self.poses.append(pose)
        self.run, self.done_here = [], True
        self.rough = fit_rough_sensor(np.array([pose.mean for pose in self.poses]), *self.stated)

    def directions(self) -> Float:
        """Return the directions of the captured poses, as far as they are known, shape (J, 3)."""
        means = np.array([pose.mean for pose in self.poses])
        return np.zeros((0, 3)) if self.rough is None else self.rough.directions(means)

    def recognised(self) -> list[int | None]:
        """Return the planned pose that each captured pose is, None for one that is not planned.

        By the latest rough sensor: which pose an early one is may become clear with the later ones.
        """
        matches = [_nearest(direction, self.planned) for direction in self.directions()]
        return [index if angle < NEAR else None for index, angle in matches]

    def length(self, reading: Float) -> float:
        """Return the length of the specific force that a reading means, in g: as calibrated, or by the rough sensor."""
        result = self.calibration
        if result is not None and result.verdict != "undetermined":
            return float(np.linalg.norm(result.apply(reading))) / result.g
        rough = self.rough or fit_rough_sensor(reading[None], *self.stated)
        return float(np.linalg.norm(reading - rough.centre)) / rough.scale

    def readings(self) -> Readings:
        """Return the poses taken so far as readings to calibrate with, at least one."""
        readings = Readings.from_array(
            np.array([pose.mean for pose in self.poses]),
            count=[pose.n for pose in self.poses],
            scatter=[pose.spread for pose in self.poses],
            warnings=self.notices(),
        )
        return replace(readings, form=replace(readings.form, unit=self.unit))

    def calibrate(self, g: float | None = None) -> None:
        """Calibrate the poses taken so far, by the quickest solver, into `calibration`; 15 to 30 ms.

        Args:
            g: local gravity in m/s^2 or in the unit of the readings; by the unit when None.
        """
        from accelcal_cli.calibration.calibrate import calibrate

        stated: dict[str, Any] = {} if g is None else {"g": g}
        try:
            self.calibration = calibrate(self.readings(), optimizer="levenberg-marquardt", **stated)
        except DataError:  # of poses that are all alike
            self.calibration = None

    def notices(self) -> tuple[Notice, ...]:
        """Return what the captured poses show that no sensor at rest shows; nothing of fewer than SCREENED."""
        if len(self.poses) < SCREENED:
            return ()
        means = np.array([pose.mean for pose in self.poses])
        real = np.flatnonzero(means.any(axis=1))
        zeros = zero_rows(len(means) - len(real), "", len(real))
        if len(real) < SCREENED:
            return zeros
        screened = Screened(
            means[real],
            NAMES,
            len(real),
            lambda pose: f"pose {real[pose] + 1}",
            single=False,
            count=np.array([pose.n for pose in self.poses], dtype=float)[real],
            scatter=np.array([pose.spread for pose in self.poses])[real],
            behind=self.behind,
        )
        return (*screened.notices(), *zeros)

    def missing(self) -> list[int]:
        """Return the planned poses that are not captured yet."""
        return sorted(set(range(len(self.planned))) - set(self.recognised()))


def _nearest(direction: Float, among: Float) -> tuple[int, float]:
    """Return the number of the nearest of some unit directions, shape (P, 3), and the degrees to it."""
    cosine = among @ direction
    best = int(np.argmax(cosine))
    return best, math.degrees(math.acos(min(1.0, max(-1.0, float(cosine[best])))))
