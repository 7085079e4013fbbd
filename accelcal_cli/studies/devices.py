"""Estimated sensors beside the true one: every parameter, and what of its error the readings can show.

The cost does not change when K_a is multiplied by a rotation from the right: of an error of the off-diagonals the
antisymmetric part is such a rotation and cannot be observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.lotters import unpack
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.streams import Float
from accelcal_cli.studies.compare import Comparison
from accelcal_cli.studies.estimates import MATRIX
from accelcal_cli.studies.study import Record
from accelcal_cli.table import Column, Table

ABOVE, BELOW = (np.array([0, 0, 1]), np.array([1, 2, 2])), (np.array([1, 2, 2]), np.array([0, 0, 1]))
ORDER = ("K_11", "K_12", "K_13", "K_21", "K_22", "K_23", "K_31", "K_32", "K_33", "D_1", "D_2", "D_3")


@dataclass(frozen=True)
class Printed:
    """Estimates that a paper prints, in the units of the readings."""

    method: str
    K_a: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
    D_a: tuple[float, float, float]


def parameters(study: Comparison, records: Sequence[Record], printed: Sequence[Printed]) -> Table:
    """Return every parameter: truth, the paper's estimates, and those of the median run of each optimizer."""
    found = _estimates(study, records, printed)
    columns = (Column("parameter"), *(Column(name, format=".8g") for name in found))
    rows = []
    for name in ORDER:
        i = int(name[2]) - 1
        values = [K[i, int(name[3]) - 1] if name[0] == "K" else D[i] for K, D in found.values()]
        rows.append((name, *(float(v) for v in values)))
    return Table("estimates", columns, tuple(rows))


def valley(study: Comparison, records: Sequence[Record], printed: Sequence[Printed]) -> Table:
    """Return for each estimate the parts of its error, rms in output units, and its cost on the readings."""
    found = _estimates(study, records, printed)
    true_K, true_D = found["truth"]
    rows = []
    for name, (K, D) in found.items():
        raw = (K - true_K)[ABOVE], (K - true_K)[BELOW]
        seen = to_gauge(K, "lower") - to_gauge(true_K, "lower")
        rows.append(
            (
                name,
                _rms(np.concatenate(raw)),
                _rms(0.5 * (raw[0] - raw[1])),
                _rms(seen[BELOW]),
                _rms(np.diagonal(seen)),
                _rms(D - true_D),
                _cost(study, K, D),
            )
        )
    return Table("what of the error the readings show", VALLEY, tuple(rows), notes=(NOTE,))


VALLEY = (
    Column("estimate"),
    Column("off-diagonals", format=".2g", key="off_diagonals"),
    Column("rotation", format=".2g"),
    Column("misalignments", format=".2g"),
    Column("scale factors", format=".2g", key="scale_factors"),
    Column("bias", format=".2g"),
    Column("cost", "(m/s^2)^4", ".2g"),
)
NOTE = (
    "Errors, rms in output units. Rotation: the antisymmetric part of the off-diagonals, which no readings without "
    "attitudes can show. Misalignments and scale factors: in gauge lower, where no rotation is left."
)


def _estimates(
    study: Comparison, records: Sequence[Record], printed: Sequence[Printed]
) -> dict[str, tuple[Float, Float]]:
    """Return K and D of the truth, of the paper's rows, and of each optimizer's run of median cost."""
    model = study.source.sensor.model  # type: ignore[union-attr]
    found = {"truth": (model.K, model.D)}
    found |= {f"paper {p.method}": (np.array(p.K_a), np.array(p.D_a)) for p in printed}
    for cell, entry in enumerate(study.entries):
        own = sorted((r for r in records if r.cell == cell), key=lambda r: r.cost)
        if own:
            values = own[len(own) // 2].values
            names = (*MATRIX[: study.space.unknowns - 3], "D_1", "D_2", "D_3")
            K, D = unpack(np.array([values[name] for name in names], dtype=float))
            found[entry.label] = K, D
    return found


def _cost(study: Comparison, K: Float, D: Float) -> float:
    """Return the cost of an estimate on the study's readings."""
    problem = study.scene(range(1)).problem
    return float(problem.cost(problem.coordinates(K[None], D[None])[:, None])[0, 0])


def _rms(values: Float) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
