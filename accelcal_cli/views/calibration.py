"""A calibration for people: tables in the paper's units and in an engineer's, its first numbers, every pose."""

from __future__ import annotations

from dataclasses import replace
from itertools import chain

import numpy as np

from accelcal_cli.calibration.observability import (
    BIAS,
    MISALIGNMENT,
    PARAMETERS,
    SCALE,
    UNDETERMINED,
    WEAK,
)
from accelcal_cli.calibration.result import Calibration, Temperature, Worn
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor.poses import AXES
from accelcal_cli.views import quoted
from accelcal_cli.views.blocks import BLANK, Block, Column, Conclusion, Convergence, Paragraph, Table, notes

KINDS = (
    ("scale", SCALE, "ppm", units.PPM),
    ("misalignment", MISALIGNMENT, "mrad", units.MRAD),
    ("bias", BIAS, "micro-g", units.MICRO_G),
)
"""Kinds of parameters with the unit that their sigma is shown in, and its size in parts of g."""

KEYS = ("scale_factor_error", "misalignment", "bias")
"""Names of the kinds in CSV."""

VERDICTS = ("good", "weak", "suspect", "undetermined")
"""Of a calibration, the best first."""

WORST_SHOWN = 5
INTERVAL = "+- 95 %"
"""Heading of the half-widths of 95 % intervals."""


def parameter_tables(result: Calibration) -> list[Table]:
    """Return the parameters in the paper's units, in an engineer's, against temperature, and what GGIR says of wear."""
    slopes = [] if result.temperature is None else [temperature(result, result.temperature)]
    of_wear = [] if result.worn is None else [worn(result.worn)]
    return [parameters(result), engineering(result), *slopes, *of_wear]


def blocks(result: Calibration) -> list[Block]:
    """Return all there is to show of a calibration: what fits on a screen first, then each pose and the search."""
    title = f"Convergence of {result.optimizer} (best cost L so far, logarithmic)"
    curve = [Convergence(title, {"": result.convergence})] if len(result.convergence) > 1 else []
    conclusion = Conclusion(result.verdict, result.reasons, result.warnings)
    tables = [quoted.parameters(result), quoted.engineering(result), fit(result), observability(result)]
    tables += [] if result.worn is None else [worn(result.worn)]
    last = Paragraph(f": {quoted.summary(result)}.", result.verdict)
    return [conclusion, BLANK, *tables, every_pose(result), *notes(result.notes), *curve, last]


def every_pose(result: Calibration) -> Table:
    """Return every kept pose: residual before and after calibration, and whether it is an outlier."""
    unit = result.unit
    columns = (
        Column("pose", format="d"),
        Column("where"),
        Column("before", unit, ".1e"),
        Column("after", unit, ".1e"),
        Column("studentised", format=".2f"),
        Column("leverage", format=".2f"),
        Column(""),
    )
    rows = tuple(
        (
            p.pose + 1,
            p.where,
            p.residual_before,
            p.residual,
            p.studentised,
            p.leverage,
            "outlier" if p.pose in result.outliers else "",
        )
        for p in result.poses_fit
    )
    return Table("Poses, |f| - g before and after calibration", columns, rows).filled()


