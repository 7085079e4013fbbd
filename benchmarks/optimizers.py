"""Our optimizers beside other tools': `python -m benchmarks.optimizers [--func rosenbrock,sphere] [--repeat 7]`.

Everyone minimises the same function of 12 coordinates with 100 points and 500 iterations, in turn, in this one
process and thread; the table gives medians of million new points a second of processor time, and their ratios.
A tool that evaluates a point it already knows again gets no credit for that: the column "asked" says how many
evaluations it asked for per new point. A peer that is not installed is skipped.
"""

from __future__ import annotations

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # before numpy reads them

import argparse
import contextlib
import statistics
import tempfile
import time
from dataclasses import dataclass, field

from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.studies.functions import PAPER, TestFunction
from benchmarks.peers import ITERATIONS, NATIVE, POPULATION, PYTHON, D, Job, Objective

NEW_POINTS = POPULATION * ITERATIONS
FAMILY = {"pso": "pso", "de": "de", "de-pso": "de", "shade-cma": "cmaes"}
"""Ours, and the pygmo algorithm nearest to each."""

KIN = {
    "pso": {"PSO", "pso", "pso_gen"},
    "de": {"DE", "de"},
    "de-pso": {"PSO", "pso", "pso_gen", "DE", "de"},
    "shade-cma": {"CMA-ES", "cmaes"},
}
"""What the peers that do the same as ours are called: the word before the comma."""

OURS = {f"{name} x{runs}": (name, runs) for name in FAMILY for runs in (1, 20)}


def accelcal(objective: Objective, name: str, runs: int) -> Job:
    budget = {"population": POPULATION, "iterations": ITERATIONS}
    if name == "shade-cma":  # its population is a schedule; the evaluations are the same
        budget = {"evaluations": NEW_POINTS}
    optimizer = OPTIMIZERS.get(name)(**budget)
    return lambda: int(minimize(objective.problem, optimizer, runs=runs).evaluations.sum())


@dataclass
class Rates:
    """What the repetitions of one job gave: million new points a second, evaluations per new point."""

    runs: int = 1
    rates: list[float] = field(default_factory=list)
    asked: float = 0.0

    def add(self, job: Job, objective: Objective) -> None:
        """Time one search."""
        before, start = objective.points, time.process_time()
        returned = job()
        seconds = time.process_time() - start
        evaluations = returned if isinstance(returned, int) else objective.points - before
        # Without credit for a point known already, nor for one left out by a search that ends before its budget.
        new = min(evaluations, self.runs * NEW_POINTS)
        self.asked = evaluations / new
        self.rates.append(new / seconds / 1e6)

    def over(self, other: Rates) -> float:
        """Return the median of the ratios to the other's rate, repetition by repetition."""
        return statistics.median(a / b for a, b in zip(self.rates, other.rates, strict=True))


def measure(problem: TestFunction, repeat: int, console: Console) -> dict[str, Rates]:
    """Return the rates of everyone, ours first, all repetitions interleaved."""
    objective = Objective(problem)
    jobs = {label: accelcal(objective, *ours) for label, ours in OURS.items()}
    results = {label: Rates(runs) for label, (_, runs) in OURS.items()}
    for name, adapter in (PYTHON | NATIVE).items():
        try:
            jobs[name], results[name] = adapter(objective), Rates()
        except ImportError as error:
            console.print(f"skipped {name}: {error}")
    for _ in range(repeat):
        for name, job in jobs.items():
            results[name].add(job, objective)
    return results


def table(results: dict[str, Rates], title: str) -> Table:
    """Return the table: a row a peer, a column for each of ours."""
    out = Table(box=SIMPLE, padding=(0, 1), title=f"{title}: million new points a second, and ours / theirs")
    out.add_column("", no_wrap=True)
    for column in ("rate", "asked", *OURS):
        out.add_column(column, justify="right", no_wrap=True)
    rates = (f"{statistics.median(results[label].rates):.2f}" for label in OURS)
    out.add_row("accelcal", "", "1.00", *rates, end_section=True)
    for peer in (name for name in results if name not in OURS):
        theirs = results[peer]
        ratios = (f"{results[label].over(theirs):.2f}" for label in OURS)
        out.add_row(peer, f"{statistics.median(theirs.rates):.3g}", f"{theirs.asked:.2f}", *ratios)
    return out


def goals(results: dict[str, Rates]) -> list[str]:
    """Return what has to hold, measured: one run beside Python objectives, twenty beside C++ throughout."""
    lines = []
    for name, family in FAMILY.items():
        one, many, native = results[f"{name} x1"], results[f"{name} x20"], f"pygmo {family}, all C++"
        python = {peer: one.over(results[peer]) for peer in PYTHON if peer in results}
        alike = {peer: ratio for peer, ratio in python.items() if _method(peer) in KIN[name]}
        for label, ratios in (("of its kind", alike), ("of all", python)):
            if ratios:
                hardest = min(ratios, key=ratios.__getitem__)
                lines.append(
                    f"{name}, one run / fastest {label}, {hardest}: {ratios[hardest]:.2f} (at least 1)"
                )
        if native in results:
            lines.append(
                f"{name}, 20 runs / {native}: {many.over(results[native]):.2f} (at least 0.6, aim 1.5)"
            )
    return lines


def _method(peer: str) -> str:
    return peer.split(",")[0].split()[-1]


def main(functions: tuple[str, ...] = PAPER, repeat: int = 3) -> None:
    console = Console(width=150)
    # pyswarms leaves a report.log wherever it is run.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        for function in functions:
            results = measure(TestFunction(function, D), repeat, console)
            console.print(table(results, function))
            console.print("\n".join(goals(results)) + "\n", highlight=False)


def _functions(text: str) -> tuple[str, ...]:
    names = tuple(text.split(","))
    if unknown := [name for name in names if name not in PAPER]:
        raise argparse.ArgumentTypeError(f"unknown {', '.join(unknown)}; known: {', '.join(PAPER)}")
    return names


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--func", type=_functions, default=PAPER, help="names with commas")
    parser.add_argument("--repeat", type=int, default=3)
    options = parser.parse_args()
    main(options.func, options.repeat)
