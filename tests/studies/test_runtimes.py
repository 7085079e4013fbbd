"""Running times against what the points of the runs themselves say, and which optimizers differ."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.studies.benchmark import Benchmark, holm, pairwise, statistics, unequal_budgets
from accelcal_cli.studies.engine import Journal, run_study
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.runtimes import (
    REDUCTIONS,
    Targeted,
    data_profile,
    expected_running_time,
    hits_of,
    runtime_distribution,
)
from accelcal_cli.studies.study import Budget, Task, choose

TARGETS = (1.0, 1e-2, 1e-6)


def study(optimizers=("pso", "de", "shade-cma"), budget=None, **changes):
    budget = budget or Budget(evaluations=2500)
    changes = {
        "dimensions": (2, 3),
        "runs": 6,
        "instances": 4,
        "targets": TARGETS,
        "evaluations": 2500,
        **changes,
    }
    return Benchmark(("sphere", "rastrigin"), tuple(choose(optimizers, None, (), budget)), **changes)


@pytest.fixture(scope="module")
def done():
    small = study()
    return small, run_study(small, Journal(None))


class Seen(TestFunction):
    """A test function that keeps every cost in the order of the evaluations."""

    def __init__(self, *arguments, **changes):
        super().__init__(*arguments, **changes)
        self.seen = []

    def cost(self, x):
        fx = super().cost(x)
        self.seen.append(fx)
        return fx


@pytest.mark.parametrize("name", ["pso", "ade", "shade-cma", "ifoa"])
def test_hits_are_counted_to_the_point(name):
    """Every evaluation is looked at, one after the other; a run that ended keeps what it reached."""
    problem = Seen("sphere", 3)
    settings = {"shade-cma": {"evaluations": 1200}}.get(name, {"iterations": 40})
    watched = Targeted(problem, 3, TARGETS, REDUCTIONS)
    run = minimize(watched, OPTIMIZERS.get(name)(**settings), runs=3, seed=2)
    costs = np.concatenate(problem.seen, axis=1)
    assert costs.shape[1] == run.evaluations[0]
    for row, hits in enumerate(hits_of(watched, 0, None)):
        limits = [*TARGETS, *(part * costs[row, 0] for part in REDUCTIONS)]
        for limit, hit in zip(limits, hits, strict=True):
            reached = np.flatnonzero(costs[row] <= limit)
            assert hit == (reached[0] + 1 if len(reached) else None)
    assert any(hit for hits in hits_of(watched, 0, None) for hit in hits)


def test_least_squares_counts_residuals_and_jacobians():
    small = study(("levenberg-marquardt",), Budget(), dimensions=(3,), evaluations=None)
    small = dataclasses.replace(small, functions=("sphere",))
    for r in run_study(small, Journal(None)):
        assert r.hits[-1] is not None
        assert 1 <= r.hits[0] <= r.hits[1] <= r.hits[2] <= r.evaluations


def test_ert_counts_failures(done):
    assert expected_running_time([10, None, 20], [100, 100, 100]) == (10 + 100 + 20) / 2
    assert expected_running_time([None, None], [5, 6]) is None
    small, records = done
    rows = statistics(small, records)
    assert len(rows) == 2 * 2 * 3 * 3
    for row in rows:
        own = [r for r in records if small.names(r.cell)["optimizer"] == row["optimizer"]]
        own = [r for r in own if small.problems[r.cell][:2] == (row["function"], row["dimension"])]
        number = TARGETS.index(row["target"])
        reached = [r for r in own if r.cost <= row["target"]]
        assert row["success_rate"] == len(reached) / 6
        spent = sum(r.hits[number] or r.evaluations for r in own)
        assert row["ert"] == (spent / len(reached) if reached else None)
        assert row["instance"] == "1-4"
    assert {row["ert"] is None for row in rows} == {True, False}


def test_distributions_and_profiles_count_runs_by_hand(done):
    small, records = done
    own = [r for r in records if small.names(r.cell)["optimizer"] == "shade-cma"]
    sizes = [small.problems[r.cell][1] for r in own]
    for budget in (10.0, 300.0, 900.0):
        solved = [(hit or math.inf) <= budget * D for r, D in zip(own, sizes, strict=True) for hit in r.hits]
        assert runtime_distribution(own, sizes, [budget]) == [sum(solved) / len(solved)]
        within = [(r.reductions[1] or math.inf) <= budget * (D + 1) for r, D in zip(own, sizes, strict=True)]
        assert data_profile(own, sizes, [budget], 1e-3) == [sum(within) / len(within)]
    assert (
        0 < runtime_distribution(own, sizes, [300.0])[0] < runtime_distribution(own, sizes, [900.0])[0] <= 1
    )


def test_a_run_with_an_instance_is_the_same_alone(done):
    small, records = done
    for cell in (0, 5, 8):
        (alone,) = small.execute(Task(cell, 4, 5))
        other = next(r for r in records if (r.cell, r.run) == (cell, 4))
        assert (alone.cost, alone.point, alone.hits) == (other.cost, other.point, other.hits)
        assert (alone.instance, small.instance(5), small.instance(0)) == (1, 2, 1)


# Significance


def test_pairs_are_those_of_scipy_with_holm(done):
    small, records = done
    found, tested = pairwise(small, records)
    assert tested == 2 * 2 * 3
    costs = {small.names(c)["optimizer"]: [r.cost for r in records if r.cell == c] for c in range(3)}
    p = sorted(
        stats.mannwhitneyu(costs[a], costs[b]).pvalue
        for a, b in (("pso", "de"), ("pso", "shade-cma"), ("de", "shade-cma"))
    )
    own = sorted(d.p for d in found if (d.function, d.dimension) == ("sphere", 2))
    expected = [max(3 * p[0], 0), max(3 * p[0], 2 * p[1]), max(3 * p[0], 2 * p[1], p[2])]
    assert own == pytest.approx([value for value in expected if value < 0.05])
    for d in found:
        if d.function == "sphere" and d.dimension == 2:
            assert np.median(costs[d.better]) < np.median(costs[d.worse])


def test_holm_steps_down():
    """The example of [holm1979]'s procedure: sorted p times 4, 3, 2, 1, never falling, at most 1."""
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.6, 0.7]) == [1.0, 1.0]
    assert holm([]) == []


