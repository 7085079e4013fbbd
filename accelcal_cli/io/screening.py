"""One screening of static readings before anything is fitted: what they show that no accelerometer at rest shows.

`Screened` are the poses of one sensor, or the first `LOOKED_AT` of them; its `notices` name zeros, copies, dead and
equal axes, clipping, gravity that is missing, a sensor that was never turned, two sensors in one table, and rows of a
log. `needs_look` says cheaply which of R sensors to screen. Raw logs are screened by detection/log_screening.py.

Noise and resolution are measured on the readings themselves: `Surface` is the quadric nearest to all poses, and
`grid_step` the step that all values are multiples of. A pattern is reported where noise and resolution together
would show it in fewer than `CHANCE` of honest sets.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.io.rows import SHOWN, named
from accelcal_cli.notices import COMMAND, Notice

LOOKED_AT = 4096
"""Poses that are looked at: the first."""

CHANCE = 5e-4
"""Greatest chance of a pattern in honest readings at which it is reported."""

RAW_ROWS = 500
"""From so many rows on, rows with a time each, or each much like the one before, are a raw log rather than poses."""

ALIKE = 0.05
"""Most rows of a log differ from the one before by less than this part of the range."""

BLOCK, CREEP, MOVING = 8, 6.0, 0.02
"""Rows are in a move where means of BLOCK of them step by CREEP times what the quieter ones do; a log has MOVING of
its rows in moves."""

MANY_COPIES, SOME_COPIES = 1 / 3, 0.1
"""Parts of the poses from which on copies matter: where readings without noise may repeat, and where they cannot."""

FEWEST = 12
"""Poses that show the noise: a quadric has nine parameters."""

FIXED = 0.02
"""Least singular value of the terms of a quadric over the greatest at which poses fix it."""

FITTED = 1024
"""Poses at most that the quadric is fitted to."""

ONE_POINT = 0.05
"""A range of the readings below this part of their size is less than 3 degrees: the sensor was not turned."""

NO_SURFACE = 0.25
"""Poses fill a volume, and lie on no sphere, when they scatter about it by this part of their largest extent: noise
does so by 0.26 to 0.6, caps of 20 degrees with 20 mg of noise by less than 0.23."""

NO_SPHERE = 0.2
"""The squared radius of poses brought to unit extent scatters less about that of a sphere, where they lie on one."""

TWICE, SMALLEST = 2.0, 1e-6
"""Two sensors are suspected only where separate fits leave less than half the residual, and one fit leaves squares of
more than the second per pose, in parts of the squared radius: half a milli-g."""

RARE = 2e-5
"""Least chance that is taken for a tie of two readings."""

SCALE_SPREAD = 0.06
"""Range in which scale factor and bias put the reading of 1 g, relative: how likely a face meets the rail by chance."""

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of axes."""

Where = Callable[[int], str]


