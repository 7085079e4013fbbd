"""A plan as tables and as a record: how to hold the sensor, and the sigma to expect."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.observability import PARAMETERS, UNDETERMINED
from accelcal_cli.planning import Plan
from accelcal_cli.schema import to_mapping
from accelcal_cli.sensor.poses import AXES, describe
from accelcal_cli.views.blocks import BLANK, Block, Column, Conclusion, Table
from accelcal_cli.views.calibration import KINDS

SHORT = {"scale": "scale", "misalignment": "misal.", "bias": "bias"}
"""Headings of the kinds, short enough for all of them to stand side by side."""

ALIGNED_NOTE = "Planned for scale factors and biases alone, as the poses so far were calibrated."

SO_FAR = ("verdict", "reasons", "warnings")
"""What a plan says of the calibration so far, as `calibrate` does."""


def pose_table(plan: Plan) -> Table:
    """Return one row per pose: how to hold the sensor, and the worst of each kind expected after it."""
    rows = [_pose_row(plan, k) for k in range(len(plan.stages))]
    columns = (
        Column("pose", format="d"),
        Column("hold"),
        *(Column(axis, format=".3f") for axis in "xyz"),
        *(Column(f"DOP {SHORT[kind]}", format=".3f", key=f"dop_{kind}") for kind, *_ in KINDS),
        *(Column(f"sigma {SHORT[kind]}", unit, ".3g", f"sigma_{kind}") for kind, _, unit, _ in KINDS),
    )
    notes = (
        "x, y, z: direction of the specific force (up) in the sensor's axes. DOP and sigma: the largest of each kind "
        "after the pose; a dash where the poses do not determine it.",
        *_notes(plan),
    )
    return Table("Poses to take next", columns, tuple(rows), notes).filled()


def _pose_row(plan: Plan, k: int) -> tuple[object, ...]:
    stage = plan.stages[k]
    direction = plan.directions[k - 1] if k else None
    hold = "so far" if direction is None else describe(direction)
    vector = (None, None, None) if direction is None else tuple((direction + 0.0).tolist())
    worst = [_finite(float(stage.dop[kind].max())) for _, kind, _, _ in KINDS]
    sigma = [_times(dop, plan.noise, size) for dop, (*_, size) in zip(worst, KINDS, strict=True)]
    return (plan.poses + k, hold, *vector, *worst, *sigma)


def parameter_table(plan: Plan) -> Table:
    """Return one row per parameter: its dilution of precision and sigma so far and after the last pose."""
    rows = []
    for _, kind, unit, size in KINDS:
        for p in range(kind.start, kind.stop):
            before, after = (_finite(float(stage.dop[p])) for stage in (plan.stages[0], plan.stages[-1]))
            sigma = (_times(before, plan.noise, size), _times(after, plan.noise, size))
            rows.append((PARAMETERS[p], before, after, *sigma, unit if plan.noise is not None else None))
    columns = (
        Column("parameter"),
        Column("DOP so far", format=".3f", key="dop_before"),
        Column("DOP after", format=".3f", key="dop_after"),
        Column("sigma so far", format=".3g", key="sigma_before"),
        Column("sigma after", format=".3g", key="sigma_after"),
        Column("unit"),
    )
    return Table(
        f"Expected after all {plan.poses + len(plan.directions)} poses", columns, tuple(rows)
    ).filled()


def record(plan: Plan) -> dict[str, object]:
    """Return a plan for programs: plain mappings, lists, numbers and text."""
    return to_mapping(
        {
            "verdict": plan.verdict,
            "noise": plan.noise,
            "so_far": plan.so_far and {key: getattr(plan.so_far, key) for key in SO_FAR},
            "dop_cubic": [_finite(dop) for dop in plan.cubic.tolist()],
            "poses": pose_table(plan).records(),
            "parameters": parameter_table(plan).records(),
        }
    )


def shown_poses(plan: Plan) -> Table:
    """Return one row per pose for people: how to hold the sensor, and the worst of each kind expected after it."""
    rows = []
    for k, stage in enumerate(plan.stages):
        worst = [_finite(float(stage.dop[kind].max())) for _, kind, _, _ in KINDS]
        sigma = [_times(dop, plan.noise, size) for dop, (*_, size) in zip(worst, KINDS, strict=True)]
        hold = describe(plan.directions[k - 1]) if k else "so far"
        rows.append((plan.poses + k, hold, *(worst if plan.noise is None else sigma)))
    what = "dilution of precision" if plan.noise is None else "sigma"
    columns = (
        Column("pose", format="d"),
        Column("hold"),
        *(Column(SHORT[kind], "" if plan.noise is None else unit, ".3g") for kind, _, unit, _ in KINDS),
    )
    note = f"Largest {what} of each kind after the pose; a dash where the poses do not determine it."
    return Table(
        f"Poses to take next, and the {what} after each", columns, tuple(rows), (note, *_notes(plan))
    ).filled()


def blocks(plan: Plan, verbose: bool = False) -> list[Block]:
    """Return what a plan shows: doubts about the poses so far, the poses to take, and what to expect of them.

    With `verbose` the directions as vectors, and what to expect of each parameter.
    """
    known, expected = plan.so_far, parameter_table(plan)
    doubts: list[Block] = []
    if known is not None and (known.warnings or plan.beyond_poses):
        doubts = [Conclusion(known.verdict, known.reasons, known.warnings, "Verdict so far"), BLANK]
    more = [expected] if len(expected.columns) > 1 else []  # poses that determine nothing promise nothing
    return [*doubts, *([pose_table(plan)] if verbose else [shown_poses(plan)]), *(more if verbose else [])]


def _notes(plan: Plan) -> tuple[str, ...]:
    if plan.beyond_poses:
        return (
            "More poses do not change the verdict on those so far; the plan only shows what they would add.",
        )
    if plan.verdict != "undetermined":
        aligned = plan.so_far is not None and plan.so_far.held.any()
        return (*((ALIGNED_NOTE,) if aligned else ()), _cubic_note(plan))
    lost = plan.stages[-1].above(UNDETERMINED)
    named = ", ".join(lost) if 0 < len(lost) < len(PARAMETERS) else "all nine parameters"
    return (f"Still not determined after these poses: {named}. Plan more poses, or another fixture.",)


def _cubic_note(plan: Plan) -> str:
    """Return which axes show a cubic nonlinearity in these poses."""
    blind = [axis for axis, dop in zip(AXES, plan.cubic, strict=True) if not np.isfinite(dop)]
    if not blind:
        return f"Cubic nonlinearity shows in these poses (DOP up to {plan.cubic.max():.3g})."
    axes = "any axis" if len(blind) == 3 else f"axis {' and '.join(blind)}"
    return f"Cubic nonlinearity of {axes} does not show in these poses: it looks like a scale factor."


def _finite(value: float) -> float | None:
    """Return a dilution of precision; None where it is infinite, or 0 for a parameter that is not estimated."""
    return value if np.isfinite(value) and value > 0 else None


def _times(dop: float | None, noise: float | None, size: float) -> float | None:
    return None if dop is None or noise is None else dop * noise * size
