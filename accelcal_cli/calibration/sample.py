"""The static readings of R sensors as a calibration takes them: a table in blocks, or a batch of a fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.io.fleet import Batch, FleetReadings
from accelcal_cli.io.readings import Readings
from accelcal_cli.io.screening import LOOKED_AT, RAW_ROWS, may_be_doubtful

Blocks = Callable[[], Iterator[tuple[int, Float]]]
"""Yields (number of the first pose, outputs, shape (R, B, 3)) from the first pose on, as often as it is called."""


@dataclass(frozen=True, eq=False)
class Sample:
    """Poses of R sensors, J at most; a sensor with fewer repeats its last one, and the repetitions count nothing.

    Attributes:
        poses: J of each sensor, shape (R,).
        lower, upper: least and greatest output of each axis, shape (R, 3), output units.
        blocks: the outputs, shape (R, B, 3) a block, output units.
        doubtful: whether `readings` has warnings, or might have, shape (R,).
        readings: of each sensor by its number, from 0: origin, names of the poses, notes and warnings of the reader.
        count: raw readings behind each pose, shape (R, J); scatter: standard deviation of one of them, shape
            (R, J, 3), output units; NaN where not known, None where nothing tells.
        reference: known specific force, shape (R, J, 3), m/s^2; temperature: shape (R, J); None where there is none.
    """

    poses: Int
    lower: Float
    upper: Float
    blocks: Blocks
    doubtful: Bool
    readings: Callable[[int], Readings]
    count: Float | None = None
    scatter: Float | None = None
    reference: Float | None = None
    temperature: Float | None = None

    @classmethod
    def of(cls, readings: Sequence[Readings]) -> Sample:
        """Return the sample of sensors with as many poses each and the same columns; one alone may have any number."""

        def stack(name: str) -> Float | None:
            if getattr(readings[0], name) is None:
                return None
            return np.stack([getattr(one, name) for one in readings])

        def blocks() -> Iterator[tuple[int, Float]]:
            for parts in zip(*(one.blocks() for one in readings), strict=True):
                yield (
                    parts[0][0],
                    np.stack([block for _, block in parts]) if len(parts) > 1 else parts[0][1][None],
                )

        return cls(
            poses=np.array([one.poses for one in readings]),
            lower=np.stack([one.lower for one in readings]),
            upper=np.stack([one.upper for one in readings]),
            blocks=blocks,
            doubtful=np.array([bool(one.cautions) for one in readings]),
            readings=readings.__getitem__,
            count=stack("count"),
            scatter=stack("scatter"),
            reference=stack("reference"),
            temperature=stack("temperature"),
        )

    @classmethod
    def of_batch(cls, fleet: FleetReadings, batch: Batch) -> Sample:
        """Return the sample of a batch of a fleet."""
        doubtful = may_be_doubtful(batch.output[:, :LOOKED_AT], batch.count) | (batch.count >= RAW_ROWS)
        return cls(
            poses=batch.count,
            lower=batch.output.min(axis=1),
            upper=batch.output.max(axis=1),
            blocks=lambda: iter([(0, batch.output)]),
            doubtful=doubtful,
            readings=lambda at: fleet.one(batch, at),
            count=batch.behind,
            scatter=batch.scatter,
        )

    def __len__(self) -> int:
        """R, the number of sensors."""
        return len(self.poses)

    def real(self, first: int, width: int) -> Bool:
        """Return which of the poses from `first` on are no repetitions, shape (R, width)."""
        return np.asarray(np.arange(first, first + width) < self.poses[:, None])

    def output(self) -> Float:
        """Return the outputs of all poses, shape (R, J, 3), output units."""
        return np.concatenate([block for _, block in self.blocks()], axis=1)

    def take(self, index: Int) -> Sample:
        """Return the sensors at `index`."""
        numbers = index.tolist()
        parts = {
            name: None if (value := getattr(self, name)) is None else value[index]
            for name in ("count", "scatter", "reference", "temperature")
        }
        return replace(
            self,
            poses=self.poses[index],
            lower=self.lower[index],
            upper=self.upper[index],
            blocks=lambda: ((first, block[index]) for first, block in self.blocks()),
            doubtful=self.doubtful[index],
            readings=lambda at: self.readings(numbers[at]),
            **parts,
        )

    def with_output(self, output: Float) -> Sample:
        """Return the same poses with other outputs, shape (R, J, 3)."""
        lower, upper = output.min(axis=1), output.max(axis=1)
        return replace(self, lower=lower, upper=upper, blocks=lambda: iter([(0, output)]))
