"""The report: one self-contained page of a calibration, with pictures, for the screen and for paper."""

from __future__ import annotations

import importlib.util
from typing import TYPE_CHECKING, Any

from accelcal_cli import __version__
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.config import dump
from accelcal_cli.errors import UsageError
from accelcal_cli.output.report import pictures
from accelcal_cli.table import Table
from accelcal_cli.views import calibration as tables

if TYPE_CHECKING:
    from jinja2 import Environment


NEEDS = ("jinja2", "matplotlib")
TEMPLATE = "report.html.jinja"
RAISED = (("m/s^2", "m/s\u00b2"), (")^4", ")\u2074"), ("(g)\u2074", "g\u2074"))


def check_packages() -> None:
    """Raise UsageError when a package that only reports need is missing."""
    if any(importlib.util.find_spec(name) is None for name in NEEDS):
        raise UsageError("a report needs jinja2 and matplotlib: pip install 'accelcal[report]'")


def page(result: Calibration, title: str) -> str:
    """Return the page as HTML; the same result gives the same text.

    Args:
        result: what is reported.
        title: heading of the page.
    """
    text = (
        _environment()
        .get_template(TEMPLATE)
        .render(
            result=result,
            title=title,
            accuracy=tables.accuracy(result),
            headline=tables.headline(result),
            parameters=tables.parameter_tables(result),
            fit=tables.fit(result),
            worst=tables.worst_poses(result).filled(),
            poses=tables.pose_residuals(result),
            observability=tables.observability(result),
            pictures=_pictures(result),
            settings=dump(result.record()["settings"]),
            origin=_origin(result),
        )
    )
    return typeset(text)


def typeset(text: str) -> str:
    """Return text with the powers of units raised."""
    for plain, raised in RAISED:
        text = text.replace(plain, raised)
    return text


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("accelcal_cli.output.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["numeric"] = _numeric
    return environment


def _numeric(table: Table) -> list[bool]:
    """Return which columns hold numbers, and stand to the right."""
    return [bool(column.format) for column in table.columns]


def _pictures(result: Calibration) -> dict[str, Any]:
    from markupsafe import Markup

    return {name: Markup(draw(result)) for name, draw in pictures.PICTURES.items()}


def _origin(result: Calibration) -> list[tuple[str, str]]:
    """Return where the numbers come from, name and value."""
    return [
        ("readings", str(result.data.get("source", "-"))),
        ("SHA-256 of the readings", str(result.data.get("sha256", "-"))),
        ("columns", ", ".join(map(str, result.data.get("columns", [])))),
        ("poses", f"{result.poses:,}"),
        ("schema of the result", result.schema),
        ("calibrated with", f"accelcal {result.version}"),
        ("reported with", f"accelcal {__version__}"),
    ]
