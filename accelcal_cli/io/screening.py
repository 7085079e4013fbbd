"""What makes readings doubtful before anything is fitted: logs, dead or doubled axes, rows copied to the last digit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int

RAW_ROWS = 500
"""Rows with a time each, or each much like the one before, from which on they are rather a raw log than poses."""

ALIKE, LOOKED_AT = 0.05, 4096
"""Poses are turned from one to the next; most of the first rows of a log differ by less than this part of the range."""

MANY_COPIES = 1 / 3
"""Part of the poses from which on copies are told of. One row that stands twice does no harm, and readings without
noise repeat where an attitude does."""


def log_cautions(rows: int, first: Float, span: float, *, timed: bool) -> tuple[str, ...]:
    """Return a caution of rows that are taken for poses and may be a log: timed, or each much like the one before.

    Args:
        rows: how many; first: the first of them, shape (B, 3), LOOKED_AT at most.
        span: the largest range of an axis; timed: whether they have times.
    """
    if rows < RAW_ROWS:
        return ()
    if not timed and np.median(np.abs(np.diff(first, axis=0)).max(axis=1)) >= ALIKE * span:
        return ()
    return (
        f"Each row is taken for a pose at rest. If these {rows:,} rows are a log with moves in it, find its poses with "
        "accelcal detect, or calibrate with --raw; of many readings of one pose, label the poses in a column.",
    )


def doubts(output: Float, names: Sequence[str]) -> list[str]:
    """Return what is doubtful about poses, in sentences.

    Args:
        output: of the poses, or of many of them, shape (J, 3), sensor units.
        names: of the three columns.
    """
    return [*_axes(output, names), *_copies(output)]


def may_be_doubtful(output: Float, poses: Int) -> Bool:
    """Return which of R sensors to ask `doubts` about, shape (R,): all of those of which it has something to say.

    Args:
        output: their poses, shape (R, J, 3), whatever stands after the last; poses: of each, shape (R,).
    """
    real = np.arange(output.shape[1]) < poses[:, None]
    dead = ((output == output[:, :1]) | ~real[..., None]).all(axis=1).any(axis=1)
    x, y, z = np.moveaxis(output, 2, 0)
    equal = [((a == b) | ~real).all(axis=1) for a, b in ((x, y), (x, z), (y, z))]
    mixed = np.sort(
        np.where(real, x + np.pi * y + np.e * z, np.nan), axis=1
    )  # equal where rows are, NaN last
    copies = (mixed[:, 1:] == mixed[:, :-1]).sum(axis=1)
    found: Bool = dead | np.logical_or.reduce(equal) | (copies >= MANY_COPIES * np.minimum(poses, LOOKED_AT))
    return found


def _axes(output: Float, names: Sequence[str]) -> list[str]:
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


def _copies(output: Float) -> list[str]:
    copies = len(output) - len({row.tobytes() for row in output})
    if copies < MANY_COPIES * len(output):
        return []
    return [
        f"{copies:,} of {len(output):,} poses repeat another to the last digit. Sigma takes them for measurements of "
        "their own: leave copies out."
    ]
