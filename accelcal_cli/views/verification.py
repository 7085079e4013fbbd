"""A verification as tables: parameter by parameter, and the tests."""

from __future__ import annotations

from accelcal_cli.calibration.observability import PARAMETERS
from accelcal_cli.sensor import model as units
from accelcal_cli.verification.verify import Difference, Verification
from accelcal_cli.views.blocks import BLANK, Block, Column, Conclusion, Table

UNITS = ((-units.PPM, "ppm"), (-1000.0 * units.MRAD, "micro-rad"), (units.MICRO_G, "micro-g"))
"""Of scale factors, misalignments and biases; those of the inverse matrix change sign, so that they are of K_a."""


def blocks(result: Verification) -> list[Block]:
    """Return what a verification shows: verdict first, then what it rests on."""
    conclusion = Conclusion(result.verdict, result.reasons, result.warnings)
    return [conclusion, BLANK, differences(result), evidence(result)]


def differences(result: Verification) -> Table:
    """Return the nine differences, new minus old, in an engineer's units."""
    rows = tuple(_row(d, result) for d in result.differences)
    columns = (
        Column("parameter"),
        Column("new - old", format=",.1f", key="difference"),
        Column("sigma", format=",.1f"),
        Column("unit"),
        Column("p-value", format=".2g", key="chance"),
        Column("adjusted", format=".2g"),
        Column("", key="changed"),
    )
    note = (
        "p-value: probability of a difference as large or larger if nothing changed; adjusted: the same, corrected for "
        "nine comparisons (Holm)."
    )
    return Table("Differences", columns, rows, (note,))


def _row(d: Difference, result: Verification) -> tuple[object, ...]:
    """Return one parameter."""
    size, unit = UNITS[PARAMETERS.index(d.name) // 3]
    if d.value != d.value:
        return (d.name, None, None, unit, None, None, "not determined")
    factor, changed = size / result.g, "changed" if d.changed else ""
    return (d.name, d.value * factor + 0.0, d.sigma * abs(factor), unit, d.chance, d.adjusted, changed)


def evidence(result: Verification) -> Table:
    """Return what the verdict rests on."""
    unit = result.unit
    known = result.freedom > 0
    noise = [("p-value of the difference in noise", f"{result.noise_chance:.2g}", "")] if known else []
    tolerance = [] if result.tolerance is None else [("tolerance", f"{result.tolerance:g}", unit)]
    rows = (
        ("p-value, all tests together", f"{result.chance:.3g}", ""),
        ("level", f"{result.level:g}", ""),
        (f"chi-square of {result.directions} directions", f"{result.chi_square:.4g}", ""),
        ("p-value of that chi-square", f"{result.chance_together:.3g}", ""),
        ("noise of one pose, old", f"{result.s_old:.6g}", unit),
        ("noise of one pose, new", f"{result.s_new:.6g}" if known else "-", unit),
        *noise,
        ("rms of |f| - g under the old result", f"{result.rms:.6g}", unit),
        *tolerance,
        ("poses", str(result.poses), ""),
        ("local gravity g", f"{result.g:.7g}", unit),
    )
    return Table("Tests", (Column("quantity"), Column("value"), Column("unit")), rows)
