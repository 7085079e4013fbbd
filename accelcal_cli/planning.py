"""Planning: which poses to take next, the ones that shrink the worst dilution of precision most.

A plan starts from what the poses so far determine; `distinct_poses` from nothing, for a capture.

A cubic nonlinearity c_i of axis i reads f_i (1 + c_i f_i^2 / g^2) for f_i. To first order it changes a residual
e = (g^2 - |f|^2) / 2g by -g c_i u_i^4, as a scale factor does by -g E_ii u_i^2. On the twelve edges u_i^2 is 0 or 1/2
and on the faces 0 or 1: on either alone the two are one, and on both together each shows. So where there are enough
poses, those that are as good for the nine to a few percent are chosen for the three c_i beside them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import (
    PRIOR,
    Observability,
    design,
    knowing,
    next_poses,
    pose_score,
)
from accelcal_cli.calibration.result import RESULTS, Calibration, load_result
from accelcal_cli.errors import UsageError, did_you_mean
from accelcal_cli.io.readings import Data
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.model import STANDARD_GRAVITY
from accelcal_cli.sensor.poses import fixture_directions, grid

FIXTURES = ("faces", "edges", "corners", "any")
"""What the sensor can be held against: each allows what those before it allow."""

POWERS = (2.0, 16.0, np.inf)
"""Norms of the variances that an exchange minimises one after the other: the sum of squares shows the way where the
largest one alone is tied, the last is the largest itself."""

STARTED_POSES, FEWEST_STARTS = 300, 2
"""Random starts of an exchange: 300 poses over the number chosen, 2 at least."""


FEWEST_WEIGHED = 14
"""Poses, those so far included, from which on nonlinearity counts: the default, twelve edges, needs all of them."""

COST = 1.1
"""What the largest dilution of precision of each kind may rise to for it, as a part of that of the best poses."""

NONLINEARITY, SEEN = 0.005, 3.0
"""A cubic term as large as data sheets of MEMS accelerometers allow, part of g, and how many sigma make it visible.
Where the noise hides it, the poses are those that are best for the nine alone."""


@dataclass(frozen=True)
class Plan:
    """The next poses.

    Attributes:
        poses: number of poses so far.
        directions: unit specific force of the next, best first, shape (k, 3).
        stages: what the poses determine before the first of them and after each, k + 1 entries.
        noise: standard deviation of one pose in parts of g; None when not known.
        cubic: dilution of precision of the cubic term of each axis, beside the nine, after all poses, shape (3,); inf
            where they cannot tell it from a scale factor.
        so_far: the calibration of the poses so far; None when there are none.
    """

    poses: int
    directions: Float
    stages: tuple[Observability, ...]
    noise: float | None
    cubic: Float
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


FROM_NOTHING, NEXT, MOST_POSES = 12, 6, 200
"""Poses that are planned unless a number is stated: in all, and to add to those so far; and at most."""


def plan(
    so_far: Calibration | str | Path | Data | None = None,
    *,
    poses: int | None = None,
    add: int | None = None,
    fixture: str = "corners",
    noise: float | None = None,
    g: float | None = None,
) -> Plan:
    """Return the poses to take next: those that shrink the worst sigma most.

    Args:
        so_far: what is known already: a calibration or its file, or readings as `calibrate` takes them; None for
            nothing.
        poses: number of poses in the end, those so far included; add: number to add, instead of `poses`.
        fixture: one of FIXTURES: what the sensor can be held against.
        noise: standard deviation of one pose, m/s^2; that of the poses so far when None.
        g: local gravity, of readings, or in m/s^2 where nothing is known yet; that of the calibration so far otherwise.

    Raises:
        UsageError: an unknown fixture, or no number of poses to add.

    Examples:
        >>> from accelcal_cli import plan
        >>> proposal = plan(add=12, noise=0.01)
        >>> len(proposal.directions), proposal.verdict
        (12, 'good')
    """
    if fixture not in FIXTURES:
        raise UsageError(
            f'--fixture "{fixture}": unknown{did_you_mean(fixture, FIXTURES)}; expected one of {", ".join(FIXTURES)}'
        )
    if poses is not None and add is not None:
        raise UsageError("--poses and --add: expected one of them, not both")
    known = _known(so_far, g)
    existing = 0 if known is None else known.poses
    count = add or ((poses or FROM_NOTHING) - existing if poses or known is None else NEXT)
    if count < 1:
        raise UsageError(f"--poses {poses}: {existing} poses exist already; expected more, or --add")
    if count > MOST_POSES:
        raise UsageError(f"--poses {poses}: {count} poses to plan; expected at most {MOST_POSES}")
    if known is None:
        part = None if noise is None else noise / (g or STANDARD_GRAVITY)
        return plan_from(np.zeros((9, 9)), 0, count, fixture, part)
    sigma = noise or (known.s if known.freedom > 0 else 0.0)
    return plan_from(
        known.information, existing, count, fixture, sigma / known.g if sigma > 0 else None, known
    )


def _known(so_far: Calibration | str | Path | Data | None, g: float | None) -> Calibration | None:
    """Return the calibration of the poses so far."""
    if so_far is None or isinstance(so_far, Calibration):
        return so_far
    if isinstance(so_far, str | Path) and Path(so_far).suffix in RESULTS:
        return load_result(so_far)
    from accelcal_cli.calibration.calibrate import calibrate

    if g is None:
        return calibrate(so_far, optimizer="levenberg-marquardt")
    return calibrate(so_far, optimizer="levenberg-marquardt", g=g)


def plan_from(
    information: Float,
    poses: int,
    count: int,
    fixture: str,
    noise: float | None,
    so_far: Calibration | None = None,
) -> Plan:
    """Return the next `count` poses: those that shrink the worst sigma most, with an eye to cubic nonlinearity.

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
    known, seen = knowing(information, held), _seen_of_twelve(so_far, held)
    chosen = np.array(best_poses(known, allowed, count), dtype=np.intp)
    if poses + count >= FEWEST_WEIGHED:
        chosen = _weighed(known, seen, allowed, chosen, noise)
    directions = allowed[chosen[next_poses_of(known, allowed[chosen])]]
    rows = design(directions)
    sums = [information + rows[:k].T @ rows[:k] for k in range(count + 1)]
    stages = tuple(Observability.of(total, poses + k, held) for k, total in enumerate(sums))
    cubic = np.sqrt(_variances(seen, _rows_of_twelve(directions))[9:])
    return Plan(poses, directions, stages, noise, np.where(cubic > UNSEEN, np.inf, cubic), so_far)


