"""How well the poses determine the parameters: information, dilution of precision, verdict.

Nine parameters, all as specific force in m/s^2 and always in gauge `lower`: g times the entries of the
lower-triangular E in K_A = (I + E) K_A0, and K_A0's diagonal times the bias. Their residuals are
e_j = (g^2 - |f_j|^2) / 2g. The dilution of precision of a parameter is the square root of its entry in
(J^T J)^-1: the error of a parameter divided by the noise of one pose. It depends on the poses alone.

Attitudes, not rows, are what determines: the dilution of precision falls with the root of the number of rows, so that
noise seems to determine what the attitudes cannot. The geometry of a set of poses is therefore judged by its distinct
attitudes, each counted once, and as if they were twelve: more attitudes make an estimate better, which sigma says, and
not the geometry.

An attitude is a label, else a cluster of directions within `APART` degrees around the most frequent one. Many rows go
through the cells of a cube first, so that memory stays constant and the order of the rows does not matter. Clusters
serve counting alone: readings are never averaged over them, for the mean over a cap of 5 degrees is 1900 ppm too short.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.model import (
    AXIS_PAIRS,
    ErrorModel,
    bias_force,
    inverse,
    inverse_normal,
    misalignment,
    sensitivity,
)
from accelcal_cli.sensor.poses import describe, faces, fixture_directions

ROWS_COLUMNS = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1), (0, 1), (0, 2), (1, 2))
"""Which K_ij each unknown is: diagonal, below it, above it (the last three in gauge `full` alone)."""

PARAMETERS = (
    "scale factor x",
    "scale factor y",
    "scale factor z",
    "misalignment xy",
    "misalignment xz",
    "misalignment yz",
    "bias x",
    "bias y",
    "bias z",
)
SCALE, MISALIGNMENT, BIAS = slice(0, 3), slice(3, 6), slice(6, 9)

WEAK, UNDETERMINED = 10.0, 25.0
"""Thresholds of the dilution of precision. Of 16 real pose sets those with usable parameters stayed below 9.4;
those with an excellent residual and useless parameters had 25 to 1850."""

RANK_TOLERANCE = 1e-12
"""An eigenvalue of the information below this part of the largest is zero: double precision's square root of
it, 1e-6, is the smallest relative difference between poses that an ordinary CSV file can carry."""

WELL_CONDITIONED = 1e5
"""Trace of the information times that of its inverse below which the inverse needs no eigenvalues."""

RIDGE = 1e-14
"""Part of the trace that is added to the diagonal, so that no matrix of a batch is singular to the last bit."""

ALIGNED = np.repeat([False, True, False], 3)
"""The parameters that are not estimated when the axes are taken as perpendicular."""

PoseVerdict = Literal["good", "weak", "undetermined"]
"""What the poses alone say of a calibration: how an error of one reading comes out in the parameters."""


def design(u: Float) -> Float:
    """Return d e / d parameters, shape (..., J, 9), for unit directions u of the specific force, shape (..., J, 3)."""
    pairs = [u[..., i] * u[..., j] for i, j in ROWS_COLUMNS[:6]]
    return np.stack([*(-p for p in pairs), u[..., 0], u[..., 1], u[..., 2]], axis=-1)


def near_inverse(normal: Float) -> Float:
    """Return the inverses of normal matrices, shape (..., p, p): without meaning where they are singular."""
    one = np.eye(normal.shape[-1])
    ridge = RIDGE * np.einsum("...pp->...", normal)[..., None, None] * one
    return inverse_normal((normal + ridge).reshape(-1, *one.shape)).reshape(normal.shape)


def verdict_of(worst: float, rank: int, parameters: int = 9) -> PoseVerdict:
    """Return the verdict on poses that determine `rank` directions, with this largest dilution of precision."""
    if rank < parameters or worst > UNDETERMINED:
        return "undetermined"
    return "weak" if worst > WEAK else "good"


CERTAIN = 1e6
"""Information, in poses, that stands for knowing a parameter."""


def knowing(information: Float, held: Bool) -> Float:
    """Return information, shape (9, 9), to which that of knowing some parameters, shape (9,), is added."""
    return np.asarray(information + CERTAIN * np.diag(held.astype(float)))


PRIOR = 1e-6
"""Information that physics lends to every parameter when it comes to naming the undetermined ones: none is off by
more than 1000 times the noise of a pose. Without it a direction that the poses say nothing of would take every
parameter along that it touches by a part in a thousand."""


@frozen(eq=False)
class Observability:
    """What sets of poses say about the parameters, for one set or for R of them (leading axis R).

    Attributes:
        cofactor: (J^T J)^-1, its pseudo-inverse when the rank is below p, shape (..., p, p) for p parameters.
        dop: dilution of precision of each parameter, shape (..., p); inf where the poses do not determine it.
        bounded: the same under the prior, at most 1000, shape (..., p): it names what is not determined. Of good poses,
            of which there is nothing to name, it is dop.
        rank: number of determined directions, at most p, shape (...).
        names: of the p parameters.
    """

    cofactor: Float
    dop: Float
    bounded: Float
    rank: Int
    names: tuple[str, ...] = PARAMETERS

    @classmethod
    def of(cls, information: Float, poses: Int | int, held: Bool | None = None) -> Observability:
        """Return the observability of matrices J^T J, shape (..., 9, 9), from so many poses, shape (...).

        `held` parameters, shape (9,), are known and not estimated: they have no error.
        """
        if held is not None and held.any():
            return cls._of_free(information, poses, np.flatnonzero(~held))
        cofactor = near_inverse(information)
        size, variance = np.einsum("...pp->...", information), np.einsum("...pp->...p", cofactor)
        with np.errstate(all="ignore"):
            dop = np.sqrt(variance)
            good = (variance.min(axis=-1) > 0) & (variance.max(axis=-1) <= WEAK**2)
            good &= size * variance.sum(axis=-1) < WELL_CONDITIONED
        rank = np.minimum(np.full(good.shape, dop.shape[-1]), poses)
        if good.all():
            return cls(cofactor, dop, dop, rank)
        poor = cls._of_eigenvalues(information[~good], np.broadcast_to(poses, good.shape)[~good])
        bounded, rank = dop.copy(), np.array(rank)
        cofactor[~good], dop[~good], bounded[~good] = poor.cofactor, poor.dop, poor.bounded
        rank[~good] = poor.rank
        return cls(cofactor, dop, bounded, rank)

    @classmethod
    def _of_eigenvalues(cls, information: Float, poses: Int) -> Observability:
        """Return the observability of matrices that may be singular, shape (R, p, p)."""
        values, vectors = np.linalg.eigh(information)
        known = values > RANK_TOLERANCE * values[..., -1:]
        inverse = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
        cofactor = (vectors * inverse[..., None, :]) @ vectors.swapaxes(-1, -2)
        # The square sum of a row of the eigenvectors, each weighted, is what stands in the diagonal.
        bounded = np.sqrt((vectors**2 @ (1.0 / (np.maximum(values, 0.0) + PRIOR))[..., None])[..., 0])
        dop = np.sqrt(np.einsum("...pp->...p", cofactor))
        whole = known.all(axis=-1, keepdims=True)
        dop = np.where(whole, dop, np.where(bounded > UNDETERMINED, np.inf, bounded))
        return cls(cofactor, dop, bounded, np.minimum(known.sum(axis=-1), poses))

    @classmethod
    def _of_free(cls, information: Float, poses: Int | int, free: Int) -> Observability:
        """Return the observability of the parameters at `free`, the others without error."""
        part = cls.of(information[..., free[:, None], free], poses)
        cofactor, dop, bounded = np.zeros_like(information), *np.zeros((2, *information.shape[:-1]))
        cofactor[..., free[:, None], free] = part.cofactor
        dop[..., free], bounded[..., free] = part.dop, part.bounded
        return cls(cofactor, dop, bounded, part.rank + 9 - len(free))

    def __getitem__(self, index: Int | int) -> Observability:
        """Return what the sets of poses at `index` say."""
        return Observability(
            self.cofactor[index], self.dop[index], self.bounded[index], self.rank[index], self.names
        )

    def replaced(self, where: Bool, other: Observability) -> Observability:
        """Return the same with the sets of poses marked in shape (R,) as another has them."""
        square, vector = where[:, None, None], where[:, None]
        return Observability(
            np.where(square, other.cofactor, self.cofactor),
            np.where(vector, other.dop, self.dop),
            np.where(vector, other.bounded, self.bounded),
            np.where(where, other.rank, self.rank),
            self.names,
        )

    @property
    def worst(self) -> Float:
        """The largest dilution of precision, shape (...)."""
        return np.asarray(self.dop.max(axis=-1))

    @property
    def verdict(self) -> PoseVerdict:
        """Definition: undetermined above 25 or below full rank, weak above 10, good otherwise. One set of poses."""
        return verdict_of(float(self.worst), int(self.rank), len(self.names))

    @cached_property
    def verdicts(self) -> list[PoseVerdict]:
        """The verdict on each of R sets of poses."""
        words: list[PoseVerdict] = ["good"] * len(self.dop)
        for at in np.flatnonzero(~((self.worst <= WEAK) & (self.rank == len(self.names)))).tolist():
            words[at] = verdict_of(float(self.worst[at]), int(self.rank[at]), len(self.names))
        return words

    def in_words(self, whose: str, suggestions: Sequence[str]) -> tuple[str, ...]:
        """Return what is not determined, what is weak, and what to add, in sentences. One set of poses."""
        lines = []
        lost = self.above(UNDETERMINED)
        if lost:
            lines.append(f"{whose} do not determine: {', '.join(lost)}.")
        elif self.rank < len(self.names):
            lines.append(f"{whose} do not determine all nine parameters.")
        weak = [name for name in self.above(WEAK) if name not in lost]
        if weak:
            lines.append(f"Weakly determined: {', '.join(weak)}.")
        if lines and suggestions:
            lines.append("Add these poses: " + "; ".join(suggestions) + ".")
        return tuple(lines)

    def above(self, limit: float) -> list[str]:
        """Return the names of the parameters whose bounded dilution is above `limit`, worst first. One set of poses."""
        order = np.argsort(-np.round(self.bounded, 3), kind="stable")
        return [self.names[i] for i in order if self.bounded[i] > limit]


APART = 5.0
"""Degrees from the middle of an attitude within which directions belong to it."""

STANDARD = 12
"""Attitudes that the thresholds of the dilution of precision are made for."""

CELLS = 64
"""Cells along the edge of a face of the cube: 1.4 degrees, well below APART."""

NEAR = float(np.cos(np.radians(APART)))


@frozen(eq=False)
class Geometry:
    """What the distinct attitudes of R sensors determine.

    Attributes:
        attitudes: how many there are, shape (R,).
        observability: of the attitudes, each counted once and all together as `STANDARD`.
        information: J^T J of the attitudes, each counted once, shape (R, 9, 9).
    """

    attitudes: Int
    observability: Observability
    information: Float

    @classmethod
    def of(cls, information: Float, attitudes: Int, held: Bool | None) -> Geometry:
        """Return the geometry of so many attitudes, shape (R,), with their J^T J, shape (R, 9, 9).

        `held` parameters, shape (9,), are not estimated.
        """
        # More than twelve attitudes count as twelve of the same kind.
        excess = np.maximum(attitudes / STANDARD, 1.0)[:, None, None]
        return cls(attitudes, Observability.of(information / excess, attitudes, held), information)


def distinct(u: Float, real: Bool, labelled: Bool) -> tuple[Int, Bool]:
    """Return how many attitudes poses have, shape (R,), and which poses are one of each, shape (R, J).

    The direction with the most neighbours within `APART` degrees takes them all, until none is left.

    Args:
        u: unit directions of the specific force, shape (R, J, 3), J at most some thousand; real: which poses count.
        labelled: sensors whose poses are attitudes of their own, shape (R,).
    """
    count, one = real.sum(axis=1), real
    near = (u @ u.swapaxes(1, 2) >= NEAR) & real[:, :, None] & real[:, None]
    for sensor in np.flatnonzero((near.sum(axis=(1, 2)) > count) & ~labelled).tolist():
        one = one.copy() if one is real else one
        one[sensor] = False
        one[sensor, _greedy(near[sensor], real[sensor])] = True
        count[sensor] = one[sensor].sum()
    return count, one


def _greedy(near: Bool, real: Bool) -> list[int]:
    """Return the middles of the attitudes among directions whose neighbours are marked in shape (J, J)."""
    left, middles = real.copy(), []
    while left.any():
        neighbours = near[:, left].sum(axis=1) * left
        middle = int(np.argmax(neighbours))
        middles.append(middle)
        left &= ~near[middle]
    return middles


OPEN = 1e-12
"""Part of the trace that is added to the diagonal, so that attitudes that leave a direction open have a root, too."""


def lessened(once: Float, whole: Float, loss: Float) -> Float:
    """Return J^T J of attitudes that count once, less the part that slopes take of that of the weighted poses.

    The same part of each direction, whatever the weights are: B (1 - C^-1 L C^-T) B^T with B B^T = once, C C^T = whole.

    Args:
        once, whole, loss: shape (R, 9, 9); loss: L.
    """
    one = np.eye(9)
    B, C = (
        np.linalg.cholesky(part + OPEN * np.einsum("rpp->r", part)[:, None, None] * one)
        for part in (once, whole)
    )
    inverse = np.linalg.inv(C)
    return np.asarray(B @ (one - inverse @ loss @ inverse.swapaxes(1, 2)) @ B.swapaxes(1, 2))


@dataclass(eq=False)
class CellCount:
    """The directions of one sensor's rows by cells of a cube, in constant memory.

    Attributes:
        sums: of the directions in each cell, shape (6 CELLS^2, 3); count: how many there are, shape (6 CELLS^2,).
    """

    sums: Float = field(default_factory=lambda: np.zeros((6 * CELLS**2, 3)))
    count: Float = field(default_factory=lambda: np.zeros(6 * CELLS**2))

    def add(self, u: Float) -> None:
        """Add unit directions, shape (B, 3)."""
        cell = _cell(u)
        size = len(self.count)
        self.count += np.bincount(cell, minlength=size)
        for k in range(3):
            self.sums[:, k] += np.bincount(cell, weights=u[:, k], minlength=size)

    def distinct(self) -> tuple[int, Float]:
        """Return how many attitudes there are, and J^T J of one direction of each, shape (9, 9)."""
        used = np.flatnonzero(self.count)
        used = used[np.argsort(-self.count[used], kind="stable")]
        u = self.sums[used]
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        left, middles = np.ones(len(u), dtype=bool), []
        for k in range(len(u)):
            if left[k]:
                middles.append(k)
                left &= u @ u[k] < NEAR
                left[k] = False
        rows = design(u[middles])
        return len(middles), rows.T @ rows


def _cell(u: Float) -> Int:
    """Return the number of the cell of each direction, shape (B,)."""
    size = np.abs(u)
    axis = np.argmax(size, axis=1)
    at = np.arange(len(u))
    face = 2 * axis + (u[at, axis] < 0)
    largest = size[at, axis]
    first, second = (
        np.minimum(((u[at, (axis + k) % 3] / largest + 1.0) * (0.5 * CELLS)).astype(np.intp), CELLS - 1)
        for k in (1, 2)
    )
    return np.asarray((face * CELLS + first) * CELLS + second)


def moved_sensor(K: Float, D: Float, step: Float, g: float) -> tuple[Float, Float]:
    """Return K, gauge `lower`, and D of sensors whose nine parameters change by a step, m/s^2, shape (R, 9).

    K_A becomes (I + E) K_A, with the lower triangle E (times g) and the biases as force from the step.
    """
    E = np.zeros_like(K)
    for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
        E[:, i, j] = step[:, p] / g
    return K @ inverse(np.eye(3) + E), D + np.einsum("rii->ri", K) * step[:, BIAS]


def unit(force: Float) -> Float:
    """Return the unit directions of specific force, both shape (..., 3); 0 for none."""
    return np.asarray(force / np.maximum(np.linalg.norm(force, axis=-1, keepdims=True), 1e-300))


def directions_of(output: Float, model: ErrorModel) -> Float:
    """Return the unit directions of the specific force of outputs, both shape (J, 3)."""
    return unit(model.specific_force(output))


def attitudes(u: Float, n: NDArray[np.int64], angle: float) -> list[Int]:
    """Group directions: the longest pose that is left takes all within `angle`, until none is left.

    Args:
        u: unit directions, shape (J, 3); n: rows of each pose, shape (J,).
        angle: degrees.

    Returns:
        Indices of each group, its longest pose first.
    """
    left = np.argsort(-n, kind="stable")
    limit = np.cos(np.radians(angle))
    groups = []
    while len(left):
        near = u[left] @ u[left[0]] >= limit
        near[0] = True
        groups.append(left[near])
        left = left[~near]
    return groups


FEWEST_POSES = 12
"""Suggested poses bring a poor set to at least this many: nine fit exactly and say nothing of their noise."""

COMFORTABLE, MOST_SUGGESTIONS = 5.0, 8
"""Suggested poses bring every dilution of precision to this, half of what counts as weak; and how many they are."""

SUM_WEIGHT = 1e-3
"""Weight of the sum of the variances beside the largest one: it decides between sets alike in the largest."""


DIGITS = 9
"""Decimals of a score: rounding decides between equal candidates otherwise, and with it the machine."""


def poses_to_add(information: Float, poses: int, *, aligned: bool) -> tuple[str, ...]:
    """Return the poses to hold next that bring every dilution of precision to COMFORTABLE, in words.

    Args:
        information: J^T J of the poses so far, shape (9, 9); poses: how many they are.
        aligned: whether the axes are taken as perpendicular: faces suffice then.
    """
    candidates = faces() if aligned else fixture_directions()
    known = knowing(information, ALIGNED) if aligned else information
    chosen = next_poses(known, candidates, MOST_SUGGESTIONS, COMFORTABLE, FEWEST_POSES + 1 - poses)
    return tuple(dict.fromkeys(describe(candidates[i]) for i in chosen))


def next_poses(
    information: Float, candidates: Float, count: int, enough: float = 0.0, least: int = 0
) -> list[int]:
    """Return the indices of up to `count` candidates, greedily chosen, best first.

    Args:
        information: J^T J of the poses so far, shape (9, 9); zeros when there are none.
        candidates: unit directions to choose from, shape (C, 3); one may be chosen again.
        count: how many to choose.
        enough: stop when the worst dilution of precision is at or below this, but not before `least` are chosen.

    Each choice minimises the largest variance after it; the variances after a candidate a follow from the
    rank-one update P - P a a^T P / (1 + a^T P a). Ties go to the smallest sum of variances.
    """
    rows = design(candidates)
    cofactor = np.linalg.inv(information + PRIOR * np.eye(9))
    chosen: list[int] = []
    while len(chosen) < count and (len(chosen) < least or np.diagonal(cofactor).max() > enough**2):
        gain = rows @ cofactor
        drop = gain**2 / (1.0 + np.einsum("cp,cp->c", gain, rows))[:, None]
        after = np.diagonal(cofactor) - drop
        best = int(np.argmin(pose_score(after, np.inf)))
        chosen.append(best)
        cofactor = cofactor - np.outer(gain[best], gain[best]) / (1.0 + gain[best] @ rows[best])
    return chosen


def pose_score(variances: Float, power: float) -> Float:
    """Return the logarithm of a norm of variances, shape (..., 9), and a little of their sum."""
    largest = variances.max(axis=-1)
    score = np.log(largest)
    if np.isfinite(power):
        score = score + np.log(((variances / largest[..., None]) ** power).sum(axis=-1)) / power
    total = SUM_WEIGHT * np.log(variances.sum(axis=-1))
    return np.asarray(np.round(np.round(score, DIGITS) + total, DIGITS))


def propagate(K: Float, K_lower: Float, covariance: Float, gauge: str, g: float) -> tuple[Float, Float]:
    """Return one-sigma of K_a in a gauge, shape (..., 3, 3), and of D_a, shape (..., 3).

    Args:
        K: K_a in `gauge`, shape (..., 3, 3); K_lower: the same sensors in gauge `lower`.
        covariance: of the nine parameters, (m/s^2)^2, shape (..., 9, 9).
        gauge: `lower`, `upper` or `symmetric`; in `full` the free rotation moves every entry of K_a, the diagonal to
            second order, and they come out as NaN.
        g: local gravity, m/s^2.
    """
    sigma_D = np.sqrt(np.einsum("...pp->...p", covariance)[..., BIAS]) * np.einsum("...ii->...i", K_lower)
    if gauge == "full":
        return np.full(K.shape, np.nan), sigma_D
    chain = gauge_chain(K, K_lower, gauge, g)
    sigma_K = propagated(chain, covariance[..., :6, :6]).reshape(K.shape)
    exact = {"lower": np.triu(np.ones((3, 3)), 1), "upper": np.tril(np.ones((3, 3)), -1)}
    # A zero of the gauge has no error.
    return np.where(exact.get(gauge, np.zeros((3, 3))), 0.0, sigma_K), sigma_D


def engineering_quantities(K: Float, D: Float) -> Float:
    """Return what an engineer states, shape (..., 9): sensitivities, misalignments (rad) and biases as force.

    In the order of PARAMETERS; none of them depends on the gauge.

    Args:
        K: K_a in any gauge, shape (..., 3, 3); D: bias, less its nominal value where there is one, shape (..., 3).
    """
    return np.concatenate([sensitivity(K), misalignment(K), bias_force(K, D)], axis=-1)


def engineering_chain(lower: Float, D: Float, g: float) -> Float:
    """Return d quantities / d parameters, shape (..., 9, 9); sensitivities as a part of themselves.

    K_a changes by -K_a E / g. With k_i the rows of K_a, s_i their lengths and r_i = k_i / s_i:

        d s_i / s_i = -r_i E r_i / g
        d (r_i r_j) = -r_i (E + E^T) r_j / g - r_i r_j (d s_i / s_i + d s_j / s_j)
        d (D_i / s_i) = d D_i / s_i - D_i / s_i (d s_i / s_i)

    Args:
        lower: K_a in gauge `lower`, shape (..., 3, 3); D: as of `engineering_quantities`, shape (..., 3).
        g: local gravity, m/s^2: the first six parameters are g times the entries of E.
    """
    s = sensitivity(lower)
    rows, (a, b), (i, j) = lower / s[..., None], np.transpose(ROWS_COLUMNS[:6]), np.transpose(AXIS_PAIRS)
    first, second = rows.take(a, axis=-1), rows.take(b, axis=-1)
    scale = -first * second / g
    cosine = np.sum(rows.take(i, axis=-2) * rows.take(j, axis=-2), axis=-1)[..., None]
    turn = first.take(i, axis=-2) * second.take(j, axis=-2) + second.take(i, axis=-2) * first.take(j, axis=-2)
    turn = -turn / g - cosine * (scale.take(i, axis=-2) + scale.take(j, axis=-2))
    change = np.zeros((*lower.shape[:-2], 9, 9))
    change[..., :3, :6] = scale
    with np.errstate(divide="ignore", invalid="ignore"):  # two axes that are one have no angle to turn
        change[..., 3:6, :6] = turn / np.sqrt(1.0 - cosine**2)
    change[..., 6:, :6] = -(D / s)[..., None] * scale
    for k in range(3):
        change[..., 6 + k, 6 + k] = lower[..., k, k] / s[..., k]
    return change


def propagated(chain: Float, covariance: Float) -> Float:
    """Return the standard deviations, shape (..., n), that a covariance, shape (..., p, p), gives n quantities.

    Args:
        chain: their derivatives, shape (..., n, p).
        covariance: NaN in the row of a parameter without one, which leaves none to the quantities that it moves.
    """
    lost = np.isnan(np.einsum("...pp->...p", covariance))
    if not lost.any():
        return np.asarray(np.sqrt(np.maximum(np.sum((chain @ covariance) * chain, axis=-1), 0.0)))
    square = np.sum((chain @ np.nan_to_num(covariance)) * chain, axis=-1)
    size = np.abs(chain)
    moved = size > NEGLIGIBLE * size.max(axis=(-1, -2), keepdims=True)
    touched = (moved & lost[..., None, :]).any(axis=-1)
    return np.where(touched, np.nan, np.sqrt(np.maximum(square, 0.0)))


NEGLIGIBLE = 1e-9
"""A derivative below this part of the largest is rounding."""


def gauge_chain(K: Float, K_lower: Float, gauge: str, g: float) -> Float:
    """Return d K / d parameters, shape (..., 9, 6): entries of K_a in a gauge by the first six of the nine parameters.

    A change E of the inverse matrix in gauge `lower` moves K by -K (R E R^T - W), R = K^-1 K_lower, where the
    small rotation W (skew) is the one that keeps K in its gauge: three linear conditions. In `full`, which has none,
    W leaves the body frame unturned.
    """
    if gauge == "lower":  # K E is of this gauge, nothing turns
        chain = np.zeros((*K.shape[:-2], 3, 3, 6))
        for p, (i, j) in enumerate(ROWS_COLUMNS[:6]):
            chain[..., j, p] = -K[..., i] / g
        return chain.reshape(*K.shape[:-2], 9, 6)
    R = np.linalg.solve(K, K_lower)
    turned = [K @ _skew(axis) for axis in np.eye(3)]
    turns = np.stack([_conditions(change, gauge) for change in turned], axis=-1)
    columns = []
    for i, j in ROWS_COLUMNS[:6]:
        moved = R[..., :, i, None] * R[..., None, :, j] / g  # R E R^T
        change = -0.5 * K @ (moved + moved.swapaxes(-1, -2))
        if gauge != "full":
            angle = np.linalg.solve(turns, -_conditions(change, gauge)[..., None])
            for k, turn in enumerate(turned):
                change = change + angle[..., k, :, None] * turn
        columns.append(change.reshape(*K.shape[:-2], 9))
    return np.stack(columns, axis=-1)


def _conditions(change: Float, gauge: str) -> Float:
    """Return what must vanish for a change of K to stay in the gauge, shape (..., 3)."""
    above, below = change[..., [0, 0, 1], [1, 2, 2]], change[..., [1, 2, 2], [0, 0, 1]]
    return {"lower": above, "upper": below}.get(gauge, above - below)


def _skew(axis: Float) -> Float:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
