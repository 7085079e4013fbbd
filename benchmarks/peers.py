"""The other tools that `benchmarks.optimizers` measures, each as a job: one whole search.

pip install pyswarms scikit-opt scipy mealpy pygmo fcmaes pymoo
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.studies.functions import TestFunction

POPULATION, ITERATIONS, D = 100, 500, 12
PSO_WEIGHT = 0.7298
PSO = {"w": PSO_WEIGHT, "c1": 1.49618, "c2": 1.49618}

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


def pymoo(objective: Objective, name: str) -> Job:
    from pymoo.algorithms.soo.nonconvex.de import DE
    from pymoo.algorithms.soo.nonconvex.pso import PSO
    from pymoo.core.problem import Problem
    from pymoo.optimize import minimize

    class Asked(Problem):
        def __init__(self) -> None:
            super().__init__(n_var=D, n_obj=1, xl=objective.lower, xu=objective.upper)

        def _evaluate(self, x: Float, out: dict[str, Float], *_: Any, **__: Any) -> None:
            out["F"] = objective.rows(x)[:, None]

    maker = {"pso": partial(PSO, adaptive=False, w=PSO_WEIGHT, c1=1.49618, c2=1.49618), "de": DE}[name]
    return lambda: minimize(Asked(), maker(pop_size=POPULATION), ("n_gen", ITERATIONS), seed=1)


def fcmaes(objective: Objective, name: str) -> Job:
    from fcmaes import cmaescpp, decpp
    from scipy.optimize import Bounds

    search = {"de": decpp.DE_C, "cma": cmaescpp.ACMA_C}[name]

    def run() -> None:
        found = search(D, Bounds(objective.lower, objective.upper), popsize=POPULATION)
        for _ in range(ITERATIONS):
            found.tell(objective.rows(np.asarray(found.ask())))

    return run


def pygmo_python(objective: Objective, name: str) -> Job:
    """Minimise in C++ a function in Python: pso_gen asks for whole populations, the others for one point at a time."""
    import pygmo

    class InPython:
        def fitness(self, x: Float) -> list[float]:
            return [objective.one(x)]

        def batch_fitness(self, x: Float) -> Float:
            return objective.rows(x.reshape(-1, D))

        def get_bounds(self) -> tuple[Float, Float]:
            return objective.lower, objective.upper

    def run() -> None:
        method = _pygmo_method(name)
        if name == "pso_gen":
            method.set_bfe(pygmo.bfe(pygmo.member_bfe()))
        pygmo.algorithm(method).evolve(pygmo.population(pygmo.problem(InPython()), POPULATION))

    return run


def _pygmo_method(name: str) -> Any:
    import pygmo

    never = {} if name.startswith("pso") else {"ftol": 0.0, "xtol": 0.0}
    box = {"force_bounds": True} if name == "cmaes" else {}
    return getattr(pygmo, name)(gen=ITERATIONS, **never, **box)


def pygmo_native(objective: Objective, name: str) -> Job:
    """Minimise in C++ throughout. pygmo has no sphere; its Rosenbrock stands in, a few operations dearer."""
    import pygmo

    function = getattr(pygmo, objective.problem.name, pygmo.rosenbrock)(dim=D)

    def run() -> int:
        population = pygmo.population(pygmo.problem(function), POPULATION)
        return int(pygmo.algorithm(_pygmo_method(name)).evolve(population).problem.get_fevals())

    return run


PYTHON: dict[str, Callable[[Objective], Job]] = {
    "pyswarms PSO": pyswarms_pso,
    "scikit-opt PSO": partial(scikit_opt, name="pso"),
    "scikit-opt DE": partial(scikit_opt, name="de"),
    "SciPy DE": scipy_de,
    "mealpy PSO": mealpy_pso,
    "pymoo PSO": partial(pymoo, name="pso"),
    "pymoo DE": partial(pymoo, name="de"),
    "pygmo pso, point by point": partial(pygmo_python, name="pso"),
    "pygmo pso_gen, batched": partial(pygmo_python, name="pso_gen"),
    "pygmo de, point by point": partial(pygmo_python, name="de"),
    "pygmo cmaes, point by point": partial(pygmo_python, name="cmaes"),
    "fcmaes DE, ask and tell": partial(fcmaes, name="de"),
    "fcmaes CMA-ES, ask and tell": partial(fcmaes, name="cma"),
}
"""Peers that minimise the same function in Python; those of pygmo and fcmaes are themselves C++."""

NATIVE: dict[str, Callable[[Objective], Job]] = {
    f"pygmo {name}, all C++": partial(pygmo_native, name=name) for name in ("pso", "de", "cmaes")
}
"""Peers whose objective is C++ too."""
