"""Repeated readings of a labelled pose, averaged as they stream by."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.errors import DataError
from accelcal_cli.streams import Float

MOST_LABELS = 1_000_000
Label = TypeVar("Label", bound=Hashable)


class LabelledMeans(Generic[Label]):
    """Weighted mean and scatter of the rows of each label (Welford's update, a block at a time).

    A row may itself be a mean of `weight` raw readings with standard deviation `spread`; its raw readings
    then count as if they had been rows. Memory grows with the labels, never with the rows.
    """

    def __init__(self, source: str, width: int, most: int | None = None) -> None:
        """Average rows of `width` numbers; the first three are the sensor output."""
        self.source = source
        self.most = MOST_LABELS if most is None else most
        self.index: dict[Label, int] = {}
        self.rows = np.zeros(0)  # (J,) table rows of each label
        self.weight = np.zeros(0)  # (J,) raw readings of each label
        self.mean = np.zeros((0, width))  # (J, width)
        self.square = np.zeros((0, 3))  # (J, 3) weighted sum of squares about the mean
        self.spread = np.zeros((0, 3))  # (J, 3) spread stated by the label's last row
        self.weighted = False
        self.spreads = False

    def add(
        self,
        labels: Sequence[Label],
        rows: Float,
        weight: Float | None = None,
        spread: Float | None = None,
    ) -> None:
        """Add rows (B, width), with weights (B,) and standard deviations (B, 3) in sensor units if known."""
        index = self.index
        codes = np.fromiter((index.setdefault(label, len(index)) for label in labels), np.intp, len(labels))
        self._grow(len(index))
        self.weighted, self.spreads = weight is not None, spread is not None
        weight = np.ones(len(rows)) if weight is None else weight
        self.rows += np.bincount(codes, minlength=len(index))
        self._merge(codes, rows, weight)
        if spread is not None:
            self.spread[codes] = spread
            inner = np.where(weight[:, None] > 1, spread**2 * (weight[:, None] - 1), 0.0)
            np.add.at(self.square, codes, inner)

    def _merge(self, codes: NDArray[np.intp], rows: Float, weight: Float) -> None:
        origin = rows[0]  # sums of differences keep the digits that a large offset would eat
        shifted = rows - origin
        fresh = _sums(codes, weight, len(self.weight))
        seen = fresh > 0
        total = self.weight + fresh
        share = np.divide(fresh, total, out=np.zeros_like(total), where=seen)
        for k in range(rows.shape[1]):
            mean = np.divide(
                _sums(codes, weight * shifted[:, k], len(fresh)), fresh, out=np.zeros_like(fresh), where=seen
            )
            step = np.where(seen, origin[k] + mean - self.mean[:, k], 0.0)
            if k < 3:
                inner = _sums(codes, weight * (shifted[:, k] - mean[codes]) ** 2, len(fresh))
                self.square[:, k] += inner + step**2 * self.weight * share
            self.mean[:, k] += step * share
        self.weight = total

    def _grow(self, size: int) -> None:
        if size > self.most:
            raise DataError(f"{self.source}: more than {self.most:,} different position labels")
        more = size - len(self.rows)
        if more:
            self.rows, self.weight = (np.append(old, np.zeros(more)) for old in (self.rows, self.weight))
            self.mean, self.square, self.spread = (
                np.vstack([old, np.zeros((more, old.shape[1]))])
                for old in (self.mean, self.square, self.spread)
            )

    @property
    def repeated(self) -> bool:
        """Whether any label came more than once."""
        return bool((self.rows > 1).any())

    def count(self) -> Float | None:
        """Raw readings of each label (J,); None where rows are single or means of an unknown number."""
        return self.weight if self.weighted or (self.repeated and not self.spreads) else None

    def scatter(self) -> Float | None:
        """Standard deviation of a single raw reading (J, 3) in sensor units; nan where nothing tells it."""
        if not (self.spreads or self.repeated):
            return None
        freedom = (self.weight if self.spreads else self.rows)[:, None] - 1
        single = np.full_like(self.spread, np.nan) if not self.spreads else self.spread
        pooled = np.sqrt(np.divide(self.square, freedom, out=np.zeros_like(self.square), where=freedom > 0))
        return np.where(self.rows[:, None] > 1, pooled, single)


def _sums(codes: NDArray[np.intp], values: Float, size: int) -> Float:
    return np.bincount(codes, weights=values, minlength=size).astype(np.float64, copy=False)
