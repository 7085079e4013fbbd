"""One random stream per run, so that a run's bits do not depend on its company.

Run 13 alone, run 13 in a batch of 20 and run 13 on another worker draw the same numbers: every run owns a
generator seeded from (seed, run), and a batched draw fills each run's slice from that run's generator.

Arrays come out as (R, P, D) with the population axis contiguous in memory: operations over a population of
100 then run along 100 neighbours instead of along 12 coordinates, which is two to three times as fast.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum

import numpy as np
from numpy.random import SFC64, Generator, SeedSequence

from accelcal_cli.arrays import Float, Int


class Purpose(IntEnum):
    """What numbers are drawn for: under one seed each purpose has streams of its own.

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
    FIELD = 20  # gravity map
    INS = 21  # errors of an inertial navigation system
    GRAVIMETER = 22  # noise of measured gravity
    FILTER = 23  # everything that a navigation filter draws


class Streams:
    """R independent generators, one a run.

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

    @property
    def generators(self) -> list[Generator]:
        """One generator a run; an algorithm that draws nothing never pays for them."""
        if self._started is None:
            self._started = [
                Generator(SFC64(SeedSequence(self._seed, spawn_key=(self._purpose, run))))
                for run in self._runs
            ]
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

    def take(self, index: Int) -> Streams:
        """Return the streams of the runs at `index`, going on where they stand."""
        chosen = Streams(self._seed, (self._runs[i] for i in index), self._purpose)
        # Shared: what one draws the other does not draw again.
        chosen._started = [self.generators[i] for i in index]
        return chosen
