"""Does `good` mean good? `python -m benchmarks.truth`: the traps and their honest counterparts, one table.

A draw is a random sensor in random attitudes with a fault, and the same without. The fault matters where it moves a
parameter of a plain least-squares fit by 3 sigma or more of an honest one and the readings can show it: in the rows
themselves, or in the residuals of that plain fit. Of the draws in which it matters

    judged right    the verdict is neither good nor weak, or every 95 % interval holds the truth: each widened so that
                    all of them do so with a chance of 99 % (Bonferroni), or honest chance would count as a fault
    cause named     a note or warning has one of the keys that the trap expects; poor attitudes need no name where
                    the intervals hold

and of the honest counterparts the share that is not called good. `weak` counts as good for twelve single readings of
which one has a leverage of 0.9 or more.

    python -m benchmarks.truth [--draws N] [--only NAME] [--jobs N] [--seed N] [--json] [--write PAGE]
    python -m benchmarks.truth --coverage | --weights | --robust | --verify | --all
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import TextIO

import numpy as np

from benchmarks.truth_scenes import (
    Outcome,
    Recording,
    Scene,
    fault_of,
    holds,
    in_processes,
    inside,
    observe,
    stream,
)
from benchmarks.truth_traps import INVISIBLE, REPEATED, TRAPS, Trap

NOISES = (0.2, 2.0)
"""Noise of one row and axis, mg."""

SHIFT = 3.0
"""Honest sigma by which a fault moves a parameter, from which on it has to be seen."""

CHECKABLE = 0.9
"""Leverage below which a pose is checked by the others."""

CHUNK = 10
"""Draws that a process takes at a time."""

RIGHT, HONEST_CELL, HONEST_ALL = 0.95, 0.04, 0.01
"""Least share judged right with the cause named; largest share of honest draws not good, in a cell and in all."""


@dataclass(frozen=True)
class Drawn:
    """What came of one draw.

    Attributes:
        shift: of the fault, in honest sigma; matters, right, named: as at the top; verdict, keys: of the faulty one.
        honest: verdict of the honest counterpart; honest_keys: what was said of it.
        sound: whether it counts as good.
        inside, honest_inside: how many 95 % intervals hold of those called good or weak, and how many there are.
    """

    shift: float
    matters: bool
    right: bool
    named: bool
    verdict: str
    keys: tuple[str, ...]
    honest: str
    honest_keys: tuple[str, ...]
    sound: bool
    inside: tuple[int, int]
    honest_inside: tuple[int, int]


@dataclass
class Cell:
    """The draws of one trap at one noise and number of attitudes."""

    trap: str
    noise: float
    attitudes: int
    drawn: list[Drawn] = field(default_factory=list)

    @property
    def mattering(self) -> list[Drawn]:
        return [one for one in self.drawn if one.matters]

    def share(self, what: str) -> float | None:
        """Return the share of the draws in which the fault matters that are `right`, `named` or `both`."""
        of = self.mattering
        if not of:
            return None
        hits = [(one.right or what == "named") and (one.named or what == "right") for one in of]
        return sum(hits) / len(of)

    @property
    def unsound(self) -> int:
        return sum(not one.sound for one in self.drawn)

    @property
    def passed(self) -> bool:
        both = self.share("both")
        return (both is None or both >= RIGHT) and self.unsound <= HONEST_CELL * len(self.drawn)

    def row(self) -> list[str]:
        """Return the cells of the table."""
        shares = [_percent(self.share(what)) for what in ("right", "named")]
        matters = _percent(len(self.mattering) / len(self.drawn))
        honest = _percent(self.unsound / len(self.drawn))
        return [
            self.trap,
            f"{self.noise:g} mg",
            f"{self.attitudes:,}",
            str(len(self.drawn)),
            matters,
            *shares,
            honest,
        ]

    def record(self) -> dict[str, object]:
        """Return the figures of the row, and how often which verdict and key came."""
        return {
            "trap": self.trap,
            "noise_mg": self.noise,
            "attitudes": self.attitudes,
            "draws": len(self.drawn),
            "matters": len(self.mattering),
            "right": sum(one.right for one in self.mattering),
            "named": sum(one.named for one in self.mattering),
            "right_and_named": sum(one.right and one.named for one in self.mattering),
            "honest_not_good": self.unsound,
            "verdicts": Counter(one.verdict for one in self.mattering),
            "keys": Counter(key for one in self.mattering for key in one.keys),
            "honest_verdicts": Counter(one.honest for one in self.drawn),
            "honest_keys": Counter(key for one in self.drawn for key in one.honest_keys),
            "missed": [
                k for k, one in enumerate(self.drawn) if one.matters and not (one.right and one.named)
            ],
            "false_alarms": [k for k, one in enumerate(self.drawn) if not one.sound],
        }


def _percent(share: float | None, digits: int = 0) -> str:
    return "-" if share is None else f"{share:.{digits}%}"


def coverage_of(all_cells: Sequence[Cell]) -> dict[str, float | None]:
    """Return the share of 95 % intervals that hold the truth, of all draws called good or weak."""
    shares: dict[str, float | None] = {}
    for what, field_name in (("honest", "honest_inside"), ("faulty", "inside")):
        pairs = [getattr(one, field_name) for cell in all_cells for one in cell.drawn]
        hits, of = (sum(pair[k] for pair in pairs) for k in (0, 1))
        shares[what] = hits / of if of else None
    return shares


def draw(trap: Trap, noise: float, count: int, index: int, seed: int) -> Drawn:
    """Make one draw of a trap and judge it."""
    rows = trap.rows or (1, REPEATED)[index % 2]
    scene = Scene.of(stream(seed, trap.name, int(1000 * noise), count, index), noise, count, rows)
    faulty, honest = trap.make(scene)
    outcome = observe(faulty)
    shift, matters = float("inf"), True
    if trap.matters == "shift":
        fault = fault_of(faulty, honest)
        shift, matters = fault.shift, fault.shift >= SHIFT and (fault.seen or trap.shown)
    right = not outcome.trusted
    if outcome.result is not None and outcome.trusted:
        right = holds(outcome.result, faulty.truth)
    other = observe(honest)
    return Drawn(
        shift,
        matters,
        right and outcome.verdict != "crashed",
        bool(trap.keys & outcome.keys) or (trap.matters == "attitudes" and right and outcome.trusted),
        outcome.verdict,
        tuple(sorted(outcome.keys)),
        other.verdict,
        tuple(sorted(other.keys)),
        is_sound(other, count, rows),
        _inside(outcome, faulty),
        _inside(other, honest),
    )


def _inside(outcome: Outcome, recording: Recording) -> tuple[int, int]:
    """Return how many intervals of a result called good or weak hold the truth, and how many it has."""
    if outcome.result is None or not outcome.trusted:
        return 0, 0
    hits = inside(outcome.result, recording.truth)
    return int(np.nansum(hits)), int(np.isfinite(hits).sum())


def is_sound(honest: Outcome, count: int, rows: int) -> bool:
    """Whether the outcome of honest readings counts as good."""
    if honest.verdict != "weak" or honest.result is None:
        return honest.verdict == "good"
    return count <= 12 and rows == 1 and max(pose.leverage for pose in honest.result.poses_fit) >= CHECKABLE


Task = tuple[str, float, int, range, int]


def draws(task: Task) -> list[Drawn]:
    """Make the draws of a task: trap, noise, attitudes, numbers of the draws, seed."""
    name, noise, count, indices, seed = task
    trap = next(trap for trap in TRAPS if trap.name == name and count in trap.counts)
    return [draw(trap, noise, count, index, seed) for index in indices]


def cells(traps: Sequence[Trap], number: int, seed: int, jobs: int) -> Iterator[Cell]:
    """Yield the cells of the table as they come, in order."""
    kinds = [(trap.name, noise, count) for trap in traps for count, noise in product(trap.counts, NOISES)]
    chunks = [range(first, min(first + CHUNK, number)) for first in range(0, number, CHUNK)]
    tasks = [(*kind, chunk, seed) for kind in kinds for chunk in chunks]
    results = in_processes(draws, tasks, jobs)
    for kind in kinds:
        cell = Cell(*kind)
        for _ in chunks:
            cell.drawn += next(results)
        yield cell


DRAWS = 100
REMARKS = "\nRemarks\n"
"""Begins what is printed below a table and does not belong to it."""


def table_of_traps(only: Sequence[str], number: int | None, seed: int, jobs: int, as_json: bool) -> bool:
    """Print the table of the traps whose names contain one of `only`; return whether all of it is as it should be."""
    traps = [trap for trap in TRAPS if not only or any(part in trap.name for part in only)]
    if not as_json:
        print(
            "| trap | noise | attitudes | draws | fault matters | judged right | cause named | honest not good |"
        )
        print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    all_cells = []
    for cell in cells(traps, number or DRAWS, seed, jobs):
        all_cells.append(cell)
        if not as_json:
            print(f"| {' | '.join(cell.row())} |", flush=True)
    honest = sum(len(cell.drawn) for cell in all_cells)
    unsound = sum(cell.unsound for cell in all_cells)
    passed = all(cell.passed for cell in all_cells) and unsound <= HONEST_ALL * honest
    if as_json:
        record = {
            "cells": [cell.record() for cell in all_cells],
            "honest": honest,
            "honest_not_good": unsound,
            "coverage": coverage_of(all_cells),
            "invisible": INVISIBLE,
            "passed": passed,
        }
        print(json.dumps(record, indent=1))
        return passed
    print(f"\nHonest draws not called good: {unsound:,} of {honest:,} ({unsound / max(1, honest):.1%}).")
    for what, share in coverage_of(all_cells).items():
        print(f"95 % intervals that hold the truth, {what} draws called good or weak: {_percent(share, 1)}.")
    print(REMARKS)
    if missed := [cell for cell in all_cells if not cell.passed]:
        print("Short of 95 % judged right with the cause named, or beyond 4 % of honest draws not good:\n")
        for cell in missed:
            print(f"- {cell.trap}, {cell.noise:g} mg, {cell.attitudes:,} attitudes: {in_words(cell)}")
    print(f"\nInvisible, and so left out:\n\n{invisible()}")
    return passed


def in_words(cell: Cell) -> str:
    """Return what a cell's draws were called, faulty and honest."""
    record = cell.record()
    words = []
    for what, verdicts, keys in (
        ("faulty", "verdicts", "keys"),
        ("honest", "honest_verdicts", "honest_keys"),
    ):
        counted = [f"{count} {name}" for name, count in record[verdicts].most_common()]  # type: ignore[attr-defined]
        said = [f"{name} {count}" for name, count in record[keys].most_common(4)]  # type: ignore[attr-defined]
        words.append(f"{what} {', '.join(counted) or 'none'} ({', '.join(said) or 'nothing said'})")
    return "; ".join(words)


