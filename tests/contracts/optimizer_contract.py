"""What every optimizer has to do, as functions that raise AssertionError when it does not.

They take the class and build it with its defaults, so that a new file in `optimization/algorithms/`, or somebody
else's package, is held to them without an edit here. BUDGETS is for an algorithm whose defaults are too small, or
needlessly large, for these small problems.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from known_problems import CASES, Holed, watched

from accelcal_cli.optimization.minimize import Stopping, minimize
from accelcal_cli.optimization.optimizer import Status

RUNS, BATCH = 3, 20

LARGEST_BUDGET = 110_000
"""Evaluations of one run that an optimizer may use up."""

BUDGETS: Mapping[str, Mapping[str, Any]] = {
    "akpso": {"population": 100, "iterations": 300},
    "full-foa": {"iterations": 2000},
    "ifoa": {"iterations": 3000},
    "kpso": {"iterations": 200},
    "newton": {"population": 20},
    "shade-cma": {"evaluations": 12_000, "iterations": 600},
}
"""Settings by optimizer where the defaults are needlessly large, or too small, for these small problems."""

SHORT: Mapping[str, Mapping[str, Any]] = {
    "shade-cma": {"population": 30, "evaluations": 1500, "iterations": 200},
}
"""Settings where 60 iterations do not pass through all that the algorithm does."""

FLOORS: Mapping[str, float] = {"sphere": 0.01, "rosenbrock": 2e-3, "residuals": 2e-5, "calibration": 0.1}
"""The cost that counts as reached, by case, for an optimizer that does not converge. Less than one run of random
search in fifty finds it within the largest budget."""

REACHED: Mapping[str, Mapping[str, float]] = {
    "foa": {"rosenbrock": 0.12},
    "full-foa": {"sphere": 0.08, "rosenbrock": 0.1, "residuals": 4e-3, "calibration": 0.5},
    "kpso": {"sphere": 0.06, "rosenbrock": 0.08, "residuals": 1.2e-3, "calibration": 0.2},
}
"""A higher floor, by optimizer and case: swarms with a radius or a noise that never shrinks. It is still several times
below what random search finds in as many evaluations."""

BEYOND: Mapping[str, tuple[str, ...]] = {"foa": ("sphere", "residuals", "calibration")}
"""Minima that an algorithm as published cannot reach (FOA's candidates are positive and near its swarm's radius)."""


def build(cls):
    """The optimizer with its defaults, cut to the largest budget, or with its entry of BUDGETS."""
    if cls.name in BUDGETS:
        return cls(**BUDGETS[cls.name])
    default = cls()
    return cls(iterations=min(default.iterations, max(1, LARGEST_BUDGET // default.population - 1)))


def short(cls):
    """The optimizer for checks that do not need it to arrive: 60 iterations."""
    if cls.name in SHORT:
        return cls(**SHORT[cls.name])
    return dataclasses.replace(build(cls), iterations=min(60, build(cls).iterations))


def arrived(cls, cost, case):
    """Whether enough runs have reached the minimum: two of three, so that one may be trapped."""
    return len(cost) > 0 and (cost <= reached(cls, case)).mean() >= 0.6


def searches(cls):
    """Whether the optimizer searches at all: a closed form evaluates one point and has no second step."""
    limits = {field.name: field.metadata for field in dataclasses.fields(cls)}
    return limits["iterations"]["high"] != 1


def cases(cls):
    """Names of the known problems that offer what the optimizer needs."""
    return [name for name, case in CASES.items() if build(cls).suits(case.make())]


def reached(cls, case):
    """The cost that counts as the minimum."""
    usual = CASES[case].reached if cls.converges else FLOORS[case]
    return REACHED.get(cls.name, {}).get(case, usual)


def reaches_the_minimum(cls, case):
    problem = CASES[case].make()
    run = minimize(problem, build(cls), runs=RUNS, seed=5)
    assert arrived(cls, run.cost, case), f"{case}: best costs {run.cost}"
    assert (run.evaluations <= LARGEST_BUDGET).all(), f"{case}: {run.evaluations} evaluations"
    at_best = problem.cost(run.x[:, None, :])[:, 0]
    np.testing.assert_allclose(at_best, run.cost, rtol=1e-6, atol=1e-20)


def never_worsens(cls, case):
    run = minimize(CASES[case].make(), short(cls), runs=RUNS, seed=6)
    assert (np.diff(run.trace, axis=1) <= 0).all()
    assert (np.diff(run.trace_evaluations, axis=1) >= 0).all()
    np.testing.assert_array_equal(run.trace[:, -1], run.cost)
    np.testing.assert_array_equal(run.trace_evaluations[:, -1], run.evaluations)
    if searches(cls):
        assert (run.trace[:, -1] < run.trace[:, 0]).any(), "not one improvement"
        assert (run.trace_evaluations[:, -1] > run.trace_evaluations[:, 0]).all(), "not one evaluation"


def keeps_to_the_box(cls, case):
    problem = watched(CASES[case].make())
    minimize(problem, short(cls), runs=RUNS, seed=7)
    points = problem.seen.all()
    assert len(points) >= RUNS
    assert (points >= problem.lower).all()
    assert (points <= problem.upper).all()


def counts_every_evaluation(cls, case):
    problem = watched(CASES[case].make())
    run = minimize(problem, short(cls), runs=1, seed=8)
    assert problem.seen.evaluations == run.evaluations[0] > 0
    many = watched(CASES[case].make())
    batch = minimize(many, short(cls), runs=3, seed=8)
    assert many.seen.evaluations == batch.evaluations.sum()
    assert batch.evaluations[0] == run.evaluations[0]
    if searches(cls):
        assert len(np.unique(problem.seen.all(), axis=0)) > 3, "it stays where it started"


def alone_equals_batch(cls, case):
    """Run 13 alone and in a batch of 20 gives the same bits, also when others of the batch end before it."""
    problem, optimizer = CASES[case].make(), short(cls)
    batch = minimize(problem, optimizer, runs=BATCH, seed=9)
    different = len(np.unique(batch.trace[:, 0]))
    assert different == (BATCH if searches(cls) else 1), "runs are copies of each other"
    tolerances = np.quantile(batch.trace[:, batch.trace.shape[1] // 2], [0.2, 0.5])
    for stopping in (Stopping(), *map(Stopping, tolerances)):
        batch = minimize(problem, optimizer, runs=BATCH, seed=9, stopping=stopping)
        for number in (0, 13):
            alone = minimize(problem, optimizer, runs=[number], seed=9, stopping=stopping)
            same_run(alone, 0, batch, number)


def same_run(first, i, second, j):
    """Run i of the first outcome has the same bits as run j of the second."""
    for name in ("x", "cost", "evaluations", "iterations"):
        one, other = getattr(first, name)[i], getattr(second, name)[j]
        assert one.tobytes() == other.tobytes(), f"{name} of run {j}"
    length = min(first.trace.shape[1], second.trace.shape[1])
    assert first.trace[i, :length].tobytes() == second.trace[j, :length].tobytes()
    assert first.status[i] == second.status[j]


def a_seed_repeats(cls, case):
    def points(seed):
        problem = watched(CASES[case].make())
        minimize(problem, short(cls), runs=2, seed=seed)
        return problem.seen.all().tobytes()

    first = points(11)
    assert first == points(11)
    if searches(cls):
        assert first != points(12)


def survives_nan(cls, case):
    problem = Holed(CASES[case].make())
    run = minimize(problem, build(cls), runs=5, seed=13)
    alive = np.isfinite(run.cost)
    for well, status in zip(alive, run.status, strict=True):
        assert well != (status is Status.FAILED)
    assert (run.x[alive, 0] >= problem.edge).all()
    if case not in BEYOND.get(cls.name, ()):
        assert arrived(cls, run.cost[alive], case), f"{case}: best costs {run.cost}"
    # A population of many has points outside the hole, and has to find its way from them.
    assert alive.all() or build(cls).population == 1
    nowhere = minimize(Holed(CASES[case].make(), share=2.0), build(cls), runs=2, seed=13)
    assert nowhere.status == (Status.FAILED, Status.FAILED)


def stops_at_the_tolerance(cls, case):
    problem = CASES[case].make()
    free = minimize(problem, short(cls), runs=1, seed=14)
    if not searches(cls):
        assert minimize(problem, short(cls), seed=14, stopping=Stopping(1e9)).cost[0] <= 1e9
        return
    assert free.cost[0] < free.trace[0, 0]
    tolerance = float(np.sqrt(free.trace[0, 0] * max(free.cost[0], 1e-6 * free.trace[0, 0])))
    run = minimize(problem, short(cls), runs=1, seed=14, stopping=Stopping(tolerance=tolerance))
    steps = int(np.argmax(free.trace[0] <= tolerance))
    assert 0 < steps < free.trace.shape[1]
    assert run.status == (Status.TOLERANCE,)
    assert run.iterations[0] == steps
    assert run.cost[0] <= tolerance
    np.testing.assert_array_equal(run.trace[0], free.trace[0, : steps + 1])


def stops_at_the_budget(cls, case):
    problem = CASES[case].make()
    free = minimize(problem, short(cls), runs=1, seed=15)
    counts = free.trace_evaluations[0]
    if not searches(cls):
        assert counts[-1] == 1
        return
    assert len(counts) > 2
    for step in (1, min(3, len(counts) - 2)):
        budget = int(counts[step - 1]) + 1
        run = minimize(problem, short(cls), runs=1, seed=15, stopping=Stopping(evaluations=budget))
        assert run.status == (Status.EVALUATIONS,)
        assert run.evaluations[0] == counts[step]  # the step under way is finished, no other is started
        assert run.iterations[0] == step


CONTRACT = (
    reaches_the_minimum,
    never_worsens,
    keeps_to_the_box,
    counts_every_evaluation,
    alone_equals_batch,
    a_seed_repeats,
    survives_nan,
    stops_at_the_tolerance,
    stops_at_the_budget,
)
