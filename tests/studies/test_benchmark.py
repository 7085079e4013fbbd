"""A benchmark's numbers against numpy and scipy, and what it is made of."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import stats

from accelcal_cli.errors import ConfigError
from accelcal_cli.studies import benchmark as ranks
from accelcal_cli.studies.benchmark import Benchmark, statistics
from accelcal_cli.studies.engine import Journal, run_study
from accelcal_cli.studies.study import Budget, Record, Task, choose, median_curve, median_curves, words
from accelcal_cli.views.studies import ranking_table, raw_table

SMALL = {"population": 20, "iterations": 30}
CONTRACT = {
    "function", "optimizer", "runs", "evaluations", "min", "max", "mean", "variance", "median", "success_rate",
    "seconds", "ert", "target", "dimension", "instance",
}  # fmt: skip


def study(functions=("sphere", "rosenbrock"), optimizers=("pso", "de"), **changes):
    budget = Budget(**SMALL)
    changes = {"dimensions": (3,), "runs": 7, "tolerance": 1e-2, **changes}
    return Benchmark(tuple(functions), tuple(choose(optimizers, None, (), budget)), **changes)


@pytest.fixture(scope="module")
def done():
    small = study()
    return small, run_study(small, Journal(None))


def record(cell, run, cost, hit=None, curve=(), status="iterations", seconds=0.1):
    return Record(cell, run, cost, 100 + run, 10, status, hit, {}, tuple(curve), seconds)


def test_rows_have_the_names_of_the_contract(done):
    rows = statistics(*done)
    assert [(r["function"], r["optimizer"]) for r in rows] == [
        ("sphere", "pso"), ("sphere", "de"), ("rosenbrock", "pso"), ("rosenbrock", "de"),
    ]  # fmt: skip
    assert set(rows[0]) >= CONTRACT


def test_statistics_are_those_of_the_runs(done):
    small, records = done
    for cell, row in enumerate(statistics(small, records)):
        own = [r for r in records if r.cell == cell]
        cost = [r.cost for r in own]
        assert row["runs"] == len(own) == 7
        assert row["min"] == min(cost)
        assert row["max"] == max(cost)
        assert row["mean"] == pytest.approx(sum(cost) / 7, rel=1e-12)
        assert row["variance"] == pytest.approx(np.var(cost, ddof=1), rel=1e-12)
        assert row["median"] == sorted(cost)[3]
        assert row["success_rate"] == sum(c <= small.tolerance for c in cost) / 7
        assert row["seconds"] > 0


def test_hits_are_evaluations_until_the_tolerance(done):
    small, records = done
    reached = [r for r in records if r.hit is not None]
    assert reached
    assert all((r.hit is not None) == (r.cost <= small.tolerance) for r in records)
    for r in reached:
        before = [cost for n, cost in r.curve if n < r.hit]
        after = [cost for n, cost in r.curve if n >= r.hit]
        assert min(before, default=math.inf) > small.tolerance >= max(after)


def test_one_run_has_no_variance_and_no_hits_no_evaluations_to_tolerance():
    (row,) = statistics(study(("sphere",), ("pso",), runs=1), [record(0, 0, 3.0)])
    assert row["variance"] is None
    assert row["evaluations_to_tolerance"] is None
    assert row["success_rate"] == 0


def test_a_run_without_a_cost_is_infinite_and_a_failure():
    records = [record(0, 0, 1.0), record(0, 1, math.inf, status="failed")]
    (row,) = statistics(study(("sphere",), ("pso",), runs=2), records)
    assert (row["min"], row["mean"], row["variance"], row["failures"]) == (1.0, math.inf, None, 1)


def test_raw_rows_do_not_tell_how_long_it_took(done):
    table = raw_table(*done)
    names = [column.name for column in table.columns]
    assert names == [
        *("function", "optimizer", "run", "cost", "evaluations", "iterations", "status", "hit"),
        *("dimension", "instance", "trace_evaluations", "trace_cost", "x_1", "x_2", "x_3"),
    ]
    assert [row[2] for row in table.rows] == list(range(7)) * 4


def test_a_run_is_the_same_in_any_task(done):
    small, records = done
    (alone,) = small.execute(Task(2, 4, 5))
    other = next(r for r in records if (r.cell, r.run) == (2, 4))
    assert (alone.cost, alone.hit, alone.curve) == (other.cost, other.hit, other.curve)


def test_the_median_curve_keeps_the_cost_of_a_run_that_ended():
    long = record(0, 0, 1.0, curve=[(10, 8.0), (20, 4.0), (30, 1.0)])
    short = record(0, 1, 2.0, curve=[(10, 6.0), (20, 2.0)])
    grid, cost = median_curve([long, short], points=3)
    assert grid.tolist() == [10, 20, 30]
    assert cost.tolist() == [7.0, 3.0, 1.5]
    assert median_curve([record(0, 0, math.inf)]) is None


def test_curves_are_named_and_fall(done):
    found = median_curves(*done)
    assert list(found) == ["sphere", "rosenbrock"]
    for panel in found.values():
        assert list(panel) == ["pso", "de"]
        for _, cost in panel.values():
            assert (np.diff(cost) <= 0).all()


def test_least_squares_takes_part_where_there_are_squares():
    everyone = choose(["all"], None, (), Budget(population=20, evaluations=600))
    mixed = Benchmark(("sphere", "rastrigin"), tuple(everyone), dimensions=(3,))
    assert ("sphere", "levenberg-marquardt") in [(f, e.label) for f, e in mixed.pairs]
    assert ("rastrigin", "levenberg-marquardt") in mixed.unsuited
    left, notes = mixed.suiting([])
    assert "ellipsoid" not in [entry.label for entry in left.entries]
    assert any("levenberg-marquardt needs residuals" in n and "rastrigin does not have" in n for n in notes)
    with pytest.raises(ConfigError, match="ellipsoid needs a closed form, which sphere and rastrigin do not"):
        mixed.suiting(["ellipsoid"])


def test_levenberg_marquardt_solves_sums_of_squares():
    small = Benchmark(("sphere", "zakharov", "elliptic"), tuple(choose(["levenberg-marquardt"], None, (), Budget())),
                      dimensions=(4,), runs=3, shift=True, rotate=True)  # fmt: skip
    assert all(r.cost < 1e-12 for r in run_study(small, Journal(None)))


# Optimizers of a study


def test_a_budget_of_evaluations_is_used_by_all():
    budget = Budget(evaluations=3000)
    small = Benchmark(("rastrigin",), tuple(choose(["pso", "de", "ifoa", "shade-cma"], None, (), budget)),
                      dimensions=(4,), runs=2, evaluations=3000)  # fmt: skip
    for r in run_study(small, Journal(None)):
        assert 2900 <= r.evaluations <= 3200


def test_words_are_split_and_kept_once():
    assert words(["a, b", "b", ",c"]) == ["a", "b", "c"]


def test_a_file_states_optimizers_with_labels(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text(
        "optimizers:\n- optimizer: pso\n- {optimizer: pso, label: slow, parameters: {inertia: 0.9}}\n"
    )
    first, second = choose([], file, ("de",), Budget())
    assert (first.label, second.label, second.build().inertia) == ("pso", "slow", 0.9)
    assert [e.label for e in choose(["slow", "de"], file, (), Budget())] == ["slow", "de"]
    assert {"slow", "de", "pso"} <= {e.label for e in choose(["all"], file, (), Budget())}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("optimizers: []", "expected a list"),
        ("optimizers:\n- pso", r"optimizers\[1\]: expected a mapping"),
        ("optimizers:\n- {optimizer: psso}", 'did you mean "pso"'),
        ("optimizers:\n- {optimizer: pso, parameters: {inertai: 1}}", r'\[1\]: unknown key "inertai"'),
        ("optimizers:\n- {optimizer: pso}\n- {optimizer: pso}", "given twice"),
        ("optimizers:\n- {optimizer: pso, label: all}", "label"),
        ("optimizer: pso\nfunctions: 3", 'unknown key "functions"'),
    ],
)
def test_a_wrong_file_is_explained(tmp_path, text, message):
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message):
        choose([], file, (), Budget())


# Ranks


def test_ranks_and_friedman_are_those_of_scipy():
    medians = np.random.default_rng(5).random((9, 4)) + np.array([0.0, 0.3, 0.6, 0.0])
    result = ranks.ranking(["a", "b", "c", "d"], medians)
    order = ["abcd".index(label) for label in result.labels]
    assert result.ranks == pytest.approx(stats.rankdata(medians, axis=1).mean(axis=0)[order])
    assert list(result.ranks) == sorted(result.ranks)
    expected = stats.friedmanchisquare(*medians.T)
    assert result.chi_squared == pytest.approx(expected.statistic)
    assert result.p_friedman == pytest.approx(expected.pvalue)


def test_the_critical_difference_is_that_of_the_table():
    """[demsar2006] section 3.2.3: q = 2.569 for four classifiers, CD = 1.25 over fourteen data sets."""
    result = ranks.ranking(list("abcd"), np.random.default_rng(1).random((14, 4)))
    assert result.critical == pytest.approx(2.569 * math.sqrt(4 * 5 / (6 * 14)), rel=1e-3)
    assert result.critical == pytest.approx(1.25, abs=0.01)


def test_a_difference_as_large_as_the_critical_one_has_p_of_the_level():
    result = ranks.ranking(list("abc"), np.tile([1.0, 2.0, 3.0], (12, 1)))
    assert result.ranks == (1, 2, 3)
    assert result.p[2] < 0.001 < result.p[1] < ranks.LEVEL
    assert result.p_friedman < 0.001


def test_ties_of_all_are_no_difference():
    result = ranks.ranking(list("abc"), np.zeros((4, 3)))
    assert (result.chi_squared, result.p_friedman) == (0.0, 1.0)
    assert result.ranks == (2, 2, 2)


def test_ranks_need_two_of_either_and_leave_out_who_missed_a_function(done):
    small, records = done
    assert ranks.rank(small, records).labels in {("pso", "de"), ("de", "pso")}
    assert ranks.rank(study(("sphere",)), records[:14]) is None
    mixed = study(("sphere", "ackley"), ("pso", "levenberg-marquardt"))
    assert ranks.rank(mixed, run_study(mixed, Journal(None))) is None
    assert "Nemenyi" in " ".join(ranking_table(ranks.rank(small, records)).notes)
