"""The static readings of R sensors as a calibration takes them: a table in blocks, or a batch of a fleet."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.settings import Robust, Settings, Weights
from accelcal_cli.io.readings import Readings
from accelcal_cli.io.screening import LOOKED_AT
from accelcal_cli.notices import Notice
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.poses import AXES

if TYPE_CHECKING:
    from accelcal_cli.io.batches import Batch, FleetReadings

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

NOISE_TOLD: dict[Robust, float] = {"huber": 0.74, "soft-l1": 0.65}
"""Degrees of freedom of s^2 under a robust loss, per one of the residuals: 2 / (J var log s^2) for normal residuals in
units of their median. A loss that looks away from large residuals knows their size less well."""

NO_NOISE = 1e-9
"""Residuals, or their standard deviation, below this part of g are rounding: readings are seldom written with ten
digits, and no accelerometer is as quiet."""

NORMAL_MAD = 1.4826
"""Standard deviation of normal noise over its median absolute deviation."""

SCALE_SAMPLE = 100_000
"""At most about this many residuals decide the scale of a robust loss."""


UP_OR_DOWN = re.compile(
    r"(?<![a-z0-9])(?P<sign>[+-]?)(?P<axis>[xyz])[\s_-]*(?:axis[\s_-]*)?(?P<way>up|down)(?![a-z])",
    re.IGNORECASE,
)
"""What in a label says which way a sensor axis points: "+x up", "-z up", "x_down", "Y axis up"."""


def axis_up(label: str) -> tuple[int, int] | None:
    """Return the axis, 0 to 2, that a label says something of, and 1 if its positive end is up, else -1; or None."""
    found = UP_OR_DOWN.search(label)
    if found is None:
        return None
    up = 1 if found["way"].lower() == "up" else -1
    return AXES.index(found["axis"].lower()), -up if found["sign"] == "-" else up


def _name_up(where: Callable[[int], str], poses: Iterable[int]) -> bool:
    """Whether a pose's name says which way an axis points."""
    names = (where(pose) for pose in poses)
    first = next(names, "")
    if not first.startswith("position "):  # the number of a line, as are all others
        return False
    return axis_up(first) is not None or any(axis_up(name) is not None for name in names)


