"""Results for people: blocks drawn with rich, on a terminal of any width or into a pipe.

Convergence curves have a logarithmic axis: one is drawn with Braille dots, several with letters.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from string import ascii_letters
from typing import IO, Any

from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment
from rich.text import Text

from accelcal_cli.errors import visible
from accelcal_cli.views.blocks import Block, Conclusion, Convergence, Paragraph, Table, wrapped

PIPE_WIDTH = 160
"""Columns of a table that goes into a pipe or a file, where no terminal sets a limit."""

GAP = 2
"""Blanks before each column of a table."""

NARROWEST_CURVE, NARROWEST_CURVES = 40, 48
"""Columns of the narrowest terminal that gets a plot of one curve, and of several."""

VERDICT_STYLE = {
    "good": "bold green",
    "weak": "bold yellow",
    "suspect": "bold red",
    "undetermined": "bold red",
    "unchanged": "bold green",
    "changed": "bold red",
    "inconclusive": "bold yellow",
}


class _Console(Console):
    """A console that leaves a broken pipe to the command line, where rich itself would exit with 1.

    Control characters in what is shown are written out: labels come from files.
    """

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of what is drawn, without control characters but those of rich itself."""
        for segment in super().render(renderable, options):
            plain = segment.text if segment.control else visible(segment.text)
            yield segment if plain == segment.text else Segment(plain, segment.style)

    def on_broken_pipe(self) -> None:
        """Pass the BrokenPipeError on."""
        raise


def console(file: IO[str] | None = None) -> Console:
    """Return a console for `file` (standard output when None); NO_COLOR and COLUMNS are respected."""
    target = file or sys.stdout
    stated = os.environ.get("COLUMNS", "").strip("0")  # of 0 columns rich would print nothing
    width = None if target.isatty() or stated else PIPE_WIDTH
    return _Console(file=target, width=width, highlight=False, emoji=False, markup=False)


def show(blocks: Iterable[Block], out: Console | None = None) -> None:
    """Draw blocks one under the other, on standard output when there is no other console."""
    out = out or console()
    for block in blocks:
        DRAW[type(block)](block, out)


def _show_paragraph(block: Paragraph, out: Console) -> None:
    margin = " " * block.indent
    text = wrapped(block.heading + block.text, out.width, margin)
    head = len(margin) + len(block.heading)
    out.print(Text.assemble((text[:head], "bold"), text[head:]), soft_wrap=True)


def _show_conclusion(block: Conclusion, out: Console) -> None:
    style = VERDICT_STYLE.get(block.verdict, "bold")
    out.print(Text.assemble((f"{block.title}: ", "bold"), (block.verdict, style)))
    for reason in block.reasons:
        out.print(Text(wrapped(reason, out.width, "  ")), soft_wrap=True)
    for notice in block.warnings:
        head, colour = ("Warning: ", "bold yellow") if notice.severity == "warning" else ("Note: ", "bold")
        text = wrapped(f"{head}{notice}", out.width, "", "  ")
        out.print(Text.assemble((text[: len(head)], colour), text[len(head) :]), soft_wrap=True)


def _show_convergence(block: Convergence, out: Console) -> None:
    """Draw one curve with Braille dots, where the encoding has them, or several with letters."""
    single, width = block.curves.get(""), min(60, out.width - 22)
    if single is not None and out.width >= NARROWEST_CURVE and out.encoding.startswith("utf"):
        out.print(Text(block.title))
        out.print(draw_curve(single, width=width), crop=False, overflow="ignore")
    if single is None and out.width >= NARROWEST_CURVES:
        out.print(Text(block.title))
        text = draw_curves(block.curves, width=width, least=block.least)
        out.print(Text(text), crop=False, overflow="ignore", soft_wrap=True)
        out.print()


def _show_table(table: Table, out: Console) -> None:
    """Draw a table with its notes; one too wide for the terminal in parts, each with the first column again."""
    table = _encodable(table, out)
    parts = _parts(table, out.width)
    for part in parts:
        out.print(_drawn(part, out), crop=False)
    if not parts:
        _show_stacked(table, out)
    for note in table.notes:
        out.print(Text(wrapped(note, out.width)), soft_wrap=True)
    if table.notes or not parts:
        out.print()


