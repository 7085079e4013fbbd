"""A calibration on one screen: values as people quote them, to two digits of their 95 % interval."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.observability import BIAS, PARAMETERS
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor.poses import AXES
from accelcal_cli.views.blocks import BLANK, Block, Column, Conclusion, Paragraph, Table, notes

UNKNOWN, ASSUMED = "not determined", "taken as 0"

PLUS_MINUS = "±"
QUOTED = f"value {PLUS_MINUS} 95 %"
"""Heading of values with the half-width of their 95 % interval."""

FINEST = 1e7
"""A value of so many times its uncertainty is exact to all digits that one reads."""

MOST_NOTES = 4
"""Sentences of verdict and warnings that the text of a calibration holds: it has fifteen lines at most."""


def quote(value: float, interval: float) -> tuple[str, str]:
    """Return a value and its uncertainty to two digits of the latter; to six digits where it has none.

    >>> quote(1693.4286, 0.5779)
    ('1693.43', '0.58')
    >>> quote(14029.1, 346.2)
    ('14030', '350')
    >>> quote(512.0553, math.nan)
    ('512.055', '')
    """
    if not (math.isfinite(interval) and interval > 0):
        return f"{value:.6g}", ""
    digits = 1 - math.floor(math.log10(interval))
    if round(interval, digits) >= 10 ** (2 - digits):  # 0.0996 is 0.10, not 0.100
        digits -= 1
    if abs(value) > FINEST * interval or not -15 < digits < 15:
        return f"{value:.9g}", f"{interval:.1e}"
    shown = max(digits, 0)
    return f"{round(value, digits) + 0.0:.{shown}f}", f"{round(interval, digits):.{shown}f}"


def _column(entries: Iterable[tuple[float, float] | str]) -> list[str]:
    """Return the cells of one column, the signs of its uncertainties below each other."""
    pairs = [(entry, "") if isinstance(entry, str) else quote(*entry) for entry in entries]
    left = max((len(value) for value, spread in pairs if spread), default=0)
    right = max(len(spread) for _, spread in pairs)
    return [
        f"{value:>{left}} {PLUS_MINUS} {spread:<{right}}" if spread else f"{value:>{left}}"
        for value, spread in pairs
    ]


def _entries(result: Calibration) -> list[list[str]]:
    """Return K_a and the bias as cells, column by column."""
    lost = result.lost_entries
    values = np.column_stack([result.K_a, result.D_a])
    intervals = np.column_stack([result.interval.K_a, result.interval.D_a])
    gone = np.column_stack([lost[:3], lost[3]])
    return [
        _column(UNKNOWN if gone[i, j] else (float(values[i, j]), float(intervals[i, j])) for i in range(3))
        for j in range(4)
    ]


def parameters(result: Calibration) -> Table:
    """Return K_a and the bias with their 95 % intervals, as they are quoted."""
    columns = [Column("axis"), *(Column(name) for name in ("K_x", "K_y", "K_z", "bias"))]
    rows = tuple(zip(AXES, *_entries(result), strict=True))
    note = f"N = K f + bias. K in output units per {result.unit}, bias in output units, gauge {result.gauge}."
    if result.gauge == "full" and not np.isfinite(result.sigma.K_a).all():
        note += " The body frame of gauge full is free: the next table has what is observable."
    return Table(f"Calibration, {QUOTED}", tuple(columns), rows, (note,))


def kinds(result: Calibration) -> tuple[tuple[str, str, float, str, float], ...]:
    """Return the kinds of parameters: name, unit and its size, and a second unit and its size."""
    metres = units.STANDARD_GRAVITY / units.OUTPUT_OF_1_G[result.unit] * _per_g(result)
    return (
        ("scale factor error", "ppm", units.PPM, "%", 100.0),
        ("misalignment", "mrad", units.MRAD, "arcsec", units.ARCSEC),
        ("bias", "micro-g", units.MICRO_G, "m/s^2", metres),
    )


def _per_g(result: Calibration) -> float:
    """Return what 1 g is in the unit of the force: one in metres is divided by the local gravity."""
    return units.OUTPUT_OF_1_G[result.unit] if result.unit in ("g", "mg") else result.g


def in_parts(result: Calibration) -> tuple[Float, Float]:
    """Return the nine of the engineering view and the half-widths of their intervals, biases in parts of g."""
    values, sigma = result.engineering
    interval = result.interval_of(sigma)
    values[BIAS] /= _per_g(result)
    interval[BIAS] /= _per_g(result)
    return values, interval


def engineering(result: Calibration) -> Table:
    """Return scale-factor errors, misalignments and biases as they are quoted, with slopes where there are any."""
    values, interval = in_parts(result)
    first: list[str] = []
    second: list[str] = []
    for k, (_, _, size, other_unit, other) in enumerate(kinds(result)):
        nine = range(3 * k, 3 * k + 3)
        first += _column(_cell(result, p, values[p] * size, interval[p] * size) for p in nine)
        cells = _column(_cell(result, p, values[p] * other, interval[p] * other) for p in nine)
        named = [f"{cell} {other_unit}" for cell in cells]
        second += [
            "" if result.held[p] or result.lost[p] else cell for p, cell in zip(nine, named, strict=True)
        ]
    names = [
        f"{kinds(result)[p // 3][0]} {name.split()[-1]} [{kinds(result)[p // 3][1]}]"
        for p, name in enumerate(PARAMETERS)
    ]
    columns = [Column("parameter"), Column(QUOTED), Column("in other units")]
    rows = list(zip(names, first, second, strict=True))
    if result.temperature is not None:
        columns[2] = Column("per degree")
        rows = list(zip(names, first, _slopes(result), strict=True))
    return Table("Engineering view", tuple(columns), tuple(rows), (reference(result),))


def _cell(result: Calibration, p: int, value: float, interval: float) -> tuple[float, float] | str:
    if result.held[p]:
        return ASSUMED
    return UNKNOWN if result.lost[p] else (value, interval)


def _slopes(result: Calibration) -> list[str]:
    """Return the change per degree of the nine parameters in their units; misalignments have none."""
    drift = result.temperature
    assert drift is not None
    force = units.MICRO_G / units.sensitivity(result.K_a) / result.g
    scale = zip(drift.scale * units.PPM, drift.interval_scale * units.PPM, strict=True)
    bias = zip(drift.bias * force, drift.interval_bias * force, strict=True)
    return [
        *_column((float(v), float(u)) for v, u in scale),
        "",
        "",
        "",
        *_column((float(v), float(u)) for v, u in bias),
    ]


def reference(result: Calibration) -> str:
    """Return the sentence that says what the engineering numbers are relative to."""
    nominal = f"{result.nominal_scale[0]:.6g}"
    if np.ptp(result.nominal_scale) > 0:
        nominal = ", ".join(f"{k:.6g}" for k in result.nominal_scale)
    offset = ", ".join(f"{d:g}" for d in result.nominal_bias) if result.nominal_bias.any() else "0"
    drift = result.temperature
    warm = (
        ""
        if drift is None
        else f" At {drift.reference:.4g} degrees; poses from {drift.low:.4g} to {drift.high:.4g}."
    )
    return (
        f"Relative to {nominal} output units per {result.unit} and a bias of {offset} output units; misalignment: the "
        f"angle by which two sensor axes miss 90 degrees.{warm}"
    )


def fit(result: Calibration) -> Table:
    """Return how well the readings fit, in the few numbers that a reader wants first."""
    unit = result.unit
    rows: list[tuple[str, str]] = [
        (f"rms of |f| - g before and after [{unit}]", f"{result.rms_before:.3g} -> {result.rms:.3g}"),
        (f"noise of one pose, s [{unit}]", f"{result.s:.3g}" if result.freedom > 0 else "-"),
    ]
    if result.residual_noise_ratio is not None:
        rows.append(
            (
                "residual noise / noise expected from the readings",
                f"{result.residual_noise_ratio:.3g} (p-value {result.residual_noise_p:.2g})",
            )
        )
    worst = f"{result.dop.worst:.3g}" if np.isfinite(result.dop.worst) else "infinite"
    rows += [
        ("worst dilution of precision", worst),
        ("poses, degrees of freedom", f"{result.poses:,}, {result.freedom:,}"),
    ]
    return Table("Fit", (Column("quantity"), Column("value")), tuple(rows))


def summary(result: Calibration) -> str:
    """Return the calibration in one line."""
    gravity = f"g = {result.g:.7g} {result.unit}" if result.g != 1.0 else "in units of g"
    fall = f"{result.rms_before:.3g} -> {result.rms:.3g} {result.unit}"
    return f"{result.poses:,} poses, rms of |f| - g {fall}, {gravity}"


def screen(result: Calibration, *further: Table) -> list[Block]:
    """Return what a calibration shows on one screen: verdict and what to do, parameters, fit, one line at the end.

    Args:
        result: the calibration; further: tables that it has beside, as of days of wear.
    """
    conclusion = Conclusion(result.verdict, result.reasons, result.warnings)
    last = Paragraph(f": {summary(result)}. All poses, search, observability: --verbose", result.verdict)
    tables = [parameters(result), engineering(result), fit(result), *further]
    kept = [Paragraph(f": {value}", key) for key, value in result.meta.items()]
    return [conclusion, BLANK, *tables, *kept, *notes(result.notes), last]


def _said(result: Calibration) -> list[str]:
    """Return the sentences of the verdict and the warnings, as many as fit."""
    said = [*result.reasons, *(f"{notice.severity.capitalize()}: {notice}" for notice in result.warnings)]
    if len(said) <= MOST_NOTES:
        return said
    return [*said[: MOST_NOTES - 1], f"... and {len(said) - MOST_NOTES + 1} more, see reasons and warnings"]


def text(result: Calibration) -> str:
    """Return a calibration on at most fifteen lines."""
    values, interval = in_parts(result)
    lines = [f"{result.verdict}: {summary(result)}", *(f"  {sentence}" for sentence in _said(result))]
    lines.append(f"N = K f + bias, {QUOTED}, K in output units per {result.unit}, gauge {result.gauge}")
    lines += _lines([list(AXES), *_entries(result)], ["", "K_x", "K_y", "K_z", "bias"])
    rows = [[f"{name} [{unit}]" for name, unit, *_ in kinds(result)]]
    for i in range(3):
        cells = [
            _column([_cell(result, p, values[p] * size, interval[p] * size)])[0]
            for p, (_, _, size, *_) in zip((i, 3 + i, 6 + i), kinds(result), strict=True)
        ]
        rows.append(cells)
    lines += _lines(rows, ["", "x or xy", "y or xz", "z or yz"])
    return "\n".join(lines)


def _lines(columns: Sequence[Sequence[str]], names: Sequence[str]) -> list[str]:
    """Return columns as lines of text below their names."""
    cells = [[name, *column] for name, column in zip(names, columns, strict=True)]
    widths = [max(map(len, column)) for column in cells]
    rows = zip(*cells, strict=True)
    return [
        "  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in rows
    ]


def html(result: Calibration) -> str:
    """Return a calibration as a piece of HTML for notebooks."""
    said = "".join(f"<br>{escape(sentence)}" for sentence in _said(result))
    tables = "".join(_html_table(table) for table in (parameters(result), engineering(result)))
    return f"<div><p><b>{result.verdict}</b>: {escape(summary(result))}{said}</p>{tables}</div>"


def _html_table(table: Table) -> str:
    head = "".join(f"<th>{escape(column.name)}</th>" for column in table.columns)
    body = "".join(
        f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in table.rows
    )
    notes_ = "".join(f"<br><small>{escape(note)}</small>" for note in table.notes)
    return f"<table><caption>{escape(table.title)}{notes_}</caption><tr>{head}</tr>{body}</table>"
