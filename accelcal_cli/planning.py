"""Planning: which poses to take next, the ones that shrink the worst dilution of precision most.

A plan starts from what the poses so far determine; `distinct_poses` from nothing, for a capture.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.calibration.observability import (
    PRIOR,
    Observability,
    design,
    knowing,
    next_poses,
    pose_score,
)
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.poses import fixture_directions, grid

FIXTURES = ("faces", "edges", "corners", "any")
"""What the sensor can be held against: each allows what those before it allow."""

POWERS = (2.0, 16.0, np.inf)
"""Norms of the variances that an exchange minimises one after the other: the sum of squares shows the way where the
largest one alone is tied, the last is the largest itself."""

STARTED_POSES, FEWEST_STARTS = 300, 2
"""Random starts of an exchange: 300 poses over the number chosen, 2 at least."""


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
        fixture: one of FIXTURES.
        noise: standard deviation of one pose in parts of g; None when not known.
        so_far: the calibration of the poses so far, whose verdict the plan carries on.
    """
    allowed = candidates(fixture)
    held = np.zeros(9, dtype=bool) if so_far is None else so_far.held
    directions = allowed[best_poses(knowing(information, held), allowed, count)]
    rows = design(directions)
    sums = [information + rows[:k].T @ rows[:k] for k in range(count + 1)]
    stages = tuple(Observability.of(total, poses + k, held) for k, total in enumerate(sums))
    return Plan(poses, directions, stages, noise, so_far)


def candidates(fixture: str) -> Float:
    """Return the directions that a fixture allows, shape (C, 3), the easiest to hold first.

    `faces`: 6; `edges`: 18, `corners`: 26; `any`: 290, all of them with components in ratios up to 3.
    """
    directions = fixture_directions()
    allowed = {"faces": directions[:6], "edges": directions[:18], "corners": directions}
    return allowed[fixture] if fixture in allowed else np.concatenate([directions, grid(3)[26:]])


def best_poses(information: Float, candidates: Float, count: int) -> list[int]:
    """Return the indices of the `count` candidates that together leave the smallest largest variance, best first.

    Greedy choice looks one pose ahead. An exchange [fedorov1972] improves on that: each pose in turn is replaced by the
    candidate that suits the others best, until none is. From the greedy choice and from random ones, the best kept.
    """
    rows = design(candidates)
    starts = Streams(0, range(max(FEWEST_STARTS, STARTED_POSES // count)), Purpose.PLAN)
    drawn = (starts.uniform(1, count)[:, 0] * len(rows)).astype(np.intp)
    greedy = np.array(next_poses(information, candidates, count), dtype=np.intp)
    kept, least = greedy, np.inf
    for start in (greedy, *drawn):
        chosen = start
        for power in POWERS:
            chosen = _exchange(information, rows, chosen, power)
        reached = float(pose_score(_variances(information, rows[chosen]), np.inf))
        if reached < least:
            kept, least = chosen, reached
    return [int(kept[i]) for i in next_poses_of(information, candidates[kept])]


def distinct_poses(candidates: Float, count: int) -> list[int]:
    """Return the indices of a set of `count` different candidates, as good from nothing as `best_poses`, best first.

    A set that wants a pose twice gets the best of the other candidates in its place.
    """
    chosen: list[int] = []
    while len(chosen) < count:
        left = [i for i in range(len(candidates)) if i not in chosen]
        rows = design(candidates[chosen])
        more = best_poses(rows.T @ rows, candidates[left], count - len(chosen))
        chosen += dict.fromkeys(left[i] for i in more)
    return chosen


def next_poses_of(information: Float, directions: Float) -> list[int]:
    """Return the order in which to take all of some poses, shape (k, 3): each time the one that helps most."""
    left = list(range(len(directions)))
    order: list[int] = []
    while left:
        (best,) = next_poses(information, directions[left], 1)
        row = design(directions[[left[best]]])
        information = information + row.T @ row
        order.append(left.pop(best))
    return order


def _exchange(information: Float, rows: Float, start: Int, power: float) -> Int:
    """Return the poses after exchanging one for a better one until no exchange helps."""
    chosen = start.copy()
    score = float(pose_score(_variances(information, rows[chosen]), power))
    moved = True
    while moved:
        moved = False
        for k in range(len(chosen)):
            others = rows[np.delete(chosen, k)]
            after = _variances_with(information + others.T @ others, rows)
            scores = pose_score(after, power)
            best = int(np.argmin(scores))
            if scores[best] < score:
                chosen[k], score, moved = best, float(scores[best]), True
    return chosen


def _variances(information: Float, rows: Float) -> Float:
    """Return the variances after the poses of some design rows, shape (9,)."""
    return np.diagonal(np.linalg.inv(information + PRIOR * np.eye(9) + rows.T @ rows))


def _variances_with(information: Float, rows: Float) -> Float:
    """Return the variances after each of some poses alone, shape (C, 9): P - P a a^T P / (1 + a^T P a)."""
    cofactor = np.linalg.inv(information + PRIOR * np.eye(9))
    gain = rows @ cofactor
    drop: Float = gain**2 / (1.0 + np.einsum("cp,cp->c", gain, rows))[:, None]
    return np.diagonal(cofactor) - drop
