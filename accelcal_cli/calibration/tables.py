"""A calibration as tables: what it shows, in the paper's units and in an engineer's."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from accelcal_cli.calibration.quality import UNDETERMINED, WEAK
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.temperature import Temperature
from accelcal_cli.sensor import units
from accelcal_cli.sensor.poses import AXES
from accelcal_cli.table import Column, Table

WORST_SHOWN = 5
UNKNOWN = "not determined"


def tables(result: Calibration) -> list[Table]:
    """Return every table of a result, in reading order."""
    warmth = [] if result.temperature is None else [temperature(result, result.temperature)]
    return [
        parameters(result),
        engineering(result),
        *warmth,
        fit(result),
        observability(result),
        worst_poses(result),
    ]


def parameters(result: Calibration) -> Table:
    """Return K_a and D_a with their one-sigma."""
    lost = _undetermined(result)
    rows = []
    for i in range(3):
        row: list[object] = [AXES[i]]
        for j in range(3):
            row += _pair(result.K_a[i, j], result.sigma.K_a[i, j], lost=bool(lost[i, j]))
        row += _pair(result.D_a[i], result.sigma.D_a[i], lost=bool(lost[3, i]))
        rows.append(row)
    columns = [Column("axis")]
    for name in ("K_x", "K_y", "K_z", "bias"):
        columns += [Column(name, format=".8g"), Column("sigma", format=".2g", key=f"sigma_{name}")]
    notes = [f"K_a in output units per {result.unit}, bias D_a in output units, gauge {result.gauge}."]
    if result.gauge == "full" and not np.isfinite(result.sigma.K_a).all():
        notes.append(
            "In gauge full a rotation of the body frame is free and moves every entry of K_a; the search box alone "
            "chose it. Observable, and with a sigma in the next table, are the scale factors and misalignments of "
            "gauge lower and the bias."
        )
    return Table("Calibration", tuple(columns), tuple(tuple(r) for r in rows), tuple(notes))


def _lost(result: Calibration) -> NDArray[np.bool_]:
    """Return which of the nine parameters are undetermined, shape (9,): all of them with fewer than nine poses."""
    return (np.array(list(result.dop.parameters.values())) > UNDETERMINED) | (result.freedom < 0)


def _undetermined(result: Calibration) -> NDArray[np.bool_]:
    """Return which entries of K_a (rows 0 to 2) and D_a (row 3) the poses leave undetermined, shape (4, 3)."""
    dop = _lost(result)
    lost = np.zeros((4, 3), dtype=bool)
    for p, (i, j) in enumerate(((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))):
        lost[i, j] = lost[j, i] = dop[p]
    lost[3] = dop[6:]
    lost[:3] &= result.K_a != 0  # a zero of the gauge is exact
    return lost


def _pair(value: float, sigma: float, *, lost: bool) -> list[object]:
    """Return a value and its sigma; a value that the poses do not determine is not shown as one."""
    if lost:
        return [UNKNOWN, None]
    return [value, sigma if np.isfinite(sigma) else None]


def engineering(result: Calibration) -> Table:
    """Return scale-factor errors, misalignments and biases, each in the two units that engineers use."""
    # A result in units of g counts the bias in g already; one in m/s^2 is divided by the local g for micro-g.
    metres, per_g = (units.STANDARD_GRAVITY, 1.0) if result.unit == "g" else (1.0, result.g)
    sigma = np.sqrt(np.diagonal(result.covariance))
    # In gauge lower, as their sigma: another gauge, above all the free rotation of gauge full, moves a scale factor
    # by half the square of the misalignments, which is many times that sigma.
    K = result.model.in_gauge("lower").K
    scale = units.scale_error(K, result.nominal_scale)
    angle = units.misalignment(K)
    bias = units.bias_force(K, result.D_a - result.nominal_bias)
    lost = _lost(result)
    sigma = np.where(lost, np.nan, sigma)
    rows = [_row(f"scale factor error {AXES[i]}", scale[i], sigma[i] / per_g, "ppm", "%") for i in range(3)]
    for p, (i, j) in enumerate(((0, 1), (0, 2), (1, 2))):
        value = angle[i, j] + angle[j, i]
        rows.append(_row(f"misalignment {AXES[i]}{AXES[j]}", value, sigma[3 + p] / per_g, "mrad", "arcsec"))
    for i in range(3):
        row = _row(
            f"bias {AXES[i]}", bias[i] / per_g, sigma[6 + i] / per_g, "micro-g", "m/s^2", metres * per_g
        )
        rows.append(row)
    columns = (
        Column("parameter"),
        Column("value", format=",.1f"),
        Column("sigma", format=",.1f"),
        Column("unit"),
        Column("value", format=".5f", key="value_2"),
        Column("sigma", format=".5f", key="sigma_2"),
        Column("unit", key="unit_2"),
    )
    return Table("Engineering view", columns, tuple(rows), (_reference(result),))


def _row(
    name: str, value: float, sigma: float, unit: str, second: str, force: float = 1.0
) -> tuple[object, ...]:
    """Return one row: value and sigma in two units; `force` is what one g is in the second unit of a bias."""
    first_factor = {"ppm": units.PPM, "mrad": units.MRAD, "micro-g": units.MICRO_G}[unit]
    second_factor = {"%": 100.0, "arcsec": units.ARCSEC, "m/s^2": force}[second]
    if not np.isfinite(sigma):
        return (name, UNKNOWN, None, unit, UNKNOWN, None, second)
    return (
        name,
        value * first_factor,
        sigma * first_factor,
        unit,
        value * second_factor,
        sigma * second_factor,
        second,
    )


def _reference(result: Calibration) -> str:
    """Return the sentence that says what the engineering numbers are relative to."""
    nominal = f"{result.nominal_scale[0]:.6g}"
    if np.ptp(result.nominal_scale) > 0:
        nominal = ", ".join(f"{k:.6g}" for k in result.nominal_scale)
    offset = ", ".join(f"{d:g}" for d in result.nominal_bias) if result.nominal_bias.any() else "0"
    return (
        f"Scale-factor errors against {nominal} output units per {result.unit}, biases against {offset} output units. "
        "Misalignment: the angle by which two sensor axes miss 90 degrees."
    )


def temperature(result: Calibration, slopes: Temperature) -> Table:
    """Return the change of scale factors and biases per degree."""
    force = units.MICRO_G / np.diagonal(result.model.in_gauge("lower").K) / result.g
    rows = [
        (
            f"scale factor {AXES[i]}",
            slopes.scale[i] * units.PPM,
            slopes.sigma_scale[i] * units.PPM,
            "ppm per degree",
        )
        for i in range(3)
    ]
    rows += [
        (f"bias {AXES[i]}", slopes.bias[i] * force[i], slopes.sigma_bias[i] * force[i], "micro-g per degree")
        for i in range(3)
    ]
    columns = (
        Column("parameter"),
        Column("slope", format=",.2f"),
        Column("sigma", format=",.2f"),
        Column("unit"),
    )
    note = (
        f"The other parameters hold at {slopes.reference:.4g} degrees; the poses went from {slopes.low:.4g} to "
        f"{slopes.high:.4g}."
    )
    return Table("Temperature", columns, tuple(rows), (note,))


def fit(result: Calibration) -> Table:
    """Return how well the readings fit."""
    unit = result.unit
    rows: list[tuple[object, ...]] = [
        ("rms of |f| - g before", f"{result.rms_before:.6g}", unit),
        ("rms of |f| - g after", f"{result.rms:.6g}", unit),
        ("noise of one pose, s", f"{result.s:.6g}" if result.freedom > 0 else "-", unit),
        ("poses", str(result.poses), ""),
        ("degrees of freedom", str(result.freedom), ""),
        (f"cost L after {result.optimizer}", f"{result.cost_search:.9g}", f"({unit})^4"),
        ("cost L after polish", f"{result.cost:.9g}", f"({unit})^4"),
        ("evaluations", f"{result.evaluations:,}", ""),
        ("searches in this minimum", f"{result.runs_agreeing} of {result.runs}", ""),
        ("local gravity g", f"{result.g:.7g}", unit),
    ]
    if not result.settings.get("polish", True):
        rows.pop(6)
    if result.noise_ratio is not None:
        rows.insert(3, ("s over the scatter within poses", f"{result.noise_ratio:.3g}", ""))
        rows.insert(4, ("chance of that ratio or more", f"{result.noise_chance:.2g}", ""))
    notes = (f"Before: {result.before}.",)
    return Table("Fit", (Column("quantity"), Column("value"), Column("unit")), tuple(rows), notes)


def observability(result: Calibration) -> Table:
    """Return the dilution of precision of each parameter."""
    rows = []
    for name, dop in result.dop.parameters.items():
        word = "undetermined" if dop > UNDETERMINED else "weak" if dop > WEAK else "good"
        rows.append((name, dop if np.isfinite(dop) else "infinite", word))
    notes = (
        "Dilution of precision: how many times the noise of one pose the error of a parameter comes out "
        f"(as {result.unit} at 1 g). Above {WEAK:g} weak, above {UNDETERMINED:g} undetermined.",
    )
    columns = (Column("parameter"), Column("DOP", format=".3f"), Column(""))
    return Table("Observability", columns, tuple(rows), notes)


def worst_poses(result: Calibration) -> Table:
    """Return the poses with the largest studentised residuals, and those named as outliers."""
    size = [abs(p.studentised) if np.isfinite(p.studentised) else abs(p.residual) for p in result.poses_fit]
    order = np.argsort(-np.array(size), kind="stable")[:WORST_SHOWN]
    rows = tuple(
        (
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
        Column("pose"),
        Column("|f| - g", unit, ".3e"),
        Column("studentised", format=".2f"),
        Column("leverage", format=".2f"),
        Column("left out", unit, ".3e"),
        Column(""),
    )
    return Table("Worst poses", columns, rows)


def values(result: Calibration) -> Table:
    """Return the parameters one a row, for CSV."""
    unit = f"output units per {result.unit}"
    rows: list[tuple[object, ...]] = [
        (f"K_{i + 1}{j + 1}", result.K_a[i, j], result.sigma.K_a[i, j], unit)
        for i in range(3)
        for j in range(3)
    ]
    rows += [(f"D_{i + 1}", result.D_a[i], result.sigma.D_a[i], "output units") for i in range(3)]
    rows += [
        ("cost", result.cost, None, f"({result.unit})^4"),
        ("rms", result.rms, None, result.unit),
        ("g", result.g, None, result.unit),
        ("verdict", result.verdict, None, ""),
    ]
    columns = (Column("parameter"), Column("value"), Column("sigma"), Column("unit"))
    plain = [tuple(v.item() if isinstance(v, np.generic) else v for v in row) for row in rows]
    return Table("Calibration", columns, tuple(plain))
