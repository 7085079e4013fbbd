"""What makes readings doubtful before anything is fitted: dead or doubled axes, rows copied to the last digit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

MANY_COPIES = 1 / 3
"""Part of the poses from which on copies are told of. One row that stands twice does no harm, and readings without
noise repeat where an attitude does."""


def doubts(output: Floats, names: Sequence[str]) -> list[str]:
    """Return what is doubtful about poses, in sentences.

    Args:
        output: of the poses, or of many of them, shape (J, 3), sensor units.
        names: of the three columns.
    """
    return [*_axes(output, names), *_copies(output)]


def _axes(output: Floats, names: Sequence[str]) -> list[str]:
    found = []
    for i, name in enumerate(names):
        if (output[:, i] == output[0, i]).all():
            found.append(
                f'Column "{name}" is {output[0, i]:g} in every pose: its axis is dead or was never turned.'
            )
    for i, j in ((0, 1), (0, 2), (1, 2)):
        if (output[:, i] == output[:, j]).all():
            found.append(
                f'Columns "{names[i]}" and "{names[j]}" are equal in every pose: they show one axis.'
            )
    return found


def _copies(output: Floats) -> list[str]:
    copies = len(output) - len({row.tobytes() for row in output})
    if copies < MANY_COPIES * len(output):
        return []
    return [
        f"{copies:,} of {len(output):,} poses repeat another to the last digit. Sigma takes them for measurements of "
        "their own: leave copies out."
    ]
