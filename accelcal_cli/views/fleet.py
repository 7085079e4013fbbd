"""A fleet as tables: one row per sensor for programs, a summary for people."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.fleet import FAILED, NOISE, Fleet, Standout
from accelcal_cli.calibration.observability import PARAMETERS
from accelcal_cli.notices import Notice, in_one
from accelcal_cli.views.blocks import BLANK, Block, Column, Paragraph, Table

SHOWN = 10
"""Sensors of one kind that the summary names."""

FEW_SHOWN = 5
"""The same on one screen."""

WORST = 5
"""Sensors with the largest rms that the summary names."""

ADVICE = " Add these poses:"
"""Where the advice behind a reason begins, for which the summary has no room."""

CLAUSE = re.compile(r"[:.] ")
"""Where the first clause of a warning ends."""

RMS_BEFORE, RMS_AFTER = "rms of |f| - g before", "rms of |f| - g after"
WORST_DOP = "worst dilution of precision"
"""Names of the quantities that are shown beside the nine parameters and `NOISE`."""

SHORT = ("scale ", "misal. ", "bias ")
"""Kinds of parameters where there is little room."""

QUANTILES = (0.0, 0.05, 0.5, 0.95, 1.0)
VERDICTS = ("good", "weak", "suspect", "undetermined", FAILED)


class Cell(tuple[Notice, ...]):
    """Notices as a cell: one text to people and in CSV, a list of records in JSON."""

    __slots__ = ()

    def __str__(self) -> str:
        """The notices, one behind the other."""
        return in_one(self)


def sensors(fleet: Fleet, labels: Sequence[str], standouts: Sequence[Standout]) -> Table:
    """Return one row per sensor: verdict, parameters with sigma, dilution of precision, fit, and what is wrong."""
    entries = [(i, j) for i in range(3) for j in range(3)]
    numbers: list[tuple[str, Float]] = [
        *((f"K_{i + 1}{j + 1}", fleet.K_a[:, i, j]) for i, j in entries),
        *((f"D_{i + 1}", fleet.D_a[:, i]) for i in range(3)),
        *((f"sigma_K_{i + 1}{j + 1}", fleet.sigma_k[:, i, j]) for i, j in entries),
        *((f"sigma_D_{i + 1}", fleet.sigma_d[:, i]) for i in range(3)),
        *((f"dop_{name.replace(' ', '_')}", fleet.dop[:, p]) for p, name in enumerate(PARAMETERS)),
        ("coverage_factor", fleet.coverage),
        ("rms", fleet.rms),
        ("rms_before", fleet.rms_before),
        ("s", fleet.s),
        ("cost", fleet.cost),
    ]
    names = np.full(len(labels), "", dtype=object)
    for one in standouts:
        names[one.at] += ("; " if names[one.at] else "") + one.name
    columns = (
        Column("sensor"),
        Column("verdict"),
        Column("poses", format="d"),
        *(Column(name, format=".9g") for name, _ in numbers),
        Column("outlying poses", key="outlying_poses"),
        Column("stands out", key="stands_out"),
        Column("reason"),
        Column("warnings"),
    )
    said = [Cell(warnings) for warnings in fleet.warnings]
    lists = (
        [labels, fleet.verdict.tolist(), fleet.poses.tolist()]
        + [values.tolist() for _, values in numbers]
        + [fleet.outlying.tolist(), names.tolist(), fleet.reason.tolist(), said]
    )
    return Table("Sensors", columns, tuple(zip(*lists, strict=True)))


def counts(fleet: Fleet) -> str:
    """Return how many sensors there are of each verdict, and how many with a note or a warning, in words."""
    each = {word: int((fleet.verdict == word).sum()) for word in VERDICTS}
    listed = ", ".join(f"{n:,} {word}" for word, n in each.items() if n)
    warned = int(fleet.warned.sum())
    warnings = f", {warned:,} of them with a note or a warning" if warned else ""
    return f"{len(fleet.verdict):,} sensor{'s' * (len(fleet.verdict) != 1)}: {listed}{warnings}"


def blocks(
    fleet: Fleet, labels: Sequence[str], standouts: Sequence[Standout], g: float, verbose: bool = False
) -> list[Block]:
    """Return what a fleet shows: how many sensors of each verdict, which are not good, and how the fleet spreads.

    With `verbose` also those with the largest residuals and with warnings, and more of each kind.
    """
    most, shown = SHOWN if verbose else FEW_SHOWN, [Paragraph(heading=counts(fleet)), BLANK]
    tables = []
    bad, warned = np.flatnonzero(fleet.verdict != "good"), np.flatnonzero(fleet.warned)
    if len(bad):
        tables.append(_not_good(fleet, labels, bad, most))
    if standouts:
        tables.append(_standing_out(labels, standouts, g, most))
    if fleet.determined.any():
        tables += [_spread(fleet, g), *([_worst(fleet, labels, g)] if verbose else [])]
    if len(warned) and verbose:
        tables.append(_warned(fleet, labels, warned, g))
    last = "." if verbose else ". Worst fits and warnings: --verbose; a row for each sensor: --format csv"
    return [*shown, *tables, Paragraph(counts(fleet) + last)]


def _formats(g: float) -> dict[str, tuple[str, str]]:
    """Return unit and format of each quantity by its name, in the order in which they are shown."""
    force = "g" if g == 1.0 else "m/s^2"
    kinds = [(f"per {force}", ".6g"), ("mrad", ".2f"), ("micro-g", ",.0f")]
    return {
        **{name: kinds[p // 3] for p, name in enumerate(PARAMETERS)},
        RMS_BEFORE: (force, ".3g"),
        RMS_AFTER: (force, ".3g"),
        NOISE: (force, ".3g"),
        WORST_DOP: ("", ".3f"),
    }


def quantities(fleet: Fleet, g: float) -> dict[str, tuple[str, Float]]:
    """Return unit and values of each quantity, shape (R,), NaN for the sensors that their poses do not determine."""
    values = {
        **dict(zip(PARAMETERS, fleet.parameters.T, strict=True)),
        RMS_BEFORE: fleet.rms_before,
        RMS_AFTER: fleet.rms,
        NOISE: fleet.s,
        WORST_DOP: fleet.dop.max(axis=1),
    }
    return {
        name: (unit, np.where(fleet.determined, values[name], np.nan))
        for name, (unit, _) in _formats(g).items()
    }


def tables(fleet: Fleet, labels: Sequence[str], standouts: Sequence[Standout], g: float) -> list[Table]:
    """Return the tables of a fleet that `blocks` shows with `verbose`."""
    return [block for block in blocks(fleet, labels, standouts, g, verbose=True) if isinstance(block, Table)]


def listing(fleet: Fleet, labels: Sequence[str], g: float) -> Table:
    """Return one row per sensor for people: verdict, poses, fit, parameters."""
    formats = _formats(g)
    columns = (
        Column("sensor"),
        Column("verdict"),
        Column("poses", format="d"),
        Column("rms after", formats[RMS_AFTER][0], ".3g"),
        Column("s", formats[NOISE][0], ".3g"),
        *(Column(SHORT[p // 3] + name.split()[-1], *formats[name]) for p, name in enumerate(PARAMETERS)),
    )
    shown = np.where(fleet.determined[:, None], fleet.parameters, np.nan)
    rows = tuple(
        (label, verdict, poses, rms, s, *numbers)
        for label, verdict, poses, rms, s, numbers in zip(
            labels,
            fleet.verdict.tolist(),
            fleet.poses.tolist(),
            fleet.rms.tolist(),
            fleet.s.tolist(),
            shown.tolist(),
            strict=True,
        )
    )
    return Table("Sensors", columns, rows)


def _spread(fleet: Fleet, g: float) -> Table:
    """Return quantiles of parameters, fit and dilution of precision over the sensors with a verdict to use."""
    formats, rows = _formats(g), []
    for name, (unit, values) in quantities(fleet, g).items():
        spec = formats[name][1]
        values = values[np.isfinite(values)]
        if len(values):
            row = np.quantile(values, QUANTILES).tolist()
            named = f"{name} [{unit}]" if unit else name
            cells = [format(v, spec) for v in row]
            rows.append((named, *cells))
    columns = ("quantity", "least", "5 %", "median", "95 %", "most")
    note = "Of the sensors that their poses determine; scale factors in output units."
    numbers = [list(column) for column in zip(*rows, strict=True)]
    aligned = [numbers[0], *([f"{cell:>{max(map(len, own))}}" for cell in own] for own in numbers[1:])]
    return Table("Fleet", tuple(map(Column, columns)), tuple(zip(*aligned, strict=True)), (note,))


def _worst(fleet: Fleet, labels: Sequence[str], g: float) -> Table:
    """Return the sensors with the largest rms."""
    size = np.where(fleet.determined, fleet.rms, -1.0)
    order = np.argsort(-size, kind="stable")[: min(WORST, int(fleet.determined.sum()))]
    unit = "g" if g == 1.0 else "m/s^2"
    columns = (
        Column("sensor"),
        Column("rms after", unit, ".4g"),
        Column("rms before", unit, ".4g"),
        Column("s", unit, ".3g"),
        Column("worst DOP", format=".3f"),
        Column("poses", format="d"),
        Column("outlying poses"),
    )
    rows = [
        (
            labels[r],
            float(fleet.rms[r]),
            float(fleet.rms_before[r]),
            float(fleet.s[r]),
            float(fleet.dop[r].max()),
            int(fleet.poses[r]),
            str(fleet.outlying[r]),
        )
        for r in order
    ]
    outlying = int((fleet.outlying != "").sum())
    note = f"Sensors with outliers: {outlying:,} (column outlying_poses of --format csv)."
    return Table("Worst fit", columns, tuple(rows), (note,) if outlying else ()).filled()


def _more(number: int, most: int, where: str = "") -> tuple[str, ...]:
    """Return a note of the sensors that are not shown, of a number of them."""
    return (f"And {number - most:,} more{where}.",) if number > most else ()


def _standing_out(labels: Sequence[str], standouts: Sequence[Standout], g: float, most: int) -> Table:
    """Return the sensors that stand out from the fleet."""
    formats = _formats(g)
    rows = tuple(
        (
            labels[one.at],
            f"{one.name} [{formats[one.name][0]}]" if formats[one.name][0] else one.name,
            *(format(value, formats[one.name][1]) for value in (one.value, one.middle)),
            one.z,
        )
        for one in standouts[:most]
    )
    columns = (
        Column("sensor"),
        Column("quantity"),
        Column("value"),
        Column("fleet"),
        Column("z", format="+.1f"),
    )
    note = (
        "z: distance from the median in standard deviations of the fleet, by its median absolute deviation."
    )
    more = _more(len(standouts), most, " (column stands_out of --format csv)")
    return Table("Stand out from the fleet", columns, rows, (note, *more))


def _warned(fleet: Fleet, labels: Sequence[str], warned: Int, g: float) -> Table:
    """Return the sensors with notes or warnings, the noisiest first; of each the first in short."""
    order = warned[np.argsort(-np.nan_to_num(fleet.s[warned]), kind="stable")][:SHOWN]
    rows = tuple(
        (
            labels[r],
            100.0 * float(fleet.s[r]) / g,
            fleet.outlying[r],
            CLAUSE.split(fleet.warnings[r][0].text)[0],
        )
        for r in order
    )
    note = "s: standard deviation of one pose. Full sentences: column warnings of --format csv."
    columns = (
        Column("sensor"),
        Column("s", "% of g", ".3g"),
        Column("outlying poses"),
        Column("warning"),
    )
    return Table("Warnings", columns, rows, (note, *_more(len(warned), SHOWN)))


def _why(fleet: Fleet, r: int) -> str:
    """Return why a sensor is not good: what its poses leave open, else its first warning, in short."""
    serious = [notice for notice in fleet.warnings[r] if notice.severity == "warning"]
    if fleet.verdict[r] == "suspect" and serious:
        return CLAUSE.split(serious[0].text)[0].rstrip(".")
    return str(fleet.reason[r].partition(ADVICE)[0])


def _not_good(fleet: Fleet, labels: Sequence[str], bad: Int, most: int) -> Table:
    """Return the sensors whose verdict is not good, the worst verdict first."""
    order = sorted(bad.tolist(), key=lambda r: -VERDICTS.index(fleet.verdict[r]))
    rows = tuple((labels[r], fleet.verdict[r], _why(fleet, r)) for r in order[:most])
    columns = (Column("sensor"), Column("verdict"), Column("why"))
    return Table("Not good", columns, rows, _more(len(bad), most))


def with_limits(table: Table, passed: Bool, reasons: Sequence[str]) -> Table:
    """Return the rows of sensors with whether each keeps the limits, shape (R,), and why not."""
    columns = (*table.columns, Column("passed"), Column("failed limits", key="failed_limits"))
    words = ("false", "true")
    ends = zip(table.rows, passed.tolist(), reasons, strict=True)
    return Table(
        table.title, columns, tuple((*row, words[one], reason) for row, one, reason in ends), table.notes
    )


def limit_blocks(
    passed: Bool,
    counts: Mapping[str, int],
    reason: Callable[[int], str],
    labels: Sequence[str],
    verbose: bool = False,
) -> list[Block]:
    """Return how many sensors keep the limits and which do not.

    Args:
        passed: which do, shape (R,); counts: how many do not, by parameter; reason: why one does not, by its number.
        labels: of the sensors; verbose: more of them.
    """
    bad, most = np.flatnonzero(~passed), SHOWN if verbose else FEW_SHOWN
    beyond = ", ".join(f"{kind} {n:,}" for kind, n in counts.items() if n)
    line = f"Limits: {len(passed) - len(bad):,} of {len(passed):,} sensors pass" + (
        f"; beyond: {beyond}" if beyond else ""
    )
    if not len(bad):
        return [Paragraph(line), BLANK]
    rows = tuple((labels[r], reason(r)) for r in bad[:most].tolist())
    more = _more(len(bad), most, " (column failed_limits of --format csv)")
    return [Paragraph(line), BLANK, Table("Beyond the limits", (Column("sensor"), Column("why")), rows, more)]