@frozen(eq=False)
class Sample:
    """Poses of R sensors, J at most; a sensor with fewer repeats its last one, and the repetitions count nothing.

    Attributes:
        poses: J of each sensor, shape (R,).
        lower, upper: least and greatest output of each axis, shape (R, 3), output units.
        blocks: the outputs, shape (R, B, 3) a block, output units.
        doubtful: whether `readings` has warnings, or might have, shape (R,).
        labelled: whether a label makes each pose an attitude of its own, shape (R,).
        in_time: whether poses follow each other in time, so that neighbours may share errors, shape (R,).
        readings: of each sensor by its number, from 0: origin, notes and warnings of the reader.
        where: how to name a pose, by the number of its sensor and its own: by its label or its line.
        count: raw readings behind each pose, shape (R, J); scatter: standard deviation of one of them, shape
            (R, J, 3), output units; cross: covariances xy, xz, yz of one, shape (R, J, 3), output units squared; NaN
            where not known, None where nothing tells.
        reference: known specific force, shape (R, J, 3), m/s^2; temperature: shape (R, J); None where there is none.
    """

    poses: Int
    lower: Float
    upper: Float
    blocks: Blocks
    doubtful: Bool
    labelled: Bool
    in_time: Bool
    readings: Callable[[int], Readings]
    where: Callable[[int, int], str]
    count: Float | None = None
    scatter: Float | None = None
    cross: Float | None = None
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
            doubtful=np.array(
                [
                    bool(one.warnings) or _name_up(one.where, range(min(one.poses, LOOKED_AT)))
                    for one in readings
                ]
            ),
            labelled=np.array([one.labels is not None for one in readings]),
            in_time=np.array([one.in_time for one in readings]),
            readings=readings.__getitem__,
            where=lambda at, pose: readings[at].where(pose),
            count=stack("count"),
            scatter=stack("scatter"),
            cross=stack("cross"),
            reference=stack("reference"),
            temperature=stack("temperature"),
        )

    @classmethod
    def of_batch(cls, fleet: FleetReadings, batch: Batch) -> Sample:
        """Return the sample of a batch of a fleet."""
        doubtful = fleet.doubtful(batch)
        if _name_up(fleet.where, batch.pose[:1].ravel().tolist()):  # one table, one kind of labels
            doubtful = np.ones_like(doubtful)
        return cls(
            poses=batch.count,
            lower=batch.output.min(axis=1),
            upper=batch.output.max(axis=1),
            blocks=lambda: iter([(0, batch.output)]),
            doubtful=doubtful,
            labelled=fleet.labelled(batch),
            in_time=np.zeros_like(doubtful),
            readings=lambda at: fleet.one(batch, at, screened=bool(doubtful[at])),
            where=lambda at, pose: fleet.where(int(batch.pose[at, pose])),
            count=batch.behind,
            scatter=batch.scatter,
            cross=batch.cross,
            reference=batch.reference,
            temperature=batch.temperature,
        )

    def __len__(self) -> int:
        """R, the number of sensors."""
        return len(self.poses)

    def warnings(self, at: int) -> tuple[Notice, ...]:
        """Return what the reader warns of the sensor number `at`."""
        return self.readings(at).warnings if self.doubtful[at] else ()

    def real(self, first: int, width: int) -> Bool:
        """Return which of the poses from `first` on are no repetitions, shape (R, width)."""
        return np.asarray(np.arange(first, first + width) < self.poses[:, None])

    def each_weight(self, weights: Float | None) -> Float:
        """Return the weight of each pose, 1 where all count alike and 0 for repetitions, shape (R, J)."""
        return self.real(0, int(self.poses.max())).astype(float) if weights is None else weights

    def counted(self, rejected: Bool | None) -> Int:
        """Return how many poses are not left out, shape (R,), of those marked in shape (R, J)."""
        return self.poses if rejected is None else np.asarray(self.poses - rejected.sum(axis=1))

    def output(self) -> Float:
        """Return the outputs of all poses, shape (R, J, 3), output units."""
        return np.concatenate([block for _, block in self.blocks()], axis=1)

    def take(self, index: Int) -> Sample:
        """Return the sensors at `index`."""
        numbers = index.tolist()
        parts = {
            name: None if (value := getattr(self, name)) is None else value[index]
            for name in ("count", "scatter", "cross", "reference", "temperature")
        }
        return replace(
            self,
            poses=self.poses[index],
            lower=self.lower[index],
            upper=self.upper[index],
            blocks=lambda: ((first, block[index]) for first, block in self.blocks()),
            doubtful=self.doubtful[index],
            labelled=self.labelled[index],
            in_time=self.in_time[index],
            readings=lambda at: self.readings(numbers[at]),
            where=lambda at, pose: self.where(numbers[at], pose),
            **parts,
        )

    def alone(self, at: int) -> Sample:
        """Return the sensor number `at` by itself, without repetitions of its last pose."""
        one, poses = self.take(np.array([at])), int(self.poses[at])

        def cut(values: Float | None) -> Float | None:
            return None if values is None else values[:, :poses]

        return replace(
            one,
            blocks=lambda: ((first, block[:, : poses - first]) for first, block in one.blocks()),
            count=cut(one.count),
            scatter=cut(one.scatter),
            cross=cut(one.cross),
            reference=cut(one.reference),
            temperature=cut(one.temperature),
        )

    def with_output(self, output: Float) -> Sample:
        """Return the same poses with other outputs, shape (R, J, 3)."""
        lower, upper = output.min(axis=1), output.max(axis=1)
        return replace(self, lower=lower, upper=upper, blocks=lambda: iter([(0, output)]))

    def counts(self, choice: Weights) -> Float | None:
        """Return weights by the number of raw readings behind each pose, or None for all alike; see `normalised`.

        For choices other than `n` the poses count alike.
        """
        real = self.real(0, int(self.poses.max()))
        if choice != "n" or self.count is None:
            return None if real.all() else real.astype(float)
        return self.normalised(self.count)

    def normalised(self, weights: Float) -> Float:
        """Return weights, shape (R, J), with mean 1 per sensor and 0 for repetitions; NaN where one is not known."""
        weights = np.where(self.real(0, weights.shape[1]), weights, 0.0)
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

    def faults(self, choice: Weights) -> list[str]:
        """Return why each sensor cannot be calibrated with these weights, in a sentence, or nothing."""
        words = [""] * len(self)
        for at in np.flatnonzero(self.without_weights(choice)).tolist():
            words[at] = f"--weights {choice} needs {NEEDS[choice]}"
        for at in np.flatnonzero(~(self.upper > self.lower).any(axis=1)).tolist():
            poses = int(self.poses[at])
            words[at] = (
                f"nothing to calibrate: {'only one pose' if poses == 1 else f'all {poses} poses are equal'}"
            )
        return words

    def errors(self, K: Float, D: Float, g: float) -> Iterator[tuple[int, Float, Float]]:
        """Yield (first pose, e, f) block by block: e = (g^2 - |f|^2) / 2g and f, m/s^2, shapes (R, B) and (R, B, 3).

        K, shape (R, 3, 3), and D, shape (R, 3), are those of the sensors.
        """
        K_A = np.linalg.inv(K)
        for first, block in self.blocks():
            # Columns of contiguous memory: ten times as fast as rows of three for many poses.
            f = K_A @ np.subtract(block.swapaxes(1, 2), D[..., None], order="C")
            yield first, (g * g - np.einsum("rij,rij->rj", f, f)) / (2.0 * g), f.swapaxes(1, 2)

    def noise(self, K: Float, D: Float, g: float, weights: Float | None) -> Float:
        """Return a robust standard deviation of sqrt(w) e, m/s^2, shape (R,): 1.4826 times the median absolute value.

        Poses with weight 0 do not count.
        """
        poses = int(self.poses.max())
        stride = max(1, poses // SCALE_SAMPLE)
        sizes = []
        for first, e, _ in self.errors(K, D, g):
            part = slice((-first) % stride, None, stride)
            root = np.ones_like(e) if weights is None else np.sqrt(weights[:, first : first + e.shape[1]])
            sizes.append(np.where(root > 0, np.abs(root * e), np.nan)[:, part])
        size = np.concatenate(sizes, axis=1)
        counted = np.count_nonzero(~np.isnan(size), axis=1) * (poses / size.shape[1])
        # Nine parameters follow the smallest residuals: the factor gives the scale back what they took.
        freedom = np.maximum(1.0, counted - 9.0) / counted
        return np.asarray(NORMAL_MAD * np.nanmedian(size, axis=1) / np.sqrt(freedom))

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


def length_error(e: Float, g: float) -> Float:
    """Return |f| - g in m/s^2 from e = (g^2 - |f|^2) / 2g, same shape."""
    return np.asarray(np.sqrt(np.maximum(g * g - 2.0 * g * e, 0.0)) - g)


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
