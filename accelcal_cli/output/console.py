"""Tables for people: drawn with rich, on a terminal of any width or into a pipe."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from typing import IO

from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from accelcal_cli.table import Table

PIPE_WIDTH = 120
"""Columns of a table that goes into a pipe or a file, where no terminal sets a limit."""

VERDICT_STYLE = {"good": "bold green", "weak": "bold yellow", "undetermined": "bold red"}


def console(file: IO[str] | None = None) -> Console:
    """Return a console for `file` (standard output when None); NO_COLOR and COLUMNS are respected."""
    target = file or sys.stdout
    width = None if target.isatty() or "COLUMNS" in os.environ else PIPE_WIDTH
    return Console(file=target, width=width, highlight=False, emoji=False, markup=False)


def show(tables: Iterable[Table], out: Console) -> None:
    """Draw tables one under the other, each with its notes."""
    for table in tables:
        drawn = RichTable(title=table.title, title_justify="left", title_style="bold", box=_box(out))
        for column in table.columns:
            heading = f"{column.name}\n[{column.unit}]" if column.unit else column.name
            numeric = bool(column.format)
            drawn.add_column(heading, justify="right" if numeric else "left", no_wrap=numeric)
        for row in table.rows:
            drawn.add_row(*(column.text(value) for column, value in zip(table.columns, row, strict=True)))
        if table.columns:
            out.print(drawn)
        for note in table.notes:
            out.print(Text(note))
        out.print()


def verdict(word: str, sentences: Iterable[str], out: Console) -> None:
    """Print the verdict and what it rests on."""
    out.print(Text.assemble(("Verdict: ", "bold"), (word, VERDICT_STYLE.get(word, "bold"))))
    for sentence in sentences:
        out.print(Text(f"  {sentence}"))


def _box(out: Console):  # type: ignore[no-untyped-def]
    from rich import box

    return box.SIMPLE_HEAD if out.encoding.lower().startswith("utf") else box.ASCII2