@dataclass(frozen=True, eq=False)
class Surface:
    """The quadric nearest to some poses, and how far they are off it.

    Attributes:
        noise: standard deviation of one axis, shape (3,), sensor units.
    """

    noise: Float

    @classmethod
    def of(cls, output: Float) -> Self | None:
        """Return the surface of poses, shape (J, 3), None where they are too few or an axis is constant."""
        output = output[:: max(1, len(output) // FITTED)]
        terms = _terms(output)
        if terms is None:
            return None
        x, half, poses = terms[:, 6:9], np.ptp(output, axis=0) / 2, len(output)
        _, singular, right = np.linalg.svd(terms, full_matrices=False)
        a = right[-1]
        square = np.array([[2 * a[0], a[3], a[4]], [a[3], 2 * a[1], a[5]], [a[4], a[5], 2 * a[2]]])
        slope = math.sqrt(float(np.mean(np.sum((x @ square + a[6:9]) ** 2, axis=1))))
        off = singular[-1] / math.sqrt(max(poses - 9, 1)) / max(slope, 1e-300)
        return cls(off * half)


def thickness(output: Float) -> float:
    """Return the scatter of poses, shape (J, 3), about the nearest sphere over their largest standard deviation.

    The axes are taken as they are and at unit extent, whichever fits better: sensors have axes of different scale.
    """
    output = output[:: max(1, len(output) // FITTED)]
    return min(_thickness(output), _thickness(output / np.ptp(output, axis=0)))


def _thickness(output: Float) -> float:
    x = output - output.mean(axis=0)
    x /= math.sqrt(float(np.linalg.eigvalsh(np.cov(x.T))[-1]))
    left = np.column_stack([2 * x, np.ones(len(x))])
    c = np.linalg.lstsq(left, (x * x).sum(axis=1), rcond=None)[0]
    radius = math.sqrt(max(float(c[3] + c[:3] @ c[:3]), 0.0))
    off = np.linalg.norm(x - c[:3], axis=1) - radius
    return math.sqrt(float((off**2).sum()) / (len(x) - 4))


def _terms(output: Float) -> Float | None:
    """Return the ten terms of a quadric, shape (J, 10), of poses brought to -1 to 1; None where they tell nothing."""
    low, high = output.min(axis=0), output.max(axis=0)
    if len(output) < FEWEST or not (high > low).all():
        return None
    x, y, z = ((output - (low + high) / 2) / ((high - low) / 2)).T
    return np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones_like(x)], axis=1)


def grid_step(values: Float) -> float:
    """Return the step of which all differences of some values are multiples, 0 where there is none."""
    values = np.unique(values)
    if len(values) < 3:
        return float(values[-1] - values[0]) if len(values) == 2 else 0.0
    gaps = np.diff(values)
    least = float(gaps[gaps > 1e-12 * float(values[-1] - values[0])].min())
    for step in (*(least / k for k in range(1, 13)), *(10.0**-k for k in range(9))):
        parts = gaps / step
        if (np.abs(parts - np.round(parts)) < 0.02).all() and (len(gaps) > 5 or step < least):
            return step
    return 0.0


@dataclass(frozen=True, eq=False)
class Screened:
    """Poses of one sensor, to be screened.

    Attributes:
        output: of the poses, LOOKED_AT at most, shape (J, 3), sensor units; names: of the three columns.
        rows: how many poses there are in all; where: names a pose, from 0; source: of them, for a command.
        single: whether each row of a table is a pose; timed: whether the rows have times.
        warm: whether they have temperatures, with which one sensor may drift from the first half to the second.
        count: readings behind each pose, shape (J,); scatter: standard deviation of one, shape (J, 3); or None.
    """

    output: Float
    names: Sequence[str]
    rows: int
    where: Where
    source: str = "<array>"
    single: bool = True
    timed: bool = False
    warm: bool = False
    count: Float | None = None
    scatter: Float | None = None

    def notices(self) -> tuple[Notice, ...]:
        """Return what the readings show, warnings first."""
        dead = list(self._dead_axes())
        if not dead and (self.never_moved or self.gravity_removed):
            return tuple(self._one_point())
        found = [*self._log(), *dead, *self._copies()]
        if not dead:
            found += [*self._several(), *self._clipped(), *self._frozen()]
        return tuple(sorted(found, key=lambda notice: notice.severity != "warning"))

    @cached_property
    def surface(self) -> Surface | None:
        """The quadric nearest to the poses."""
        return Surface.of(self.output)

    @cached_property
    def steps(self) -> Float:
        """Resolution of each axis, shape (3,), 0 where none shows."""
        return np.array([grid_step(axis) for axis in self.output[:LOOKED_AT].T])

    @cached_property
    def tie(self) -> Float:
        """Chance that two poses of one attitude read the same on an axis, shape (3,): 1 without noise."""
        if self.surface is None:
            return np.ones(3)
        step = np.maximum(self.steps, 1e-12 * np.abs(self.output).max(axis=0))
        noise = np.maximum(self.surface.noise, 1e-300)
        # The difference of two normal readings has a density of 1 / (2 sqrt(pi) sigma) at zero.
        return np.asarray(np.minimum(1.0, step / (2 * math.sqrt(math.pi) * noise)))

    @cached_property
    def copies(self) -> int:
        """How many poses repeat an earlier one to the last digit."""
        return len(self.output) - len({row.tobytes() for row in self.output})

    @property
    def never_moved(self) -> bool:
        """Whether all poses are one attitude, 3 degrees wide at most."""
        size = float(np.linalg.norm(self.output.mean(axis=0)))
        return len(self.output) > 2 and float(np.ptp(self.output, axis=0).max()) < ONE_POINT * size

    @property
    def gravity_removed(self) -> bool:
        """Whether the poses fill a volume instead of a surface."""
        return self.surface is not None and thickness(self.output) > NO_SURFACE and self._is_one_blob()

    def _is_one_blob(self) -> bool:
        """Whether distances from the middle spread as those of noise, not as those of a sphere with a few outliers."""
        middle = np.median(self.output, axis=0)
        width = np.median(np.abs(self.output - middle), axis=0)
        if not (width > 0).all():
            return True
        radius = np.linalg.norm((self.output - middle) / width, axis=1)
        low, half, high = np.quantile(radius, [0.1, 0.5, 0.9])
        return bool(high - low > 0.6 * half)

    def _one_point(self) -> Iterator[Notice]:
        if self.never_moved:
            text = f"The sensor was never turned: all {self.rows:,} readings lie within 3 degrees of one attitude."
            yield Notice(
                "never-moved", "warning", text, "Record poses that differ: accelcal plan names twelve."
            )
        else:
            text = (
                "All poses are one point within their noise, so gravity is not in these columns "
                f"({', '.join(self.names)}): they hold linear acceleration or turning rates."
            )
            yield Notice("gravity-removed", "warning", text, "Name the raw accelerometer with --columns.")

    def _log(self) -> Iterator[Notice]:
        if not self.single or self.rows < RAW_ROWS:
            return
        steps = np.abs(np.diff(self.output, axis=0)).max(axis=1)
        span = float(np.ptp(self.output, axis=0).max())
        if not (self.timed or np.median(steps) < ALIKE * span):
            return
        label = "of many readings of one pose, label the poses in a column."
        if not (self.timed or _has_moves(self.output)):
            text = f"Each row is taken for a pose at rest, and these {self.rows:,} rows are a log or repeat their poses"
            yield Notice("log", "note", f"{text}; {label}")
            return
        text = (
            f"Each row is taken for a pose at rest. If these {self.rows:,} rows are a log with moves in it, its static "
            f"poses have to be found first; {label}"
        )
        place = {"<stdin>": "-", "<array>": "LOG"}.get(self.source, shlex.quote(self.source))
        yield Notice(
            "log", "warning", f"{text} with moves in it; {label}", f"{COMMAND}calibrate {place} --raw"
        )

    def _dead_axes(self) -> Iterator[Notice]:
        output, names = self.output, self.names
        for i, name in enumerate(names):
            if (output[:, i] == output[0, i]).all():
                text = f'Column "{name}" is {output[0, i]:g} in every pose: its axis is dead or was never turned.'
                yield Notice(
                    "dead-axis", "warning", text, "Check the sensor, or name its columns with --columns."
                )
        for i, j in PAIRS:
            if (output[:, i] == output[:, j]).all() or (output[:, i] == -output[:, j]).all():
                text = f'Columns "{names[i]}" and "{names[j]}" are equal in every pose: they show one axis.'
                yield Notice("dead-axis", "warning", text, "Name the columns of three axes with --columns.")

    def _copies(self) -> Iterator[Notice]:
        poses, copies = len(self.output), self.copies
        if copies < max(2, SOME_COPIES * poses):
            return
        text = f"{copies:,} of {poses:,} poses repeat another to the last digit."
        expected = float(np.prod(self.tie)) * self._near_pairs()
        if copies > 3 + 5 * expected or (copies >= MANY_COPIES * poses and not (self.steps > 0).all()):
            text += " Sigma counts them as independent measurements."
            yield Notice("duplicate-rows", "warning", text, "Leave copies out.")
        elif copies >= MANY_COPIES * poses:
            text += (
                " The readings are quantized more coarsely than their noise, so repeating a pose adds little."
            )
            yield Notice("duplicate-rows", "note", text, "Average many readings of each pose.")

    def _near_pairs(self) -> float:
        """Return about how many pairs of poses are one attitude within the noise."""
        if self.surface is None:
            return 0.5 * len(self.output) ** 2
        width = 4 * np.maximum(np.maximum(self.surface.noise, self.steps), 1e-9 * np.ptp(self.output, axis=0))
        cells = np.round(self.output / width)
        _, count = np.unique(cells, axis=0, return_counts=True)
        return float((count * (count - 1) / 2).sum())

    def _clipped(self) -> Iterator[Notice]:
        marks = Rails(self).marked()
        if not marks:
            return
        poses = sorted({pose for pose, _, _ in marks})
        sides = sorted({(axis, value) for _, axis, value in marks})
        ends = ", ".join(f'"{self.names[axis]}" at {value:.10g}' for axis, value in sides)
        places = named([self.where(pose) for pose in poses[:SHOWN]], len(poses))
        yield Notice(
            "clipped",
            "warning",
            f"Clipped readings: column {ends}, an end of the range, in {len(poses)} of "
            f"{len(self.output)} poses ({places}).",
            "Set a wider range of the sensor and measure again, or leave these poses out.",
        )

    def _frozen(self) -> Iterator[Notice]:
        """Poses without any scatter, in all axes at once, or in one axis alone, where every other has some."""
        if self.scatter is None or len(self.output) < FEWEST:
            return
        zero = (self.scatter == 0) & (True if self.count is None else self.count[:, None] > 2)
        whole = zero.all(axis=1)
        alone = zero.sum(axis=0)
        number = int(zero.sum())
        if whole.any() and number == 3 * whole.sum() and 2 * whole.sum() < len(whole):
            yield self._frozen_notice(np.flatnonzero(whole), "all axes repeat one value")
        elif number > FEWEST // 2 and number == alone.max() < len(whole) - FEWEST // 2:
            axis = int(alone.argmax())
            if not Rails(self).marked():
                poses = np.flatnonzero(zero[:, axis])
                yield self._frozen_notice(poses, f'column "{self.names[axis]}" repeats one value')

    def _frozen_notice(self, poses: Int, what: str) -> Notice:
        places = named([self.where(pose) for pose in poses[:SHOWN].tolist()], len(poses))
        text = f"Frozen readings: {what} to the last digit in {len(poses)} poses ({places}), while others scatter."
        return Notice("frozen", "warning", text, "Leave these poses out, or measure them again.")

    def _several(self) -> Iterator[Notice]:
        poses = len(self.output)
        if self.warm:
            return
        order = np.arange(poses)
        for part, words in ((order % 2 == 0, "every second row"), (order < poses // 2, "the second half")):
            if _fit_apart(self.output, part):
                text = f"The poses fit two sensors, not one: {words} is another sensor, or it changed in between."
                remedy = "Give each sensor its own file, or a column that labels it (--where COLUMN=VALUE)."
                yield Notice("several-sensors", "warning", text, remedy)
                return


def _has_moves(output: Float) -> bool:
    """Return whether rows, shape (J, 3), pass through moves: means of BLOCK rows that creep for three steps or more.

    A jump from pose to pose, without rows between, is in two steps at most.
    """
    blocks = len(output) // BLOCK
    means = output[: blocks * BLOCK].reshape(blocks, BLOCK, 3).mean(axis=1)
    steps = np.abs(np.diff(means, axis=0)).max(axis=1)
    if np.median(steps) > np.median(np.abs(np.diff(output, axis=0)).max(axis=1)):
        return True  # it moves all the time: means of noise would differ by less than rows do
    span = float(np.ptp(output, axis=0).max())
    moving = steps > max(CREEP * float(np.quantile(steps, 0.25)), 1e-3 * span)
    return bool((moving[2:] & moving[1:-1] & moving[:-2]).mean() > MOVING)


def _fit_apart(output: Float, part: Bool) -> bool:
    """Return whether two quadrics, one for each part of the poses, fit beyond chance better than one for all."""
    terms = _terms(output)
    if terms is None or len(output) < 2 * FEWEST:
        return False
    squares, freedom = 0.0, len(output) - 18
    joint = _squares(terms)
    for half in (part, ~part):
        squares += _squares(terms[half])
    return math.isfinite(squares + joint) and bool(
        _beyond_chance(np.array(joint), np.array(squares), freedom)
    )


def _beyond_chance(joint: Float, apart: Float, freedom: Int | int) -> Bool:
    """Return where sums of squares say that two surfaces fit better than one, of `freedom` above those of two."""
    ratio = (joint - apart) / 9 / np.maximum(apart / np.maximum(freedom, 1), 1e-300)
    # Above the 1e-4 quantile of F(9, freedom) for every freedom from 6 on.
    surely = ratio > 6 + 120 / np.maximum(freedom, 1)
    return np.asarray(surely & (joint > TWICE**2 * apart) & (joint > SMALLEST * (freedom + 18)))


def _squares(terms: Float) -> float:
    """Return the sum of squares that the quadric leaves, inf where the poses do not fix it."""
    if len(terms) < FEWEST:
        return math.inf
    left, target = terms[:, :9], terms[:, 9]
    # Normal equations: rounding is far below SMALLEST, and many poses cost little.
    values, vectors = np.linalg.eigh(left.T @ left)
    if values[0] < FIXED**2 * values[-1]:
        return math.inf
    parts = vectors.T @ (left.T @ target)
    return max(float(target @ target - (parts**2 / values).sum()), 0.0)


@dataclass(frozen=True, eq=False)
class Rails:
    """Which poses read exactly the end of a range, on which axis."""

    screened: Screened

    def marked(self) -> list[tuple[int, int, float]]:
        """Return (pose, axis, value) of every clipped reading."""
        output = self.screened.output
        if self.screened.copies:
            output = np.unique(output, axis=0)
        if len(output) < 6:
            return []
        marks = []
        for values in self._groups(output):
            tied = [(a, v, int(np.count_nonzero(output[:, a] == v))) for a, v in values]
            if self._chance(output, tied) < CHANCE:
                marks += [
                    (pose, axis, value)
                    for axis, value, _ in tied
                    for pose in np.flatnonzero(self.screened.output[:, axis] == value).tolist()
                ]
        return marks

    def _groups(self, output: Float) -> list[list[tuple[int, float]]]:
        """Return the extremes (axis, value) in groups that are one range: the same size, or -2^n and 2^n - 1."""
        groups: dict[float, list[tuple[int, float]]] = {}
        for axis in range(3):
            for value in (float(output[:, axis].min()), float(output[:, axis].max())):
                size = abs(value) if bits_of_rail(value) is None else 2.0 ** (bits_of_rail(value) or 0)
                groups.setdefault(size, []).append((axis, value))
        return list(groups.values())

    def _chance(self, output: Float, tied: list[tuple[int, float, int]]) -> float:
        """Return about how often honest poses would meet these extremes so many times."""
        number, sides = sum(m for _, _, m in tied), len(tied)
        if number < 2:
            return 1.0
        equal, near = _ties_elsewhere(output, tied, self.screened.surface)
        tie = max(float(self.screened.tie.max()) * near, equal, RARE)
        chance = 6 * tie ** (number - 1) if len(output) >= FEWEST else 1.0
        bits = [bits_of_rail(value) for _, value, _ in tied]
        whole = bool((output == np.round(output)).all())
        if (
            whole
            and bits[0] is not None
            and output.min() >= -(2.0 ** bits[0])
            and output.max() < 2.0 ** bits[0]
        ):
            hit = min(1.0, 1 / (SCALE_SPREAD * 2.0 ** bits[0]))
            chance = min(chance, math.comb(6, sides) * hit**sides * min(1.0, tie) ** (number - sides))
        return chance


def bits_of_rail(value: float) -> int | None:
    """Return n where a value is the end of a binary range, 2^n - 1 or -2^n."""
    size = value + 1 if value > 0 else -value
    mantissa, exponent = math.frexp(size)
    return exponent - 1 if mantissa == 0.5 and exponent > 7 else None


def _ties_elsewhere(
    output: Float, tied: list[tuple[int, float, int]], surface: Surface | None
) -> tuple[float, float]:
    """Return the parts of neighbouring values, apart from these extremes, that are equal and that are near.

    Near means within the noise: the attitudes of the poses are alike in this axis, as in symmetrical sets.
    """
    equal, near, total = 0, 1, 1
    for axis, values in enumerate(output.T):
        own = [value for a, value, _ in tied if a == axis]
        gaps = np.diff(np.sort(values[~np.isin(values, own)]))
        width = math.inf if surface is None else 4 * surface.noise[axis]
        equal, total = equal + int(np.count_nonzero(gaps == 0)), total + len(gaps)
        near += int(np.count_nonzero(gaps <= width))
    return equal / total, near / total


def needs_look(output: Float, poses: Int) -> Bool:
    """Return which of R sensors to screen, shape (R,): all of those of which `Screened` has something to say.

    Args:
        output: their poses, shape (R, J, 3), whatever follows the last; poses: of each, shape (R,).
    """
    real = np.arange(output.shape[1]) < poses[:, None]
    axes = np.moveaxis(output, 2, 0)
    equal = [((np.abs(axes[i]) == np.abs(axes[j])) | ~real).all(axis=1) for i, j in PAIRS]
    # Mixed into one number, rows that are equal stay equal; NaN comes last.
    mixed = np.sort(np.where(real, axes[0] + np.pi * axes[1] + np.e * axes[2], np.nan), axis=1)
    copies = (mixed[:, 1:] == mixed[:, :-1]).sum(axis=1)
    many = copies >= np.maximum(2, SOME_COPIES * np.minimum(poses, LOOKED_AT))
    return np.asarray(
        np.logical_or.reduce(equal)
        | many
        | _at_ends(axes, real)
        | _is_odd(output, real)
        | (poses >= RAW_ROWS)
    )


def _at_ends(axes: Float, real: Bool) -> Bool:
    """Return which sensors meet an extreme more than once, or are dead in an axis: axes (3, R, J)."""
    low = np.where(real, axes, np.inf).min(axis=2)
    high = np.where(real, axes, -np.inf).max(axis=2)
    hits = ((axes == low[..., None]) | (axes == high[..., None])) & real
    sizes = np.sort(np.abs(np.concatenate([low, high])), axis=0)
    near = ((sizes[1:] - sizes[:-1]) <= 1.0) & ((sizes[1:] == sizes[:-1]) | (np.fmod(sizes[1:], 1.0) == 0))
    return np.asarray((hits.sum(axis=(0, 2)) > 6) | near.any(axis=0))


def _is_odd(output: Float, real: Bool) -> Bool:
    """Return which sensors may not have been turned, lack gravity, or are two: shape (R,)."""
    poses = real.sum(axis=1)
    low, high = output.min(axis=1), output.max(axis=1)
    size = np.maximum(np.abs(low), np.abs(high)).max(axis=1)
    odd = (high - low).max(axis=1) < 2 * ONE_POINT * size
    half = np.where(high > low, (high - low) / 2, 1.0)
    x = (output - ((low + high) / 2)[:, None]) / half[:, None]
    terms = np.concatenate([x * x, x * x[..., [1, 2, 0]], x], axis=2)
    joint = _squares_of(terms, real)
    odd |= _off_sphere(x, real) > NO_SPHERE**2 * poses
    many = np.flatnonzero((joint > SMALLEST * poses) & (poses >= 2 * FEWEST) & ~odd)
    if len(many):
        terms, real, poses, place = terms[many], real[many], poses[many], np.arange(output.shape[1])
        for first in (place < (poses // 2)[:, None], np.broadcast_to(place % 2 == 0, real.shape)):
            apart = _squares_of(terms, real & first) + _squares_of(terms, real & ~first)
            odd[many] |= _beyond_chance(joint[many], apart, poses - 18)
    return np.asarray(odd)


def _off_sphere(x: Float, real: Bool) -> Float:
    """Return the squares of |x|^2 about the nearest sphere, shape (R,), of poses brought to -1 to 1."""
    left = np.concatenate([x, np.ones((*x.shape[:2], 1))], axis=2) * real[..., None]
    target = np.where(real, np.einsum("rji,rji->rj", x, x), 0.0)
    normal, right = left.swapaxes(1, 2) @ left, np.einsum("rji,rj->ri", left, target)
    solution = np.linalg.solve(normal + 1e-9 * np.eye(4), right[..., None])[..., 0]
    return np.asarray((target**2).sum(axis=1) - (right * solution).sum(axis=1))


def _squares_of(terms: Float, part: Bool) -> Float:
    """Return what a quadric leaves of the poses in `part`, shape (R,), terms (R, J, 9)."""
    rows = terms * part[..., None]
    normal = rows.swapaxes(1, 2) @ rows
    right = rows.sum(axis=1)
    ridge = 1e-12 * np.trace(normal, axis1=1, axis2=2) + 1e-300
    solution = np.linalg.solve(normal + ridge[:, None, None] * np.eye(9), right[..., None])[..., 0]
    return np.asarray(np.maximum(part.sum(axis=1) - (right * solution).sum(axis=1), 0.0))
