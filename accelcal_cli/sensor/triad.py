"""Targets that correct axis by axis: the sensor's own triad of axes, and how the sensor is mounted in the body.

A target without misalignments makes C (N - D) of a reading, C diagonal. With N = K_a f + D that is C K_a f, which
should be O f, O the turn of the force into an orthogonal triad of sensor axes. Over all directions of a force of 1 g
the error has the mean square g^2 |C K_a - O|^2 / 3 (Frobenius). It is least where

    O = polar factor of C K_a,   c_i = k_i o_i / |k_i|^2

k_i and o_i rows of K_a and O. Neither C nor the error depends on the gauge. With known attitudes O is the mounting.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.sensor.poses import AXES

ROUNDS, SETTLED = 200, 1e-15
"""Rounds of C and O at most, and the change of C, as a part of it, that ends them; axes that miss 90 degrees by 0.1 rad
need about ten."""

NEAR = 5.0
"""Degrees from an orientation that the target has a name for, up to which a mounting is said to be that one."""

ORIENTATIONS = (
    (0, 0, 0), (0, 0, 45), (0, 0, 90), (0, 0, 135), (0, 0, 180), (0, 0, 225), (0, 0, 270), (0, 0, 315),
    (180, 0, 0), (180, 0, 45), (180, 0, 90), (180, 0, 135), (0, 180, 0), (180, 0, 225), (180, 0, 270), (180, 0, 315),
    (90, 0, 0), (90, 0, 45), (90, 0, 90), (90, 0, 135), (270, 0, 0), (270, 0, 45), (270, 0, 90), (270, 0, 135),
    (0, 90, 0), (0, 270, 0), (0, 180, 90), (0, 180, 270), (90, 90, 0), (180, 90, 0), (270, 90, 0), (90, 180, 0),
    (270, 180, 0), (90, 270, 0), (180, 270, 0), (270, 270, 0), (90, 180, 90), (90, 0, 270),
)  # fmt: skip
"""Roll, pitch and yaw, degrees, of MAVLink's MAV_SENSOR_ROTATION 0 to 37, whose numbers PX4 and ArduPilot share."""


@dataclass(frozen=True, eq=False)
class Triad:
    """A sensor as three orthogonal axes with a scale factor each.

    Attributes:
        scale: C, what a reading without its bias is multiplied by, shape (3,), m/s^2 per output unit.
        axes: O, the sensor's axes in the body frame, a row each, shape (3, 3); a mirror where the log is left-handed.
        rms, worst: error of the force that this leaves, over all directions and at most, parts of the force.
    """

    scale: Float
    axes: Float
    rms: float
    worst: float

    @classmethod
    def of(cls, K: Float) -> Triad:
        """Return the triad with the least rms error, of K_a, shape (3, 3)."""
        square = np.sum(K**2, axis=1)
        scale = 1.0 / np.sqrt(square)
        for _ in range(ROUNDS):
            left, _, right = np.linalg.svd(scale[:, None] * K)
            axes = left @ right
            before, scale = scale, np.sum(K * axes, axis=1) / square
            if np.abs(scale / before - 1.0).max() < SETTLED:
                break
        error = scale[:, None] * K - axes
        return cls(
            scale, axes, float(np.linalg.norm(error)) / math.sqrt(3.0), float(np.linalg.norm(error, 2))
        )

    @property
    def mirrored(self) -> bool:
        """Whether the axes of the log are left-handed in the body frame: no rotation mounts a sensor so."""
        return bool(np.linalg.det(self.axes) < 0)

    @property
    def straight(self) -> Float:
        """The nearest way to exchange and reverse body axes, shape (3, 3): entries 0, 1 and -1, one in each row."""
        best = max(
            itertools.permutations(range(3)), key=lambda order: np.abs(self.axes[range(3), order]).sum()
        )
        straight = np.zeros((3, 3))
        straight[range(3), best] = np.sign(self.axes[range(3), best])
        return straight

    def in_words(self, parameter: str) -> str:
        """Return how the sensor is mounted, for a target whose board orientation is a parameter of that name."""
        if self.mirrored:
            straight = self.straight
            reads = ", ".join(
                f"{AXES[i]} reads {'+' if row.sum() > 0 else '-'}{AXES[int(np.abs(row).argmax())]}"
                for i, row in enumerate(straight)
            )
            rest = angle(self.axes @ straight.T)
            return (
                f"the axes of the log are left-handed in the body frame of fx, fy, fz: {reads}, {rest:.3g} degrees "
                f"off; no {parameter} does that, so exchange or reverse columns before these numbers apply"
            )
        turn = self.axes.T
        roll, pitch, yaw = roll_pitch_yaw(turn)
        angles = [angle(turn @ rotation(*named).T) for named in ORIENTATIONS]
        number = int(np.argmin(angles))
        name = "_".join(
            f"{word}_{degrees}"
            for word, degrees in zip(("ROLL", "PITCH", "YAW"), ORIENTATIONS[number], strict=True)
            if degrees
        )
        near = (
            f"{parameter} {number} ({name or 'NONE'}) is {angles[number]:.2g} degrees from it"
            if angles[number] <= NEAR
            else f"no {parameter} is within {NEAR:g} degrees of it"
        )
        return (
            f"roll {roll:.2f}, pitch {pitch:.2f}, yaw {yaw:.2f} degrees turn the axes of the log to the body frame of "
            f"fx, fy, fz; {near}"
        )


def angle(turn: Float) -> float:
    """Return the angle of a rotation, shape (3, 3), degrees."""
    sine = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    return math.degrees(math.atan2(float(np.linalg.norm(sine)), float(np.trace(turn)) - 1.0))


def rotation(roll: float, pitch: float, yaw: float) -> Float:
    """Return the matrix Rz(yaw) Ry(pitch) Rx(roll), shape (3, 3), of angles in degrees."""
    (a, b, c), (x, y, z) = (f(np.radians([roll, pitch, yaw])) for f in (np.cos, np.sin))
    return np.array(
        [
            [b * c, x * y * c - a * z, a * y * c + x * z],
            [b * z, x * y * z + a * c, a * y * z - x * c],
            [-y, x * b, a * b],
        ]
    )


def roll_pitch_yaw(turn: Float) -> tuple[float, float, float]:
    """Return the angles of `rotation`, degrees; roll 0 where the pitch is 90 degrees and yaw alone shows."""
    pitch = math.asin(min(1.0, max(-1.0, -float(turn[2, 0]))))
    if abs(turn[2, 0]) > 1.0 - 1e-12:
        roll, yaw = 0.0, math.atan2(-turn[0, 1], turn[1, 1])
    else:
        roll, yaw = math.atan2(turn[2, 1], turn[2, 2]), math.atan2(turn[1, 0], turn[0, 0])
    # No minus before a zero.
    return tuple(round(math.degrees(v), 9) + 0.0 for v in (roll, pitch, yaw))  # type: ignore[return-value]
