"""A self-contained HTML page of a template: its style and its script inside, and a policy that lets it load nothing.

The content security policy names style and script by their hashes; nothing else in the page may run or be fetched.
"""

from __future__ import annotations

import base64
import hashlib
import importlib.util
import re
from collections.abc import Iterable
from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from accelcal_cli.errors import UsageError

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

RAISED = (("m/s^2", "m/s\u00b2"), (")^4", ")\u2074"), ("(g)\u2074", "g\u2074"), ("+- 95 %", "\u00b1 95 %"))

OPTION = re.compile(r"(?<![\w-])(--[a-z][\w-]*)")
NAME = re.compile(r"(?<![\w>-])([a-z]{1,12}(?:-[a-z0-9]{1,12}){1,2})(?![\w-])")
"""Options of the command line, and short names with hyphens as de-pso: no line may end within."""


def check_packages() -> None:
    """Raise UsageError when the package that pages need is missing."""
    if importlib.util.find_spec("jinja2") is None:
        raise UsageError("a report needs jinja2: python -m pip install jinja2")


def render(
    template: str, styles: Iterable[str], script: str | None = None, *, rules: str = "", **context: Any
) -> str:
    """Return the page of a template; the same context gives the same text.

    Args:
        template, script: files of the folder `templates`; styles: style sheets there, one after the other.
        rules: further style; context: what the template shows.
    """
    from markupsafe import Markup

    style = "".join(_file(name) for name in styles) + rules
    code = "" if script is None else _file(script)
    text = (
        _environment()
        .get_template(template)
        .render(style=Markup(style), script=Markup(code), policy=_policy(style, code), **context)
    )
    return typeset(text)


def typeset(text: str) -> str:
    """Return text with the powers of units raised."""
    for plain, raised in RAISED:
        text = text.replace(plain, raised)
    return text


def _policy(style: str, script: str) -> str:
    """Return the content security policy of a page with this style and this script alone."""
    allowed = f"; script-src {_source(script)}" if script else ""
    others = "img-src data:; base-uri 'none'; form-action 'none'"
    return f"default-src 'none'; style-src {_source(style)}{allowed}; {others}"


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


@cache
def _file(name: str) -> str:
    return (files("accelcal_cli.output") / "templates" / name).read_text("utf-8")


def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("accelcal_cli.output", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # Which columns hold numbers, and stand to the right.
    environment.filters["numeric"] = lambda table: [bool(column.format) for column in table.columns]
    environment.filters["prose"] = prose
    return environment


def prose(text: str) -> Markup:
    """Return text as HTML in which no option and no short name is split at its hyphens.

    >>> print(prose("add --no-misalignment & go"))
    add <code>--no-misalignment</code> &amp; go
    """
    from markupsafe import Markup, escape

    marked = NAME.sub(r'<span class="whole">\1</span>', str(escape(text)))
    return Markup(OPTION.sub(r"<code>\1</code>", marked))
