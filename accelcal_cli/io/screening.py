"""What makes readings doubtful before anything is fitted: logs, dead or duplicate axes, copied rows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int

RAW_ROWS = 500
"""From so many rows on, rows with a time each, or each much like the one before, are a raw log rather than poses."""

ALIKE, LOOKED_AT = 0.05, 4096
"""Poses differ from one to the next; most of the first LOOKED_AT rows of a log differ by less than this part of the
range."""

MANY_COPIES = 1 / 3
"""Part of the poses from which on copies are reported. One row that occurs twice does no harm, and readings without
noise repeat where an attitude does."""

PAIRS = ((0, 1), (0, 2), (1, 2))
"""Pairs of axes."""


def log_cautions(rows: int, first: Float, span: float, *, timed: bool) -> tuple[str, ...]:
    """Return a caution for rows that are taken for poses and may be a log: timed, or each much like the one before.

    Args:
        rows: how many; first: the first of them, shape (B, 3), LOOKED_AT at most.
        span: the largest range of an axis; timed: whether they have times.
    """
    if rows < RAW_ROWS or not (timed or np.median(np.abs(np.diff(first, axis=0)).max(axis=1)) < ALIKE * span):
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
    sentences = [
        f'Column "{name}" is {output[0, i]:g} in every pose: its axis is dead or was never turned.'
        for i, name in enumerate(names)
        if (output[:, i] == output[0, i]).all()
    ]
    sentences += [
        f'Columns "{names[i]}" and "{names[j]}" are equal in every pose: they show one axis.'
        for i, j in PAIRS
        if (output[:, i] == output[:, j]).all()
    ]
    copies = len(output) - len({row.tobytes() for row in output})
    if copies >= MANY_COPIES * len(output):
        sentences.append(
            f"{copies:,} of {len(output):,} poses repeat another to the last digit. Sigma counts them as independent "
            "measurements: leave copies out."
        )
    return sentences


def may_be_doubtful(output: Float, poses: Int) -> Bool:
    """Return which of R sensors to ask `doubts` about, shape (R,): all of those of which it has something to say.

    Args:
        output: their poses, shape (R, J, 3), whatever follows the last; poses: of each, shape (R,).
    """
    real = np.arange(output.shape[1]) < poses[:, None]
    dead = ((output == output[:, :1]) | ~real[..., None]).all(axis=1).any(axis=1)
    axes = np.moveaxis(output, 2, 0)
    equal = [((axes[i] == axes[j]) | ~real).all(axis=1) for i, j in PAIRS]
    x, y, z = axes
    # Mixed into one number, rows that are equal stay equal; NaN comes last.
    mixed = np.sort(np.where(real, x + np.pi * y + np.e * z, np.nan), axis=1)
    copies = (mixed[:, 1:] == mixed[:, :-1]).sum(axis=1)
    doubtful: Bool = (
        dead | np.logical_or.reduce(equal) | (copies >= MANY_COPIES * np.minimum(poses, LOOKED_AT))
    )
    return doubtful
