"""What a comparison comes to: one row an optimizer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from accelcal_cli.studies.compare import Comparison
from accelcal_cli.studies.estimates import ERRORS, WITHIN, limit
from accelcal_cli.studies.scene import Recording
from accelcal_cli.studies.study import Record
from accelcal_cli.table import Column, Table

ROUNDING = 1e-12
"""An excess of the cost below this part is rounding."""


def summary(study: Comparison, records: Sequence[Record], only_successful: bool = False) -> Table:
    """Return one row an optimizer: success rate, medians of time, evaluations and cost, rms errors over the runs.

    Args:
        study: the comparison; records: of its runs.
        only_successful: leave the runs that failed out of all but the success rate.
    """
    rows = []
    records = judged(study, records)
    for cell, entry in enumerate(study.entries):
        own = [r for r in records if r.cell == cell]
        if own:
            rows.append((entry.label, *_row(study, own, only_successful)))
    return Table("Comparison", COLUMNS, tuple(rows), notes=(*_notes(study), *_missed(rows)))


def judged(study: Comparison, records: Sequence[Record]) -> list[Record]:
    """Return the records with the least cost that anything found on the same readings.

    Levenberg-Marquardt from the truth ends in the nearest minimum; a search may have found a lower one.
    """
    alike = [0 if isinstance(study.source, Recording) else r.run for r in records]
    least: dict[int, float] = {}
    for which, r in zip(alike, records, strict=True):
        found = [cost for cost in (r.values.get("least_cost"), r.cost) if cost is not None and cost >= 0.0]
        least[which] = min((*found, least.get(which, np.inf)))
    return [
        replace(r, values={**r.values, "least_cost": least[which] if np.isfinite(least[which]) else None})
        for which, r in zip(alike, records, strict=True)
    ]


def succeeded(study: Comparison, record: Record) -> bool:
    """Return whether a run came to the least cost."""
    least = record.values.get("least_cost")
    return least is not None and record.cost <= float(limit(np.array(least), study.tolerance))


def _row(study: Comparison, own: Sequence[Record], only_successful: bool) -> tuple[object, ...]:
    good = [succeeded(study, r) for r in own]
    counted = [r for r, g in zip(own, good, strict=True) if g or not only_successful]
    hits = [r.hit for r, g in zip(own, good, strict=True) if g and r.hit is not None]
    return (
        len(own),
        sum(good) / len(own),
        _median([r.seconds for r in counted]),
        _count([r.evaluations for r in counted]),
        _count(hits),
        _median([r.cost for r in counted]),
        _median([_excess(r) for r in counted]) if study.noisy else None,
        *(_total(counted, name) for name in ERRORS),
        _total(counted, "efficiency"),
    )


def _excess(record: Record) -> float:
    """Return the part by which a run's cost is above the least cost; what is only rounding is zero."""
    excess = record.cost / (record.values["least_cost"] or np.nan) - 1.0
    return 0.0 if abs(excess) < ROUNDING else excess


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def _count(values: Sequence[int]) -> int | None:
    return int(np.median(values)) if values else None


def _total(records: Sequence[Record], name: str) -> float | None:
    """Return the rms over the runs of one of their values; None where no run has it."""
    values = [v for r in records if (v := r.values.get(name)) is not None]
    return float(np.sqrt(np.mean(np.square(values)))) if values else None


def _missed(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Return a sentence for each optimizer that did not always come to the least cost of noisy readings."""
    rate, excess = (
        next(i for i, c in enumerate(COLUMNS) if c.name == name) for name in ("success", "excess")
    )
    return [
        f"{row[0]} came within 1 % of the least cost in {row[rate]:.0%} of its runs; its median run is "
        f"{'within 1 %' if row[excess] <= WITHIN else f'{1.0 + row[excess]:.3g} times as high'}."
        for row in rows
        if row[excess] is not None and row[rate] < 1.0
    ]


def _notes(study: Comparison) -> tuple[str, ...]:
    reached = f"Success: within {study.tolerance:g} (m/s^2)^4 or 1 % of the least cost of the readings."
    if isinstance(study.source, Recording):
        return (reached, "Errors: distance from the Levenberg-Marquardt solution of the same readings.")
    if study.source.noise > 0:
        return (reached, "Efficiency: error over the Cramer-Rao bound; 1 is as good as the noise allows.")
    return (reached,)


COLUMNS = (
    Column("optimizer"),
    Column("runs", format=",d"),
    Column("success", format=".0%", key="success_rate"),
    Column("time", "s", ".3f", key="seconds"),
    Column("evaluations", format=",d"),
    Column("to success", format=",d", key="evaluations_to_success"),
    Column("cost", "(m/s^2)^4", ".3g"),
    Column("excess", format=".2g"),
    Column("bias error", "micro-g", ".3g", key="bias_error"),
    Column("scale error", "ppm", ".3g", key="scale_error"),
    Column("misalignment", "arcsec", ".3g", key="misalignment_error"),
    Column("efficiency", format=".3g"),
)
