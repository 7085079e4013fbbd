"""The certificate of a calibration: a page of two printed sides, A4 or Letter."""

from __future__ import annotations

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError, did_you_mean
from accelcal_cli.output import figures
from accelcal_cli.output.document import render
from accelcal_cli.views import certificate as views

PAPERS = {"a4": "A4", "letter": "letter"}
"""Sizes of paper by name, as CSS calls them. The sides fit on either."""

STYLES = ("figures.css", "certificate.css")


def page(result: Calibration, name: str, title: str | None = None, paper: str = "a4") -> str:
    """Return the certificate of a result as HTML; the same result gives the same text.

    Args:
        result: what is certified; name: of its file, for a message.
        title: heading; paper: name of PAPERS.

    Raises:
        UsageError: the result is undetermined, or no such paper.
    """
    from markupsafe import Markup

    if paper not in PAPERS:
        raise UsageError(
            f'--paper "{paper}": unknown{did_you_mean(paper, PAPERS)}; expected one of {", ".join(PAPERS)}'
        )
    views.check(result, name)
    return render(
        "certificate.html.jinja",
        STYLES,
        rules=f"@page {{ size: {PAPERS[paper]}; }}\n",
        title=views.heading(title),
        paper=paper,
        result=result,
        limits=views.LIMITS,
        meaning=views.MEANING[result.verdict],
        stated=views.stated(result.meta),
        said=views.said(result),
        method=views.method(result),
        conditions=views.conditions(result),
        coverage=views.coverage(result),
        matrix=views.matrix(result),
        engineering=views.engineering(result),
        fit=views.fit(result),
        hashes=views.hashes(result),
        sphere=Markup(figures.sphere(result)),
        residuals=Markup(figures.residuals(result)),
    )
