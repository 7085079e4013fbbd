"""Other libraries' optimizers on our problems, with the same budget: `scipy:differential_evolution`, `pygmo:pso_gen`.

A peer is asked as its own library has it, with its own settings but for population and budget. It sees an `Objective`:
a function of one point, or of many, over a box. The objective counts, remembers the best, and ends the search by an
exception once the budget is used, so that no library's own way of counting matters.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError, DataError, did_you_mean
from accelcal_cli.optimization.minimize import Run
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.registry import import_place

BUDGET = 50_000
"""Evaluations of a run when none are stated."""


class BudgetUsedError(Exception):
    """All evaluations have been used; ends a search of another library."""


class Objective:
    """One run of a problem as other libraries take it.

    Attributes:
        problem: of one run, R = 1; budget: evaluations at most.
        lower, upper: the box, shape (D,); bounds: the same as pairs.
        best, cost: the best point so far, shape (D,), and its cost; evaluations: used.
        trace: evaluations and cost at every improvement.
    """

    def __init__(self, problem: Problem, budget: int) -> None:
        """Start with nothing evaluated."""
        self.problem, self.budget = problem, budget
        self.lower, self.upper = problem.lower, problem.upper
        self.bounds = list(zip(self.lower.tolist(), self.upper.tolist(), strict=True))
        self.best, self.cost, self.evaluations = np.full(problem.dimensions, np.nan), math.inf, 0
        self.trace: list[tuple[int, float]] = []

    def __call__(self, x: Float, *_: Any) -> float:
        """Return the cost of one point, shape (D,)."""
        return float(self.rows(np.asarray(x, dtype=float)[None])[0])

    def rows(self, x: Float) -> Float:
        """Return the costs, shape (P,), of points, shape (P, D), of which those outside the box count as at its wall.

        Raises:
            BudgetUsedError: the budget had been used before; of points beyond it none is looked at.
        """
        left = self.budget - self.evaluations
        if left <= 0:
            raise BudgetUsedError
        x = np.clip(np.asarray(x, dtype=float), self.lower, self.upper)[:left]
        fx = self.problem.cost(np.asfortranarray(x)[None])[0]
        fx = np.where(np.isnan(fx), np.inf, fx)
        return self._noted(x, fx)

    def residuals(self, x: Float) -> Float:
        """Return the residuals of one point, shape (M,)."""
        if self.evaluations >= self.budget:
            raise BudgetUsedError
        x = np.clip(np.asarray(x, dtype=float), self.lower, self.upper)[None]
        r: Float = self.problem.residuals(x[None])[0, 0]
        self._noted(x, np.array([float(r @ r)]))
        return r

    def _noted(self, x: Float, fx: Float) -> Float:
        at = int(fx.argmin())
        if fx[at] < self.cost:
            self.cost, self.best = float(fx[at]), x[at].copy()
            self.trace.append((self.evaluations + at + 1, self.cost))
        self.evaluations += len(fx)
        if self.evaluations >= self.budget and len(fx) > 1:
            raise BudgetUsedError
        return fx


Search = Callable[[Objective, int], object]
"""One whole search: an objective and a seed; what it returns is not looked at."""


def run_search(problem: Problem, search: Search, runs: Sequence[int], seed: int, budget: int) -> Run:
    """Return the outcome of a search of another library, run by run.

    Args:
        problem: of as many runs as there are numbers, in their order.
        search: what minimises an `Objective`.
        runs: their numbers; with the seed they make that of each search.
        budget: evaluations at most.
    """
    objectives = []
    for row, number in enumerate(runs):
        objective = Objective(problem.take(np.array([row])), budget)
        with np.errstate(all="ignore"):
            _search(search, objective, int(np.random.SeedSequence([seed, number]).generate_state(1)[0] >> 1))
        objectives.append(objective)
    longest = max(len(one.trace) for one in objectives) + 1
    traces = np.array([_padded(one, longest) for one in objectives])
    counts = np.array([one.evaluations for one in objectives])
    return Run(
        np.array(runs, dtype=np.int64),
        np.array([one.best for one in objectives]),
        np.array([one.cost for one in objectives]),
        counts,
        np.full(len(counts), longest - 1),
        tuple(_status(one) for one in objectives),
        traces[:, :, 1],
        traces[:, :, 0].astype(np.int64),
    )


def _search(search: Search, objective: Objective, seed: int) -> None:
    try:
        search(objective, seed)
    except BudgetUsedError:
        return
    except Exception:  # libraries in C++ wrap the exception of the objective in one of their own
        if objective.evaluations < objective.budget:
            raise


def _padded(one: Objective, length: int) -> list[tuple[int, float]]:
    end = (one.evaluations, one.cost)
    return [*one.trace, *[end] * (length - len(one.trace))]


def _status(one: Objective) -> Status:
    if not math.isfinite(one.cost):
        return Status.FAILED
    return Status.EVALUATIONS if one.evaluations >= one.budget else Status.CONVERGED


POPULATION = 100


def _scipy(name: str) -> Search:
    from scipy import optimize

    def differential_evolution(f: Objective, seed: int) -> None:
        count = max(1, round(POPULATION / len(f.bounds)))
        optimize.differential_evolution(
            f, f.bounds, popsize=count, maxiter=f.budget, tol=0.0, rng=seed, polish=False
        )

    def dual_annealing(f: Objective, seed: int) -> None:
        optimize.dual_annealing(f, f.bounds, maxfun=f.budget, maxiter=f.budget, rng=seed)

    def direct(f: Objective, _: int) -> None:
        optimize.direct(f, f.bounds, maxfun=f.budget, maxiter=f.budget)

    def shgo(f: Objective, _: int) -> None:
        optimize.shgo(f, f.bounds, options={"maxfev": f.budget})

    def least_squares(f: Objective, seed: int) -> None:
        start = np.random.default_rng(seed).uniform(f.lower, f.upper)
        optimize.least_squares(
            f.residuals, start, bounds=(f.lower, f.upper), xtol=1e-15, ftol=1e-15, gtol=1e-15
        )

    def minimize(f: Objective, seed: int) -> None:
        start = np.random.default_rng(seed).uniform(f.lower, f.upper)
        optimize.minimize(f, start, bounds=f.bounds, method="L-BFGS-B", options={"maxfun": f.budget})

    searches = (differential_evolution, dual_annealing, direct, shgo, least_squares, minimize)
    return _one_of("scipy", name, {search.__name__: search for search in searches})


def _pygmo(name: str) -> Search:
    import pygmo

    found = getattr(pygmo, name, None)
    if not (inspect.isclass(found) and {"get_log", "get_seed"} <= set(dir(found))):
        known = [one for one in dir(pygmo) if {"get_log", "get_seed"} <= set(dir(getattr(pygmo, one)))]
        raise ConfigError(
            f'peer "pygmo:{name}": unknown{did_you_mean(name, known)}; known: {", ".join(known)}'
        )

    def search(f: Objective, seed: int) -> None:
        class Asked:  # pygmo copies it, attributes and all; what it closes over stays one
            def fitness(self, x: Float) -> list[float]:
                return [f(x)]

            def get_bounds(self) -> tuple[Float, Float]:
                return f.lower, f.upper

        settings: dict[str, Any] = {"gen": f.budget // POPULATION + 1, "seed": seed}
        if name in ("de", "sade", "de1220", "cmaes", "xnes"):
            settings |= {"ftol": 0.0, "xtol": 0.0}
        if name in ("cmaes", "xnes"):
            settings["force_bounds"] = True
        method = found(**settings)
        population = pygmo.population(pygmo.problem(Asked()), POPULATION, seed=seed)
        pygmo.algorithm(method).evolve(population)

    return search


def _fcmaes(name: str) -> Search:
    from fcmaes import cmaescpp, decpp
    from scipy.optimize import Bounds

    makers = {"de": decpp.DE_C, "cma": cmaescpp.ACMA_C}

    def search(maker: Any, f: Objective, seed: int) -> None:
        generator = np.random.default_rng(seed)
        found = maker(len(f.bounds), Bounds(f.lower, f.upper), popsize=POPULATION, rg=generator)
        while f.evaluations < f.budget:
            found.tell(f.rows(np.asarray(found.ask())))

    return _one_of("fcmaes", name, {key: partial(search, maker) for key, maker in makers.items()})


def _pyswarms(name: str) -> Search:
    import logging

    from pyswarms.single import GlobalBestPSO

    def pso(f: Objective, seed: int) -> None:
        logging.disable(logging.INFO)
        np.random.seed(seed % 2**32)  # noqa: NPY002  # the only stream that pyswarms has
        weights = {"w": 0.7298, "c1": 1.49618, "c2": 1.49618}
        swarm = GlobalBestPSO(POPULATION, len(f.bounds), weights, (f.lower, f.upper))
        swarm.optimize(f.rows, f.budget // POPULATION + 1, verbose=False)

    return _one_of("pyswarms", name, {"pso": pso})


def _scikit_opt(name: str) -> Search:
    from sko import DE, PSO
    from sko.tools import set_run_mode

    def search(kind: str, f: Objective, seed: int) -> None:
        np.random.seed(seed % 2**32)  # noqa: NPY002  # the only stream that scikit-opt has
        rows = partial(f.rows)
        set_run_mode(rows, "vectorization")
        common = {"n_dim": len(f.bounds), "max_iter": f.budget, "lb": f.lower, "ub": f.upper}
        if kind == "pso":
            PSO.PSO(rows, pop=POPULATION, w=0.7298, c1=1.49618, c2=1.49618, **common).run()
        else:
            DE.DE(rows, size_pop=POPULATION, **common).run()

    return _one_of("scikit-opt", name, {kind: partial(search, kind) for kind in ("pso", "de")})


def _pymoo(name: str) -> Search:
    from pymoo.algorithms.soo.nonconvex.cmaes import CMAES
    from pymoo.algorithms.soo.nonconvex.de import DE
    from pymoo.algorithms.soo.nonconvex.ga import GA
    from pymoo.algorithms.soo.nonconvex.pso import PSO
    from pymoo.core.problem import Problem as Base
    from pymoo.optimize import minimize

    class AskedByRows(Base):  # type: ignore[misc]
        def __init__(self, f: Objective) -> None:
            super().__init__(n_var=len(f.bounds), n_obj=1, xl=f.lower, xu=f.upper)
            self.f = f

        def _evaluate(self, x: Float, out: dict[str, Float], *_: Any, **__: Any) -> None:
            out["F"] = self.f.rows(x)[:, None]

    def search(maker: Callable[[], Any], f: Objective, seed: int) -> None:
        minimize(AskedByRows(f), maker(), ("n_eval", f.budget + POPULATION), seed=seed)

    makers = {
        "de": partial(DE, pop_size=POPULATION),
        "pso": partial(PSO, pop_size=POPULATION),
        "ga": partial(GA, pop_size=POPULATION),
        "cmaes": CMAES,
    }
    return _one_of("pymoo", name, {key: partial(search, maker) for key, maker in makers.items()})


LIBRARIES: Mapping[str, Callable[[str], Search]] = {
    "scipy": _scipy,
    "pygmo": _pygmo,
    "fcmaes": _fcmaes,
    "pyswarms": _pyswarms,
    "scikit-opt": _scikit_opt,
    "pymoo": _pymoo,
}


def _one_of(library: str, name: str, searches: Mapping[str, Search]) -> Search:
    if name not in searches:
        raise ConfigError(
            f'peer "{library}:{name}": unknown{did_you_mean(name, searches)}; known: {", ".join(searches)}'
        )
    return searches[name]


def callable_at(place: str) -> Search:
    """Return the search by a callable like SciPy's, `search(function, bounds)`, stated as package.module:name.

    It is given `rng` or `seed` where it has such a parameter.
    """
    found: Any = import_place(place, "optimizer")
    names = inspect.signature(found).parameters
    seeded = next((name for name in ("rng", "seed", "random_state") if name in names), None)
    return lambda f, seed: found(f, f.bounds, **({seeded: seed} if seeded else {}))


def run_peer(name: str, problem: Problem, runs: Sequence[int], seed: int, budget: int | None) -> Run:
    """Return the runs of a peer, by LIBRARY:NAME or by the place of a callable; see `run_search`."""
    search = peer(name) if name.partition(":")[0] in LIBRARIES else callable_at(name)
    return run_search(problem, search, runs, seed, budget or BUDGET)


def peer(name: str) -> Search:
    """Return the search of a peer by its name, LIBRARY:NAME.

    Raises:
        ConfigError: no such library or algorithm.
        DataError: a library that is not installed.
    """
    library, _, algorithm = name.partition(":")
    if library not in LIBRARIES or not algorithm:
        known = ", ".join(f"{key}:NAME" for key in LIBRARIES)
        raise ConfigError(f'peer "{name}": unknown{did_you_mean(library, LIBRARIES)}; expected {known}')
    try:
        return LIBRARIES[library](algorithm)
    except ImportError as error:
        raise DataError(
            f"peer {name} needs the extra bench: python -m pip install {library} ({error})"
        ) from None
