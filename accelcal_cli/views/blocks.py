"""What a result shows, block after block: paragraphs, a conclusion, tables, convergence curves.

The views of each kind of result return such blocks in reading order; `output.console` draws them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from accelcal_cli.arrays import Float
from accelcal_cli.table import Table

Curves = Mapping[str, Mapping[str, tuple[Float, Float]]]
"""Evaluations and median cost, by function (or problem) and optimizer."""


@dataclass(frozen=True)
class Paragraph:
    """Text for people; an empty one is a blank line.

    Attributes:
        text: what it says, behind the heading if there is one.
        heading: bold beginning.
        indent: columns that every line is indented by.
    """

    text: str = ""
    heading: str = ""
    indent: int = 0


BLANK = Paragraph()


@dataclass(frozen=True)
class Conclusion:
    """A verdict, the reasons for it, and warnings about what it does not cover.

    Attributes:
        verdict: one word.
        reasons, cautions: sentences.
        title: what it is a verdict on.
    """

    verdict: str
    reasons: Sequence[str]
    cautions: Sequence[str] = ()
    title: str = "Verdict"


@dataclass(frozen=True)
class Convergence:
    """Best cost so far against evaluations, on a logarithmic axis.

    Attributes:
        title: stands above it.
        curves: evaluations and cost, by label; one without a label is drawn finer.
        least: lower costs are drawn on the floor of the plot.
    """

    title: str
    curves: Mapping[str, Sequence[tuple[float, float]]]
    least: float = 0.0


Block = Paragraph | Conclusion | Table | Convergence


def notes(sentences: Iterable[str]) -> list[Block]:
    """Return one paragraph per note."""
    return [Paragraph(f"Note: {sentence}") for sentence in sentences]


def convergence(name: str, curves: Mapping[str, tuple[Float, Float]], least: float = 0.0) -> Convergence:
    """Return the median convergence of optimizers on one function or problem."""
    points = {label: list(zip(n.tolist(), cost.tolist(), strict=True)) for label, (n, cost) in curves.items()}
    return Convergence(f"{name}: median cost so far, logarithmic", points, least)


def study(title: str, tables: Iterable[Table], curves: Curves, note: str = "") -> list[Block]:
    """Return what a study shows.

    Args:
        title: what was run; note: what to know when reading it.
        tables: its tables, each with its title and notes.
        curves: evaluations and median cost, by what they belong to and optimizer.
    """
    remark: list[Block] = [Paragraph(note.strip())] if note else []
    plots = [convergence(name, panel) for name, panel in curves.items()]
    return [Paragraph(heading=title), *remark, BLANK, *tables, *plots]


BELOW = 1e-4
"""Part of the tolerance where the plots of a benchmark have their floor."""


def benchmark(
    title: str, summary: Table, curves: Curves, tolerance: float, further: Iterable[Table]
) -> list[Block]:
    """Return what a benchmark shows: table and curves of each function, then tables of all.

    Args:
        title: what was run.
        summary: its first column is the function.
        curves: evaluations and median cost by function and optimizer.
        tolerance: costs far below it are not told apart in the plots.
        further: tables that follow, such as ranks.
    """
    blocks: list[Block] = [Paragraph(heading=title), BLANK]
    for function, panel in curves.items():
        blocks.append(_of_function(summary, function))
        if panel:
            blocks.append(convergence(function, panel, tolerance * BELOW))
    return [*blocks, *further]


def _of_function(summary: Table, function: str) -> Table:
    """Return the rows of one function, without what the heading says, nor failures where there are none."""
    keys = [column.label for column in summary.columns]
    rows = tuple(row for row in summary.rows if row[0] == function)
    failed = any(row[keys.index("failures")] for row in rows)
    hidden = ("function", "runs") if failed else ("function", "runs", "failures")
    table = Table(function, summary.columns, rows)
    return table.with_columns(i for i, key in enumerate(keys) if key not in hidden)
