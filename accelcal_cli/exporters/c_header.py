"""A C header: two constant arrays and an inline function, C99 or C++."""

from __future__ import annotations

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import Export, Target

HEADER = """\
#ifndef ACCELCAL_CALIBRATION_H
#define ACCELCAL_CALIBRATION_H

/*
{said} */

#define ACCELCAL_UNIT "{unit}" /* of the force */

static const double accelcal_K_A[3][3] = {{
{matrix}}};

static const double accelcal_f_0[3] = {{{bias}}};

/* force = K_A * reading - f_0 */
static inline void accelcal_apply(const double reading[3], double force[3]) {{
    for (int i = 0; i < 3; i++) {{
        force[i] = accelcal_K_A[i][0] * reading[0] + accelcal_K_A[i][1] * reading[1]
                 + accelcal_K_A[i][2] * reading[2] - accelcal_f_0[i];
    }}
}}

#endif
"""


def export(result: Calibration, target: Target) -> Export:  # noqa: ARG001  # one signature for all
    """Return accelcal_K_A, accelcal_f_0 and accelcal_apply: f = K_A N - f_0, in the unit of the result."""
    said = [line.replace("*/", "* /") for line in base.origin(result)]
    matrix = "".join(f"    {{{_numbers(row)}}},\n" for row in base.rows(result.model.K_A))
    text = HEADER.format(
        said=base.comment(said, " *"),
        unit=result.unit,
        matrix=matrix,
        bias=_numbers(base.rows(result.model.f_0)[0]),
    )
    return Export(text.encode(), base.without_temperature(result))


def _numbers(row: list[float]) -> str:
    return ", ".join(repr(value) for value in row)
