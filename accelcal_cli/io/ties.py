"""Readings that repeat a value to the last digit, and how often honest ones do: ends of a range, stuck axes, copies.

Noise and resolution are measured on the readings themselves: `Surface` is the quadric nearest to all poses, and
`grid_step` the step that all values are multiples of. A pattern is told of where noise and resolution together would
show it in fewer than `CHANCE` of honest sets.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import field
from functools import cached_property
from typing import NamedTuple, Self

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.schema import frozen

CHANCE = 5e-4
"""Greatest chance of a pattern in honest readings at which it is reported."""

DIGITS = 12
"""Digits to which values are compared: the mean of equal readings is off by rounding."""

ROUNDING = 1e-9
"""Part of the range below which noise is rounding: no accelerometer is as quiet."""

FEWEST = 12
"""Poses that show the noise: a quadric has nine parameters."""

FITTED = 1024
"""Poses at most that the quadric is fitted to."""

MOST_PARTS = 65
"""The least difference of two readings is looked for a resolution in fewer parts than this."""

MOST_ROUNDED, ROUNDED = 9, 0.12
"""The same where multiples of the resolution are themselves rounded, and by how much of it: of a dozen gaps between
any values one would be off by more."""

RARE = 2e-5
"""Least chance that is taken for a tie of two readings."""

SCALE_SPREAD = 0.06
"""Range in which scale factor and bias put the reading of 1 g, relative: how likely a face meets the rail by chance."""

NEAR = 4.0
"""Noises by which two readings of an axis that is turned alike differ at most."""

TURNED, FEWEST_TURNS = 0.1, 2
"""Another axis changes by this part of the range, 11 degrees, or far beyond its noise, where a sensor is turned; ties
of neighbours from which on an axis may be stuck."""

ALIVE = 10.0
"""Another axis changes by so many steps at least where a tie counts."""

LOST, LOST_CHANCE = 0.06, 0.05
"""Poses this far off the sphere through the others, in parts of 1 g, are wrong, whatever they are: of an axis that
keeps its value through one this chance is enough, and through two any."""

LIKELY_OFF, SURELY_OFF = 2.0, 6.0
"""Sigmas by which poses are likely and surely off the sphere through others."""

LONGER = 0.02
"""Poses with a clipped reading are not longer than others by this part of 1 g."""

ALIKE = 1.5
"""Largest ratio of the extents of axes that are taken to be of one scale."""

FINER = 0.7
"""Scatter of rows over their step from which on it is their noise: two neighbouring values have up to 0.5."""


def exact(output: Float) -> Float:
    """Return readings to DIGITS digits of the largest, so that means of equal readings are equal."""
    size = float(np.abs(output).max(initial=0.0))
    return np.round(output, DIGITS - math.ceil(math.log10(size))) if size > 0 else output


@frozen(eq=False)
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
        terms = quadric_terms(output)
        if terms is None:
            return None
        x, half, poses = terms[:, 6:9], np.ptp(output, axis=0) / 2, len(output)
        _, singular, right = np.linalg.svd(terms, full_matrices=False)
        a = right[-1]
        square = np.array([[2 * a[0], a[3], a[4]], [a[3], 2 * a[1], a[5]], [a[4], a[5], 2 * a[2]]])
        slope = math.sqrt(float(np.mean(np.sum((x @ square + a[6:9]) ** 2, axis=1))))
        off = singular[-1] / math.sqrt(max(poses - 9, 1)) / max(slope, 1e-300)
        return cls(off * half)


def quadric_terms(output: Float) -> Float | None:
    """Return the ten terms of a quadric, shape (J, 10), of poses brought to -1 to 1; None where they tell nothing."""
    low, high = output.min(axis=0), output.max(axis=0)
    if len(output) < FEWEST or not (high > low).all():
        return None
    x, y, z = ((output - (low + high) / 2) / ((high - low) / 2)).T
    return np.stack([x * x, y * y, z * z, x * y, x * z, y * z, x, y, z, np.ones_like(x)], axis=1)


def grid_step(*axes: Float) -> float:
    """Return the step of which all differences of values within an axis are multiples, 0 where there is none."""
    values = [np.unique(axis) for axis in axes]
    gaps = np.concatenate([np.diff(axis) for axis in values])
    if len(gaps) < 2:
        return float(gaps.sum())
    least = float(gaps[gaps > 1e-12 * max(float(np.ptp(axis)) for axis in values)].min())
    if step := _rounded_step(gaps, least):
        return step
    for step in (*(least / k for k in range(1, MOST_PARTS)), *(10.0**-k for k in range(9))):
        if all(_are_whole(part / step) for part in (gaps[:32], gaps)) and (len(gaps) > 5 or step < least):
            return step
    return 0.0


def _are_whole(numbers: Float, off: float = 0.02) -> bool:
    return bool((np.abs(numbers - np.round(numbers)) < off).all())


def _rounded_step(gaps: Float, least: float) -> float:
    """Return a step of which gaps are about multiples, as where steps are written with few digits; 0 without one."""
    if len(gaps) < FEWEST:
        return 0.0
    gaps = np.sort(gaps)
    for parts in range(1, MOST_ROUNDED):
        step = least / parts
        for several in (4, 16, 64, 256, math.inf):
            some = gaps[gaps <= several * step]
            steps = np.round(some / step)
            step = float(some @ steps) / max(float(steps @ steps), 1.0) or step
        if _are_whole(gaps / step, ROUNDED):
            return step
    return 0.0


class Stuck(NamedTuple):
    """An axis that reads one value in the poses from `first` to `end` - 1 although the sensor turns."""

    axis: int
    first: int
    end: int


@frozen(eq=False)
class Ties:
    """How the values of some poses repeat.

    Attributes:
        output: of the poses, shape (J, 3), as `exact` returns it.
        step: of the readings behind the poses, where they are means, shape (3,); 0 where it is not known.
        low, high: the extremes of these, shape (3,), where they are known.
    """

    output: Float
    step: Float = field(default_factory=lambda: np.zeros(3))
    low: Float | None = None
    high: Float | None = None

    @cached_property
    def surface(self) -> Surface | None:
        """The quadric nearest to the poses."""
        return Surface.of(self.output)

    @cached_property
    def steps(self) -> Float:
        """Resolution of each axis, shape (3,), 0 where none shows: its own, or the one of all where that is coarser."""
        own = np.maximum(grid_step(*self.output.T), [grid_step(axis) for axis in self.output.T])
        return np.maximum(own, self.step)

    @cached_property
    def tie(self) -> Float:
        """Chance that two poses of one attitude read the same on an axis, shape (3,): 1 without noise."""
        return self._tie(self.surface)

    def _tie(self, surface: Surface | None) -> Float:
        """Return the chance of ties where the noise is that of a surface.

        Rounding to a step is in the noise that the poses show: where that is below the step, it may be all of it.
        """
        if surface is None:
            return np.ones(3)
        step = np.maximum(self.steps, ROUNDING * np.ptp(self.output, axis=0))
        noise = np.maximum(surface.noise, 1e-300)
        # The difference of two normal readings has a density of 1 / (2 sqrt(pi) sigma) at zero.
        return np.where(noise < step, 1.0, np.minimum(1.0, step / (2 * math.sqrt(math.pi) * noise)))

    @cached_property
    def copies(self) -> int:
        """How many poses repeat an earlier one to the last digit."""
        return len(self.output) - len({row.tobytes() for row in self.output})

    def near_pairs(self) -> float:
        """Return about how many pairs of poses are one attitude within the noise."""
        if self.surface is None:
            return 0.5 * len(self.output) ** 2
        width = NEAR * np.maximum(
            np.maximum(self.surface.noise, self.steps), ROUNDING * np.ptp(self.output, axis=0)
        )
        cells = np.round(self.output / width)
        _, count = np.unique(cells, axis=0, return_counts=True)
        return float((count * (count - 1) / 2).sum())

    def stuck(self) -> Iterator[Stuck]:
        """Yield the axes that keep a value through more turns of the sensor than chance explains."""
        if len(self.output) < FEWEST:
            return
        change = np.abs(np.diff(self.output, axis=0))
        if not (change == 0).any():  # spares the search for the steps
            return
        turned = np.stack([np.delete(change, i, axis=1).max(axis=1) for i in range(3)], axis=1)
        alive, turned = turned > ALIVE * self.steps.max(), turned > self._shortest_turn()
        for axis, values in enumerate(self.output.T):
            first, end = _longest_run(change[:, axis] == 0)
            turns = int(np.count_nonzero(turned[first:end, axis]))
            ties = int(np.count_nonzero(alive[first:end, axis]))
            if not turns or ties < FEWEST_TURNS:
                continue
            run = np.arange(first, end + 1)
            if self.is_end(axis, float(values[first])) and not self.are_longer(run):
                continue  # clipped
            excess = self._excess(run, SURELY_OFF)
            lost, pairs = int(np.count_nonzero(np.abs(excess) > LOST)), np.arange(first, end)
            tie = (
                self._tie_apart(pairs, axis) if lost else self._tie_of_neighbours(change, turned, pairs, axis)
            )
            by_chance = 3 * len(change) * tie**ties
            if by_chance < (LOST_CHANCE if lost else CHANCE) or (lost >= 2 and turns > FEWEST_TURNS):
                yield Stuck(axis, first, end + 1)

    def _shortest_turn(self) -> float:
        """Return the change of a reading that shows that the sensor has been turned."""
        turned = TURNED * float(np.ptp(self.output, axis=0).max())
        if self.surface is None:
            return turned
        return min(turned, 2 * NEAR * float(np.maximum(self.surface.noise, self.steps).max()))

    def are_longer(self, poses: Int) -> bool:
        """Return whether poses, numbers of shape (k,), are longer than the others, as far as these tell."""
        return float(self._excess(poses, LIKELY_OFF).mean()) > LONGER

    def _excess(self, poses: Int, sigmas: float) -> Float:
        """Return by which part poses are longer than a sphere through the others, shape (k,).

        0 where that is within so many sigmas: where the others do not fix a sphere, or lie on none.
        """
        extent, rest = np.ptp(self.output, axis=0), np.delete(self.output, poses, axis=0)
        if not extent.all() or len(rest) < 6:
            return np.zeros(len(poses))
        unit = extent if extent.max() > ALIKE * extent.min() else np.full(3, extent.max())
        rest, those = rest / unit, self.output[poses] / unit
        left, those_left = (np.column_stack([2 * x, np.ones(len(x))]) for x in (rest, those))
        target = (rest * rest).sum(axis=1)
        c, _, rank, _ = np.linalg.lstsq(left, target)
        square = float(c[3] + c[:3] @ c[:3])
        if rank < 4 or square <= 0:
            return np.zeros(len(poses))
        noise = float(((target - left @ c) ** 2).sum()) / (len(rest) - 4)
        off = (those * those).sum(axis=1) - those_left @ c
        spread = np.sqrt(noise * (1 + np.sum(those_left @ np.linalg.inv(left.T @ left) * those_left, axis=1)))
        part = np.sqrt(np.maximum(off + square, 0.0) / square) - 1
        return np.where(np.abs(off) > sigmas * spread, part, 0.0)

    def _tie_apart(self, pairs: Int, axis: int) -> float:
        """Return the chance that a turn keeps the value of an axis, the noise being that of all poses or of the rest.

        A value that is stuck adds to the noise.
        """
        apart = Surface.of(np.delete(self.output, np.append(pairs, pairs[-1] + 1), axis=0))
        return float(max(self.tie[axis], 0.0 if apart is None else self._tie(apart)[axis], RARE))

    def _tie_of_neighbours(self, change: Float, turned: Bool, pairs: Int, axis: int) -> float:
        """Return the same as far as other pairs of neighbours do not show more.

        Args:
            change: from pose to pose, shape (J - 1, 3); turned: whether the other axes turned, same shape.
            pairs: numbers of the pairs in question; axis: of them.
        """
        others = turned.copy()
        others[pairs, axis] = False
        near = NEAR * np.maximum(self.steps, np.inf if self.surface is None else self.surface.noise)
        apart = Surface.of(np.delete(self.output, np.append(pairs, pairs[-1] + 1), axis=0))
        if apart is not None:
            near = np.minimum(near, NEAR * np.maximum(self.steps, apart.noise))
        equal = int(np.count_nonzero(others & (change == 0)))
        shown = equal / max(1, int(np.count_nonzero(others & (change <= near))))
        return max(self._tie_apart(pairs, axis), shown)

    def is_end(self, axis: int, value: float) -> bool:
        """Return whether no reading of an axis is beyond a value on its side."""
        values, off = self.output[:, axis], 1e-9 * abs(value)
        low = float(values.min() if self.low is None else min(values.min(), self.low[axis]))
        high = float(values.max() if self.high is None else max(values.max(), self.high[axis]))
        return value <= low + off or value >= high - off

    def at_ends(self) -> list[tuple[int, int, float]]:
        """Return (pose, axis, value) of every clipped reading: those that are exactly an end of the range."""
        output = np.unique(self.output, axis=0) if self.copies else self.output
        if len(output) < 6:
            return []
        marks = []
        for values in _ends(output):
            tied = [(a, v, int(np.count_nonzero(output[:, a] == v))) for a, v in values]
            if self._chance(output, tied) < CHANCE:
                marks += [
                    (pose, axis, value)
                    for axis, value, _ in tied
                    for pose in np.flatnonzero(self.output[:, axis] == value).tolist()
                ]
        return marks

    def _chance(self, output: Float, tied: list[tuple[int, float, int]]) -> float:
        """Return about how often honest poses would meet these extremes so many times.

        Poses of one side meet by their noise; the ends of two sides meet by scale factors and biases, which are alike.
        """
        number, sides = sum(m for _, _, m in tied), len(tied)
        if number < 2:
            return 1.0
        equal, near = _ties_elsewhere(output, tied, self.surface)
        tie = min(1.0, max(float(self.tie.max()) * near, equal, RARE))
        spread = max(SCALE_SPREAD * abs(tied[0][1]), 1e-300)
        ends = min(1.0, max(tie, float(self.steps.max()) / spread))
        chance = 1.0
        if len(output) >= FEWEST:
            chance = math.comb(6, sides) * ends ** (sides - 1) * tie ** (number - sides)
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


def _longest_run(flags: Bool) -> tuple[int, int]:
    """Return first and end of the longest run, (0, 0) without any."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    if not len(edges):
        return 0, 0
    longest = int(np.argmax(edges[1::2] - edges[::2]))
    return int(edges[2 * longest]), int(edges[2 * longest + 1])