# Budgets


def test_different_budgets_are_not_ranked():
    own = choose(("pso", "kpso"), None, (), Budget())
    small = study(("pso", "kpso"), Budget(), runs=2, evaluations=None, dimensions=(2,))
    assert unequal_budgets(small, run_study(small, Journal(None))) is None
    short = dataclasses.replace(own[1], parameters={**own[1].parameters, "iterations": 100})
    other = dataclasses.replace(small, entries=(own[0], short))
    sentence = unequal_budgets(other, run_study(other, Journal(None)))
    assert sentence.startswith(
        "not ranked: pso used 50,100 evaluations and kpso was cut off after 10,100; --eval"
    )


@pytest.mark.parametrize("name", [name for name in OPTIMIZERS.names() if name != "ellipsoid"])
@pytest.mark.parametrize("budget", [333, 1000])
def test_a_budget_is_kept_to_less_than_a_generation(name, budget):
    small = study(
        (name,), Budget(evaluations=budget), runs=2, dimensions=(3,), evaluations=budget, instances=0
    )
    small = dataclasses.replace(small, functions=("sphere",), tolerance=0.0)
    optimizer = small.entries[0].build()
    generation = {"ade": 2 * optimizer.population, "newton": 1 + 2 * 9}.get(
        name, max(optimizer.population, 3)
    )
    for r in run_study(small, Journal(None)):
        assert r.evaluations < budget + generation
        if r.status in ("iterations", "evaluations"):
            assert r.evaluations > budget - generation
