"""The optimizers on the terminal: one paragraph each, or one with its settings."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from rich.text import Text

from accelcal_cli.output import console as rich_console
from accelcal_cli.table import Table


def show_catalogue(table: Table) -> None:
    """Print all optimizers with their settings."""
    out = rich_console.console()
    for record in table.records():
        heading = f" - {record['family']}, [{record['paper']}]"
        out.print(Text.assemble((record["name"], "bold"), heading))
        needs = f" Needs {record['needs']}." if record["needs"] else ""
        out.print(_indented(record["summary"] + needs, out.width))
        out.print(_indented(assignments(record["parameters"]), out.width))
    out.print()
    out.print(Text("The settings of one: accelcal optimizers NAME. The papers: docs/bibliography.md."))


def show_settings(table: Table) -> None:
    """Print one optimizer with the meaning of its settings."""
    out = rich_console.console()
    out.print(Text(table.title, "bold"))
    for name, default, values, meaning in table.rows:
        heading = Text.assemble((name, "bold"), f" = {plain(default)}", f"  ({values})" if values else "")
        out.print(heading)
        out.print(_indented(meaning, out.width))


def _indented(text: str, width: int) -> Text:
    return Text(textwrap.fill(text, width, initial_indent="  ", subsequent_indent="  "))


def assignments(parameters: Mapping[str, Any]) -> str:
    """Return settings as `name=value` with spaces between."""
    return " ".join(f"{name}={plain(value)}" for name, value in parameters.items())


def plain(value: Any) -> str:
    """Return a setting as YAML has it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def flat(table: Table) -> Table:
    """Return the table with every cell as text that fits into CSV."""
    rows = tuple(
        tuple(
            assignments(cell) if isinstance(cell, Mapping) else "" if cell == "" else plain(cell)
            for cell in row
        )
        for row in table.rows
    )
    return replace(table, rows=rows)
