"""What is said of one calibration: its verdict, the poses that would mend it, what a user should know."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration import quality
from accelcal_cli.calibration.nominal import Start
from accelcal_cli.calibration.quality import Observability
from accelcal_cli.calibration.search import Solution, lower_problem, model_at
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.verdict import FEWEST_POSES, edge_names, final_verdict, reasons_of
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import describe, faces
from accelcal_cli.streams import Bool, Float

COMFORTABLE = 5.0
"""Suggested poses bring every dilution of precision to this: half of what counts as weak."""

MOST_SUGGESTIONS = 8


@dataclass(frozen=True, eq=False)
class Judgement:
    """What is said of a solution.

    Attributes:
        verdict: good, weak or undetermined.
        reasons: why it is not good, in sentences; suggestions: poses that would mend it, in words.
        information: J^T J that the words rest on, shape (9, 9).
        dop: dilution of precision of the nine parameters by it, shape (9,).
        sight: the sensor that the directions of the poses are seen with, gauge `lower`.
        at_wall: the search stopped at a wall of its box: what it found is not the least-squares answer.
    """

    verdict: str
    reasons: tuple[str, ...]
    suggestions: tuple[str, ...]
    information: Float
    dop: Float
    sight: ErrorModel
    at_wall: bool


def judge(
    solution: Solution,
    start: Start,
    information: Float,
    low: ErrorModel,
    poses: int,
    freedom: int,
    held: Bool | None = None,
) -> Judgement:
    """Return the judgement of a solution.

    Args:
        solution: what was found from `start`.
        information: J^T J of the nine parameters, shape (9, 9).
        low: the sensor found, gauge `lower`.
        poses: J; freedom: J less the parameters.
        held: which of the nine are not estimated, shape (9,).
    """
    seen = Observability.of(information, poses, held)
    said, first, sight = _first_sight(solution, start, information, seen, low, poses, held)
    suggestions = _suggest(said, first, poses, held)
    edge = edge_names(solution.x[0])
    verdict = final_verdict(seen.verdict, bool(edge), freedom)
    return Judgement(
        verdict,
        reasons_of(first, suggestions, edge, freedom, 9 if held is None else 9 - int(held.sum())),
        suggestions,
        said,
        first.dop,
        sight,
        bool(edge),
    )


def _first_sight(
    solution: Solution,
    start: Start,
    information: Float,
    seen: Observability,
    low: ErrorModel,
    poses: int,
    held: Bool | None,
) -> tuple[Float, Observability, ErrorModel]:
    """Return the information, the observability and the sensor that the verdict is explained with.

    Readings that fix no ellipsoid let noise choose the undetermined parameters, and the others with them: the
    nearest sphere then sees the attitudes better than the fit does.
    """
    if start.source != "sphere":
        return information, seen, low
    sphere = model_at(solution.problem, np.zeros_like(solution.x))
    nine, point = lower_problem(solution.stated, sphere)
    said = quality.information(nine, point)[0]
    first = Observability.of(said, poses, held)
    return (said, first, sphere) if first.verdict == "undetermined" else (information, seen, low)


def _suggest(information: Float, seen: Observability, poses: int, held: Bool | None) -> tuple[str, ...]:
    if seen.verdict == "good":
        return ()
    from accelcal_cli.calibration.planner import fixture_directions, next_poses

    candidates = fixture_directions() if held is None else faces()
    known = information if held is None else quality.knowing(information, held)
    chosen = next_poses(known, candidates, MOST_SUGGESTIONS, COMFORTABLE, FEWEST_POSES - poses)
    return tuple(dict.fromkeys(describe(candidates[i]) for i in chosen))


def notes(solution: Solution, start: Start, settings: Settings) -> tuple[str, ...]:
    """Return what a user should know of the search, in sentences."""
    lines = []
    if start.source == "sphere":
        lines.append("The readings fix no ellipsoid; the search started from the nearest sphere.")
    if not np.isfinite(solution.search.cost).any():
        lines.append(f"The {settings.optimizer} search failed; the result is the polished nominal sensor.")
    return tuple(lines)
