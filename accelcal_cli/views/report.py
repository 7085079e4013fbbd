"""What a page shows beside the tables of `calibration`: only what was estimated, every pose in words, the origin."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

from accelcal_cli import __version__
from accelcal_cli.calibration.provenance import settings_sha256
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.views import calibration, quoted
from accelcal_cli.views.blocks import Column, Table

NOT_ESTIMATED = (
    "Misalignments were not estimated: the sensor axes are taken as perpendicular (--no-misalignment), and what "
    "misalignment there is stands in the residuals."
)


def determined(result: Calibration) -> str:
    """Return the sentence that stands where the poses leave nothing open."""
    known = result.settings.get("attitudes") == "known"
    count = "twelve parameters" if known else "nine parameters"
    return f"The poses determine all {'six parameters that were estimated' if result.held.any() else count}."


def parameter_tables(result: Calibration) -> list[Table]:
    """Return the tables of the parameters that were estimated; those that were not have no row and no number."""
    first, _, *rest = calibration.parameter_tables(result)
    cells = [list(row) for row in first.rows]
    for i, row in enumerate(cells):
        for j in range(3):
            value = 1 + 2 * j
            if result.held.any() and i != j:
                row[value] = row[value + 1] = ""
            elif result.K_a[i, j] == 0 and row[value + 1] in (None, 0.0):
                row[value + 1] = ""  # a zero of the gauge is exact
    for row in cells:
        row[1:] = ["" if b is None and a == quoted.UNKNOWN else b for a, b in pairwise(row)]
        for value in range(1, len(row), 2):
            if isinstance(row[value], float) and isinstance(row[value + 1], float):
                row[value : value + 2] = quoted.quote(row[value], row[value + 1])
    first = replace(first, rows=tuple(cells))
    return [first, engineering(result), *rest]


def two_digits(sigma: float) -> str:
    """Return a sigma as intervals are quoted; nothing without one."""
    return quoted.quote(0.0, sigma)[1]


def engineering(result: Calibration) -> Table:
    """Return the parameters that were estimated in engineering units, with sigma and 95 % intervals."""
    table = quoted.engineering(result)
    _, intervals = quoted.in_parts(result)
    rows = []
    for p, (name, shown, other) in enumerate(table.rows):
        if result.held[p]:
            continue
        size = quoted.kinds(result)[p // 3][2]
        sigma = intervals[p] * size / result.coverage_factor if result.coverage_factor else math.nan
        rows.append((name, shown, two_digits(sigma), other))
    parameter, value, further = table.columns
    notes = (*table.notes, NOT_ESTIMATED) if result.held.any() else table.notes
    return Table(
        "Parameters, " + quoted.QUOTED, (parameter, value, Column("sigma"), further), tuple(rows), notes
    )


def observability(result: Calibration) -> Table:
    """Return the dilution of precision of the parameters that were estimated."""
    table = calibration.observability(result)
    rows = tuple(row for row, held in zip(table.rows, result.held.tolist(), strict=True) if not held)
    return replace(table, rows=rows)


def fit(result: Calibration) -> Table:
    """Return how well the readings fit, without what there is not."""
    table = calibration.fit(result)
    known = [
        row
        for row in table.rows
        if row[1] != "-" and not (row[0] == "degrees of freedom" and result.freedom <= 0)
    ]
    return replace(table, rows=tuple(known))


def headline(result: Calibration) -> list[tuple[str, str]]:
    """Return the first numbers, without what there is not."""
    return [(name, value) for name, value in calibration.headline(result) if value != "-"]


def pose_key(pose: int, of: str = "") -> str:
    """Return what marks a pose in pictures and tables, by its number from 0 and, of several results, which it is of."""
    return f"pose{of}-{pose + 1}"


def pose_names(result: Calibration) -> list[str]:
    """Return every kept pose in words: its number and label, residual, leverage."""
    unit, names = result.unit, []
    for p in result.poses_fit:
        label = "" if p.where == f"pose {p.pose + 1}" else f", {p.where}"
        parts = [f"|f| - g {p.residual:.3e} {unit} after and {p.residual_before:.3e} before calibration"]
        parts += [f"studentised {p.studentised:.2f}"] if math.isfinite(p.studentised) else []
        parts += [f"leverage {p.leverage:.2f}"] if math.isfinite(p.leverage) else []
        outlier = ", outlier" if p.pose in result.outliers else ""
        names.append(f"Pose {p.pose + 1}{label}{outlier}: {', '.join(parts)}")
    return names


def dated(result: Calibration) -> str:
    """Return when the result was calculated, for people."""
    return "not recorded" if result.date is None else result.date.replace("T", " ").replace("Z", " UTC")


def gravity(result: Calibration) -> str:
    """Return local gravity and where it comes from."""
    return f"{result.g:.7g} {result.unit}, {result.g_source or 'its origin was not recorded'}"


def origin(result: Calibration) -> list[tuple[str, str]]:
    """Return where the numbers come from, name and value."""
    return [
        ("readings", str(result.data.get("source", "-"))),
        ("SHA-256 of the readings", str(result.data.get("sha256", "-"))),
        ("SHA-256 of the settings", settings_sha256(result.record()["settings"])),
        ("columns", ", ".join(map(str, result.data.get("columns", [])))),
        ("poses", f"{result.poses:,}"),
        ("local gravity", gravity(result)),
        ("calculated", dated(result)),
        ("schema of the result", result.schema),
        ("calibrated with", f"accelcal {result.version}"),
        ("reported with", f"accelcal {__version__}"),
    ]