def parameters(result: Calibration) -> Table:
    """Return K_a and D_a with their 95 % intervals."""
    lost, interval = result.lost_entries, result.interval
    entries = [  # value, interval and whether it is lost, of a row of K_a and then the bias
        np.column_stack(pair)
        for pair in ((result.K_a, result.D_a), (interval.K_a, interval.D_a), (lost[:3], lost[3]))
    ]
    rows = tuple(
        (axis, *chain.from_iterable(_pair(v, s, lost=bool(gone)) for v, s, gone in zip(*row, strict=True)))
        for axis, *row in zip(AXES, *entries, strict=True)
    )
    columns = [
        (Column(name, format=".8g"), Column(INTERVAL, format=".2g", key=f"interval_{name}", beside=True))
        for name in ("K_x", "K_y", "K_z", "bias")
    ]
    notes = [f"K_a in output units per {result.unit}, bias D_a in output units, gauge {result.gauge}."]
    if result.coverage_factor is not None:
        notes.append(
            f"{INTERVAL}: half of the 95 % interval, {result.coverage_factor:.3g} sigma (Student's t)."
        )
    if result.gauge == "full" and not np.isfinite(result.sigma.K_a).all():
        notes.append(
            "In gauge full a rotation of the body frame is free and moves every entry of K_a; the search box alone "
            "chose it. Observable, and with an interval in the next table, are the scale factors of the axes, the "
            "angles between them and the bias."
        )
    return Table("Calibration", (Column("axis"), *chain.from_iterable(columns)), rows, tuple(notes))


def _pair(value: float, interval: float, *, lost: bool) -> list[object]:
    """Return a value and its interval, or that the poses do not determine it."""
    if lost:
        return [quoted.UNKNOWN, None]
    return [value, interval if np.isfinite(interval) else None]


