"""Tables for people: drawn with rich, on a terminal of any width or into a pipe.

A calibration on the terminal: verdict first, tables, convergence, notes.

A verification on the terminal: verdict first, then what it rests on.

A detection on the terminal.

A fleet on the terminal, in a table file, and in a folder of results.

Studies on the terminal: tables, each as wide as fits, and convergence plots.

The optimizers on the terminal: one paragraph each, or one with its settings.

A benchmark on the terminal: a table and a convergence plot for every function, then the ranks.
"""

from __future__ import annotations

import json
import os
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from rich.cells import cell_len
from rich.console import Console
from rich.text import Text

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.detection.detect import Detection
from accelcal_cli.output.curve import draw, draw_several
from accelcal_cli.output.files import whole_file
from accelcal_cli.output.machine import json_rows, json_text, write_raw
from accelcal_cli.table import Table
from accelcal_cli.verification.verify import Verification
from accelcal_cli.views.calibration import tables
from accelcal_cli.views.detection import candidates_table, poses_table
from accelcal_cli.views.verification import differences, evidence

PIPE_WIDTH = 160
"""Columns of a table that goes into a pipe or a file, where no terminal sets a limit."""

VERDICT_STYLE = {
    "good": "bold green",
    "weak": "bold yellow",
    "undetermined": "bold red",
    "unchanged": "bold green",
    "changed": "bold red",
    "inconclusive": "bold yellow",
}


class _Console(Console):
    """A console that leaves a broken pipe to the command line; rich itself would exit with 1."""

    def on_broken_pipe(self) -> None:
        """Pass the BrokenPipeError on."""
        raise


def console(file: IO[str] | None = None) -> Console:
    """Return a console for `file` (standard output when None); NO_COLOR and COLUMNS are respected."""
    target = file or sys.stdout
    stated = os.environ.get("COLUMNS", "")
    width = (
        None if target.isatty() or stated.strip("0") else PIPE_WIDTH
    )  # of 0 columns rich would print nothing
    return _Console(file=target, width=width, highlight=False, emoji=False, markup=False)


def show(tables: Iterable[Table], out: Console) -> None:
    """Draw tables one under the other, each with its notes."""
    for table in tables:
        show_split(table, out)


def show_split(table: Table, out: Console) -> None:
    """Draw a table with its notes; one too wide for the terminal in parts, each with the first column again."""
    parts = _parts(table, out.width)
    for part in parts:
        out.print(_drawn(part, out), crop=False)
    if not parts:
        _show_stacked(table, out)
    for note in table.notes:
        out.print(Text(note))
    if table.notes or not parts:
        out.print()


def _parts(table: Table, width: int) -> list[Table]:
    """Return the parts of a table that fit into a width; none when there is a column too wide for it."""
    others = len(table.columns) - 1
    if not others:
        return [table]
    ends = [i for i in range(1, others + 1) if i == others or not table.columns[i + 1].beside]
    parts: list[Table] = []
    start = 0
    while start < others:
        fit = [end for end in ends if end > start and _natural_width(_part(table, start, end)) <= width]
        if not fit:
            return []
        part = _part(table, start, fit[-1])
        parts.append(replace(part, title="") if parts else part)
        start = fit[-1]
    return parts


def _part(table: Table, start: int, end: int) -> Table:
    """Return the table with its first column and those from `start` to `end` - 1 of the others."""
    keep = [0, *range(start + 1, end + 1)]
    rows = tuple([row[i] for i in keep] for row in table.rows)
    return replace(table, columns=tuple(table.columns[i] for i in keep), rows=rows)


def _natural_width(table: Table) -> int:
    """Return the characters that a table needs without wrapping a cell."""
    widths = _widths(_cells(table))
    return sum(widths) + 3 * len(widths)


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
    """Print every row as a heading and one line a column, so that the narrowest terminal loses no digit."""
    out.print(Text(table.title, "bold"))
    for row in table.rows:
        first, *rest = zip(table.columns, row, strict=True)
        out.print(Text(first[0].text(first[1])))
        for column, value in rest:
            cell = column.text(value)
            if cell not in ("", "-"):
                unit = f" {column.unit}" if column.unit else ""
                out.print(Text(f"  {column.name or 'note'} {cell}{unit}"))


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
        lines.append(f"  {'   '.join(padded)}".rstrip())
    heads = len(cells) - len(table.rows)
    line = "\u2500" if out.encoding.lower().startswith("utf") else "-"
    rule = " " + line * (sum(widths) + 3 * len(widths) - 1)
    title = [table.title, ""] if table.title else []
    head, body = "\n".join([*title, *lines[:heads]]), "\n".join([rule, *lines[heads:], ""])
    return Text.assemble((head, "bold"), "\n", body, no_wrap=True, overflow="ignore")


def verdict(
    word: str, sentences: Iterable[str], out: Console, cautions: Iterable[str] = (), title: str = "Verdict"
) -> None:
    """Print the verdict, what it rests on, and what it does not look at."""
    cautions, style = list(cautions), VERDICT_STYLE.get(word, "bold")
    if cautions and style == VERDICT_STYLE["good"]:  # no green light with a warning under it
        style = VERDICT_STYLE["weak"]
    out.print(Text.assemble((f"{title}: ", "bold"), (word, style)))
    for sentence in sentences:
        out.print(Text(f"  {sentence}"))
    for caution in cautions:
        out.print(Text.assemble(("Caution: ", "bold yellow"), caution))


