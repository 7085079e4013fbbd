"""The errors a user can cause, each with one clear message.

A message says what was wrong, where (file, line, column, key), and what was expected.
The command line prints it and exits with 2; the library raises it.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

_CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u200e\u200f\u202a-\u202e\u2066-\u2069]")
"""Characters by which a text could steer a terminal, or turn the order of what is read, but tabs and line ends."""


def visible(text: str) -> str:
    """Return a text with control characters written out: what a file holds must not steer the terminal."""
    return _CONTROL.sub(lambda match: f"\\x{ord(match[0]):02x}", text)


class AccelcalError(Exception):
    """Base of every error that is the input's fault, never the program's."""


class UsageError(AccelcalError):
    """An option or argument outside what it may be."""


class ConfigError(AccelcalError):
    """A configuration file or mapping that cannot be used."""


class DataError(AccelcalError):
    """Readings that cannot be used: unreadable, malformed or without information."""


class OutputError(AccelcalError):
    """A result that could not be written."""


class Interrupted(Exception):  # noqa: N818  # it is none
    """Work was interrupted, from the keyboard or by a signal; the message says what is kept and how to go on.

    `code` is the exit code.
    """

    def __init__(self, message: str, code: int = 130) -> None:
        """Say what is kept."""
        super().__init__(message)
        self.code = code


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return `` (did you mean "..."?)`` for the nearest known name, or nothing when none is near."""
    choices = list(known)
    folded = {name.lower(): name for name in choices}
    near = difflib.get_close_matches(word.lower(), folded, n=1, cutoff=0.5)
    return f' (did you mean "{folded[near[0]]}"?)' if near else ""
