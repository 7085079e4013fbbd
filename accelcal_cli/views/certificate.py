"""The two sides of a certificate: what is stated of the sensor, how it was calibrated, the numbers, the warnings.

Everything has a length that is known beforehand, in lines of print, so that the two sides hold it: what would not fit
is named by its key, with the place where its full text is.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from unicodedata import east_asian_width

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.calibration.provenance import settings_sha256
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError
from accelcal_cli.notices import Notice
from accelcal_cli.schema import frozen
from accelcal_cli.sensor.poses import AXES
from accelcal_cli.views import quoted
from accelcal_cli.views.blocks import Column, Table
from accelcal_cli.views.report import NOT_ESTIMATED, dated, determined, gravity

SIMPLE, IN_TABLE = 55, 12
"""Width of a value, and entries of the identification, that stand in a table; others stand one behind the other."""

MOST_STATED, NAMED = 1500, 6
"""Width of the identification that the first side has room for, and entries beyond it that are named."""

LINE, MOST_LINES = 100, 20
"""Width of a line of warnings, and lines that the second side has room for."""

SENTENCE = re.compile(r"(?<=[.]) ")
"""Where a sentence ends."""

LIMITS = (
    "This page states the result of a computation with accelcal from readings that the user supplied. It is issued by "
    "whoever signs it. accelcal is no calibration laboratory: no accreditation and no metrological traceability are "
    "stated or implied."
)

MEANING = {
    "good": "The poses determine every parameter, and no warning stands against the numbers.",
    "weak": "The poses determine the parameters poorly: the stated intervals are wide.",
    "suspect": "A warning stands: a parameter may be biased by more than its stated interval tells.",
}
"""What a verdict says."""


@frozen()
class Identification:
    """What is stated of the sensor, as far as there is room.

    Attributes:
        entries: key and value; dense: whether they stand one behind the other.
        left_out: keys of those that there is no room for, in words.
    """

    entries: tuple[tuple[str, str], ...]
    dense: bool
    left_out: str


@frozen()
class Said:
    """Reasons and warnings, as far as there is room.

    Attributes:
        sentences: in full or their first sentences; shortened: whether some are not in full.
        left_out: keys of those that there is no room for, in words.
    """

    sentences: tuple[str, ...]
    shortened: bool
    left_out: str


def check(result: Calibration, name: str) -> None:
    """Refuse a result that cannot be certified.

    Raises:
        UsageError: it is undetermined; `name` is named in the message.
    """
    if result.verdict == "undetermined":
        why = result.reasons[0].rstrip(".") if result.reasons else "the poses do not determine the parameters"
        raise UsageError(
            f"{name}: its verdict is undetermined ({why}), so there is nothing to certify; add poses and calibrate "
            "again, or leave out --certificate for a report"
        )


def width(text: str) -> float:
    """Return how wide text is printed, in small letters."""
    return sum(
        2.0 if east_asian_width(c) in "WF" else 1.7 if c in "WM@%mw" else 1.25 if c.isupper() else 1.0
        for c in text
    )


def listed(names: Sequence[str]) -> str:
    """Return names in words, the first few of many."""
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return ", ".join(names[:NAMED]) + more


def heading(title: str | None) -> str:
    """Return the heading, on two lines at most."""
    return _shortened(title or "Calibration certificate", 90)


def stated(meta: Mapping[str, str]) -> Identification:
    """Return what is stated of the sensor, in the order in which it was stated."""
    entries: list[tuple[str, str]] = []
    left_out: list[str] = []
    length = 0.0
    for key, value in meta.items():
        length += width(key) + width(value) + 4.0
        if length <= MOST_STATED:
            entries.append((key, value))
        else:
            left_out.append(key)
    dense = len(meta) > IN_TABLE or any(width(k) > 20 or width(v) > SIMPLE for k, v in entries)
    return Identification(tuple(entries), dense, listed(left_out))


def said(result: Calibration) -> Said:
    """Return reasons and warnings, warnings before notes: in full where they fit, else the first sentence of each."""
    order = sorted(result.warnings, key=lambda notice: notice.severity != "warning")
    whole = [*result.reasons, *(f"{notice.severity.capitalize()}: {notice}" for notice in order)]
    if not whole:
        return Said((determined(result),), False, "")
    if _lines(whole) <= MOST_LINES:
        return Said(tuple(whole), False, "")
    short = [*(_first(reason) for reason in result.reasons), *(_short(notice) for notice in order)]
    keys = [*("reason" for _ in result.reasons), *(notice.key for notice in order)]
    kept: list[str] = []
    for sentence in short:
        if _lines([*kept, sentence]) > MOST_LINES - 2:
            break
        kept.append(sentence)
    return Said(tuple(kept), True, listed(list(dict.fromkeys(keys[len(kept) :]))))


def _lines(sentences: Sequence[str]) -> int:
    return sum(math.ceil(width(sentence) / LINE) for sentence in sentences)


def _first(sentence: str) -> str:
    return _shortened(SENTENCE.split(sentence)[0], 3 * LINE)


def _short(notice: Notice) -> str:
    return f"{notice.severity.capitalize()}: {_first(notice.text)}"


LOSSES = {"huber": "Huber's loss", "soft-l1": "the soft l1 loss"}
WEIGHTING = {
    "n": "weighted by the number of their readings",
    "sd": "weighted by the scatter and the number of their readings",
    "auto": "weighted by the scatter of their readings beside an error that they share",
}


def method(result: Calibration) -> tuple[str, str]:
    """Return in two sentences what was estimated, and how."""
    settings = result.settings
    unknowns = "scale factors and bias (axes taken as perpendicular)" if result.held.any() else "K and D"
    drift = ", with slopes of scale factors and bias against temperature" if result.temperature else ""
    weights = WEIGHTING.get(str(settings.get("weights")), "")
    if settings.get("attitudes") == "known":
        how = f", the poses {weights}" if weights else ""
        return (
            f"All twelve parameters of N = K f + D, the readings N in a stationary sensor, follow from the stated "
            f"specific force f of each of {result.poses:,} poses{drift}.",
            f"They are found by linear least squares{how}, and their uncertainty from the residuals of the fit.",
        )
    loss = LOSSES.get(str(settings.get("robust")), "")
    details = [f"the poses {weights}"] if weights else []
    details += [f"with {loss}"] if loss else []
    polished = " and polished by Levenberg-Marquardt" if settings.get("polish", True) else ""
    how = f", {', '.join(details)}" if details else ""
    return (
        f"The modulus of gravity is the reference: {unknowns} of N = K f + D minimise the cost L, the sum of "
        f"(g\u00b2 - |f|\u00b2)\u00b2 over {result.poses:,} static poses of unknown attitude{drift}.",
        f"L was searched by {result.optimizer}{polished} ({result.evaluations:,} evaluations{how}), and the "
        "uncertainty follows from the residuals of the fit.",
    )


def conditions(result: Calibration) -> list[tuple[str, str]]:
    """Return under what the readings were taken: gravity, temperature, poses."""
    attitudes = "" if result.attitudes is None else f", {result.attitudes:,} distinct attitudes"
    return [
        ("readings", _shortened(str(result.data.get("source", "-")), 90)),
        ("poses", f"{result.poses:,}{attitudes}"),
        ("local gravity", _shortened(gravity(result), 150)),
        ("temperature", _temperature(result)),
        ("calculated", dated(result)),
    ]


def _shortened(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[: length - 4]} ..."


def _temperature(result: Calibration) -> str:
    drift = result.temperature
    if drift is not None:
        ends = f"{drift.low:.4g} to {drift.high:.4g} degrees"
        return f"poses at {ends}; the parameters hold at {drift.reference:.4g} degrees"
    measured = result.data.get("temperature")
    if isinstance(measured, list | tuple) and len(measured) == 3:
        low, mean, high = measured
        return f"poses at {low:.4g} to {high:.4g} degrees, mean {mean:.4g}; no slopes estimated"
    return "not in the readings" + (
        ", see identification" if "temperature" in result.meta else "; not recorded"
    )


def coverage(result: Calibration) -> str:
    """Return what the intervals are."""
    if result.coverage_factor is None:
        return "There are no degrees of freedom, so no uncertainty can be stated."
    return (
        f"\u00b1: half of the 95 % interval, the coverage factor k = {result.coverage_factor:.3g} times sigma; "
        f"Student's t with {result.sigma_freedom:.3g} effective degrees of freedom."
    )


def matrix(result: Calibration) -> Table:
    """Return K and the bias with sigma and 95 % intervals; a cell is the value, then its sigma."""
    values = np.column_stack([result.K_a, result.D_a])
    halves = np.column_stack([result.interval.K_a, result.interval.D_a])
    sigmas = np.column_stack([result.sigma.K_a, result.sigma.D_a])
    rows = []
    for i, axis in enumerate(AXES):
        cells: list[object] = [axis]
        for j in range(4):
            if result.held.any() and i != j < 3:
                cells += ["", ""]
                continue
            shown, spread = quoted.quote(float(values[i, j]), float(halves[i, j]))
            cells.append(f"{shown} {quoted.PLUS_MINUS} {spread}" if spread else shown)
            cells.append(_two_digits(float(sigmas[i, j])) if spread else "")
        rows.append(tuple(cells))
    columns = [Column("axis")]
    for name in ("K_x", "K_y", "K_z", "bias"):
        columns += [Column(name), Column("sigma")]
    note = f"K in output units per {result.unit}, bias in output units, gauge {result.gauge}."
    return Table(f"K and bias D of N = K f + D, {quoted.QUOTED}", tuple(columns), tuple(rows), (note,))


def _two_digits(sigma: float) -> str:
    """Return a sigma as intervals are quoted; nothing without one."""
    return quoted.quote(0.0, sigma)[1]


def engineering(result: Calibration) -> Table:
    """Return the parameters that were estimated in engineering units, with sigma and 95 % intervals."""
    table = quoted.engineering(result)
    _, intervals = quoted.in_parts(result)
    rows = []
    for p, (name, shown, other) in enumerate(table.rows):
        if result.held[p]:
            continue
        size = quoted.kinds(result)[p // 3][2]
        sigma = intervals[p] * size / result.coverage_factor if result.coverage_factor else math.nan
        rows.append((name, shown, _two_digits(sigma), other))
    parameter, value, further = table.columns
    notes = (*table.notes, NOT_ESTIMATED) if result.held.any() else table.notes
    return Table(
        "Parameters, " + quoted.QUOTED, (parameter, value, Column("sigma"), further), tuple(rows), notes
    )


def fit(result: Calibration) -> list[tuple[str, str]]:
    """Return how well the readings fit, name and value."""
    unit = result.unit
    ratio = result.residual_noise_ratio
    chance = (
        []
        if ratio is None
        else [("residual noise / noise expected", f"{ratio:.3g} (p-value {result.residual_noise_p:.2g})")]
    )
    return [
        ("rms of |f| - g before", f"{result.rms_before:.3g} {unit}"),
        ("rms of |f| - g after", f"{result.rms:.3g} {unit}"),
        *([("noise of one pose, s", f"{result.s:.3g} {unit}")] if result.freedom > 0 else []),
        ("degrees of freedom", f"{max(result.freedom, 0):,}"),
        *([("coverage factor", f"{result.coverage_factor:.3g}")] if result.coverage_factor else []),
        ("worst dilution of precision", f"{result.dop.worst:.3g}"),
        ("outliers", f"{len(result.outliers):,}"),
        *chance,
    ]


def hashes(result: Calibration) -> list[tuple[str, str]]:
    """Return the hashes of data and settings, and the versions."""
    version = f"accelcal {result.version}"
    printed = "" if result.version == __version__ else f"; page by accelcal {__version__}"
    return [
        ("SHA-256 of the readings", str(result.data.get("sha256", "not recorded"))[:64]),
        ("SHA-256 of the settings", settings_sha256(result.record()["settings"])),
        ("software", f"{version}{printed}; record {result.schema}"),
    ]