NARROWEST_CURVE = 40


def show_calibration(result: Calibration) -> None:
    """Print a calibration to standard output."""
    out = console()
    verdict(result.verdict, result.reasons, out, result.cautions)
    out.print()
    show(tables(result), out)
    for note in result.notes:
        out.print(f"Note: {note}")
    if len(result.convergence) > 1 and out.width >= NARROWEST_CURVE and out.encoding.startswith("utf"):
        out.print(f"Convergence of {result.optimizer} (best cost L so far, logarithmic)")
        out.print(draw(result.convergence, width=min(60, out.width - 22)), crop=False, overflow="ignore")


def show_verification(result: Verification) -> None:
    """Print a verification to standard output."""
    out = console()
    verdict(result.verdict, result.reasons, out, result.cautions)
    out.print()
    show_split(differences(result), out)
    show([evidence(result)], out)


MOST = 60
"""Poses printed; more are in the file of -o."""


def show_detection(found: Detection) -> None:
    """Print the poses, the thresholds tried and the notes to standard output."""
    out = console()
    poses = poses_table(found)
    if len(poses.rows) > MOST:
        note = f"{len(poses.rows) - MOST:,} more poses are not shown; -o writes them all"
        poses = replace(poses, rows=poses.rows[:MOST], notes=(note,))
    for table in (poses, candidates_table(found)):
        show_split(table, out)
    for note in (*found.notes, found.summary()):
        out.print(f"Note: {note}")


FORBIDDEN = '/\\:*?"<>|%'
"""Characters that a file name cannot have on some system, and the one that stands for them."""


def show_fleet(counts: str, tables: Iterable[Table]) -> None:
    """Print a fleet to standard output."""
    out = console()
    out.print(Text(counts, "bold"))
    out.print()
    show(tables, out)


def write_table(table: Table, path: str) -> None:
    """Write one row a sensor as CSV, Parquet or JSON by the ending of the name, whole or not at all."""
    if path.endswith(".json"):
        with whole_file(path) as file:
            file.write(json_text(json_rows([table])))
    else:
        write_raw(table, path)


def write_result(folder: Path, label: str, result: Calibration) -> None:
    """Write the result file of one sensor, named by its label."""
    text = json.dumps(result.record(), allow_nan=False, ensure_ascii=False)
    (folder / f"{file_name(label)}.json").write_text(f"{text}\n", encoding="utf-8", newline="\n")


def file_name(label: str) -> str:
    """Return a label as the name of a file: what a name cannot hold is written as in an address, %2F for a slash."""
    return "".join(f"%{ord(c):02X}" if c in FORBIDDEN or ord(c) < 32 else c for c in label)


def show_study(title: str, tables: Iterable[Table], curves: Curves, note: str = "") -> None:
    """Print a study to standard output.

    Args:
        title: what was run; note: what to know when reading it.
        tables: its tables, each with its title and notes.
        curves: evaluations and median cost, by what they belong to and optimizer.
    """
    out = console()
    out.print(Text(title, "bold"))
    if note:
        out.print(Text(note.strip()))
    out.print()
    for table in tables:
        show_split(table, out)
    if out.width < NARROWEST_CURVE:
        return
    for name, panel in curves.items():
        show_curves(name, panel, out)


def show_catalogue(table: Table) -> None:
    """Print all optimizers with their settings."""
    out = console()
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
    out = console()
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


NARROWEST_CURVE = 48
"""Columns of the narrowest terminal that gets a plot."""

BELOW = 1e-4
"""Part of the tolerance where the plots have their floor."""

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]


def show_benchmark(
    title: str, rows: Table, curves: Curves, tolerance: float, further: Sequence[Table]
) -> None:
    """Print a benchmark to standard output.

    Args:
        title: what was run.
        rows: the summary, its first column the function.
        curves: evaluations and median cost by function and optimizer.
        tolerance: costs far below it are not told apart in the plots.
        further: tables that follow, such as ranks.
    """
    out = console()
    out.print(Text(title, "bold"))
    out.print()
    for function, plotted in curves.items():
        show_split(_of_function(rows, function), out)
        if plotted and out.width >= NARROWEST_CURVE:
            show_curves(function, plotted, out, least=tolerance * BELOW)
    show(further, out)


def show_curves(
    name: str, panel: Mapping[str, tuple[Float, Float]], out: Console, least: float = 0.0
) -> None:
    """Print the curves of one function or problem; costs below `least` lie on the floor."""
    points = {
        label: [(float(n), float(c)) for n, c in zip(*curve, strict=True)] for label, curve in panel.items()
    }
    out.print(Text(f"{name}: median cost so far, logarithmic"))
    text = draw_several(points, width=min(60, out.width - 22), least=least)
    out.print(Text(text), crop=False, overflow="ignore", soft_wrap=True)
    out.print()


def _of_function(rows: Table, function: str) -> Table:
    """Return the rows of one function, without what the heading says, nor failures where there are none."""
    own = [row for row in rows.rows if row[0] == function]
    keys = [column.key or column.name for column in rows.columns]
    failed = keys.index("failures")
    hidden = {"function", "runs"} | ({"failures"} if not any(row[failed] for row in own) else set())
    keep = [i for i, key in enumerate(keys) if key not in hidden]
    return Table(function, tuple(rows.columns[i] for i in keep), tuple([row[i] for i in keep] for row in own))
