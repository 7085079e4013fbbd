"""Which poses agree: a start for robust losses that gross errors do not reach, and the names of those that do not.

Up to a quarter of the poses may be wrong by any factor. Ellipsoids through random subsets of the poses are each judged
by the smaller three quarters of their squared residuals; the best are refined by fitting those poses again until
nothing changes (least trimmed squares with concentration steps [rousseeuw2006]). From each of these the agreeing poses
grow: a pose that the others would not call an outlier joins them. The most likely of the results is the consensus: the
least trimmed sum alone takes up wrong poses that sound ones happen to agree with.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.distributions import student_chance
from accelcal_cli.calibration.observability import ALIGNED, design, unit
from accelcal_cli.calibration.sample import NO_NOISE, Sample
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.rng import Purpose, Streams

SUBSETS, REFINED = 1000, 12
"""Subsets that are drawn: of ten poses with a quarter wrong one in eighteen is clean. And how many are refined."""

STEPS = 30
"""Concentration steps, and rounds of growing, at most."""

WRONG = 4
"""One pose in so many may be wrong."""

SPARE = 6
"""Sound poses beyond the parameters that a consensus needs."""

LOOKED_AT = 2000
"""Rows of a longer input that the consensus is searched among."""

LEVEL = 0.01
"""Chance of rejecting a pose where none is wrong (Bonferroni over the poses)."""

OPEN = 1e-15
"""Part of the trace of the information that stands for none."""

TRIMMED = 0.607
"""Standard deviation of the smaller three quarters of normal residuals, over that of all."""

SPREAD = 0.5 * (1.0 + np.log(2.0 * np.pi))
"""-log likelihood of a normal value of standard deviation 1, on average."""


def consensus(sample: Sample, settings: Settings) -> Bool | None:
    """Return which poses of one sensor agree, shape (J,); None where they are too few to tell, or none do."""
    N = sample.output()[0, : int(sample.poses[0])]
    columns = np.flatnonzero(~ALIGNED) if not settings.misalignment else np.arange(9)
    free = len(columns)
    if len(N) < free + SPARE + 1:
        return None
    middle, size = np.median(N, axis=0), float(np.median(np.abs(N - np.median(N, axis=0)).max(axis=1)))
    if not size > 0:
        return None
    x = (N - middle) / size
    random = Streams(settings.seed, [0], Purpose.CONSENSUS)
    looked = np.arange(len(x))
    if len(x) > LOOKED_AT:
        looked = np.sort(np.argsort(random.uniform(1, len(x))[0, 0], kind="stable")[:LOOKED_AT])
    terms = _terms(x[looked])[:, columns]  # in the order of the parameters that they determine
    grown = [
        _grown(x[looked], subset, columns, scale)
        for subset in _best_subsets(terms, random)
        for scale in (TRIMMED, 1.0)
    ]
    found = [one for one in grown if one is not None and one[1].sum() >= len(columns) + SPARE]
    if not found:
        return None
    agreeing = min(found, key=lambda one: one[0])[1]
    if len(looked) < len(x):
        whole = _grown(x, looked[agreeing], columns, 1.0)
        return None if whole is None else whole[1]
    return agreeing


def _terms(x: Float) -> Float:
    """Return x^2, y^2, z^2, 2xy, 2xz, 2yz, 2x, 2y, 2z of readings, shape (J, 3): shape (J, 9)."""
    pairs = [2.0 * x[:, i] * x[:, j] for i, j in ((0, 1), (0, 2), (1, 2))]
    return np.column_stack([x**2, *pairs, 2.0 * x])


def _solved(terms: Float, member: Float) -> Float:
    """Return the quadrics y, shape (M, p), with terms . y = 1 for the members, 0 or 1, shape (M, J)."""
    normal = (terms.T[None] * member[:, None]) @ terms
    right = member @ terms
    size = np.einsum("mpp->m", normal)
    with np.errstate(all="ignore"):
        normal = normal + (1e-13 * size)[:, None, None] * np.eye(terms.shape[1])
        return np.asarray(np.linalg.solve(normal, right[..., None])[..., 0])


def _errors(terms: Float, y: Float) -> Float:
    """Return e / g, shape (M, J), of quadrics y, shape (M, p), where they are ellipsoids; infinite elsewhere.

    With y the quadric x^T A x + 2 m^T x = 1, |f|^2 / g^2 = 1 + (terms . y - 1) / (1 + m^T A^-1 m).
    """
    p = y.shape[1]
    A, m = np.zeros((len(y), 3, 3)), y[:, p - 3 :]
    A[:, [0, 1, 2], [0, 1, 2]] = y[:, :3]
    if p == 9:
        A[:, [0, 0, 1], [1, 2, 2]] = A[:, [1, 2, 2], [0, 0, 1]] = y[:, 3:6]
    finite = np.asarray(np.isfinite(y).all(axis=1))
    values = np.linalg.eigvalsh(np.where(finite[:, None, None], A, np.eye(3)))
    sound = finite & (values[:, 0] > 1e-9 * values[:, 2])
    solved = np.linalg.solve(np.where(sound[:, None, None], A, np.eye(3)), m[..., None])[..., 0]
    level = 1.0 + np.sum(m * solved, axis=1)
    sound &= level > 0
    with np.errstate(all="ignore"):
        e = -0.5 * (y @ terms.T - 1.0) / level[:, None]
    return np.where(sound[:, None], e, np.inf)


def _best_subsets(terms: Float, random: Streams) -> list[Int]:
    """Return the numbers of the three quarters of the rows that agree best, of several searches, each once."""
    poses, free = terms.shape
    most = poses - poses // WRONG
    order = np.argsort(random.uniform(SUBSETS, poses)[0], axis=1, kind="stable")
    member = np.zeros((SUBSETS, poses))
    np.put_along_axis(member, order[:, : free + 1], 1.0, axis=1)
    objective = np.full(SUBSETS, np.inf)
    for step in range(STEPS):
        e = _errors(terms, _solved(terms, member))
        square = e * e
        inner = np.argpartition(square, most - 1, axis=1)[:, :most]
        value = np.take_along_axis(square, inner, axis=1).sum(axis=1)
        if step == 2:  # two steps tell which subsets are worth more
            best = np.argsort(value, kind="stable")[:REFINED]
            value, inner, objective = value[best], inner[best], np.full(REFINED, np.inf)
        if step > 2 and not (value < objective * (1.0 - 1e-9)).any():
            break
        objective = value
        member = np.zeros((len(inner), poses))
        np.put_along_axis(member, inner, 1.0, axis=1)
    return [np.flatnonzero(one) for one in np.unique(member[np.isfinite(objective)], axis=0)]


def _grown(x: Float, start: Int, columns: Int, scale: float) -> tuple[float, Bool] | None:
    """Return which of all rows agree with those that surely do, shape (J,), behind how unlikely that is.

    Args:
        x: readings, shape (J, 3); start: numbers of rows that agree; columns: of the free parameters.
        scale: what the standard deviation of the residuals of `start` is over that of all sound rows.

    Returns:
        -log likelihood of the residuals: normal ones of rows that agree, of others anything from s to g, evenly by its
        logarithm; None where the rows fix no ellipsoid.
    """
    poses, free = len(x), len(columns)
    terms = _terms(x)[:, columns]
    agreeing = np.zeros(poses, dtype=bool)
    agreeing[start] = True
    for _ in range(STEPS):
        count = int(agreeing.sum())
        y = _solved(terms, agreeing[None].astype(float))
        e = _errors(terms, y)[0]
        if not np.isfinite(e).all() or count <= free:
            return None
        s = max(float(np.sqrt(np.sum(e[agreeing] ** 2) / (count - free))) / scale, NO_NOISE)
        leverage = _leverage(x, y[0], agreeing, columns)
        room = np.where(agreeing, np.maximum(1.0 - leverage, 1e-9), 1.0 + leverage)
        t = np.abs(e) / (s * np.sqrt(room))
        chance = student_chance(np.maximum(t, 1e-9), np.full(poses, max(count - free, 1)))
        grown = poses * chance >= LEVEL
        scale = 1.0
        if (grown == agreeing).all():
            break
        agreeing = grown
    wrong = 2.0 * np.abs(e[~agreeing]) * max(np.log(1.0 / s), 1.0)
    return float((count - free) * (np.log(s) + SPREAD) + np.log(wrong).sum()), agreeing


def _leverage(x: Float, y: Float, agreeing: Bool, columns: Int) -> Float:
    """Return the leverage of every row, shape (J,), in a fit of the agreeing ones."""
    p = len(y)
    A = np.diag(y[:3])
    if p == 9:
        A[[0, 0, 1], [1, 2, 2]] = A[[1, 2, 2], [0, 0, 1]] = y[3:6]
    centre = -np.linalg.solve(A, y[p - 3 :])
    f = (x - centre) @ np.linalg.cholesky(A)
    rows = design(unit(f))[:, columns]
    normal = rows[agreeing].T @ rows[agreeing]
    # What the agreeing rows leave open has a huge leverage: no row disagrees there.
    cofactor = np.linalg.inv(normal + OPEN * np.trace(normal) * np.eye(len(columns)))
    return np.asarray(np.sum((rows @ cofactor) * rows, axis=1))