Study = Callable[[Sequence[str], int | None, int, int, bool], bool]
"""Prints its table: rows, draws, seed, processes, whether as JSON; returns whether all is as it should be."""


def studies() -> dict[str, Study]:
    """Return the studies by name."""
    from benchmarks.truth_checks import STUDIES
    from benchmarks.truth_coverage import table_of_coverage

    return {"traps": table_of_traps, "coverage": table_of_coverage, **STUDIES}


class Tee(io.StringIO):
    """Text that is also printed."""

    def __init__(self, stream: TextIO) -> None:
        super().__init__()
        self.stream = stream

    def write(self, text: str) -> int:
        self.stream.write(text)
        return super().write(text)

    def flush(self) -> None:
        self.stream.flush()


def filled(page: str, name: str, text: str) -> str:
    """Return a page with the text between its mark of that name and the next end."""
    mark = re.compile(rf"(<!-- truth: {name} -->\n).*?(<!-- end -->)", re.DOTALL)
    if not mark.search(page):
        raise ValueError(f"no place for {name} in the page")
    return mark.sub(lambda match: f"{match[1]}{text.strip()}\n{match[2]}", page)


def invisible() -> str:
    """Return the faults that cannot be shown, as a list."""
    return "\n".join(f"- **{what[0].upper()}{what[1:]}**: {why}." for what, why in INVISIBLE.items())


