"""One random stream per run, so that a run's bits do not depend on its company.

Run 13 alone, run 13 in a batch of 20 and run 13 on another worker draw the same numbers: every run owns a
generator seeded from (seed, run), and a batched draw fills each run's slice from that run's generator.

Arrays come out as (R, P, D) with the population axis contiguous in memory: operations over a population of
100 then run along 100 neighbours instead of along 12 coordinates, which is two to three times as fast.

A small batch spends its time on calling numpy rather than on numbers. `Streams.ahead` therefore draws for several
iterations in one call; the numbers are those of as many single draws, so that nobody else has to know.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TypeVarTuple, cast

import numpy as np
from numpy.random import SFC64, Generator, SeedSequence

from accelcal_cli.arrays import Float, Int

Arrays = TypeVarTuple("Arrays")

AHEAD = 40 * 1024
"""Numbers that a batch draws ahead at most, 320 KiB: several iterations of a few runs, in the second-level cache."""


class Purpose(IntEnum):
    """What the numbers are for: under one seed each purpose has streams of its own.

    The values are part of every seeded result: a new purpose takes a new number, and none is changed.
    """

    SEARCH = 0  # everything that an optimizer draws
    BOX = 1  # the middle of a search box, off the truth
    NOISE = 2  # of readings
    ATTITUDE = 3  # of poses
    RAW_LOG = 4  # a hold or a move of a raw log
    SHIFT = 4  # place and rotation of a test function: no command has both, and both have printed results
    SENSOR = 5  # error parameters
    START = 6  # starting population around the nominal sensor
    PLAN = 7  # sets of poses that an exchange starts from
    CONSENSUS = 8  # subsets of poses that a robust fit starts from
    FIELD = 20  # gravity map
    INS = 21  # errors of an inertial navigation system
    GRAVIMETER = 22  # noise of measured gravity
    FILTER = 23  # everything that a navigation filter draws


@dataclass
class _Stock:
    """The arrays that one call has made for several iterations.

    Attributes:
        key: function, rows and columns of the iterations.
        states: of the generators before the draw.
        steps: K, the number of iterations; used: how many of them are over.
        arrays: of the iterations to come.
    """

    key: tuple[object, int, int]
    states: list[Mapping[str, object]]
    steps: int
    arrays: Iterator[tuple[Float, ...]]
    used: int = 0

    def give_back(self, generators: list[Generator]) -> None:
        """Put the generators to where the numbers of the iterations that are over end."""
        if self.used < self.steps:
            for generator, state in zip(generators, self.states, strict=True):
                generator.bit_generator.state = state
                generator.random(self.used * self.key[1] * self.key[2])


class Streams:
    """R independent generators, one per run.

    Args:
        seed: the study's seed, a non-negative integer.
        runs: the numbers of the runs; run r draws the same whatever the others are.
        purpose: of the draws, see `Purpose`.
    """

    def __init__(self, seed: int, runs: Iterable[int], purpose: int = Purpose.SEARCH) -> None:
        """Seed one generator for every run from (seed, purpose, run), when the first number is drawn."""
        if seed < 0:
            raise ValueError(f"seed: {seed} is negative; expected 0 or more")
        self._seed, self._purpose, self._runs = seed, purpose, tuple(runs)
        self._started: list[Generator] | None = None
        self._stock: _Stock | None = None

    @property
    def generators(self) -> list[Generator]:
        """One generator per run; an algorithm that draws nothing never pays for them."""
        if self._started is None:
            self._started = [
                Generator(SFC64(SeedSequence(self._seed, spawn_key=(self._purpose, run))))
                for run in self._runs
            ]
        if self._stock is not None:
            self._stock.give_back(self._started)
            self._stock = None
        return self._started

    def __len__(self) -> int:
        """R, the number of runs."""
        return len(self._runs)

    def uniform(self, rows: int, columns: int) -> Float:
        """Return U[0, 1) numbers, shape (R, rows, columns), population-contiguous."""
        out = np.empty((len(self), columns, rows))
        for generator, part in zip(self.generators, out, strict=True):
            generator.random(out=part)
        return out.transpose(0, 2, 1)

    def normal(self, rows: int, columns: int) -> Float:
        """Return N(0, 1) numbers, shape (R, rows, columns), population-contiguous."""
        out = np.empty((len(self), columns, rows))
        for generator, part in zip(self.generators, out, strict=True):
            generator.standard_normal(out=part)
        return out.transpose(0, 2, 1)

    def ahead(self, choose: Callable[[Float], tuple[*Arrays]], rows: int, columns: int) -> tuple[*Arrays]:
        """Return what `choose` makes of `uniform(rows, columns)`, computed for several iterations in one call.

        The same bits as without drawing ahead, whatever is drawn before or after.

        Args:
            choose: makes arrays of shape (R, K, ...) of uniform numbers of shape (R, K, rows, columns), each of the K
                iterations by itself. Pass the same function in every iteration.
            rows, columns: of one iteration.

        Returns:
            The arrays of this iteration, shape (R, ...).
        """
        stock, key = self._stock, (choose, rows, columns)
        if stock is None or stock.used == stock.steps or stock.key != key:
            stock = self._stock = self._draw_ahead(choose, rows, columns)
        stock.used += 1
        return cast("tuple[*Arrays]", next(stock.arrays))

    def _draw_ahead(self, choose: Callable[[Float], tuple[*Arrays]], rows: int, columns: int) -> _Stock:
        steps = max(1, AHEAD // (len(self) * rows * columns))
        # A stock of one iteration is used up at once: nothing will be given back.
        states = [g.bit_generator.state for g in self.generators] if steps > 1 else []
        u = self.uniform(rows, steps * columns).transpose(0, 2, 1)
        parts = cast("tuple[Float, ...]", choose(u.reshape(len(self), steps, columns, rows).swapaxes(2, 3)))
        arrays = zip(*(part.swapaxes(0, 1) for part in parts), strict=True)
        return _Stock((choose, rows, columns), states, steps, arrays)

    def take(self, index: Int) -> Streams:
        """Return the streams of the runs at `index`, going on where they stand."""
        part = Streams(self._seed, (self._runs[i] for i in index), self._purpose)
        # Shared: what one draws the other does not draw again.
        part._started = [self.generators[i] for i in index]
        return part
