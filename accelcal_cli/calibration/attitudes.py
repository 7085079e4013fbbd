"""Which poses of a log have the same attitude."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.streams import Float, Int


def directions_of(output: Float, model: ErrorModel) -> Float:
    """Return the unit directions of the specific force of outputs, both shape (J, 3)."""
    force = model.specific_force(output)
    unit: Float = force / np.maximum(np.linalg.norm(force, axis=1, keepdims=True), 1e-300)
    return unit


def attitudes(u: Float, n: NDArray[np.int64], angle: float) -> list[Int]:
    """Group directions: the longest pose that is left takes all within `angle`, until none is left.

    Args:
        u: unit directions, shape (J, 3); n: rows of each pose, shape (J,).
        angle: degrees.

    Returns:
        Indices of each group, its longest pose first.
    """
    left = np.argsort(-n, kind="stable")
    limit = np.cos(np.radians(angle))
    groups = []
    while len(left):
        near = u[left] @ u[left[0]] >= limit
        near[0] = True
        groups.append(left[near])
        left = left[~near]
    return groups
