"""What a result shows, block after block: paragraphs, a conclusion, tables, convergence curves.

The views of each kind of result return such blocks in reading order; `output.console` draws them.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from accelcal_cli.arrays import Float
from accelcal_cli.notices import Notice
from accelcal_cli.schema import frozen


@frozen()
class Column:
    """One column of a Table.

    Attributes:
        name: heading.
        unit: unit shown under or behind the heading; empty when it has none.
        format: format specification of a numeric cell, as in `format(value, spec)`.
        key: name of the column in machine-readable output; the heading when not given.
        beside: it belongs to the column before it; a table that is too wide is not cut between them.
    """

    name: str
    unit: str = ""
    format: str = ""
    key: str = ""
    beside: bool = False

    @property
    def label(self) -> str:
        """Name of the column in machine-readable output."""
        return self.key or self.name

    def text(self, value: Any) -> str:
        """Return the cell as a person reads it; a missing value is a dash."""
        if value is None or value != value:
            return "-"
        return format(value, "" if isinstance(value, str) else self.format)


@frozen()
class Table:
    """Columns and rows with a title; `notes` are sentences under it.

    Attributes:
        title: what the table shows.
        columns: its columns, in order.
        rows: one sequence of raw values per row, as long as `columns`.
        notes: plain sentences that belong under the table.
    """

    title: str
    columns: tuple[Column, ...]
    rows: tuple[Sequence[Any], ...]
    notes: tuple[str, ...] = ()

    def records(self) -> list[Mapping[str, Any]]:
        """Return the rows as mappings from column key to raw value."""
        keys = [column.label for column in self.columns]
        return [dict(zip(keys, row, strict=True)) for row in self.rows]

    def filled(self) -> Table:
        """Return the table without the columns that are empty in every row."""
        return self.with_columns(
            i for i in range(len(self.columns)) if any(row[i] not in (None, "") for row in self.rows)
        )

    def with_columns(self, numbers: Iterable[int]) -> Table:
        """Return the table with the columns of these numbers, from 0, alone."""
        keep = list(numbers)
        rows = tuple([row[i] for i in keep] for row in self.rows)
        return replace(self, columns=tuple(self.columns[i] for i in keep), rows=rows)


@frozen()
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


@frozen()
class Conclusion:
    """A verdict, the reasons for it, and what speaks against it.

    Attributes:
        verdict: one word.
        reasons: sentences; warnings: notes and warnings.
        title: what it is a verdict on.
    """

    verdict: str
    reasons: Sequence[str]
    warnings: Sequence[Notice] = ()
    title: str = "Verdict"


@frozen()
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


UNITS = (
    "%|ppm|mrad|micro-g|micro-rad|arcsec|m/s\\^2|m/s²|mg|g|mGal|Hz|s|ms|sigma|degrees?|rows?|poses?|readings?|sensors?|"
    "attitudes?|logs?|runs?|evaluations|seconds?|output units|units per"
)
TOGETHER = re.compile(
    rf"(?<=[\d)]) (?=(?:{UNITS})(?![\w^-]))|(?<=\bper) (?=m/s)|(?<=[<>=±]) (?=[-+\d])"
    r"|(?<=\d) (?=±)|(?<=\b[pg]) (?=[<=])"
)
"""Blanks that no line ends at: between a number and its unit, or a sign and its number."""

KEPT = "\u00a0"


def wrapped(text: str, width: int, indent: str = "", further: str | None = None) -> str:
    """Return a text in lines of a width, none of which ends between a number and its unit.

    Args:
        text: words; width: characters of a line.
        indent: what the first line begins with, and the others unless `further` says.

    >>> print(wrapped("the noise of one pose is 0.35 m/s^2", 30))
    the noise of one pose is
    0.35 m/s^2
    """
    lines = textwrap.wrap(
        TOGETHER.sub(KEPT, text),
        max(width, 20),
        initial_indent=indent,
        subsequent_indent=indent if further is None else further,
        break_long_words=False,
        break_on_hyphens=False,
    )
    return "\n".join(lines).replace(KEPT, " ")
