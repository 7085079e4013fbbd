"""Test functions that are sums of squares: their residuals and Jacobians, for least-squares methods.

z has the shape (..., D), residuals (..., M), Jacobians (..., M, D).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.streams import Float
from accelcal_cli.studies.formulas import elliptic_weights


@dataclass(frozen=True)
class Squares:
    """Residuals r(z), whose squares sum to the function, and their Jacobian dr/dz."""

    residuals: Callable[[Float], Float]
    jacobian: Callable[[Float], Float]


def _diagonal(z: Float, weights: Float) -> Float:
    """Return a constant diagonal Jacobian for every point."""
    return np.broadcast_to(np.diag(weights), (*z.shape, z.shape[-1])).copy()


def _elliptic(z: Float) -> Float:
    root: Float = np.sqrt(elliptic_weights(z.shape[-1]))
    return root


def _valley(z: Float) -> Float:
    """Rosenbrock: r = 10 (z_{i+1} - z_i^2), then z_i - 1."""
    first = z[..., :-1]
    return np.concatenate([10.0 * (z[..., 1:] - first * first), first - 1.0], axis=-1)


def _valley_jacobian(z: Float) -> Float:
    D = z.shape[-1]
    rows = np.arange(D - 1)
    J = np.zeros((*z.shape[:-1], 2 * (D - 1), D))
    J[..., rows, rows] = -20.0 * z[..., :-1]
    J[..., rows, rows + 1] = 10.0
    J[..., D - 1 + rows, rows] = 1.0
    return J


def _zakharov(z: Float) -> Float:
    """Zakharov: r = z_i, then t and t^2 with t = sum i z_i / 2."""
    t = z @ _ramp(z)
    return np.concatenate([z, t[..., None], (t * t)[..., None]], axis=-1)


def _zakharov_jacobian(z: Float) -> Float:
    slope = _ramp(z)
    t = z @ slope
    last = np.broadcast_to(slope, z.shape)
    return np.concatenate(
        [_diagonal(z, np.ones(z.shape[-1])), last[..., None, :], (2.0 * t[..., None] * last)[..., None, :]],
        axis=-2,
    )


def _ramp(z: Float) -> Float:
    return 0.5 * np.arange(1.0, z.shape[-1] + 1.0)


SPHERE = Squares(lambda z: z, lambda z: _diagonal(z, np.ones(z.shape[-1])))
ELLIPTIC = Squares(lambda z: z * _elliptic(z), lambda z: _diagonal(z, _elliptic(z)))
ROSENBROCK = Squares(_valley, _valley_jacobian)
MODIFIED_ROSENBROCK = Squares(lambda z: _valley(-z), lambda z: -_valley_jacobian(-z))
ZAKHAROV = Squares(_zakharov, _zakharov_jacobian)
