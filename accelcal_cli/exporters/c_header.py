"""A C header: two constant arrays and an inline function, C99 or C++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.arrays import Float
    from accelcal_cli.calibration.result import Calibration

HEADER = """\
#ifndef ACCELCAL_CALIBRATION_H
#define ACCELCAL_CALIBRATION_H

/*
{origin} */

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


@EXPORTERS.register("c-header")
@dataclass(frozen=True)
class CHeader(Exporter):
    """C or C++ header with constants and a function that corrects a reading.

    accelcal_K_A, accelcal_f_0 and accelcal_apply: f = K_A N - f_0, in the unit of the result.
    """

    suffix = ".h"

    def content(self, result: Calibration) -> bytes:
        """Return the header; a `*/` in the origin does not end its comment."""
        lines = [line.replace("*/", "* /") for line in [*base.origin(result), base.frame(result)]]
        text = HEADER.format(
            origin=base.comment(lines, " *"),
            unit=result.unit,
            matrix="".join(f"    {{{_numbers(row)}}},\n" for row in result.model.K_A),
            bias=_numbers(result.model.f_0),
        )
        return text.encode()


def _numbers(row: Float) -> str:
    return ", ".join(repr(float(value)) for value in row)
