"""A plan: the poses to take next, and what the poses will determine after each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.observability import Observability, design
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.planning.design import best_poses, candidates


@dataclass(frozen=True)
class Plan:
    """The next poses.

    Attributes:
        poses: number of poses so far.
        directions: unit specific force of the next, best first, shape (k, 3).
        stages: what the poses determine before the first of them and after each, k + 1 entries.
        noise: standard deviation of one pose in parts of g; None when not known.
        so_far: the calibration of the poses so far; None when there are none.
    """

    poses: int
    directions: Float
    stages: tuple[Observability, ...]
    noise: float | None
    so_far: Calibration | None = None

    @property
    def verdict(self) -> str:
        """What the verdict will be after the last pose."""
        return "undetermined" if self.beyond_poses else self.stages[-1].verdict

    @property
    def beyond_poses(self) -> bool:
        """Whether the calibration so far is undetermined for a reason that more poses do not change."""
        if self.so_far is None or self.so_far.verdict != "undetermined":
            return False
        return self.stages[0].verdict != "undetermined"


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
        poses: their number.
        count: number of poses to add.
        fixture: one of design.FIXTURES.
        noise: standard deviation of one pose in parts of g; None when not known.
        so_far: the calibration of the poses so far, whose verdict the plan carries on.
    """
    allowed = candidates(fixture)
    held = np.zeros(9, dtype=bool) if so_far is None else so_far.held
    directions = allowed[best_poses(quality.knowing(information, held), allowed, count)]
    rows = design(directions)
    sums = [information + rows[:k].T @ rows[:k] for k in range(count + 1)]
    stages = tuple(Observability.of(total, poses + k, held) for k, total in enumerate(sums))
    return Plan(poses, directions, stages, noise, so_far)