UNSEEN = 0.5 / np.sqrt(PRIOR)
"""A dilution of precision that is the prior's alone."""


def _rows_of_twelve(u: Float) -> Float:
    """Return the design rows of the nine parameters and of the three cubic terms, shape (J, 12), of unit directions."""
    return np.concatenate([design(u), -(u**4)], axis=1)


def _seen_of_twelve(so_far: Calibration | None, held: Bool) -> Float:
    """Return what the poses whose directions are known say of the nine and the cubic terms, shape (12, 12)."""
    seen = np.zeros((12, 12))
    if so_far is not None:
        rows = _rows_of_twelve(np.array([pose.direction for pose in so_far.poses_fit]).reshape(-1, 3))
        seen += rows.T @ rows
    seen[:9, :9] = knowing(seen[:9, :9], held)
    return seen


def _weighed(known: Float, seen: Float, allowed: Float, best: Int, noise: float | None) -> Int:
    """Return poses that show the cubic terms and are as good as the best for the nine to COST; the best if none do.

    Exchanges start from the best poses and from sets that begin with some faces.

    Args:
        known: information on the nine, shape (9, 9); seen: on the twelve, shape (12, 12).
        allowed: directions to choose from, shape (C, 3); best: indices of the best poses for the nine.
        noise: standard deviation of one pose in parts of g; None when not known.
    """
    rows = design(allowed)
    limit = COST**2 * _largest(_variances(known, rows[best]))
    kept, least = best, np.inf
    for start in (best, *_begun_with_faces(known, rows, allowed, len(best))):
        if (_largest(_variances(known, rows[start])) <= limit).all():
            chosen, score = _exchange_within(known, seen, allowed, start, limit)
            if score < least:
                kept, least = chosen, score
    variances = _variances(seen, _rows_of_twelve(allowed[kept]))[9:]
    visible = SEEN * (noise or 0.0) * np.sqrt(variances) <= NONLINEARITY
    return kept if visible.any() else best


def _largest(variances: Float) -> Float:
    """Return the largest variance of each kind, shape (..., 3), of those of the nine, shape (..., 9)."""
    return np.asarray(variances.reshape(*variances.shape[:-1], 3, 3).max(axis=-1))


def _begun_with_faces(known: Float, rows: Float, allowed: Float, count: int) -> Iterator[Int]:
    """Yield sets of poses that begin with one to six faces and go on as is best for the nine."""
    for faces in ([0], [0, 2], [0, 2, 4], [0, 1, 2, 3, 4, 5]):
        if len(faces) >= count:
            return
        information = known + rows[faces].T @ rows[faces]
        rest = np.array(next_poses(information, allowed, count - len(faces)), dtype=np.intp)
        for power in POWERS:
            rest = _exchange(information, rows, rest, power)
        yield np.concatenate([np.array(faces, dtype=np.intp), rest])


def _exchange_within(
    known: Float, seen: Float, allowed: Float, start: Int, limit: Float
) -> tuple[Int, float]:
    """Return poses, exchanged while that lowers the sum of the cubic terms' variances within a limit, and the sum."""
    nine, twelve = design(allowed), _rows_of_twelve(allowed)
    chosen, score = start.copy(), float(_variances(seen, twelve[start])[9:].sum())
    moved = True
    while moved:
        moved = False
        for k in range(len(chosen)):
            others = np.delete(chosen, k)
            within = _variances_with(known + nine[others].T @ nine[others], nine)
            after = _variances_with(seen + twelve[others].T @ twelve[others], twelve)[:, 9:].sum(axis=1)
            scores = np.where((_largest(within) <= limit * (1.0 + ROUNDING)).all(axis=1), after, np.inf)
            best = int(np.argmin(scores))
            if scores[best] < score * (1.0 - LEAST_GAIN):
                chosen[k], score, moved = best, float(scores[best]), True
    return chosen, score


LEAST_GAIN, ROUNDING = 1e-6, 1e-9
"""Least part that an exchange takes off, and what a limit is missed by through rounding."""


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
    """Return the variances after the poses of some design rows, shape (p,) for p parameters."""
    return np.diagonal(np.linalg.inv(information + PRIOR * np.eye(len(information)) + rows.T @ rows))


def _variances_with(information: Float, rows: Float) -> Float:
    """Return the variances after each of some poses alone, shape (C, p): P - P a a^T P / (1 + a^T P a)."""
    cofactor = np.linalg.inv(information + PRIOR * np.eye(len(information)))
    gain = rows @ cofactor
    drop: Float = gain**2 / (1.0 + np.einsum("cp,cp->c", gain, rows))[:, None]
    return np.diagonal(cofactor) - drop
