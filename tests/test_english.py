"""Messages and pages are those of a native engineer: "per pose", not "a pose"; phrases that were replaced stay away."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [
    *(
        ROOT / name
        for name in ("README.md", "SECURITY.md", "CONTRIBUTING.md", "CHANGELOG.md", "CITATION.cff")
    ),
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / "docs").rglob("*.ipynb")),
    *sorted((ROOT / "configs").rglob("*.yaml")),
    *sorted((ROOT / "accelcal_cli").rglob("*.py")),
    *sorted((ROOT / "accelcal_cli").rglob("*.jinja")),
]

COUNTED = (
    r"rows?|readings?|entry|entries|one|line|lines|means?|values?|files?|times|samples|bits|bytes|points|runs|logs|poses|"
    r"evaluations|steps|iterations|[a-z]*seconds?|ppm|mrad|m/s\^2|\d[\d,.]*"
)
PER = re.compile(
    rf"\b(?:{COUNTED}) (?:a|an|each) (?:pose|second|sensor|run|column|reading|cell|degree|log|axis|iteration|minute)\b"
    r"(?! time\b| \()"
)
"""Numbers of something "a pose" for "per pose"."""

GONE = (
    "Beyond chance off",
    "errs by",
    "is much for an accelerometer",
    "chance of that ratio",
    "s over scatter within poses",
    "would mend",
    "has no use for it",
    "what they differ by",
    "nothing to judge their noise by",
    "how many times the noise of one pose",
)
"""Phrases that have been replaced."""


def found(text: str) -> list[str]:
    plain = " ".join(text.split())
    per = [match[0] for match in PER.finditer(plain)]
    return per + [phrase for phrase in GONE if phrase.lower() in plain.lower()]


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_file_has_none_of_the_patterns(path):
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".py":  # lines of one string that is continued on the next, and comments
        text = re.sub(r'"\s*\n\s*f?"|\n\s*#:? ?', " ", text)
    assert found(text) == []


def test_the_patterns_find_what_they_are_for():
    assert found("one row a pose, 100 readings a second") == ["row a pose", "readings a second"]
    assert found("Poses that would\nmend it") == ["would mend"]
    assert found("one row per pose; a pose that is held; load the file a second time") == []