def _ends(output: Float) -> list[list[tuple[int, float]]]:
    """Return the extremes (axis, value) in groups that are one range: the same size, or -2^n and 2^n - 1."""
    groups: dict[float, list[tuple[int, float]]] = {}
    for axis in range(3):
        for value in (float(output[:, axis].min()), float(output[:, axis].max())):
            size = abs(value) if bits_of_rail(value) is None else 2.0 ** (bits_of_rail(value) or 0)
            groups.setdefault(size, []).append((axis, value))
    return list(groups.values())


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
        width = math.inf if surface is None else NEAR * surface.noise[axis]
        equal, total = equal + int(np.count_nonzero(gaps == 0)), total + len(gaps)
        near += int(np.count_nonzero(gaps <= width))
    return equal / total, near / total


def unscattered(scatter: Float, count: Float, rows: Float) -> Bool:
    """Return the poses and axes without scatter that the resolution of the readings does not explain, shape (J, 3).

    n rows with the noise sigma read one value of steps q with a chance of at most p^(n - 1), p the chance that a
    reading falls into the step that it falls into most often.

    Args:
        scatter: of one reading in each pose, shape (J, 3); count: readings behind each, shape (J,).
        rows: some of these, as recorded, shape (n, 3).
    """
    zero = (scatter == 0) & (count[:, None] > 2)
    for axis in np.flatnonzero(zero.any(axis=0)).tolist():
        others, step = scatter[scatter[:, axis] > 0, axis], greatest_step(rows[:, axis])
        usual = float(np.median(others)) if len(others) else 0.0
        if len(others) < FEWEST // 2 or usual < FINER * step:
            zero[:, axis] = False
            continue
        noise = math.sqrt(usual**2 - step**2 / 12)
        most = math.erf(step / (2 * math.sqrt(2) * noise))
        expected, number = float((most ** (count - 1)).sum()), int(zero[:, axis].sum())
        if not expected**number / math.factorial(min(number, 20)) < CHANCE / 3:
            zero[:, axis] = False
    return np.asarray(zero)


