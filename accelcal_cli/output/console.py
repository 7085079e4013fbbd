"""Tables for people: drawn with rich, on a terminal of any width or into a pipe."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable
from dataclasses import replace
from typing import IO

from rich import box
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from accelcal_cli.table import Table

PIPE_WIDTH = 160
"""Columns of a table that goes into a pipe or a file, where no terminal sets a limit."""

VERDICT_STYLE = {
    "good": "bold green",
    "weak": "bold yellow",
    "undetermined": "bold red",
    "unchanged": "bold green",
    "changed": "bold red",
}


class _Console(Console):
    """A console that leaves a broken pipe to the command line; rich itself would exit with 1."""

    def on_broken_pipe(self) -> None:
        """Pass the BrokenPipeError on."""
        raise


def console(file: IO[str] | None = None) -> Console:
    """Return a console for `file` (standard output when None); NO_COLOR and COLUMNS are respected."""
    target = file or sys.stdout
    width = None if target.isatty() or "COLUMNS" in os.environ else PIPE_WIDTH
    return _Console(file=target, width=width, highlight=False, emoji=False, markup=False)


def show(tables: Iterable[Table], out: Console) -> None:
    """Draw tables one under the other, each with its notes; one too wide for the terminal row by row."""
    for table in tables:
        if _natural_width(table) > out.width:
            _show_stacked(table, out)
        elif table.columns:
            out.print(_drawn(table, out))
        for note in table.notes:
            out.print(Text(note))
        out.print()


def show_split(table: Table, out: Console) -> None:
    """Draw a table; one too wide for the terminal in parts, each with the first column again."""
    others = len(table.columns) - 1
    first, start = True, 0
    while start < others:
        end = others
        while end > start + 1 and _natural_width(_part(table, start, end)) > out.width:
            end -= 1
        part = _part(table, start, end)
        out.print(_drawn(part if first else replace(part, title=""), out))
        first, start = False, end
    for note in table.notes:
        out.print(Text(note))
    out.print()


def _part(table: Table, start: int, end: int) -> Table:
    """Return the table with its first column and those from `start` to `end` - 1 of the others."""
    keep = [0, *range(start + 1, end + 1)]
    rows = tuple([row[i] for i in keep] for row in table.rows)
    return replace(table, columns=tuple(table.columns[i] for i in keep), rows=rows)


def _natural_width(table: Table) -> int:
    """Return the characters that a table needs without wrapping a cell."""
    widths = [
        max(map(len, [column.name, f"[{column.unit}]", *(column.text(row[i]) for row in table.rows)]))
        for i, column in enumerate(table.columns)
    ]
    return sum(widths) + 3 * len(widths) + 1  # a space on either side, and a line


def _show_stacked(table: Table, out: Console) -> None:
    """Print every row as a heading and one line a column, so that a narrow terminal loses no digit."""
    out.print(Text(table.title, "bold"))
    for row in table.rows:
        first, *rest = zip(table.columns, row, strict=True)
        out.print(Text(first[0].text(first[1])))
        for column, value in rest:
            cell = column.text(value)
            if cell not in ("", "-"):
                unit = f" {column.unit}" if column.unit else ""
                out.print(Text(f"  {column.name or 'note'} {cell}{unit}"))


def _drawn(table: Table, out: Console) -> RichTable:
    """Return a table as rich draws it."""
    drawn = RichTable(title=table.title, title_justify="left", title_style="bold", box=_box(out))
    for column in table.columns:
        heading = f"{column.name}\n[{column.unit}]" if column.unit else column.name
        drawn.add_column(heading, justify="right" if column.format else "left", no_wrap=True)
    for row in table.rows:
        drawn.add_row(*(column.text(value) for column, value in zip(table.columns, row, strict=True)))
    return drawn


def verdict(word: str, sentences: Iterable[str], out: Console) -> None:
    """Print the verdict and what it rests on."""
    out.print(Text.assemble(("Verdict: ", "bold"), (word, VERDICT_STYLE.get(word, "bold"))))
    for sentence in sentences:
        out.print(Text(f"  {sentence}"))


def _box(out: Console) -> box.Box:
    return box.SIMPLE_HEAD if out.encoding.lower().startswith("utf") else box.ASCII2