def run(name: str, stated: argparse.Namespace) -> bool:
    """Run a study and write its table where asked to."""
    started = time.perf_counter()
    shown = Tee(sys.stdout)
    with contextlib.redirect_stdout(shown):
        passed = studies()[name](stated.only, stated.draws, stated.seed, stated.jobs, stated.json)
    if stated.write:
        page = stated.write.read_text(encoding="utf-8")
        page = filled(filled(page, name, shown.getvalue().split(REMARKS)[0]), "invisible", invisible())
        stated.write.write_text(page, encoding="utf-8")
    word = "as it should be" if passed else "not as it should be"
    print(f"{name}: {time.perf_counter() - started:.0f} s, {word}", file=sys.stderr)
    return passed


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.truth", description=__doc__.split("\n")[0])
    parser.add_argument(
        "--draws", type=int, help="draws of each row (traps and robust 100, weights 500, others 1000)"
    )
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes")
    parser.add_argument(
        "--only", action="append", default=[], metavar="NAME", help="rows whose names contain it"
    )
    parser.add_argument("--json", action="store_true", help="figures of every row, with verdicts and keys")
    parser.add_argument(
        "--write", type=Path, metavar="PAGE", help="put the table into a page, docs/explanation/trust.md"
    )
    for study in ("coverage", "weights", "robust", "verify", "all"):
        parser.add_argument(f"--{study}", dest="study", action="store_const", const=study, default="traps")
    stated = parser.parse_args(arguments)
    names = list(studies()) if stated.study == "all" else [stated.study]
    failed = [name for name in names if not run(name, stated)]
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