def greatest_step(values: Float) -> float:
    """Return the greatest step that readings of an axis in time may have, inf where they do not change often enough."""
    change = np.abs(np.diff(values))
    change = change[change > 0]
    return quantile(change, 0.25) if len(change) > 0.1 * len(values) else math.inf


def quantile(values: Float, part: float) -> float:
    """Return a quantile, as `numpy.quantile` does, which imports numpy.ma: a tenth of the time of a start."""
    ordered, at = np.sort(values), part * (len(values) - 1)
    low = int(at)
    high = min(low + 1, len(ordered) - 1)
    return float(ordered[low] + (at - low) * (ordered[high] - ordered[low]))


def _gaps(values: Float) -> Float:
    """Return the differences between neighbours among the distinct values."""
    gaps = np.diff(np.sort(values))
    return np.asarray(gaps[gaps > 0])


def is_stepped(values: Float, step: float) -> bool:
    """Return whether readings come in such steps: no two of them differ by much less."""
    gaps = _gaps(values)
    return bool(step > 0 and len(gaps) and gaps.min() > 0.5 * step)


def coarsest_step(values: Float) -> float:
    """Return the step that readings of an axis in time seem to have: the least difference where they seldom change."""
    step, gaps = greatest_step(values), _gaps(values)
    return step if step < math.inf else float(gaps.min(initial=math.inf)) if len(gaps) else 0.0
