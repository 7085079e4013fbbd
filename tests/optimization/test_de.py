"""The parts of differential evolution: partners, crossover, base vectors, selection."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_problems import ShiftedSphere, Watched

from accelcal_cli.optimization.algorithms.de import DifferentialEvolution
from accelcal_cli.optimization.operators import gather, integers, mutated_genes, partners
from accelcal_cli.rng import Streams


def _pairs(seed, runs, population):
    return _partners(Streams(seed, range(runs)).uniform(population, 2))


def _partners(u):
    population = u.shape[1]
    return partners(integers(u, population - 1, population - 2))


@given(st.integers(0, 10**6), st.integers(1, 4), st.integers(3, 60))
def test_partners_are_others_and_distinct(seed, runs, population):
    first, second = _pairs(seed, runs, population)
    own = np.arange(population)
    assert first.shape == second.shape == (runs, population)
    for index in (first, second):
        assert (index >= 0).all()
        assert (index < population).all()
        assert (index != own).all()
    assert (first != second).all()


@pytest.mark.parametrize("corner", [0.0, np.nextafter(1.0, 0.0)])
@given(population=st.integers(3, 200))
def test_partners_at_the_ends_of_the_random_numbers(corner, population):
    first, second = _partners(np.full((1, population, 2), corner))
    own = np.arange(population)
    assert ((first != own) & (second != own) & (first != second)).all()


def test_partners_are_uniform_over_all_ordered_pairs():
    """20 ordered pairs of others for each of 5 individuals: a chi-square over 12 cells each."""
    population, runs = 5, 20_000
    first, second = _pairs(3, runs, population)
    for own in range(population):
        counts = np.zeros((population, population))
        np.add.at(counts, (first[:, own], second[:, own]), 1)
        possible = [(a, b) for a in range(5) for b in range(5) if len({a, b, own}) == 3]
        seen = np.array([counts[pair] for pair in possible])
        assert seen.sum() == runs
        chi_square = ((seen - runs / 12) ** 2 / (runs / 12)).sum()
        assert chi_square < 31.3  # 0.1 % of 11 degrees of freedom


@pytest.mark.parametrize("share", [0.0, 0.2, 0.4, 0.9, 1.0])
def test_the_share_of_parental_genes(share):
    """P_c of all genes stay the parent's, but the forced one: P_c (1 - 1/D) of all."""
    dimensions, points = 12, 20_000
    u = Streams(4, [0]).uniform(points, dimensions + 1)[:, None]
    gene = integers(u[..., dimensions:], dimensions)[..., 0, :]
    mutated = mutated_genes(u[..., :dimensions], share, gene)[0, 0]
    assert np.isin(mutated, (0.0, 1.0)).all()
    expected = share * (1 - 1 / dimensions)
    assert 1 - mutated.mean() == pytest.approx(expected, abs=0.005)
    assert mutated.any(axis=1).all(), "a trial without one gene of the mutant"
    if share == 1.0:
        assert mutated.sum() == points
        assert mutated.sum(axis=0) == pytest.approx(np.full(dimensions, points / dimensions), rel=0.1)


def test_gather_takes_rows():
    x = Streams(0, range(3)).uniform(10, 4)
    index = np.array([[1, 1, 9], [0, 5, 2], [3, 3, 3]])
    expected = np.stack([x[r][index[r]] for r in range(3)])
    np.testing.assert_array_equal(gather(x, index), expected)


def _trials(strategy, crossover, keeps):
    optimizer = DifferentialEvolution(
        population=12, weight=0.5, crossover=crossover, strategy=strategy, crossover_keeps=keeps
    )
    problem, rng = Watched(ShiftedSphere()), Streams(6, [0])
    x = -0.2 + 0.4 * rng.uniform(12, 4)
    state = optimizer.init(problem, x, rng)
    problem.seen.points.clear()
    after = optimizer.step(problem, state, rng)
    return problem, state, after, problem.seen.all()


@pytest.mark.parametrize(("strategy", "base"), [("rand/1", "any"), ("current/1", "own"), ("best/1", "best")])
def test_every_mutant_is_base_plus_a_weighted_difference(strategy, base):
    """With every gene from the mutant the trial minus its base is F times the difference of two others."""
    _, state, _, trials = _trials(strategy, 0.0, "parent")
    x = state.x[0]
    best = x[state.fx[0].argmin()]
    differences = 0.5 * (x[:, None] - x[None]).reshape(-1, 4)
    for i, trial in enumerate(trials):
        bases = {"any": x, "own": x[i : i + 1], "best": best[None]}[base]
        rest = trial - bases
        miss = np.abs(rest[:, None] - differences[None]).max(axis=2).min()
        assert miss < 1e-14


def test_current_to_one_is_not_rand_to_one():
    """The own position as base leaves a trace: it is no base of rand/1 in general."""
    _, state, _, trials = _trials("rand/1", 0.0, "parent")
    x = state.x[0]
    differences = 0.5 * (x[:, None] - x[None]).reshape(-1, 4)
    own = [np.abs(t - x[i] - differences).max(axis=1).min() < 1e-14 for i, t in enumerate(trials)]
    assert sum(own) < 6


@pytest.mark.parametrize(("crossover", "keeps"), [(0.9, "parent"), (0.1, "mutant")])
def test_the_two_readings_of_the_crossover_probability_mirror_each_other(crossover, keeps):
    counts = []
    for seed in range(40):
        optimizer = DifferentialEvolution(population=12, crossover=crossover, crossover_keeps=keeps)
        problem, rng = Watched(ShiftedSphere()), Streams(seed, [0])
        state = optimizer.init(problem, -0.2 + 0.4 * rng.uniform(12, 4), rng)
        problem.seen.points.clear()
        optimizer.step(problem, state, rng)
        counts.append((problem.seen.all() == state.x[0]).mean())
    assert np.mean(counts) == pytest.approx(0.9 * 0.75, abs=0.03)


def test_selection_is_greedy_point_by_point():
    problem, state, after, trials = _trials("rand/1", 0.5, "parent")
    cost = problem.problem.cost(trials[None])
    better = (cost < state.fx)[0]
    assert 0 < better.sum() < 12
    np.testing.assert_array_equal(after.x[0], np.where(better[:, None], trials, state.x[0]))
    np.testing.assert_array_equal(after.fx, np.minimum(cost, state.fx))
