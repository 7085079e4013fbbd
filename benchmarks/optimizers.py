"""Our optimizers beside other tools': `python -m benchmarks.optimizers [--func rosenbrock] [--repeat 7]`.

Everyone minimises the same function of 12 coordinates with 100 points and 500 iterations, in turn, in this one
process and thread; the table gives medians of million new points a second of processor time, and their ratios.
A tool that evaluates a point it already knows again gets no credit for that: the column "asked" says how many
evaluations it asked for per new point.
Peers: pip install pyswarms scikit-opt scipy mealpy pygmo fcmaes; one that is missing is skipped.
"""

from __future__ import annotations

import os

os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")  # before numpy reads them

import argparse
import contextlib
import logging
import statistics
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from rich.console import Console
from rich.table import Table

from accelcal_cli.optimizers.base import OPTIMIZERS
from accelcal_cli.optimizers.minimize import minimize
from accelcal_cli.streams import Float
from accelcal_cli.studies.functions import PAPER, TestFunction

POPULATION, ITERATIONS, D = 100, 500, 12
PSO = {"w": 0.7298, "c1": 1.49618, "c2": 1.49618}
OURS = [(name, runs) for name in ("pso", "de", "de-pso", "shade-cma") for runs in (1, 20)]

NEW_POINTS = POPULATION * ITERATIONS

Job = Callable[[], object]
"""One whole search. Its evaluations are counted by its Objective, or else it returns their number."""


class Objective:
    """The function as peers with a Python objective take it, the points it was asked for counted."""

    def __init__(self, problem: TestFunction) -> None:
        self.problem, self.points = problem, 0
        self.lower, self.upper = problem.lower, problem.upper

    def rows(self, x: Float) -> Float:
        """Return costs of points, shape (P, D); laid out the way our own populations are before the sums."""
        self.points += len(x)
        return self.problem.cost(np.asfortranarray(x)[None])[0]

    def columns(self, x: Float) -> Float:
        """Return costs of points, shape (D, P)."""
        return self.rows(x.T)

    def one(self, x: Float) -> float:
        """Return the cost of one point."""
        return float(self.rows(np.asarray(x)[None])[0])


def accelcal(objective: Objective, name: str, runs: int) -> Job:
    budget = {"population": POPULATION, "iterations": ITERATIONS}
    if name == "shade-cma":  # its population is a schedule; the evaluations are the same
        budget = {"evaluations": POPULATION * ITERATIONS}
    optimizer = OPTIMIZERS.get(name)(**budget)
    return lambda: int(minimize(objective.problem, optimizer, runs=runs).evaluations.sum())


def pyswarms_pso(objective: Objective) -> Job:
    from pyswarms.single import GlobalBestPSO

    logging.disable(logging.INFO)
    bounds = (objective.lower, objective.upper)
    return lambda: GlobalBestPSO(POPULATION, D, PSO, bounds).optimize(
        objective.rows, ITERATIONS, verbose=False
    )


def scikit_opt(objective: Objective, name: str) -> Job:
    import sko.DE
    import sko.PSO
    from sko.tools import set_run_mode

    def run() -> None:
        rows = partial(objective.rows)
        set_run_mode(rows, "vectorization")
        common = {"n_dim": D, "max_iter": ITERATIONS, "lb": objective.lower, "ub": objective.upper}
        if name == "pso":
            sko.PSO.PSO(rows, pop=POPULATION, **common, **PSO).run()
        else:
            sko.DE.DE(rows, size_pop=POPULATION, **common).run()

    return run


def scipy_de(objective: Objective) -> Job:
    from scipy.optimize import differential_evolution

    def run() -> None:
        start = np.random.default_rng(0).uniform(objective.lower, objective.upper, (POPULATION, D))
        box = list(zip(objective.lower, objective.upper, strict=True))
        settings = {"maxiter": ITERATIONS, "polish": False, "tol": 0.0, "atol": 0.0}
        differential_evolution(
            objective.columns, box, init=start, vectorized=True, updating="deferred", **settings
        )

    return run


def mealpy_pso(objective: Objective) -> Job:
    from mealpy import PSO as swarm
    from mealpy import FloatVar

    bounds = FloatVar(lb=objective.lower.tolist(), ub=objective.upper.tolist())
    task = {"obj_func": objective.one, "bounds": bounds, "minmax": "min", "log_to": None}
    return lambda: swarm.OriginalPSO(epoch=ITERATIONS, pop_size=POPULATION).solve(task)


