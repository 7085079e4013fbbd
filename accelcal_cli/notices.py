"""What is said of readings and results beside their numbers: notes and warnings, each with its key and remedy."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from accelcal_cli.schema import frozen

Severity = Literal["note", "warning"]

COMMAND = "accelcal "
"""How a remedy begins that is a command line."""


@frozen()
class Notice:
    """A sentence about readings or a result.

    Attributes:
        key: what it is about, a word that programs may rely on, such as `clipped`.
        severity: `warning` where a parameter may be biased by more than 0.3 of its sigma, else `note`.
        text: the fact, in sentences.
        remedy: what to do, an action in words or a command that begins with COMMAND; empty where nothing is to be done.
    """

    key: str
    severity: Severity
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        """The sentence and what to do."""
        run = "Run: " if self.remedy.startswith(COMMAND) else ""
        return f"{self.text} {run}{self.remedy}".rstrip()


def are_serious(notices: Iterable[Notice]) -> bool:
    """Whether a warning stands among notices: a result that they are said of is suspect."""
    return any(notice.severity == "warning" for notice in notices)


def in_one(notices: Iterable[Notice]) -> str:
    """Return notices as one text, the way a cell of a table holds them."""
    return " ".join(str(notice) for notice in notices)
