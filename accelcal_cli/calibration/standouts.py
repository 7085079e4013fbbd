"""Sensors that stand out from their fleet: parameters far from all others', or more noise than theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.chances import chi_square_chance, student_chance
from accelcal_cli.calibration.fleet import Fleet
from accelcal_cli.calibration.robust import NORMAL_MAD
from accelcal_cli.calibration.search import NO_NOISE
from accelcal_cli.sensor import units
from accelcal_cli.streams import Float

LEVEL = 0.01
"""Chance of naming a sensor where none stands out (Bonferroni over sensors and quantities)."""

FEWEST = 10
"""Sensors that make a fleet to stand out from."""

EFFICIENCY = 0.37
"""A median absolute deviation of R values is worth the standard deviation of so many times R."""

MOST_FREEDOM = 1000
"""From here on Student's distribution is the normal one to any digit that matters."""


@dataclass(frozen=True)
class Quantity:
    """One quantity of every sensor: its name, unit, format, and values of shape (R,)."""

    name: str
    unit: str
    format: str
    values: Float


@dataclass(frozen=True)
class Standout:
    """A sensor that stands out: its place in the fleet, the quantity, value and median, and robust z; None for s."""

    at: int
    quantity: Quantity
    value: float
    middle: float
    z: float | None


def parameters(fleet: Fleet, g: float) -> list[Quantity]:
    """Return the nine parameters as an engineer takes them, gauge `lower`: K_ii, K_ij / K_ii, D_i / K_ii."""
    unit = "g" if g == 1.0 else "m/s^2"
    K = fleet.lower
    scale = np.einsum("rii->ri", K)
    return [
        *(
            Quantity(f"scale factor {a}", f"units per {unit}", ".7g", scale[:, i])
            for i, a in enumerate("xyz")
        ),
        *(
            Quantity(
                f"misalignment {'xyz'[j]}{'xyz'[i]}", "mrad", ".3f", K[:, i, j] / scale[:, i] * units.MRAD
            )
            for i, j in ((1, 0), (2, 0), (2, 1))
        ),
        *(
            Quantity(f"bias {a}", "micro-g", ",.1f", fleet.D_a[:, i] / scale[:, i] / g * units.MICRO_G)
            for i, a in enumerate("xyz")
        ),
    ]


def noise(fleet: Fleet, g: float) -> Quantity:
    """Return the noise of a pose of each sensor."""
    return Quantity("noise of a pose, s", "g" if g == 1.0 else "m/s^2", ".3g", fleet.s)


def standouts(fleet: Fleet, g: float) -> list[Standout]:
    """Return the sensors that stand out from those whose verdict is good or weak, farthest first, the noisy ones last.

    Parameters by their distance from the median over 1.4826 times the median absolute deviation, under Student's
    distribution; s by chi-square against the noise that the fleet shares.
    """
    known = np.flatnonzero(fleet.determined)
    if len(known) < FEWEST:
        return []
    quantities = parameters(fleet, g)
    tests = len(known) * (len(quantities) + 1)
    found = []
    for quantity in quantities:
        values = quantity.values[known]
        middle = float(np.median(values))
        spread = NORMAL_MAD * float(np.median(np.abs(values - middle)))
        if spread <= 1e-9 * float(np.abs(values).max()):
            continue  # all alike, but for rounding
        z = (values - middle) / spread
        far = np.flatnonzero(np.abs(z) > 3.0)
        freedom = np.full(len(far), min(MOST_FREEDOM, int(EFFICIENCY * len(known))))
        far = far[student_chance(np.abs(z[far]), freedom) * tests < LEVEL]
        found += [Standout(int(known[k]), quantity, float(values[k]), middle, float(z[k])) for k in far]
    found.sort(key=lambda one: -abs(one.z or 0.0))
    return found + _noisy(fleet, g, tests)


def _noisy(fleet: Fleet, g: float, tests: int) -> list[Standout]:
    """Return the sensors whose s is beyond chance above what the fleet shares, worst first."""
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    if len(known) < FEWEST:
        return []
    freedom = fleet.poses[known] - 9
    # The median of chi-square with n degrees of freedom is n (1 - 2 / 9n)^3.
    square = fleet.s[known] ** 2
    shared = float(np.median(square / (1.0 - 2.0 / (9.0 * freedom)) ** 3))
    if shared <= (NO_NOISE * g) ** 2:
        return []
    x = freedom * square / shared
    far = np.flatnonzero(x > freedom + 3.0 * np.sqrt(2.0 * freedom))
    far = far[chi_square_chance(x[far], freedom[far]) * tests < LEVEL]
    far = far[np.argsort(-x[far])]
    s, quantity = np.sqrt(square), noise(fleet, g)
    return [Standout(int(known[k]), quantity, float(s[k]), float(np.sqrt(shared)), None) for k in far]
