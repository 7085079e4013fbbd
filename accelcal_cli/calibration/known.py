"""Known attitudes: all twelve parameters by linear least squares.

    N_j = K_a f_j + D_a + K_a n_j            [dpso2014] eq. 10

With the specific force f_j of every pose known, each row of [K_a D_a] follows from the rows [f_j 1] alone. In the body
frame the errors of the estimate are X = (F^T F)^-1 F^T n, with covariance s^2 (F^T F)^-1 for each of the three axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.quality import RANK_TOLERANCE
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.streams import Float


@dataclass(frozen=True)
class Linear:
    """A linear fit.

    Attributes:
        model: the sensor, all twelve parameters.
        cofactor: (F^T W F)^-1, its pseudo-inverse below rank 4, of g times K_a's columns and of the bias, as force:
            shape (4, 4).
        error: K_a^-1 (N - K_a f - D_a), m/s^2, shape (J, 3).
        leverage: shape (J,).
        rank: of F.
        s: standard deviation of one axis, m/s^2; freedom: 3 J - 12.
    """

    model: ErrorModel
    cofactor: Float
    error: Float
    leverage: Float
    rank: int
    s: float
    freedom: int


def fit(N: Float, f: Float, g: float, weights: Float | None) -> Linear:
    """Return the fit of outputs N to specific forces f in m/s^2, both shape (J, 3), with weights (J,) or None."""
    F = np.concatenate([f / g, np.ones((len(f), 1))], axis=1)
    root = np.ones(len(f)) if weights is None else np.sqrt(weights)
    values, vectors = np.linalg.eigh((F * root[:, None]).T @ (F * root[:, None]))
    known = values > RANK_TOLERANCE * values[-1]
    inverse = np.where(known, 1.0 / np.where(known, values, 1.0), 0.0)
    cofactor = (vectors * inverse) @ vectors.T
    middle = N.mean(axis=0)  # keeps the digits that a large offset would eat
    theta = cofactor @ (F * (root**2)[:, None]).T @ (N - middle)
    K, D = theta[:3].T / g, theta[3] + middle
    if not known.all() or np.linalg.matrix_rank(K) < 3:
        return Linear(
            ErrorModel(K, D), cofactor, np.full_like(f, np.nan), np.ones(len(f)), int(known.sum()), np.nan, 0
        )
    error = np.linalg.solve(K, (N - f @ K.T - D).T).T
    freedom = 3 * len(f) - 12
    square = float(np.sum((root[:, None] * error) ** 2))
    leverage = root**2 * np.einsum("ji,ik,jk->j", F, cofactor, F)
    s = float(np.sqrt(square / freedom)) if freedom > 0 else float("nan")
    return Linear(ErrorModel(K, D), cofactor, error, np.minimum(leverage, 1.0), 4, s, freedom)
