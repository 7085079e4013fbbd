"""From dilution of precision, the walls of the box and the count of poses to the verdict and its reasons."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration import quality
from accelcal_cli.calibration.quality import Observability, Verdict
from accelcal_cli.streams import Bool, Float

FEWEST_POSES = 12
"""Suggested poses bring a poor set to at least this many: nine fit exactly and say nothing of their noise."""

EDGE = 1e-6
"""A parameter within this part of a half-width from the wall of its box is at the edge."""


def at_edge(x: Float) -> Bool:
    """Return which unknowns are at a wall of the search box, shape (..., D), for points of the box, same shape.

    Where they are, the least cost lies outside the box. In gauge `full` the free rotation reaches the walls of
    the off-diagonals by itself, which says nothing.
    """
    edge: Bool = np.asarray(np.abs(x) >= 1.0 - EDGE)
    if x.shape[-1] == 12:
        edge[..., 3:9] = False
    return edge


def edge_names(x: Float) -> tuple[str, ...]:
    """Return the names of the unknowns of a point, shape (D,), that are at a wall of the box."""
    matrix = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")[: len(x) - 3]
    return tuple(n for n, at in zip((*matrix, "D_1", "D_2", "D_3"), at_edge(x), strict=True) if at)


def final_verdict(seen: Verdict, edge: bool, freedom: int) -> Verdict:
    """Return the verdict of the poses, lowered where the search or the count of poses does not bear it out."""
    if edge:
        return "undetermined"
    return "weak" if freedom == 0 and seen == "good" else seen


def reasons_of(
    seen: Observability,
    suggestions: tuple[str, ...],
    edge: tuple[str, ...],
    freedom: int,
    parameters: int = 9,
) -> tuple[str, ...]:
    """Return why a verdict is not good, in sentences; freedom is the number of poses less that of parameters."""
    number = {6: "six", 9: "nine"}[parameters]
    lines = list(quality.in_words(seen, suggestions))
    if freedom < 0:
        lines.insert(
            0,
            f"{parameters + freedom} poses are fewer than the {number} parameters; take at least {FEWEST_POSES}.",
        )
    if freedom == 0:
        lines.append(
            f"{number.capitalize()} poses leave nothing to judge their noise by: no sigma. "
            f"Take at least {FEWEST_POSES}."
        )
    if edge and seen.verdict != "undetermined":  # of poses that leave a valley, the wall only ends it
        lines.append(
            f"The least cost lies outside the search box, beyond {', '.join(edge)}: "
            "widen the box or state the nominal sensor (--config, keys box and nominal)."
        )
    return tuple(lines)
