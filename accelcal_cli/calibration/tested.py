"""The tests of a verification: each parameter alone, all determined directions together, and what they come to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from accelcal_cli.calibration import chances
from accelcal_cli.calibration.chances import Noise, Pair
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.shift import Shift
from accelcal_cli.streams import Float

ROUNDING = 1e-9
"""Noise below this part of g is rounding: nothing is judged by less."""


@dataclass(frozen=True)
class Tests:
    """Ten questions to the difference of two estimates, and the answer to all of them.

    Attributes:
        pair: noise of both.
        covariance: of the difference, (m/s^2)^2, shape (9, 9).
        chi_square: of the determined directions; together: its chance when nothing changed.
        single: chance of each parameter alone, shape (9,).
        chance: of all of them together.
    """

    pair: Pair
    covariance: Float
    chi_square: float
    together: float
    single: Float
    chance: float

    @classmethod
    def of(cls, old: Calibration, found: Shift) -> Self:
        """Test what the new readings say against the old result; NaN is the chance where they determine nothing."""
        floor = (ROUNDING * old.g) ** 2
        a, b = old.s**2, found.noise.variance
        pair = Pair.of(Noise(max(a, floor), old.freedom), Noise(max(b, floor), found.noise.freedom))
        A, B, basis = old.covariance / old.s**2, found.cofactor, found.basis
        covariance = pair.a.variance * A + pair.b.variance * B
        d = basis.T @ found.value
        chi_square = float(d @ np.linalg.solve(basis.T @ covariance @ basis, d))
        together = pair.chance(d, basis.T @ A @ basis, basis.T @ B @ basis) if len(d) else float("nan")
        single = np.array([pair.chance(found.value[[p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)])
        chance = chances.combined(np.append(single[found.known], together))
        return cls(pair, covariance, chi_square, together, single, chance)
