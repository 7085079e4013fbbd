"""One screening of static readings before anything is fitted: what they show that no accelerometer at rest shows.

`Screened` are the poses of one sensor, or the first `LOOKED_AT` of them; its `notices` name zeros, copies, dead and
equal axes, clipping, gravity that is missing, a sensor that was never turned, two sensors in one table, and rows of a
log. `needs_look` says cheaply which of R sensors to screen. Raw logs are screened by detection/log_screening.py; what
values that repeat may mean is said by ties.py.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.io.rows import SHOWN, named
from accelcal_cli.io.ties import (
    FEWEST,
    FINER,
    FITTED,
    Ties,
    coarsest_step,
    exact,
    grid_step,
    is_stepped,
    quadric_terms,
    quantile,
    unscattered,
)
from accelcal_cli.notices import COMMAND, Notice
from accelcal_cli.schema import frozen

LOOKED_AT = 4096
"""Poses that are looked at: the first."""

RAW_ROWS = 500
"""From so many rows on, rows with a time each, or each much like the one before, are a raw log rather than poses."""

ALIKE = 0.05
"""Most rows of a log differ from the one before by less than this part of the range."""

BLOCK, CREEP, MOVING = 8, 6.0, 0.01
"""Rows are in a move where means of BLOCK of them step by CREEP times what the quieter ones do; a log has MOVING of
its rows in moves."""

ONWARD, JUMP = 2.2, 8.0
"""Rows move all the time where means of BLOCK of them get further than ONWARD in four steps, in parts of one, and few
rows jump, by JUMP times the usual."""

MANY_COPIES, SOME_COPIES = 1 / 3, 0.1
"""Parts of the poses from which on copies matter: where readings without noise may repeat, and where they cannot."""

FIXED = 0.02
"""Least singular value of the terms of a quadric over the greatest at which poses fix it."""

ONE_POINT = 0.05
"""A range of the readings below this part of their size is less than 3 degrees: the sensor was not turned."""

NO_SURFACE = 0.25
"""Poses fill a volume, and lie on no sphere, when they scatter about it by this part of their largest extent: noise
does so by 0.26 to 0.6, caps of 20 degrees with 20 mg of noise by less than 0.23."""

ROW_WIDE, FEW_STEPS = 3.0, 8
"""Extent of poses that are nothing but noise: in standard deviations of a row, and in steps of the readings."""

NO_SPHERE = 0.2
"""The squared radius of poses brought to unit extent scatters less about that of a sphere, where they lie on one."""

TWICE, SMALLEST = 2.0, 1e-6
"""Two sensors are suspected only where separate fits leave less than half the residual, and one fit leaves squares of
more than the second per pose, in parts of the squared radius: half a milli-g."""

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of axes."""

LIVELY = 10.0
"""A scatter that is stated tells readings without any where the others are so many of its own last digits."""

UNEQUAL, TELLING = 3.0, 10
"""Factor between the noise of poses, or of axes, that is told of, and readings of each pose that tell it."""

COARSE = 2.0
"""Steps over the scatter of the readings from which on an average of many is no finer than one: the noise is below
0.4 of a step."""

Where = Callable[[int], str]


class Behind(NamedTuple):
    """Single readings behind poses that are means: the first of them in time, shape (n, 3), and the extremes of all."""

    head: Float
    low: Float
    high: Float

    def and_also(self, readings: Float, most: int) -> Behind:
        """Return them with more readings, shape (n, 3), of which as many are kept as make `most` in all."""
        head = np.concatenate([self.head, readings[: max(0, most - len(self.head))]])
        low, high = np.minimum(self.low, readings.min(axis=0)), np.maximum(self.high, readings.max(axis=0))
        return Behind(head, low, high)


NOTHING = Behind(np.zeros((0, 3)), np.full(3, np.inf), np.full(3, -np.inf))
"""Before the first reading."""


SOUND = 0.75
"""Part of the poses, those nearest to one surface, that still have to fit two where there are two sensors."""


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