def _encodable(table: Table, out: Console) -> Table:
    """Return a table without the sign ± where the encoding lacks it."""
    try:
        "±".encode(out.encoding)
    except (UnicodeEncodeError, LookupError):
        texts = [
            [cell.replace("±", "+-") if isinstance(cell, str) else cell for cell in row] for row in table.rows
        ]
        columns = tuple(replace(column, name=column.name.replace("±", "+-")) for column in table.columns)
        return replace(table, title=table.title.replace("±", "+-"), columns=columns, rows=tuple(texts))
    return table


def _parts(table: Table, width: int) -> list[Table]:
    """Return the parts of a table that fit into a width; none when there is a column too wide for it."""
    others = len(table.columns) - 1
    if not others:
        return [table]
    ends = [i for i in range(1, others + 1) if i == others or not table.columns[i + 1].beside]
    parts: list[Table] = []
    start = 0
    while start < others:
        cuts = [table.with_columns([0, *range(start + 1, end + 1)]) for end in ends if end > start]
        fitting = [part for part in cuts if _natural_width(part) <= width]
        if not fitting:
            return []
        parts.append(replace(fitting[-1], title="") if parts else fitting[-1])
        start += len(fitting[-1].columns) - 1
    return parts


def _natural_width(table: Table) -> int:
    """Return the characters that a table needs without wrapping a cell."""
    widths = _widths(_cells(table))
    return sum(widths) + GAP * len(widths)


def _cells(table: Table) -> list[list[str]]:
    """Return the cells line by line, headings first: the names, and where there are units these under them."""
    rows = [
        [column.text(value) for column, value in zip(table.columns, row, strict=True)] for row in table.rows
    ]
    names, units = [c.name for c in table.columns], [f"[{c.unit}]" if c.unit else "" for c in table.columns]
    if not any(units):
        return [names, *rows]
    over = [name if unit else "" for name, unit in zip(names, units, strict=True)]
    return [over, [unit or name for name, unit in zip(names, units, strict=True)], *rows]


def _widths(cells: list[list[str]]) -> list[int]:
    return [max(map(cell_len, column)) for column in zip(*cells, strict=True)]


def _show_stacked(table: Table, out: Console) -> None:
    """Print every row as a heading and one line per column, so that the narrowest terminal loses no digit."""
    out.print(Text(table.title, "bold"))
    for row in table.rows:
        first, *rest = zip(table.columns, row, strict=True)
        out.print(Text(first[0].text(first[1])))
        for column, value in rest:
            cell = column.text(value)
            if cell not in ("", "-"):
                unit = f" {column.unit}" if column.unit else ""
                text = wrapped(f"{column.name or 'note'} {cell}{unit}", out.width, "  ", "    ")
                out.print(Text(text), soft_wrap=True)


def _drawn(table: Table, out: Console) -> Text:
    """Return a table as text: title, headings, a rule, rows; numbers to the right, words to the left."""
    # Laid out here and not by rich.table: no cell wraps, and rich takes a tenth of a calibration's time for it.
    cells = _cells(table)
    widths = _widths(cells)
    lines = []
    for row in cells:
        gaps = [" " * (width - cell_len(cell)) for cell, width in zip(row, widths, strict=True)]
        padded = [
            gap + cell if column.format else cell + gap
            for cell, gap, column in zip(row, gaps, table.columns, strict=True)
        ]
        lines.append(f"  {(' ' * GAP).join(padded)}".rstrip())
    heads = len(cells) - len(table.rows)
    line = "\u2500" if out.encoding.lower().startswith("utf") else "-"
    rule = " " + line * (sum(widths) + GAP * len(widths) - 1)
    title = [table.title, ""] if table.title else []
    head, body = "\n".join([*title, *lines[:heads]]), "\n".join([rule, *lines[heads:], ""])
    return Text.assemble((head, "bold"), "\n", body, no_wrap=True, overflow="ignore")


DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))
"""Bits of the dots of a Braille cell: left column from above, right column from above."""

Points = Sequence[tuple[float, float]]
"""Pairs (evaluations, cost)."""


