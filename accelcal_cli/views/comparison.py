"""Several results side by side: what they are, their parameters, and differences from the first."""

from __future__ import annotations

import math
from collections.abc import Sequence

from accelcal_cli.calibration.observability import BIAS, MISALIGNMENT, PARAMETERS, SCALE
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError
from accelcal_cli.schema import frozen
from accelcal_cli.sensor import model as units
from accelcal_cli.verification.difference import absolute, difference
from accelcal_cli.views import quoted
from accelcal_cli.views.blocks import Column, Table
from accelcal_cli.views.report import dated, gravity

BEYOND = "differs"
"""Remark on a difference that is larger than the half-width of its 95 % interval."""


@frozen()
class Row:
    """One parameter of several results.

    Attributes:
        name, unit: of the parameter.
        values, intervals: of each result, with the half-widths of the 95 % intervals; NaN for none.
        cells: the same as people read them.
    """

    name: str
    unit: str
    values: tuple[float, ...]
    intervals: tuple[float, ...]
    cells: tuple[str, ...]


def check_alike(labels: Sequence[str], results: Sequence[Calibration]) -> None:
    """Raise UsageError for results whose forces have different units: they cannot stand side by side."""
    for label, result in zip(labels, results, strict=True):
        if result.unit != results[0].unit:
            raise UsageError(
                f"{label}: is in {result.unit}, and {labels[0]} in {results[0].unit}; expected results of one unit"
            )


def _kinds(result: Calibration) -> tuple[tuple[str, slice, str, float], ...]:
    """Return the kinds of parameters: name, which of the nine, unit and its size."""
    return (
        ("scale factor", SCALE, f"output units per {result.unit}", 1.0),
        ("misalignment", MISALIGNMENT, "mrad", units.MRAD),
        ("bias", BIAS, "micro-g", units.MICRO_G),
    )


def rows(results: Sequence[Calibration]) -> dict[str, list[Row]]:
    """Return the parameters that at least one result estimated, by their kind."""
    numbers = [absolute(result) for result in results]
    halves = [
        (math.nan if result.coverage_factor is None else result.coverage_factor) * sigma
        for result, (_, sigma) in zip(results, numbers, strict=True)
    ]
    kinds: dict[str, list[Row]] = {}
    for kind, part, unit, size in _kinds(results[0]):
        for p in range(9)[part]:
            if all(result.held[p] for result in results):
                continue
            values = tuple(float(one[0][p]) * size for one in numbers)
            intervals = tuple(float(half[p]) * size for half in halves)
            cells = tuple(_cell(results[k], p, values[k], intervals[k]) for k in range(len(results)))
            kinds.setdefault(kind, []).append(Row(PARAMETERS[p], unit, values, intervals, cells))
    return kinds


def _cell(result: Calibration, p: int, value: float, half: float) -> str:
    if result.held[p]:
        return "not estimated"
    return quoted.UNKNOWN if math.isnan(value) else _quoted(value, half)


def _quoted(value: float, half: float) -> str:
    shown, spread = quoted.quote(value, half)
    return f"{shown} {quoted.PLUS_MINUS} {spread}" if spread else shown


def overview(labels: Sequence[str], results: Sequence[Calibration]) -> Table:
    """Return what the results are: verdict, date, what was stated of them, fit."""
    unit = results[0].unit
    keys = dict.fromkeys(key for result in results for key in result.meta)
    lines: list[tuple[str, list[str]]] = [
        ("verdict", [result.verdict for result in results]),
        ("calculated", [dated(result) for result in results]),
        *((key, [result.meta.get(key, "") for result in results]) for key in keys),
        ("readings", [str(result.data.get("source", "-")) for result in results]),
        ("poses", [f"{result.poses:,}" for result in results]),
        ("degrees of freedom", [f"{max(result.freedom, 0):,}" for result in results]),
        (f"rms of |f| - g before [{unit}]", [f"{result.rms_before:.3g}" for result in results]),
        (f"rms of |f| - g after [{unit}]", [f"{result.rms:.3g}" for result in results]),
        (f"noise of one pose, s [{unit}]", [f"{r.s:.3g}" if r.freedom > 0 else "" for r in results]),
        ("coverage factor", [f"{r.coverage_factor:.3g}" if r.coverage_factor else "" for r in results]),
        ("local gravity", [gravity(result) for result in results]),
    ]
    columns = (Column("quantity"), *(Column(label) for label in labels))
    shown = tuple((name, *cells) for name, cells in lines if any(cells))
    return Table("Results", columns, shown)


def parameters(labels: Sequence[str], results: Sequence[Calibration]) -> Table:
    """Return the parameters of each result with their 95 % intervals."""
    lines = tuple((f"{row.name} [{row.unit}]", *row.cells) for own in rows(results).values() for row in own)
    notes = (
        "Relative to no nominal sensor: sensitivity of each axis, the angles by which axes miss 90 degrees, bias along "
        "each axis. \u00b1: half of the 95 % interval, the coverage factor times sigma.",
    )
    columns = (Column("parameter"), *(Column(label) for label in labels))
    return Table(f"Parameters, {quoted.QUOTED}", columns, lines, notes)


def differences(labels: Sequence[str], results: Sequence[Calibration]) -> Table:
    """Return how each result differs from the first, with the 95 % interval of the difference."""
    first, others = results[0], results[1:]
    found = [difference(first, other) for other in others]
    lines = []
    for _, part, unit, size in _kinds(first):
        for p in range(9)[part]:
            cells: list[str] = []
            for change, half in found:
                value, width = float(change[p]) * size, float(half[p]) * size
                beyond = math.isfinite(width) and abs(value) > width
                cells += [_quoted(value, width) if math.isfinite(value) else "", BEYOND if beyond else ""]
            if any(cells):
                lines.append((f"{PARAMETERS[p]} [{unit}]", *cells))
    columns = [Column("parameter")]
    for label in labels[1:]:
        columns += [Column(f"{label} less {labels[0]}"), Column("", key=f"remark_{label}")]
    notes = (
        f'"{BEYOND}": the difference is larger than half of its own 95 % interval, which holds for independent errors; '
        "about one in twenty is by chance. Whether a sensor has changed, accelcal verify tells from new readings.",
    )
    return Table("Differences", tuple(columns), tuple(lines), notes)
