"""What a result shows, block after block: paragraphs, a conclusion, tables, convergence curves.

The views of each kind of result return such blocks in reading order; `output.console` draws them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from accelcal_cli.arrays import Float
from accelcal_cli.table import Table


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