def draw_curve(points: Points, width: int = 60, height: int = 8) -> str:
    """Return a plot of (evaluations, cost) with log10 of the cost upwards.

    Args:
        points: at least one; costs of zero are drawn on the floor.
        width, height: of the plot in characters, labels come on top of that.
    """
    limits = _limits([points])
    if limits is None:
        return "cost 0 from the first evaluation on"
    high, span = limits
    low = high - span
    first, last = points[0][0], points[-1][0]
    cells = [[0] * width for _ in range(height)]
    previous = None
    for evaluations, cost in points:
        column = round((evaluations - first) / max(last - first, 1) * (2 * width - 1))
        row = _row(cost, limits, 4 * height)
        for r in range(min(row, previous if previous is not None else row), row + 1):
            cells[r // 4][column // 2] |= DOTS[column % 2][r % 4]
        previous = row
    lines = ["".join(chr(0x2800 + bits) if bits else " " for bits in row) for row in cells]
    return _framed(lines, (f"{10**high:.0e}", f"{10**low:.0e}"), (first, last))


def draw_curves(curves: Mapping[str, Points], width: int = 60, height: int = 10, least: float = 0.0) -> str:
    """Return one plot of several curves, each of a letter, with a legend of letters and labels under it.

    Args:
        curves: points by label, at least one each.
        width, height: of the plot in characters.
        least: costs below this are drawn on the floor, as those of zero are.
    """
    limits = _limits(curves.values(), least)
    if limits is None:
        return "cost 0 from the first evaluation on"
    high, span = limits
    first = min(points[0][0] for points in curves.values())
    last = max(points[-1][0] for points in curves.values())
    cells: list[list[list[str]]] = [[[] for _ in range(width)] for _ in range(height)]
    for letter, points in zip(ascii_letters, curves.values(), strict=False):
        columns = [round((n - first) / max(last - first, 1) * (width - 1)) for n, _ in points]
        rows = [_row(cost, limits, height) for _, cost in points]
        for column, row in set(_steps(columns, rows)):
            cells[row][column].append(letter)
    # Curves that share a cell take turns along the line.
    lines = ["".join(c[i % len(c)] if c else " " for i, c in enumerate(row)) for row in cells]
    below = any(cost < 10 ** (high - span) * 0.999 for points in curves.values() for _, cost in points)
    floor = f"{'<' * below}{10 ** (high - span):.0e}"
    plot = _framed(lines, (f"{10**high:.0e}", floor), (first, last))
    legend = [f"{letter} {label}" for letter, label in zip(ascii_letters, curves, strict=False)]
    return "\n".join([plot, *_wrapped(legend, width)])


def _steps(columns: Sequence[int], rows: Sequence[int]) -> Iterable[tuple[int, int]]:
    """Yield every cell of a staircase through the points, without gaps in either direction."""
    yield columns[0], rows[0]
    for (left, above), (right, below) in pairwise(zip(columns, rows, strict=True)):
        for column in range(left + 1, right + 1):
            yield column, above
        for row in range(above + 1, below + 1):
            yield right, row


def _limits(curves: Iterable[Points], least: float = 0.0) -> tuple[float, float] | None:
    """Return log10 of the highest positive cost and the span down to the lowest; None when there is none."""
    costs = [cost for points in curves for _, cost in points if 0 < cost < math.inf]
    levels = [math.log10(max(cost, least)) for cost in costs]
    return (max(levels), max(max(levels) - min(levels), 1e-9)) if levels else None


def _row(cost: float, limits: tuple[float, float], height: int) -> int:
    high, span = limits
    if cost <= 0:
        return height - 1
    part = (high - min(math.log10(cost), high)) / span
    return round(min(part, 1.0) * (height - 1))


def _framed(lines: Sequence[str], levels: tuple[str, str], ends: tuple[float, float]) -> str:
    """Return lines of a plot with the costs of its first and last line and the evaluations of its ends."""
    width = len(lines[0])
    labels = [levels[0], *[""] * (len(lines) - 2), levels[1]]
    body = [f"{text:>7} |{line}".rstrip() for text, line in zip(labels, lines, strict=True)]
    foot = f"{ends[0]:,.0f}".ljust(width - 12) + f"{ends[1]:,.0f}".rjust(12)
    return "\n".join([*body, " " * 8 + "+" + "-" * width, " " * 9 + foot + "  evaluations"])


def _wrapped(words: Iterable[str], width: int) -> list[str]:
    """Return words on as few lines as fit into the width of a plot."""
    lines = [""]
    for word in words:
        if lines[-1] and len(lines[-1]) + len(word) + 3 > width:
            lines.append("")
        lines[-1] += ("   " if lines[-1] else "") + word
    return [" " * 9 + line for line in lines]


DRAW: dict[type[Block], Callable[[Any, Console], None]] = {
    Table: _show_table,
    Conclusion: _show_conclusion,
    Convergence: _show_convergence,
    Paragraph: _show_paragraph,
}
"""What draws a block of each kind."""
