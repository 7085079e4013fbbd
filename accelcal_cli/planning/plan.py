"""A plan: the poses to take next, and what every parameter is expected to come out with after each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.observability import PARAMETERS, Observability, design
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.planning.design import best_poses, candidates
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor.poses import describe
from accelcal_cli.table import Column, Table

KINDS = (
    ("scale", quality.SCALE, "ppm", units.PPM),
    ("misalignment", quality.MISALIGNMENT, "mrad", units.MRAD),
    ("bias", quality.BIAS, "micro-g", units.MICRO_G),
)
"""Kinds of parameters with the unit that their sigma is shown in, and its size in parts of g."""


SHORT = {"scale": "scale", "misalignment": "misal.", "bias": "bias"}
"""Headings of the kinds, short enough for all of them to stand side by side."""

SO_FAR = ("verdict", "reasons", "cautions")
"""What a plan says of the calibration so far, as `calibrate` does."""


@dataclass(frozen=True)
class Plan:
    """The next poses.

    Attributes:
        poses: how many have been taken.
        directions: unit specific force of the next, best first, shape (k, 3).
        seen: what the poses determine before the first of them and after each, k + 1 entries.
        noise: standard deviation of one pose in parts of g; None when not known.
        so_far: the calibration of the poses that have been taken; None when there are none.
    """

    poses: int
    directions: Float
    seen: tuple[Observability, ...]
    noise: float | None
    so_far: Calibration | None = None

    @property
    def verdict(self) -> str:
        """What the verdict will be after the last pose."""
        return "undetermined" if self.beyond_poses else self.seen[-1].verdict

    @property
    def beyond_poses(self) -> bool:
        """Whether the calibration so far is undetermined for another reason than its poses: more do not mend it."""
        if self.so_far is None or self.so_far.verdict != "undetermined":
            return False
        return self.seen[0].verdict != "undetermined"


def plan(
    information: Float,
    poses: int,
    count: int,
    fixture: str,
    noise: float | None,
    so_far: Calibration | None = None,
) -> Plan:
    """Return the next `count` poses that shrink the worst sigma most.

    Args:
        information: J^T J of the poses so far, shape (9, 9); zeros when there are none.
        poses: how many they are.
        count: how many to add.
        fixture: one of planner.FIXTURES.
        noise: standard deviation of one pose in parts of g; None when not known.
        so_far: the calibration of the poses so far, whose verdict the plan carries on.
    """
    allowed = candidates(fixture)
    held = np.zeros(9, dtype=bool) if so_far is None else so_far.held
    directions = allowed[best_poses(quality.knowing(information, held), allowed, count)]
    rows = design(directions)
    sums = [information + rows[:k].T @ rows[:k] for k in range(count + 1)]
    seen = tuple(Observability.of(total, poses + k, held) for k, total in enumerate(sums))
    return Plan(poses, directions, seen, noise, so_far)


def pose_table(found: Plan) -> Table:
    """Return one row a pose: how to hold the sensor, and the worst of each kind expected after it."""
    rows = [_pose_row(found, k) for k in range(len(found.seen))]
    columns = [Column("pose", format="d"), Column("hold")]
    columns += [Column(axis, format=".3f") for axis in "xyz"]
    columns += [Column(f"DOP {SHORT[kind]}", format=".3f", key=f"dop_{kind}") for kind, *_ in KINDS]
    columns += [Column(f"sigma {SHORT[kind]}", unit, ".3g", f"sigma_{kind}") for kind, _, unit, _ in KINDS]
    notes = (
        "x, y, z: direction of the specific force (up) in the sensor's axes. DOP and sigma: the largest of each kind "
        "after the pose; a dash where the poses do not determine it.",
        *_notes(found),
    )
    return Table("Poses to take next", tuple(columns), tuple(rows), notes).filled()


def _pose_row(found: Plan, k: int) -> tuple[object, ...]:
    seen = found.seen[k]
    direction = found.directions[k - 1] if k else None
    hold = "so far" if direction is None else describe(direction)
    vector = (None, None, None) if direction is None else tuple((direction + 0.0).tolist())
    worst = [_finite(float(seen.dop[kind].max())) for _, kind, _, _ in KINDS]
    sigma = [_times(dop, found.noise, size) for dop, (*_, size) in zip(worst, KINDS, strict=True)]
    return (found.poses + k, hold, *vector, *worst, *sigma)


def parameter_table(found: Plan) -> Table:
    """Return one row a parameter: its dilution of precision and sigma so far and after the last pose."""
    rows = []
    for _, kind, unit, size in KINDS:
        for p in range(kind.start, kind.stop):
            before, after = (_finite(float(seen.dop[p])) for seen in (found.seen[0], found.seen[-1]))
            sigma = (_times(before, found.noise, size), _times(after, found.noise, size))
            rows.append((PARAMETERS[p], before, after, *sigma, unit if found.noise is not None else None))
    columns = (
        Column("parameter"),
        Column("DOP so far", format=".3f", key="dop_before"),
        Column("DOP after", format=".3f", key="dop_after"),
        Column("sigma so far", format=".3g", key="sigma_before"),
        Column("sigma after", format=".3g", key="sigma_after"),
        Column("unit"),
    )
    return Table(
        f"Expected after all {found.poses + len(found.directions)} poses", columns, tuple(rows)
    ).filled()


def record(found: Plan) -> dict[str, object]:
    """Return a plan for programs: plain mappings, lists, numbers and text."""
    return {
        "verdict": found.verdict,
        "noise": found.noise,
        "so_far": None if found.so_far is None else {key: getattr(found.so_far, key) for key in SO_FAR},
        "poses": [dict(row) for row in pose_table(found).records()],
        "parameters": [dict(row) for row in parameter_table(found).records()],
    }


ALIGNED_NOTE = "Planned for scale factors and biases alone, as the poses so far were calibrated."


def _notes(found: Plan) -> tuple[str, ...]:
    if found.beyond_poses:
        return (
            "More poses do not mend the verdict on those so far; the plan only tells what they would add.",
        )
    if found.verdict != "undetermined":
        return (ALIGNED_NOTE,) if found.so_far is not None and found.so_far.held.any() else ()
    lost = found.seen[-1].above(quality.UNDETERMINED)
    named = ", ".join(lost) if 0 < len(lost) < len(PARAMETERS) else "all nine parameters"
    return (f"Still not determined after these poses: {named}. Plan more poses, or another fixture.",)


def _finite(value: float) -> float | None:
    """Return a dilution of precision; None where it is infinite, or 0 for a parameter that is not estimated."""
    return value if np.isfinite(value) and value > 0 else None


def _times(dop: float | None, noise: float | None, size: float) -> float | None:
    return None if dop is None or noise is None else dop * noise * size
