"""Roll and pitch of a body at rest from its calibrated specific force, and their one-sigma.

At rest the specific force points up. With x forward, y to the left and z up a level body has f = (0, 0, g), and

    roll = atan2(f_y, f_z),   pitch = atan2(-f_x, sqrt(f_y^2 + f_z^2)).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.sigma import gauge_chain
from accelcal_cli.errors import UsageError
from accelcal_cli.streams import Float


@dataclass(frozen=True)
class Tilt:
    """What a result says of the tilt.

    Attributes:
        moves: change of f, m/s^2, for a unit of each of n parameters and of f (4th: 1): shape (n, 3, 4).
        root: a root of their covariance, shape (n, m): covariance = root root^T.
        noise: one-sigma of a reading, m/s^2.
    """

    moves: Float
    root: Float
    noise: float

    @classmethod
    def of(cls, result: Calibration, noise: float = 0.0) -> Tilt:
        """Return the tilt of a result.

        Raises:
            UsageError: gauge `full` without known attitudes leaves the body frame open.
        """
        if result.gauge != "full":
            return cls(*_nine(result), noise)
        if not np.isfinite(result.sigma.K_a).all():
            raise UsageError(
                "--tilt: gauge full leaves the body frame open; calibrate in gauge lower or symmetric"
            )
        return cls(*_twelve(result), noise)

    def columns(self, f: Float) -> Float:
        """Return roll, pitch and their one-sigma in degrees, shape (B, 4), of forces f in m/s^2, shape (B, 3)."""
        x, y, z = f.T
        flat = y * y + z * z
        level, square = np.sqrt(flat), flat + x * x
        zero = np.zeros_like(x)
        with np.errstate(divide="ignore", invalid="ignore"):
            roll = np.stack([zero, z, -y], axis=1) / flat[:, None]
            pitch = np.stack([-level, x * y / level, x * z / level], axis=1) / square[:, None]
            spread = [self._sigma(direction, f) for direction in (roll, pitch)]
        angles: Float = np.stack([np.arctan2(y, z), np.arctan2(-x, level), *spread], axis=1)
        return np.rad2deg(angles)

    def _sigma(self, direction: Float, f: Float) -> Float:
        """Return the one-sigma, rad, of an angle with gradient `direction`, shape (B, 3)."""
        ones = np.concatenate([f, np.ones((len(f), 1))], axis=1)
        products = (direction[:, :, None] * ones[:, None, :]).reshape(len(f), 12)
        parts = products @ (self.moves.reshape(-1, 12).T @ self.root)
        noise = self.noise**2 * np.einsum("bi,bi->b", direction, direction)
        sigma: Float = np.sqrt(np.einsum("bm,bm->b", parts, parts) + noise)
        return sigma


def _nine(result: Calibration) -> tuple[Float, Float]:
    """Return moves and root of the nine parameters: f = K_A (N - D_a), so df = -K_A (dK_a f + dD_a)."""
    lower = result.model.in_gauge("lower").K
    chain = gauge_chain(result.K_a, lower, result.gauge, result.g)
    moves = np.zeros((9, 3, 4))
    moves[:6, :, :3] = -result.model.K_A @ chain.T.reshape(6, 3, 3)
    for i in range(3):
        moves[6 + i, :, 3] = -result.model.K_A[:, i] * lower[i, i]
    if not np.isfinite(result.covariance).all():
        return moves, np.full((9, 9), np.nan)
    values, vectors = np.linalg.eigh(result.covariance)
    return moves, vectors * np.sqrt(np.maximum(values, 0.0))


def _twelve(result: Calibration) -> tuple[Float, Float]:
    """Return moves and root of K_a and D_a, entry by entry: known attitudes determine each of them."""
    moves = np.zeros((12, 3, 4))
    for p in range(12):
        i, j = divmod(p, 4)
        moves[p, :, j] = -result.model.K_A[:, i]
    sigma = np.concatenate([result.sigma.K_a, result.sigma.D_a[:, None]], axis=1)
    return moves, np.diag(sigma.ravel())