@frozen(eq=False)
class Screened:
    """Poses of one sensor, to be screened.

    Attributes:
        output: of the poses, LOOKED_AT at most, shape (J, 3), sensor units; names: of the three columns.
        rows: how many poses there are in all; where: names a pose, from 0; source: of them, for a command.
        single: whether each row of a table is a pose; timed: whether the rows have times.
        warm: whether they have temperatures, with which one sensor may drift from the first half to the second.
        count: readings behind each pose, shape (J,); scatter: standard deviation of one, shape (J, 3); or None.
        behind: the readings behind the poses; None where they are not known.
        zeros: whether rows of zeros have been left out.
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
    behind: Behind | None = None
    zeros: bool = False

    def notices(self) -> tuple[Notice, ...]:
        """Return what the readings show, warnings first."""
        dead = list(self._dead_axes())
        frozen = [] if dead else list(self._frozen())
        if not dead and (self.never_moved or (self.gravity_removed and not frozen)):
            return tuple(self._one_point())
        found = [*self._log(), *dead, *self._copies(), *frozen]
        if not dead:
            found += [
                *self._clipped(),
                *self._quantised(),
                *self._unequal(),
                *(() if frozen else self._several()),
            ]
        return tuple(sorted(found, key=lambda notice: notice.severity != "warning"))

    @cached_property
    def ties(self) -> Ties:
        """How the values of the poses repeat."""
        steps = self._row_steps
        steps = np.where(steps > self._usual_scatter / FINER, steps, 0.0)
        low, high = (None, None) if self.behind is None else (self.behind.low, self.behind.high)
        return Ties(exact(self.output), steps, low, high)

    @cached_property
    def _usual_scatter(self) -> Float:
        """Root mean square of the scatter, shape (3,), 0 where it is not known."""
        known = self.scatter is not None and bool(np.isfinite(self.scatter).any())
        return (
            np.sqrt(np.nanmean(self.scatter**2, axis=0))
            if self.scatter is not None and known
            else np.zeros(3)
        )

    @cached_property
    def _row_steps(self) -> Float:
        """Steps in which the readings behind the poses come, shape (3,), 0 where they are not known."""
        return (
            np.zeros(3)
            if self.behind is None
            else np.array([coarsest_step(axis) for axis in self.behind.head.T])
        )

    @cached_property
    def _clipped_at(self) -> list[tuple[int, int]]:
        """Axis and pose of every reading at the end of a range.

        A clipped reading makes its pose shorter; poses that are longer than others have an axis that is stuck.
        """
        marks: dict[tuple[int, float], set[int]] = {}
        for pose, axis, value in self.ties.at_ends():
            marks.setdefault((axis, value), set()).add(pose)
        output = self.ties.output
        flat = self._unscattered & ((output == output.min(axis=0)) | (output == output.max(axis=0)))
        flat[self._unscattered.all(axis=1)] = False
        for pose, axis in np.argwhere(flat).tolist():
            marks.setdefault((axis, float(output[pose, axis])), set()).add(pose)
        return [
            (axis, pose)
            for (axis, value), poses in marks.items()
            if self.ties.is_end(axis, value) and not self.ties.are_longer(np.array(sorted(poses)))
            for pose in sorted(poses)
        ]

    @property
    def never_moved(self) -> bool:
        """Whether all poses are one attitude, 3 degrees wide at most."""
        size = float(np.linalg.norm(self.output.mean(axis=0)))
        return len(self.output) > 2 and float(np.ptp(self.output, axis=0).max()) < ONE_POINT * size

    @property
    def gravity_removed(self) -> bool:
        """Whether the poses fill a volume instead of a surface, or lie within the noise of a row."""
        extent = np.ptp(self.output, axis=0)
        if extent.max() < ROW_WIDE * self._usual_scatter.max():
            return True
        steps = np.array([coarsest_step(axis) for axis in self.output.T])
        few = bool((extent <= FEW_STEPS * steps).all())
        if few and self.zeros:
            return True
        volume = self.ties.surface is not None and thickness(self.output) > NO_SURFACE
        return (
            volume and (few or self._is_one_blob()) and not self._clipped_at
        )  # a clipped sphere fills a volume

    def _is_one_blob(self) -> bool:
        """Whether distances from the middle spread as those of noise, not as those of a sphere with a few outliers."""
        middle = np.median(self.output, axis=0)
        width = np.median(np.abs(self.output - middle), axis=0)
        if not (width > 0).all():
            return True
        with np.errstate(over="ignore"):  # of readings that are no acceleration at all
            off = np.minimum(np.abs(self.output - middle) / width, 1e100)
        radius = np.linalg.norm(off, axis=1)
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
        yield Notice("log", "warning", text, f"{COMMAND}calibrate {place} --raw")

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
        poses, copies = len(self.output), self.ties.copies
        if copies < max(2, SOME_COPIES * poses):
            return
        text = f"{copies:,} of {poses:,} poses repeat another to the last digit."
        expected = float(np.prod(self.ties.tie)) * self.ties.near_pairs()
        if copies > 3 + 5 * expected or (copies >= MANY_COPIES * poses and not (self.ties.steps > 0).all()):
            text += " Sigma counts them as independent measurements."
            yield Notice("duplicate-rows", "warning", text, "Leave copies out.")
        elif copies >= MANY_COPIES * poses:
            text += (
                " The readings are quantized more coarsely than their noise, so repeating a pose adds little."
            )
            yield Notice("duplicate-rows", "note", text, "Average many readings of each pose.")

    def _clipped(self) -> Iterator[Notice]:
        marks = self._clipped_at
        if not marks:
            return
        poses = sorted({pose for _, pose in marks})
        sides = sorted({(axis, float(self.ties.output[pose, axis])) for axis, pose in marks})
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
        """Poses without any scatter, in all axes or in one, where others have some, and axes that do not turn."""
        zero = self._unscattered.copy()
        whole = zero.all(axis=1)
        if whole.any():
            yield self._frozen_notice(np.flatnonzero(whole), "all axes repeat one value")
        zero[whole] = False
        for axis, pose in self._clipped_at:
            zero[pose, axis] = False
        for axis, first, end in self.ties.stuck():
            zero[first:end, axis] = True
        for axis in np.flatnonzero(zero.any(axis=0)).tolist():
            poses = np.flatnonzero(zero[:, axis])
            yield self._frozen_notice(poses, f'column "{self.names[axis]}" repeats one value')

    @cached_property
    def _unscattered(self) -> Bool:
        """Return the poses and axes without scatter although they should have some, shape (J, 3)."""
        nothing = np.zeros(self.output.shape, dtype=bool)
        if self.scatter is None or len(self.output) < FEWEST:
            return nothing
        count = np.full(len(self.output), np.inf) if self.count is None else self.count
        scatter = np.where(self.scatter > 1e-12 * np.abs(self.output).max(), self.scatter, 0.0)
        if self.behind is not None:
            return unscattered(scatter, count, self.behind.head)
        zero = (scatter == 0) & (count[:, None] > 2)
        whole, number = zero.all(axis=1), int(zero.sum())
        if number == 3 * whole.sum() and 2 * whole.sum() < len(whole):
            return np.asarray(zero)
        alone, others = zero.sum(axis=0), scatter[scatter > 0]
        if not len(others) or np.median(others) < LIVELY * grid_step(scatter.ravel()):
            return nothing
        one_axis = FEWEST // 2 < number == alone.max() < len(whole) - FEWEST // 2
        return np.asarray(zero) if one_axis else nothing

    def _frozen_notice(self, poses: Int, what: str) -> Notice:
        places = named([self.where(pose) for pose in poses[:SHOWN].tolist()], len(poses))
        plural = "s" if len(poses) > 1 else ""
        text = (
            f"Frozen readings: {what} to the last digit in {len(poses):,} pose{plural} ({places}), while others "
            "change."
        )
        return Notice("frozen", "warning", text, "Leave these poses out, or measure them again.")

    def _quantised(self) -> Iterator[Notice]:
        """Steps so much coarser than the noise that an average of many readings is off by as much as one."""
        if self.behind is None or self.scatter is None:
            return
        step = self._row_steps
        stepped = [is_stepped(axis, own) for axis, own in zip(self.behind.head.T, step, strict=True)]
        coarse = np.flatnonzero((step > COARSE * self._usual_scatter) & stepped)
        if len(coarse):
            names = ", ".join(f'"{self.names[axis]}"' for axis in coarse.tolist())
            text = (
                f"Column {names} changes in steps of {float(step[coarse].max()):.4g}, coarser than the noise: the mean "
                "of a pose is off by up to half a step, however many readings it has. Sigma counts that as noise."
            )
            yield Notice(
                "quantised", "note", text, "Choose a finer resolution or a narrower range of the sensor."
            )

    def _unequal(self) -> Iterator[Notice]:
        """Poses or axes whose noise differs by a factor: sigma knows, an unweighted fit makes no use of it."""
        if self.scatter is None or self.count is None or len(self.output) < FEWEST:
            return
        if not (self.count >= TELLING).all() or not np.isfinite(self.scatter).all():
            return
        poses = np.sqrt((self.scatter**2).mean(axis=1) / self.count)
        for what, noise in (("poses", poses), ("axes", self._usual_scatter)):
            ends = (0.1, 0.9) if len(noise) > 3 else (0.0, 1.0)
            low, high = (quantile(noise, end) for end in ends)
            if high > UNEQUAL * low > 0:
                text = f"The noise of the {what} differs by a factor of {high / low:.2g}; sigma counts that."
                yield Notice(
                    "unequal-noise", "note", text, "Add --weights auto, which counts poses by their noise."
                )

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
    """Return whether rows, shape (J, 3), pass through moves: means of BLOCK rows that creep for two steps or more.

    A jump from pose to pose, without rows between, is one row's step; noise that follows itself does not get further
    in four blocks than a random walk, which comes to twice the step of one.
    """
    blocks = len(output) // BLOCK
    means = output[: blocks * BLOCK].reshape(blocks, BLOCK, 3).mean(axis=1)
    row = np.abs(np.diff(output, axis=0)).max(axis=1)
    steps, largest = _block_steps(means, row, 1)
    far, within = _block_steps(means, row, 4)
    smooth = within < JUMP * float(np.median(row))
    if smooth.mean() > 0.5 and np.median(far[smooth]) > ONWARD * max(np.median(steps), np.median(row)):
        return True  # it moves all the time
    span = float(np.ptp(output, axis=0).max())
    moving = steps > np.maximum(largest, max(CREEP * float(np.quantile(steps, 0.25)), 1e-3 * span))
    return bool((moving[1:] & moving[:-1]).mean() > MOVING)


def _block_steps(means: Float, row: Float, blocks: int) -> tuple[Float, Float]:
    """Return how far means of BLOCK rows are from those so many blocks on, and the largest step of a row between."""
    steps = np.abs(means[blocks:] - means[:-blocks]).max(axis=1)
    width = BLOCK * (blocks + 1) - 1
    windows = np.lib.stride_tricks.sliding_window_view(row, width)[::BLOCK]
    return steps, windows.max(axis=1)[: len(steps)]


def _fit_apart(output: Float, part: Bool) -> bool:
    """Return whether two quadrics, one for each part of the poses, fit beyond chance better than one for all."""
    terms = quadric_terms(output)
    if terms is None or len(output) < 2 * FEWEST or not _are_apart(terms, part):
        return False
    # A few wrong poses bend one of the surfaces; of two sensors no pose fits the surface of both.
    solution = np.linalg.lstsq(terms[:, :9], terms[:, 9])[0]
    off = np.abs(terms[:, :9] @ solution - terms[:, 9])
    sound = off <= np.quantile(off, SOUND)
    enough = min(np.count_nonzero(sound & part), np.count_nonzero(sound & ~part)) >= FEWEST
    return not enough or _are_apart(terms[sound], part[sound])


def _are_apart(terms: Float, part: Bool) -> bool:
    """Return whether quadrics through two parts of the poses leave less of their terms than one, beyond chance."""
    joint, squares = _squares(terms), _squares(terms[part]) + _squares(terms[~part])
    return math.isfinite(squares + joint) and bool(
        _beyond_chance(np.array(joint), np.array(squares), len(terms) - 18)
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
        | _keep_a_value(axes, real)
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


def _keep_a_value(axes: Float, real: Bool) -> Bool:
    """Return which sensors have an axis with three equal values in a row in poses that differ: axes (3, R, J)."""
    same = (axes[..., 1:] == axes[..., :-1]) & real[:, 1:]
    alone = same & ~same.all(axis=0)
    return np.asarray((alone[..., 1:] & alone[..., :-1]).any(axis=(0, 2)))


def _is_odd(output: Float, real: Bool) -> Bool:
    """Return which sensors may not have been turned, lack gravity, or are two: shape (R,)."""
    poses = real.sum(axis=1)
    low, high = output.min(axis=1), output.max(axis=1)
    size = np.maximum(np.abs(low), np.abs(high)).max(axis=1)
    odd = (high - low).max(axis=1) < 2 * ONE_POINT * size
    half = np.where(high > low, (high - low) / 2, 1.0)
    x = (output - ((low + high) / 2)[:, None]) / half[:, None]
    terms = np.concatenate([x * x, x * x[..., [1, 2, 0]], x], axis=2)
    odd |= _off_sphere(x, real) > NO_SPHERE**2 * poses
    many = np.flatnonzero((poses >= 2 * FEWEST) & ~odd)
    if len(many):
        terms, real, poses, place = terms[many], real[many], poses[many], np.arange(output.shape[1])
        joint = _squares_of(terms, real)
        some = joint > SMALLEST * poses
        many, terms, real, poses, joint = many[some], terms[some], real[some], poses[some], joint[some]
    if len(many):
        for first in (place < (poses // 2)[:, None], np.broadcast_to(place % 2 == 0, real.shape)):
            apart = _squares_of(terms, real & first) + _squares_of(terms, real & ~first)
            odd[many] |= _beyond_chance(joint, apart, poses - 18)
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
