"""Sensors that stand out from their fleet: parameters far from all others', or more noise than theirs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.chances import chi_square_chance, student_chance
from accelcal_cli.calibration.fleet import Fleet
from accelcal_cli.calibration.lotters import ROWS_COLUMNS
from accelcal_cli.calibration.quality import MISALIGNMENT, PARAMETERS
from accelcal_cli.calibration.residuals import NO_NOISE
from accelcal_cli.calibration.robust import NORMAL_MAD
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
    """One quantity of every sensor.

    Attributes:
        name, unit, format: as it is shown; values: shape (R,).
        gain: its error over the noise of a pose in m/s^2, shape (R,); None where the poses do not decide it.
    """

    name: str
    unit: str
    format: str
    values: Float
    gain: Float | None = None


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
    per_unit = f"units per {'g' if g == 1.0 else 'm/s^2'}"
    K, dop = fleet.lower, fleet.dop / g
    scale = np.einsum("rii->ri", K)
    mrad, micro_g = units.MRAD, units.MICRO_G
    return [
        *(
            Quantity(f"scale factor {a}", per_unit, ".7g", scale[:, i], scale[:, i] * dop[:, i])
            for i, a in enumerate("xyz")
        ),
        *(
            Quantity(name, "mrad", ".3f", K[:, i, j] / scale[:, i] * mrad, dop[:, p] * mrad)
            for p, name, (i, j) in zip((3, 4, 5), PARAMETERS[MISALIGNMENT], ROWS_COLUMNS[3:6], strict=True)
        ),
        *(
            Quantity(f"bias {a}", "micro-g", ",.1f", bias * micro_g, dop[:, 6 + i] * micro_g)
            for i, (a, bias) in enumerate(zip("xyz", (fleet.D_a / scale / g).T, strict=True))
        ),
    ]


def noise(fleet: Fleet, g: float) -> Quantity:
    """Return the noise of a pose of each sensor."""
    return Quantity("noise of a pose, s", "g" if g == 1.0 else "m/s^2", ".3g", fleet.s)


def standouts(fleet: Fleet, g: float) -> list[Standout]:
    """Return the sensors that stand out from those whose verdict is good or weak, farthest first, the noisy ones last.

    Parameters by their distance from the median over 1.4826 times the median absolute deviation, under Student's
    distribution; s by chi-square against the noise that the fleet shares. A sensor whose poses tell less of a parameter
    than most others' do may be farther off.
    """
    known = np.flatnonzero(fleet.determined)
    if len(known) < FEWEST:
        return []
    quantities = parameters(fleet, g)
    tests = len(known) * (len(quantities) + 1)
    found = []
    pose = np.fmax(
        fleet.s[known], np.sqrt(_shared_variance(fleet))
    )  # few poses estimate it too small at times
    for quantity in quantities:
        values = quantity.values[known]
        middle = float(np.median(values))
        spread = NORMAL_MAD * float(np.median(np.abs(values - middle)))
        if spread <= 1e-9 * float(np.abs(values).max()):
            continue  # all alike, but for rounding
        own = 0.0 if quantity.gain is None else (pose * quantity.gain[known]) ** 2
        z = (values - middle) / np.sqrt(spread**2 + np.maximum(own - np.median(own), 0.0))
        far = np.flatnonzero(np.abs(z) > 3.0)
        freedom = np.full(len(far), min(MOST_FREEDOM, int(EFFICIENCY * len(known))))
        far = far[student_chance(np.abs(z[far]), freedom) * tests < LEVEL]
        found += [Standout(int(known[k]), quantity, float(values[k]), middle, float(z[k])) for k in far]
    found.sort(key=lambda one: -abs(one.z or 0.0))
    return found + _noisy(fleet, g, tests)


def _shared_variance(fleet: Fleet) -> float:
    """Return the variance of a pose that the sensors share, (m/s^2)^2, by the median; 0 of too few sensors."""
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    if len(known) < FEWEST:
        return 0.0
    # The median of chi-square with n degrees of freedom is n (1 - 2 / 9n)^3.
    middle = (1.0 - 2.0 / (9.0 * (fleet.poses[known] - 9))) ** 3
    return float(np.median(fleet.s[known] ** 2 / middle))


def _noisy(fleet: Fleet, g: float, tests: int) -> list[Standout]:
    """Return the sensors whose s is beyond chance above what the fleet shares, worst first."""
    shared = _shared_variance(fleet)
    if shared <= (NO_NOISE * g) ** 2:
        return []
    known = np.flatnonzero(fleet.determined & (fleet.s > 0))
    freedom = fleet.poses[known] - 9
    x = freedom * fleet.s[known] ** 2 / shared
    far = np.flatnonzero(x > freedom + 3.0 * np.sqrt(2.0 * freedom))
    far = far[chi_square_chance(x[far], freedom[far]) * tests < LEVEL]
    far = known[far[np.argsort(-x[far])]]
    quantity, middle = noise(fleet, g), float(np.sqrt(shared))
    return [Standout(int(at), quantity, float(fleet.s[at]), middle, None) for at in far]
