"""Which poses to take next: the ones that shrink the worst dilution of precision most."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.quality import PRIOR, Observability, design
from accelcal_cli.sensor.poses import corners, edges, faces
from accelcal_cli.streams import Float


def fixture_directions() -> Float:
    """Return what can be held against a cube and its edges and corners: 26 directions, shape (26, 3)."""
    return np.concatenate([faces(), edges(), corners()])


def next_poses(
    information: Float, candidates: Float, count: int, enough: float = 0.0, least: int = 0
) -> list[int]:
    """Return the indices of up to `count` candidates, greedily chosen, best first.

    Args:
        information: J^T J of the poses so far, shape (9, 9); zeros when there are none.
        candidates: unit directions to choose from, shape (C, 3); one may be chosen again.
        count: how many to choose.
        enough: stop when the worst dilution of precision is at or below this, but not before `least` are chosen.

    Each choice minimises the largest variance after it; the variances after a candidate a follow from the
    rank-one update P - P a a^T P / (1 + a^T P a). Ties go to the smallest sum of variances.
    """
    rows = design(candidates)
    cofactor = np.linalg.inv(information + PRIOR * np.eye(9))
    chosen: list[int] = []
    while len(chosen) < count and (len(chosen) < least or np.diagonal(cofactor).max() > enough**2):
        gain = rows @ cofactor
        drop = gain**2 / (1.0 + np.einsum("cp,cp->c", gain, rows))[:, None]
        after = np.diagonal(cofactor) - drop
        # Rounding decides between equal candidates otherwise, and with it the machine.
        score = np.round(np.log(after.max(axis=1)), 9) + 1e-3 * np.log(after.sum(axis=1))
        best = int(np.argmin(np.round(score, 9)))
        chosen.append(best)
        cofactor = cofactor - np.outer(gain[best], gain[best]) / (1.0 + gain[best] @ rows[best])
    return chosen


def dop_after(information: Float, directions: Float) -> Observability:
    """Return the observability after taking the poses `directions`, shape (k, 3), too."""
    rows = design(directions)
    return Observability.of(information + rows.T @ rows, 9)
