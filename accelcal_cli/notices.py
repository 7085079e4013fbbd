"""What is said of readings and results beside their numbers: notes and warnings, each with its key and remedy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["note", "warning"]


@dataclass(frozen=True)
class Notice:
    """A sentence about readings or a result.

    Attributes:
        key: what it is about, a word that programs may rely on, such as `clipped`.
        severity: `warning` where a parameter may be biased by more than 0.3 of its sigma, else `note`.
        text: the fact, in sentences.
        remedy: what to do, a command or an action; empty where nothing is to be done.
    """

    key: str
    severity: Severity
    text: str
    remedy: str = ""

    def __str__(self) -> str:
        """The sentence and what to do."""
        return f"{self.text} {self.remedy}".rstrip()