def engineering(result: Calibration) -> Table:
    """Return scale-factor errors, misalignments and biases, each in the two units that engineers use."""
    values, interval = quoted.in_parts(result)
    kinds, rows = quoted.kinds(result), []
    for p, name in enumerate(PARAMETERS):
        kind, unit, factor, second, second_factor = kinds[p // 3]
        pair = (
            [quoted.ASSUMED, None]
            if result.held[p]
            else _pair(values[p], interval[p], lost=bool(result.lost[p]))
        )
        first, other = ([_times(cell, f) for cell in pair] for f in (factor, second_factor))
        rows.append((f"{kind} {name.split()[-1]}", *first, unit, *other, second))
    columns = (
        Column("parameter"),
        Column("value", format=",.6g"),
        Column(INTERVAL, format=",.3g", key="interval", beside=True),
        Column("unit", beside=True),
        Column("value", format=",.6g", key="value_2"),
        Column(INTERVAL, format=",.3g", key="interval_2", beside=True),
        Column("unit", key="unit_2", beside=True),
    )
    return Table("Engineering view", columns, tuple(rows), (quoted.reference(result),))


def _times(cell: object, factor: float) -> object:
    """Return a number times a factor; words and nothing as they are."""
    return cell * factor if isinstance(cell, float) else cell


def temperature(result: Calibration, slopes: Temperature) -> Table:
    """Return the change of scale factors and biases per degree."""
    force = units.MICRO_G / units.sensitivity(result.K_a) / result.g
    rows = [
        (
            f"scale factor {AXES[i]}",
            slopes.scale[i] * units.PPM,
            slopes.interval_scale[i] * units.PPM,
            "ppm per degree",
        )
        for i in range(3)
    ]
    rows += [
        (
            f"bias {AXES[i]}",
            slopes.bias[i] * force[i],
            slopes.interval_bias[i] * force[i],
            "micro-g per degree",
        )
        for i in range(3)
    ]
    columns = (
        Column("parameter"),
        Column("slope", format=",.2f"),
        Column(INTERVAL, format=",.2f", key="interval", beside=True),
        Column("unit"),
    )
    note = (
        f"The other parameters hold at {slopes.reference:.4g} degrees; the poses range from {slopes.low:.4g} to "
        f"{slopes.high:.4g}."
    )
    return Table("Temperature", columns, tuple(rows), (note,))


def worn(figures: Worn) -> Table:
    """Return what GGIR says of a calibration with days of wear."""
    rows = (
        (
            "mean error before",
            f"{figures.error_before:.4g}" if np.isfinite(figures.error_before) else "-",
            "mg",
        ),
        ("mean error after", f"{figures.error_after:.4g}", "mg"),
        ("points, windows of 10 s at rest", f"{figures.windows:,}", ""),
        ("sphere filled within +-0.3 g", "yes" if figures.filled else "no", ""),
        *(
            (f"rest along {axis}", f"{low:.2f} to {high:.2f}", "g")
            for axis, low, high in zip(AXES, figures.low, figures.high, strict=True)
        ),
        ("hours recorded", f"{figures.hours:.4g}", "h"),
        ("hours at rest", f"{figures.rest_hours:.4g}", "h"),
    )
    note = "Error: mean of | |a| - 1 g | over the windows. GGIR asks for a filled sphere and less than 10 mg after."
    return Table(
        "Days of wear", (Column("quantity"), Column("value"), Column("unit", beside=True)), rows, (note,)
    )


def fit(result: Calibration) -> Table:
    """Return how well the readings fit."""
    unit = result.unit
    polished = [("cost L after polish", f"{result.cost:.9g}", f"({unit})^4")]
    chance = result.residual_noise_ratio is not None and [
        ("residual noise / noise expected from the readings", f"{result.residual_noise_ratio:.3g}", ""),
        ("p-value", f"{result.residual_noise_p:.2g}", ""),
    ]
    rows = (
        ("rms of |f| - g before", f"{result.rms_before:.6g}", unit),
        ("rms of |f| - g after", f"{result.rms:.6g}", unit),
        ("noise of one pose, s", f"{result.s:.6g}" if result.freedom > 0 else "-", unit),
        *(chance or ()),
        ("poses", str(result.poses), ""),
        ("degrees of freedom", str(result.freedom), ""),
        (f"cost L after {result.optimizer}", f"{result.cost_search:.9g}", f"({unit})^4"),
        *(polished if result.settings.get("polish", True) else ()),
        ("evaluations", f"{result.evaluations:,}", ""),
        ("searches in this minimum", f"{result.runs_agreeing} of {result.runs}", ""),
        ("local gravity g", f"{result.g:.7g}", unit),
    )
    columns = (Column("quantity"), Column("value"), Column("unit", beside=True))
    return Table("Fit", columns, rows, (f"Before: {result.before}.",))


def observability(result: Calibration) -> Table:
    """Return the dilution of precision of each parameter by the distinct attitudes, which the verdict rests on."""
    rows: list[tuple[object, ...]] = []
    for (name, dop), held in zip(result.geometry.parameters.items(), result.held, strict=True):
        word = "undetermined" if dop > UNDETERMINED else "weak" if dop > WEAK else "good"
        size = dop if np.isfinite(dop) else "infinite"
        rows.append((name, "-", quoted.ASSUMED) if held else (name, size, word))
    notes = (
        "Dilution of precision: parameter error divided by the noise of one pose "
        f"(as {result.unit} at 1 g), of the distinct attitudes; more than twelve count as twelve of their kind. Above "
        f"{WEAK:g} weak, above {UNDETERMINED:g} undetermined.",
    )
    columns = (Column("parameter"), Column("DOP", format=".3f"), Column(""))
    return Table("Observability", columns, tuple(rows), notes)


def worst_poses(result: Calibration) -> Table:
    """Return the poses with the largest studentised residuals, and those named as outliers."""
    size = [abs(p.residual if np.isnan(p.studentised) else p.studentised) for p in result.poses_fit]
    order = np.argsort(-np.array(size), kind="stable")[:WORST_SHOWN]
    rows = tuple(
        (
            p.pose + 1,
            p.where,
            p.residual,
            p.studentised,
            p.leverage,
            p.left_out,
            "outlier" if p.pose in result.outliers else "",
        )
        for p in (result.poses_fit[i] for i in order)
    )
    unit = result.unit
    columns = (
        Column("pose", format="d"),
        Column("where"),
        Column("|f| - g", unit, ".3e"),
        Column("studentised", format=".2f"),
        Column("leverage", format=".2f"),
        Column("left out", unit, ".3e"),
        Column(""),
    )
    return Table("Worst poses", columns, rows)


def numbers(result: Calibration) -> Table:
    """Return one row per parameter and number, for frames; one that is not determined has no value."""
    whole = values(result)
    columns = tuple(
        replace(column, format="g") if 0 < k < 4 else column for k, column in enumerate(whole.columns)
    )
    return Table(whole.title, columns, tuple(row for row in whole.rows if row[0] != "verdict"))


def values(result: Calibration) -> Table:
    """Return one row per parameter, for CSV; one that is not determined has no value."""
    lost = result.lost_entries
    names = [f"K_{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)] + ["D_1", "D_2", "D_3"]
    entries = (
        np.concatenate([result.K_a, [result.D_a]]),
        np.concatenate([result.sigma.K_a, [result.sigma.D_a]]),
        np.concatenate([result.interval.K_a, [result.interval.D_a]]),
    )
    units_ = [f"output units per {result.unit}"] * 9 + ["output units"] * 3
    rows: list[tuple[object, ...]] = [
        (name, *((None,) * 3 if gone else numbers), unit)
        for name, *numbers, gone, unit in zip(
            names, *(e.ravel().tolist() for e in entries), lost.ravel().tolist(), units_, strict=True
        )
    ]
    rows += _engineering_values(result)
    rows += [
        ("cost", result.cost, None, None, f"({result.unit})^4"),
        ("rms", result.rms, None, None, result.unit),
        ("g", result.g, None, None, result.unit),
        ("coverage_factor", result.coverage_factor, None, None, ""),
        ("verdict", result.verdict, None, None, ""),
    ]
    columns = (Column("parameter"), Column("value"), Column("sigma"), Column("interval"), Column("unit"))
    return Table("Calibration", columns, tuple(rows))


def _engineering_values(result: Calibration) -> list[tuple[object, ...]]:
    """Return the engineering view as rows for CSV: name, value, sigma, interval, unit."""
    values, sigma = result.engineering
    table = np.stack([values, sigma, result.interval_of(sigma)])
    table[:, BIAS] /= result.g
    table[:, result.lost | result.held] = np.nan
    names = [f"{kind}_{name.split()[-1]}" for kind, name in zip(np.repeat(KEYS, 3), PARAMETERS, strict=True)]
    rows: list[tuple[object, ...]] = []
    for p, (name, column) in enumerate(zip(names, table.T, strict=True)):
        *_, unit, size = KINDS[p // 3]
        rows.append((name, *(_finite(v * size) for v in column.tolist()), unit))
    return rows


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None


def pose_residuals(result: Calibration) -> Table:
    """Return every kept pose: residual before and after calibration, and the direction that pointed up."""
    unit = result.unit
    columns = (
        Column("pose", format="d"),
        Column("where"),
        Column("before", unit, ".3e"),
        Column("after", unit, ".3e"),
        Column("studentised", format=".2f"),
        Column("leverage", format=".2f"),
        *(Column(axis, format=".3f") for axis in AXES),
    )
    rows = tuple(
        (p.pose + 1, p.where, p.residual_before, p.residual, p.studentised, p.leverage, *p.direction)
        for p in result.poses_fit
    )
    notes = ("Before, after: |f| - g. x, y, z: unit direction of the specific force, gauge lower.",)
    return Table("Poses", columns, rows, notes)


def accuracy(result: Calibration) -> str:
    """Say in one sentence how well the parameters are known; an empty text where the poses do not tell."""
    values, sigma = result.engineering
    interval = result.interval_of(sigma)
    interval[SCALE] /= 1.0 + values[SCALE]
    interval[BIAS] /= result.g
    if result.verdict == "undetermined" or not np.isfinite(interval).all():
        return ""
    largest = [(name, interval[kind].max() * size, unit) for name, kind, unit, size in KINDS]
    parts = [f"{name} {v:{'.2g' if v < 100 else ',.0f'}} {unit}" for name, v, unit in largest if v > 0]
    return f"Largest half of a 95 % interval of each kind: {', '.join(parts)}."


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