def fcmaes_de(objective: Objective) -> Job:
    from fcmaes.decpp import DE_C
    from scipy.optimize import Bounds

    def run() -> None:
        search = DE_C(D, Bounds(objective.lower, objective.upper), popsize=POPULATION)
        for _ in range(ITERATIONS):
            search.tell(objective.rows(np.asarray(search.ask())))

    return run


def pygmo_batch(objective: Objective) -> Job:
    import pygmo

    class Batched:
        def fitness(self, x: Float) -> list[float]:
            return [objective.one(x)]

        def batch_fitness(self, x: Float) -> Float:
            return objective.rows(x.reshape(-1, D))

        def get_bounds(self) -> tuple[Float, Float]:
            return objective.lower, objective.upper

    def run() -> None:
        method = pygmo.pso_gen(gen=ITERATIONS)
        method.set_bfe(pygmo.bfe(pygmo.member_bfe()))
        pygmo.algorithm(method).evolve(pygmo.population(pygmo.problem(Batched()), POPULATION))

    return run


def pygmo_native(objective: Objective, name: str) -> Job:
    import pygmo

    function = getattr(pygmo, objective.problem.name)(dim=D)
    method = {
        "pso": pygmo.pso(gen=ITERATIONS),
        "de": pygmo.de(gen=ITERATIONS, ftol=0.0, xtol=0.0),
        "cmaes": pygmo.cmaes(gen=ITERATIONS, ftol=0.0, xtol=0.0, force_bounds=True),
    }[name]

    def run() -> int:
        population = pygmo.population(pygmo.problem(function), POPULATION)
        return int(pygmo.algorithm(method).evolve(population).problem.get_fevals())

    return run


PEERS: dict[str, Callable[[Objective], Job]] = {
    "pyswarms PSO": pyswarms_pso,
    "scikit-opt PSO": partial(scikit_opt, name="pso"),
    "scikit-opt DE": partial(scikit_opt, name="de"),
    "SciPy differential_evolution": scipy_de,
    "mealpy PSO": mealpy_pso,
    "fcmaes DE, ask and tell": fcmaes_de,
    "pygmo pso_gen, batched": pygmo_batch,
    "pygmo pso, all C++": partial(pygmo_native, name="pso"),
    "pygmo de, all C++": partial(pygmo_native, name="de"),
    "pygmo cmaes, all C++": partial(pygmo_native, name="cmaes"),
}


@dataclass
class Rates:
    """What the repetitions of one job gave: million new points a second, evaluations per new point."""

    runs: int
    rates: list[float] = field(default_factory=list)
    asked: float = 0.0

    def add(self, job: Job, objective: Objective) -> None:
        """Time one search."""
        before, start = objective.points, time.process_time()
        returned = job()
        seconds = time.process_time() - start
        evaluations = returned if isinstance(returned, int) else objective.points - before
        self.asked = evaluations / (self.runs * NEW_POINTS)
        self.rates.append(self.runs * NEW_POINTS / seconds / 1e6)

    @property
    def median(self) -> float:
        """The median rate."""
        return statistics.median(self.rates)


def measure(problem: TestFunction, repeat: int, console: Console) -> dict[str, Rates]:
    """Return the rates of everyone, ours first, all repetitions interleaved."""
    objective = Objective(problem)
    jobs = {f"{name} x {runs}": accelcal(objective, name, runs) for name, runs in OURS}
    results = {f"{name} x {runs}": Rates(runs) for name, runs in OURS}
    for name, adapter in PEERS.items():
        try:
            jobs[name], results[name] = adapter(objective), Rates(1)
        except (ImportError, AttributeError) as error:
            console.print(f"skipped {name}: {error}")
    for _ in range(repeat):
        for name, job in jobs.items():
            results[name].add(job, objective)
    return results


def show(results: dict[str, Rates], title: str) -> Table:
    """Return the table: a row a peer, a column for each of ours."""
    ours, peers = list(results)[: len(OURS)], list(results)[len(OURS) :]
    table = Table("", "M points/s", "asked", *ours, title=f"{title}: ours (x runs), and ours / theirs")
    table.add_row("accelcal", "", "1.00", *(f"{results[name].median:.2f}" for name in ours), end_section=True)
    for peer in peers:
        theirs = results[peer]
        ratios = (f"{results[name].median / theirs.median:.2f}" for name in ours)
        table.add_row(peer, f"{theirs.median:.3g}", f"{theirs.asked:.2f}", *ratios)
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--func", choices=PAPER, default="rosenbrock")
    parser.add_argument("--repeat", type=int, default=7)
    options = parser.parse_args()
    console = Console(width=120)
    # pyswarms leaves a report.log wherever it is run.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        results = measure(TestFunction(options.func, D), options.repeat, console)
    console.print(show(results, options.func))


if __name__ == "__main__":
    main()
