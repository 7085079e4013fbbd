"""The static readings of R sensors as a calibration takes them: a table in blocks, or a batch of a fleet."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.settings import Robust, Settings, Weights
from accelcal_cli.io.readings import LOOKED_AT, RAW_ROWS, Readings, may_be_doubtful

if TYPE_CHECKING:
    from accelcal_cli.io.fleet import Batch, FleetReadings

Blocks = Callable[[], Iterator[tuple[int, Float]]]
"""Yields (number of the first pose, outputs, shape (R, B, 3)) from the first pose on, as often as it is called."""

NEEDS = {
    "n": 'a column "n" or repeated readings per pose',
    "sd": 'a column "n" and standard deviations above zero (columns sx, sy, sz), or at least two readings per pose',
    "auto": "the number of readings and their standard deviation (columns n, sx, sy, sz), or at least two readings "
    "per pose",
}
"""What weights need to stand beside the readings, in words."""


HUBER = 1.345
"""Huber's k: 95 % of the efficiency of least squares under normal noise (Huber 1964)."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SCALE_SAMPLE = 100_000
"""At most about this many residuals decide the scale of a robust loss."""


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
            doubtful=np.array([bool(one.warnings) for one in readings]),
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

    def weights(self, choice: Weights) -> Float | None:
        """Return the weights of the poses, mean 1 per sensor, 0 for repetitions, shape (R, J), or None for all alike.

        n: how many raw readings a pose is the mean of; sd: those over the variance of one. Weights of a sensor whose
        readings do not give them (see `without_weights`) mean nothing.
        """
        real = self.real(0, int(self.poses.max()))
        if choice == "none" or self.count is None:
            return None if real.all() else real.astype(float)
        weights = self.count.astype(float)
        if choice == "sd" and self.scatter is not None:
            square = np.mean(self.scatter**2, axis=2)
            weights = np.divide(weights, square, out=np.full(weights.shape, np.nan), where=square > 0)
        weights = np.where(real, weights, 0.0)
        mean: Float = weights.sum(axis=1, keepdims=True) / self.poses[:, None]
        return weights / mean

    def without_weights(self, choice: Weights) -> Bool:
        """Return which sensors have readings that do not give the weights, shape (R,)."""
        if choice == "none":
            return np.zeros(len(self), dtype=bool)
        count, scatter = self.count, self.scatter
        if count is None or (choice != "n" and scatter is None):
            return np.ones(len(self), dtype=bool)
        usable: Bool = np.isfinite(count) & (count > 0)
        if scatter is not None and choice != "n":
            usable &= ~np.isnan(scatter).any(axis=2)
            usable &= (choice == "auto") | (scatter > 0).any(axis=2)
        return np.asarray((~usable & self.real(0, count.shape[1])).any(axis=1))

    def explained(self, first: int, f: Float, K: Float) -> Float:
        """Return the variance of the modulus that the scatter of each pose explains, (m/s^2)^2, shape (R, B), or NaN.

        Args:
            first: number of the first of B poses; f: their specific force, m/s^2, shape (R, B, 3).
            K: of the sensors, output units per m/s^2, shape (R, 3, 3).
        """
        if self.scatter is None or self.count is None:
            return np.full(f.shape[:2], np.nan)
        part = slice(first, first + f.shape[1])
        u = f / np.linalg.norm(f, axis=2, keepdims=True)
        force = self.scatter[:, part] / np.einsum("rii->ri", K)[:, None, :]
        return np.asarray(np.sum((u * force) ** 2, axis=2) / self.count[:, part])

    def errors(self, K: Float, D: Float, g: float) -> Iterator[tuple[int, Float, Float]]:
        """Yield (first pose, e, f) block by block: e = (g^2 - |f|^2) / 2g and f, m/s^2, shapes (R, B) and (R, B, 3).

        K, shape (R, 3, 3), and D, shape (R, 3), are those of the sensors.
        """
        K_A = np.linalg.inv(K)
        for first, block in self.blocks():
            # Columns of contiguous memory: ten times as fast as rows of three for many poses.
            f = K_A @ np.subtract(block.swapaxes(1, 2), D[..., None], order="C")
            yield first, (g * g - np.einsum("rij,rij->rj", f, f)) / (2.0 * g), f.swapaxes(1, 2)

    def noise(self, K: Float, D: Float, g: float) -> Float:
        """Return a robust standard deviation of e, m/s^2, shape (R,): its median absolute value times 1.4826."""
        poses = int(self.poses.max())
        stride = max(1, poses // SCALE_SAMPLE)
        sizes = [np.abs(e)[:, (-first) % stride :: stride] for first, e, _ in self.errors(K, D, g)]
        # Nine parameters follow the smallest residuals: the factor gives the scale back what they took.
        freedom = max(1.0, poses - 9.0) / poses
        return np.asarray(NORMAL_MAD * np.median(np.concatenate(sizes, axis=1), axis=1) / np.sqrt(freedom))

    def reweighted(
        self, K: Float, D: Float, settings: Settings, noise: Float, weights: Float | None
    ) -> Iterator[tuple[Float, Float | None]]:
        """Yield the readings with the weights that a robust loss gives them, shape (R, B), block by block.

        Args:
            K, D: the sensors that residuals are of; noise: their standard deviation, m/s^2, shape (R,).
            settings: g and the loss; weights: of the poses, shape (R, J), or None.
        """
        for (first, block), (_, e, _) in zip(self.blocks(), self.errors(K, D, settings.g), strict=True):
            own: Float | float = 1.0 if weights is None else weights[:, first : first + e.shape[1]]
            yield block, own * loss_weight(np.sqrt(own) * e / noise[:, None], settings.robust)


def loss_weight(z: Float, loss: Robust) -> Float:
    """Return the weight psi(z) / z of residuals z in units of the noise, same shape."""
    if loss == "huber":
        return HUBER / np.maximum(np.abs(z), HUBER)
    return 1.0 / np.sqrt(1.0 + z * z)  # soft-L1: rho = 2 (sqrt(1 + z^2) - 1)


def loss_slope(z: Float, loss: Robust) -> Float:
    """Return psi'(z), same shape."""
    if loss == "huber":
        return (np.abs(z) <= HUBER).astype(float)
    return (1.0 + z * z) ** -1.5
