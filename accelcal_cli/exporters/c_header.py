"""A C header: constant arrays and an inline function, or with slopes two, C99 or C++."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from accelcal_cli.exporters import base
from accelcal_cli.exporters.base import EXPORTERS, Exporter

if TYPE_CHECKING:
    from accelcal_cli.arrays import Float
    from accelcal_cli.calibration.result import Calibration, Temperature

HEADER = """\
#ifndef ACCELCAL_CALIBRATION_H
#define ACCELCAL_CALIBRATION_H

/*
{origin} */

#define ACCELCAL_UNIT "{unit}" /* of the force */

static const double accelcal_K_A[3][3] = {{
{matrix}}};

static const double accelcal_f_0[3] = {{{bias}}};

/* force = K_A * reading - f_0{when} */
static inline void accelcal_apply(const double reading[3], double force[3]) {{
    for (int i = 0; i < 3; i++) {{
        force[i] = accelcal_K_A[i][0] * reading[0] + accelcal_K_A[i][1] * reading[1]
                 + accelcal_K_A[i][2] * reading[2] - accelcal_f_0[i];
    }}
}}
{slopes}
#endif
"""

SLOPES = """
#define ACCELCAL_TEMPERATURE {reference} /* degrees, T_0, at which K_A and f_0 hold */
#define ACCELCAL_TEMPERATURE_LOW {low}
#define ACCELCAL_TEMPERATURE_HIGH {high} /* of the poses; beyond them the slopes are extrapolated */

static const double accelcal_D_a[3] = {{{bias}}};

static const double accelcal_scale_slope[3] = {{{scale_slope}}}; /* of the scale factors, per degree */

static const double accelcal_bias_slope[3] = {{{bias_slope}}}; /* of D_a, per degree */

/* force = K_A * (reading - D_a - bias_slope * t) / (1 + scale_slope * t), t = degrees - T_0 */
static inline void accelcal_apply_at(const double reading[3], double degrees, double force[3]) {{
    const double t = degrees - ACCELCAL_TEMPERATURE;
    double at_reference[3];
    for (int i = 0; i < 3; i++) {{
        at_reference[i] = (reading[i] - accelcal_D_a[i] - accelcal_bias_slope[i] * t)
                        / (1.0 + accelcal_scale_slope[i] * t) + accelcal_D_a[i];
    }}
    accelcal_apply(at_reference, force);
}}
"""


@EXPORTERS.register("c-header")
@dataclass(frozen=True)
class CHeader(Exporter):
    """C or C++ header with constants and a function that corrects a reading.

    accelcal_K_A, accelcal_f_0 and accelcal_apply: f = K_A N - f_0, in the unit of the result; with temperature slopes
    also accelcal_apply_at.
    """

    suffix = ".h"
    slopes = "all"

    def content(self, result: Calibration) -> bytes:
        """Return the header; a `*/` in the origin does not end its comment."""
        lines = [line.replace("*/", "* /") for line in [*self.header(result), base.frame(result)]]
        text = HEADER.format(
            origin=base.comment(lines, " *"),
            unit=result.unit,
            matrix="".join(f"    {{{_numbers(row)}}},\n" for row in result.model.K_A),
            bias=_numbers(result.model.f_0),
            when="" if result.temperature is None else ", at ACCELCAL_TEMPERATURE",
            slopes="" if result.temperature is None else _slopes(result.D_a, result.temperature),
        )
        return text.encode()


def _slopes(D_a: Float, drift: Temperature) -> str:
    return SLOPES.format(
        reference=repr(float(drift.reference)),
        low=repr(float(drift.low)),
        high=repr(float(drift.high)),
        bias=_numbers(D_a),
        scale_slope=_numbers(drift.scale),
        bias_slope=_numbers(drift.bias),
    )


def _numbers(row: Float) -> str:
    return ", ".join(repr(float(value)) for value in row)
