"""What a report shows beside the tables of a calibration: the first numbers, and every pose."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.plan import KINDS
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.sensor.poses import AXES
from accelcal_cli.table import Column, Table


def pose_residuals(result: Calibration) -> Table:
    """Return every kept pose: residual before and after calibration, and the direction that pointed up."""
    unit = result.unit
    columns = (
        Column("pose"),
        Column("before", unit, ".3e"),
        Column("after", unit, ".3e"),
        Column("studentised", format=".2f"),
        Column("leverage", format=".2f"),
        *(Column(axis, format=".3f") for axis in AXES),
    )
    rows = tuple(
        (p.where, p.residual_before, p.residual, p.studentised, p.leverage, *p.direction)
        for p in result.poses_fit
    )
    notes = ("Before, after: |f| - g. x, y, z: unit direction of the specific force, gauge lower.",)
    return Table("Poses", columns, rows, notes)


def accuracy(result: Calibration) -> str:
    """Say in one sentence how well the parameters are known; nothing where the poses do not tell."""
    variance = np.diagonal(result.covariance)
    if result.verdict == "undetermined" or result.freedom < 1 or not np.isfinite(variance).all():
        return ""
    sigma = np.sqrt(variance) / result.g
    largest = [(name, sigma[kind].max() * size, unit) for name, kind, unit, size in KINDS]
    parts = [f"{name} {v:{'.2g' if v < 100 else ',.0f'}} {unit}" for name, v, unit in largest if v > 0]
    return f"Largest one-sigma of each kind: {', '.join(parts)}."


def headline(result: Calibration) -> list[tuple[str, str]]:
    """Return the few numbers that a reader wants first, name and value."""
    unit = result.unit
    worst = f"{result.dop.worst:.3g}" if np.isfinite(result.dop.worst) else "infinite"
    return [
        ("rms of |f| - g before", f"{result.rms_before:.3g} {unit}"),
        ("rms of |f| - g after", f"{result.rms:.3g} {unit}"),
        ("noise of one pose, s", f"{result.s:.3g} {unit}" if result.freedom > 0 else "-"),
        ("worst dilution of precision", worst),
        ("poses", f"{result.poses:,}"),
        ("local gravity g", f"{result.g:.6g} {unit}"),
    ]
