"""What happens to the process: readers of our output that leave early, as `head` does, and signals.

HUP and TERM are taken as Ctrl-C is: what a command had begun to write is removed, and what it keeps is kept.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import IO, Any

from accelcal_cli.errors import Interrupted


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
    """Discard what is still buffered for a stream, or Python would complain of it at exit."""
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, stream.fileno())
    os.close(null)


SIGNALS = ("SIGHUP", "SIGTERM")
"""A terminal that was closed or a line that was dropped; a polite kill. Windows has no SIGHUP."""


class Ended(KeyboardInterrupt):
    """A signal came; its number is the only argument."""


@contextmanager
def raised() -> Iterator[None]:
    """Raise Ended where HUP or TERM comes; one that is ignored, as nohup has it, stays ignored."""
    numbers = [getattr(signal, name) for name in SIGNALS if hasattr(signal, name)]
    before = {n: signal.getsignal(n) for n in numbers if signal.getsignal(n) != signal.SIG_IGN}

    def end(number: int, _: FrameType | None) -> None:
        for each in before:  # what is kept now must not be cut short by another
            signal.signal(each, signal.SIG_IGN)
        raise Ended(number)

    for each in before:
        signal.signal(each, end)
    try:
        yield
    finally:
        for each, handler in before.items():
            signal.signal(each, handler)


def interrupted(stop: KeyboardInterrupt) -> Interrupted:
    """Return what to say of Ctrl-C or a signal, with its exit code: 128 and the number, as shells have it."""
    if isinstance(stop, Ended):
        (number,) = stop.args
        return Interrupted(f"ended by {signal.Signals(number).name}", 128 + number)
    return Interrupted("interrupted")
