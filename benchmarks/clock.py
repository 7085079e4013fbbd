"""Timing in pairs: A B A B ..., so that a drifting machine moves both sides alike."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Pair:
    """Median seconds of both sides and the median of their ratios, pair by pair."""

    ours: float
    theirs: float
    ratio: float


def pairs(ours: Callable[[], object], theirs: Callable[[], object], repeat: int) -> Pair:
    """Time two callables in turn, `repeat` times after one warm-up of each."""
    ours(), theirs()
    times = [(seconds(ours), seconds(theirs)) for _ in range(repeat)]
    ratios = [a / b for a, b in times]
    return Pair(
        statistics.median(a for a, _ in times),
        statistics.median(b for _, b in times),
        statistics.median(ratios),
    )


def seconds(call: Callable[[], object]) -> float:
    """Return the wall seconds of one call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def process(arguments: Sequence[str]) -> Callable[[], object]:
    """Return a call that runs a whole Python process, with its bytecode cached as installed, and refuses a failure."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}

    def run() -> object:
        return subprocess.run([sys.executable, *arguments], check=True, capture_output=True, env=environment)

    return run


def report(name: str, pair: Pair, limit: float, aim: float | None = None) -> None:
    """Print one line: what, both times, the ratio, and what it has to stay under."""
    goal = f"at most {limit:g}" + (f", aim {aim:g}" if aim else "")
    print(f"{name:52} {pair.ours:9.4g} s {pair.theirs:9.4g} s   ratio {pair.ratio:5.2f}   ({goal})")
