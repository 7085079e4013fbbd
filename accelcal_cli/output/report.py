"""The report: one self-contained page of a calibration, of a few side by side, or of a fleet, for screen and paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from accelcal_cli import __version__
from accelcal_cli.calibration.result import Calibration, load_result
from accelcal_cli.config import dump
from accelcal_cli.output import figures
from accelcal_cli.output.document import check_packages, render
from accelcal_cli.output.files import whole_file
from accelcal_cli.views import calibration as tables
from accelcal_cli.views import comparison
from accelcal_cli.views import report as views

STYLES = ("report.css", "figures.css", "print.css")
SCRIPT = "report.js"

SIDE_BY_SIDE = 4
"""Results that stand side by side at most; more are a fleet."""


def report(
    result: Calibration | str | Path,
    output: str | Path | None = None,
    *,
    title: str | None = None,
    certificate: bool = False,
    paper: str = "a4",
) -> str:
    """Return a report of a result, one HTML page with pictures, and write it where a name is given.

    Args:
        result: the calibration, or its file; output: file to write, whole or not at all; title: heading of the page.
        certificate: the two printed sides of a certificate instead; paper: that they are printed on, a4 or letter.

    Raises:
        UsageError: jinja2 is missing, or a certificate of a result that is undetermined. OutputError: it cannot be
            written.

    Examples:
        >>> from accelcal_cli import calibrate, report, simulate
        >>> page = report(calibrate(simulate("mems", positions=24).output), title="Desk 1")
        >>> "Desk 1" in page
        True
    """
    check_packages()
    calibration = result if isinstance(result, Calibration) else load_result(result)
    if certificate:
        from accelcal_cli.output import certificate as sides

        text = sides.page(
            calibration, "result" if isinstance(result, Calibration) else str(result), title, paper
        )
    else:
        text = page(calibration, title or f"Calibration of {source_name(calibration)}")
    if output is not None:
        write(text, str(output))
    return text


def write(text: str, output: str) -> None:
    """Write a page, whole or not at all.

    Raises:
        OutputError: it cannot be written.
    """
    with whole_file(output, binary=True) as file:
        file.write(text.encode())  # the page says that it is UTF-8, whatever the terminal takes


def source_name(result: Calibration) -> str:
    """Return the name of the file of the readings."""
    return Path(str(result.data.get("source", "the readings"))).name


def page(result: Calibration, title: str) -> str:
    """Return the page of one result as HTML; the same result gives the same text.

    Args:
        result: what is reported; title: heading of the page.
    """
    from markupsafe import Markup

    worst = tables.worst_poses(result)
    return render(
        "report.html.jinja",
        STYLES,
        SCRIPT,
        result=result,
        title=title,
        sentence=views.determined(result),
        accuracy=tables.accuracy(result),
        headline=views.headline(result),
        parameters=views.parameter_tables(result),
        fit=views.fit(result),
        worst=worst.filled(),
        worst_keys=[views.pose_key(row[0] - 1) for row in worst.rows],
        poses=tables.pose_residuals(result).filled(),
        keys=[views.pose_key(fit.pose) for fit in result.poses_fit],
        observability=views.observability(result),
        pictures={name: Markup(draw(result)) for name, draw in PICTURES.items()},
        settings=dump(result.record()["settings"]),
        origin=views.origin(result),
    )


PICTURES = {
    "residuals": figures.residuals,
    "sphere": figures.sphere,
    "convergence": figures.convergence,
    "dilution": figures.dilution,
}
"""The pictures of a report by name."""


def side_by_side(results: Mapping[str, Calibration], title: str) -> str:
    """Return the page of two to four results by label: what they are, their parameters, their differences.

    Raises:
        UsageError: results of different units.
    """
    from markupsafe import Markup

    labels, each = list(results), list(results.values())
    comparison.check_alike(labels, each)
    words = sorted({result.verdict for result in each}, key=tables.VERDICTS.index, reverse=True)
    kinds = comparison.rows(each)
    return render(
        "comparison.html.jinja",
        STYLES,
        SCRIPT,
        title=title,
        labels=labels,
        verdicts=[
            (word, ", ".join(k for k, one in results.items() if one.verdict == word)) for word in words
        ],
        notices={word: _said(results, word) for word in words},
        overview=comparison.overview(labels, each),
        parameters=comparison.parameters(labels, each),
        differences=comparison.differences(labels, each),
        pictures=[
            Markup(figures.intervals(kind, own[0].unit, own, labels, f"intervals-{k}"))
            for k, (kind, own) in enumerate(kinds.items())
        ],
        poses=[
            (
                label,
                Markup(figures.residuals(one, f"residuals-{k}", f"-{k}")),
                Markup(figures.sphere(one, f"sphere-{k}", f"-{k}")),
            )
            for k, (label, one) in enumerate(results.items())
        ],
        origins=[(label, views.origin(one)) for label, one in results.items()],
    )


def _said(results: Mapping[str, Calibration], verdict: str) -> list[str]:
    """Return the reasons and warnings of the results of a verdict, each after the label of its result."""
    return [
        f"{label}: {sentence}"
        for label, one in results.items()
        if one.verdict == verdict
        for sentence in (*one.reasons, *(f"{n.severity.capitalize()}: {n}" for n in one.warnings))
    ]


def fleet_page(results: Mapping[str, Calibration], title: str) -> str:
    """Return the page of many results by label: counts of verdicts, who is not good or stands out, how they spread.

    Raises:
        UsageError: results of different units.
    """
    from markupsafe import Markup

    from accelcal_cli.calibration.fleet import Fleet, standouts
    from accelcal_cli.views import fleet as fleets

    labels: Sequence[str] = list(results)
    each = list(results.values())
    comparison.check_alike(labels, each)
    fleet, g = Fleet.of(each), each[0].g
    spread = fleets.quantities(fleet, g)
    return render(
        "fleet.html.jinja",
        STYLES,
        SCRIPT,
        title=title,
        counts=fleets.counts(fleet),
        verdicts=[
            (word, int((fleet.verdict == word).sum())) for word in fleets.VERDICTS if word in fleet.verdict
        ],
        tables=fleets.tables(fleet, labels, standouts(fleet, g), g),
        pictures=[
            Markup(figures.histogram(name, unit, values, labels, f"spread-{k}"))
            for k, (name, (unit, values)) in enumerate(spread.items())
            if np.isfinite(values).any()
        ],
        sensors=fleets.listing(fleet, labels, g),
        version=__version__,
    )
