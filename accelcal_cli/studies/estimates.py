"""How far estimates are from the truth, and when a run has come to the least cost."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.lotters import pack
from accelcal_cli.sensor.model import triangular
from accelcal_cli.sensor.units import ARCSEC, MICRO_G, PPM
from accelcal_cli.streams import Float
from accelcal_cli.studies.scene import Scene

WITHIN = 0.01
"""A run has reached the least cost when it is at most this part above it."""

ERRORS = ("bias_error", "scale_error", "misalignment_error")

MATRIX = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")


def limit(least: Float, tolerance: float) -> Float:
    """Return the cost at or below which a run has succeeded, same shape as the least cost."""
    highest: Float = np.maximum(least + tolerance, (1.0 + WITHIN) * least)
    return highest


def errors(K: Float, D: Float, scene: Scene, noise: float) -> dict[str, Float]:
    """Return the errors of estimates in gauge `lower` against the truth, each of shape (R,), rms over the axes.

    Definition:
        bias_error: (D_i - truth) / K_ii over g. Units: micro-g. scale_error: K_ii / truth - 1. Units: ppm.
        misalignment_error: K_ij / K_ii less the true one, i > j. Units: arcsec.
        efficiency: sqrt(p^T J^T J p / 9) / noise with p the errors of the nine parameters in m/s^2: 1 for an
        estimator that is as good as the Cramer-Rao bound allows. Units: 1; left out without noise.

    Args:
        K: shape (R, 3, 3); D: shape (R, 3).
        scene: truth and information.
        noise: one sigma of a reading and axis, m/s^2.
    """
    true_K, true_D, g = scene.truth.K, scene.truth.D, scene.problem.g
    axis = np.arange(3)
    scale = K[:, axis, axis] / true_K[:, axis, axis] - 1.0
    turned = _angles(K) - _angles(true_K)
    bias = (D - true_D) / true_K[:, axis, axis]
    found = dict(
        zip(ERRORS, (_rms(bias) / g * MICRO_G, _rms(scale) * PPM, _rms(turned) * ARCSEC), strict=True)
    )
    if noise > 0:
        usable = np.isfinite(K).all(axis=(1, 2)) & (K[:, axis, axis] != 0).all(axis=1)
        E = np.linalg.solve(np.where(usable[:, None, None], K, np.nan_to_num(true_K)), true_K) - np.eye(3)
        p = np.concatenate([g * pack(E, bias, 9)[:, :6], bias], axis=1)
        square = np.einsum("rp,rpq,rq->r", p, scene.information, p) / 9.0
        found["efficiency"] = np.where(usable, np.sqrt(square) / noise, np.nan)
    return found


def _angles(K: Float) -> Float:
    return K[:, [1, 2, 2], [0, 0, 1]] / K[:, [1, 2, 2], [1, 2, 2]]


def _rms(values: Float) -> Float:
    root: Float = np.sqrt(np.mean(values**2, axis=1))
    return root


def in_lower(K: Float) -> Float:
    """Return K in gauge `lower`, shape (R, 3, 3), for any K, a search's failure included: NaN where it is no number."""
    finite = np.asarray(np.isfinite(K).all(axis=(1, 2)))[:, None, None]
    return np.where(finite, triangular(np.where(finite, K, np.eye(3))), np.nan)
