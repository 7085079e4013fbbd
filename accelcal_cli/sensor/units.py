"""Engineering units of the error parameters."""

from __future__ import annotations

import math

import numpy as np

from accelcal_cli.streams import Float

STANDARD_GRAVITY = 9.80665
"""m/s^2, the conventional value of 1 g (CGPM 1901)."""

PPM = 1e6
MRAD = 1e3
ARCSEC = 180 * 3600 / math.pi
"""Arc seconds in a radian."""
MICRO_G = 1e6


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
