"""Readers of our output that leave early, as `head` does."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any


@contextmanager
def even_if_unread(stream: IO[Any] | None = None) -> Iterator[None]:
    """Print to `stream`, standard output when None, and go on when its reader has gone.

    For commands whose exit code carries a verdict: it is the same whoever reads how much of the output.
    """
    stream = stream or sys.stdout
    try:
        yield
        stream.flush()
    except BrokenPipeError:
        drop(stream)


def drop(stream: IO[Any]) -> None:
    """Lead what is still buffered for a stream nowhere, or Python would complain of it at its exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)
