"""Engineering units of the error parameters, and of readings."""

from __future__ import annotations

import math

import numpy as np

from accelcal_cli.errors import DataError
from accelcal_cli.streams import Float

STANDARD_GRAVITY = 9.80665
"""m/s^2, the conventional value of 1 g (CGPM 1901)."""

PPM = 1e6
MRAD = 1e3
ARCSEC = 180 * 3600 / math.pi
"""Arc seconds in a radian."""
MICRO_G = 1e6

OUTPUT_OF_1_G = {"g": 1.0, "mg": 1000.0, "m/s^2": STANDARD_GRAVITY, "m/s2": STANDARD_GRAVITY}
"""By the name of the unit. A sensor that gives its output in one of them has no bias to speak of, unlike raw counts."""

AWAY = 2.0
"""At rest a sensor reads 1 g within this factor, whatever its errors, or its unit is another one."""


def _reads_1_g(length: float, unit: str) -> bool:
    return OUTPUT_OF_1_G[unit] / AWAY <= length <= OUTPUT_OF_1_G[unit] * AWAY


def check_unit(output: Float, unit: str) -> None:
    """Raise DataError when an output at rest, shape (3,), less its bias, cannot be 1 g in the unit of that name."""
    length = float(np.linalg.norm(output))
    if _reads_1_g(length, unit):
        return
    other = next((name for name in OUTPUT_OF_1_G if _reads_1_g(length, name)), None)
    low, high = OUTPUT_OF_1_G[unit] / AWAY, OUTPUT_OF_1_G[unit] * AWAY
    raise DataError(
        f"the first pose reads {', '.join(f'{v:.6g}' for v in output)}, length {length:.4g}; expected {low:.4g} to "
        f"{high:.4g}, about 1 g with --unit {unit}; "
        + (f"state --unit {other}" if other else "are --unit and --columns right?")
    )


def scale_error(K: Float, nominal: Float) -> Float:
    """Return the scale-factor errors, shape (3,). Definition: (K_ii - nominal) / nominal. Units: 1."""
    return np.asarray(np.diagonal(K) / nominal - 1.0)


def misalignment(K: Float) -> Float:
    """Return the misalignment angles, shape (3, 3), zero diagonal.

    Definition: K_ij / K_ii, for small angles the turn of sensor axis i towards body axis j. Units: rad.
    """
    angles = K / np.diagonal(K)[:, None]
    np.fill_diagonal(angles, 0.0)
    return angles


def bias_force(K: Float, D: Float) -> Float:
    """Return the bias as specific force along each sensor axis, shape (3,).

    Definition: D_i / K_ii. Units: m/s^2 (units of g when K is per g).
    """
    return np.asarray(D / np.diagonal(K))
