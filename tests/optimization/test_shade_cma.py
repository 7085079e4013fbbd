"""The parts of L-SHADE that its results alone do not show: ties, and the memory's last value."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from known_problems import ShiftedSphere, Watched

from accelcal_cli.optimization.algorithms.shade_cma import (
    CmaState,
    ShadeCma,
    _cma_start,
    _cma_step,
    _Constants,
    _step_size,
)
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.rng import Streams

SETTINGS = ShadeCma(population=20, evaluations=5000, memory=3)


class Plateau(ShiftedSphere):
    """The same cost everywhere."""

    def cost(self, x):
        return np.ones(x.shape[:2])


def _one_step(problem):
    watched, rng = Watched(problem), Streams(3, [0])
    x = problem.lower + (problem.upper - problem.lower) * rng.uniform(20, 4)
    state = SETTINGS.init(watched, x, rng)
    watched.seen.points.clear()
    return state, SETTINGS.step(watched, state, rng), watched.seen.all()


def test_a_tie_moves_the_individual_and_teaches_nothing():
    before, after, trials = _one_step(Plateau())
    np.testing.assert_array_equal(after.x[0], trials)
    assert (trials != before.x[0]).any(axis=1).all()
    np.testing.assert_array_equal(after.weights, before.weights)
    np.testing.assert_array_equal(after.rates, before.rates)
    assert after.archived[0] == after.position[0] == 0


def test_a_gain_moves_teaches_and_fills_the_archive():
    problem = ShiftedSphere()
    before, after, trials = _one_step(problem)
    better = problem.cost(trials[None])[0] < before.fx[0]
    assert 0 < better.sum() < 20
    np.testing.assert_array_equal(after.x[0], np.where(better[:, None], trials, before.x[0]))
    assert after.archived[0] == better.sum()
    np.testing.assert_array_equal(after.archive[0, : better.sum()], before.x[0][better])
    assert after.position[0] == 1
    assert after.rates[0, 0] != 0.5


def test_a_memory_of_crossovers_that_are_all_zero_is_never_left():
    """[tanabe2014] algorithm 1: while other rates go on learning."""
    state, _, _ = _one_step(ShiftedSphere())
    state = dataclasses.replace(state, position=np.array([1]))
    F, CR = np.full((1, 20), 0.7), np.r_[np.zeros(10), np.full(10, 0.9)][None]
    gain = np.r_[np.ones(10), np.zeros(10)][None]  # of those at zero alone
    ended = SETTINGS._learn(state, F, CR, gain)
    np.testing.assert_allclose(ended.weights, [[0.5, 0.7, 0.5]])
    np.testing.assert_array_equal(ended.rates, [[0.5, np.nan, 0.5]])

    again = SETTINGS._learn(dataclasses.replace(ended, position=np.array([1])), F, CR, 1.0 - gain)
    assert np.isnan(again.rates[0, 1])
    other = SETTINGS._learn(ended, F, CR, 1.0 - gain)
    np.testing.assert_allclose(other.rates[0, 2], 0.9)

    entry = np.where(np.arange(20) < 10, 0.4, 0.9)[None]  # M_CR no. 1 for half of them, no. 2 for the others
    _, drawn = SETTINGS._draw(again, entry, np.full((1, 20), 0.5), Streams(1, [0]))
    assert (drawn[0, :10] == 0.0).all()
    assert (drawn[0, 10:] > 0.0).all()


# Generations written out by hand


def _by_hand(x, fx, memory, archive, u, normal, replace, problem, size):
    """Return population, costs, memories and archive after one generation of [tanabe2014], and who came from where.

    `memory` is M_F, M_CR and the next entry, `replace` the random numbers that choose what a full archive loses.
    """
    weights, rates, position = memory
    population, D = x.shape
    order, own_archive, from_archive = np.argsort(fx, kind="stable"), list(archive), 0
    new, new_cost, successes = x.copy(), fx.copy(), []
    for i in range(population):
        entry = int(u[i, 0] * len(weights))
        least = (
            0.5 + np.arctan(-weights[entry] / 0.1) / np.pi
        )  # share of the Cauchy distribution that is not positive
        F = min(1.0, weights[entry] + 0.1 * np.tan(np.pi * (least + (1 - least) * u[i, 1] - 0.5)))
        CR = min(max(rates[entry] + 0.1 * normal[i], 0.0), 1.0)
        pbest = x[order[int(u[i, 2] * max(2, round(0.2 * population)))]]
        first = [k for k in range(population) if k != i][int(u[i, 3] * (population - 1))]
        pool = [*x, *archive]
        second = [k for k in range(len(pool)) if k not in (i, first)][int(u[i, 4] * (len(pool) - 2))]
        from_archive += second >= population
        forced, trial = int(u[i, 5] * D), x[i].copy()
        for j in range(D):
            if u[i, 6 + j] <= CR or j == forced:
                mutant = x[i, j] + F * (pbest[j] - x[i, j]) + F * (x[first, j] - pool[second][j])
                if mutant < problem.lower[j]:
                    mutant = 0.5 * (x[i, j] + problem.lower[j])
                if mutant > problem.upper[j]:
                    mutant = 0.5 * (x[i, j] + problem.upper[j])
                trial[j] = mutant
        cost = float(problem.cost(trial[None, None])[0, 0])
        if cost < fx[i]:
            successes.append((fx[i] - cost, F, CR))
            limit = int(1.4 * population)
            if len(own_archive) < limit:
                own_archive.append(x[i])
            else:
                own_archive[int(replace[i] * limit)] = x[i]
            new[i], new_cost[i] = trial, cost
    weights, rates = weights.copy(), rates.copy()
    if successes:
        gain, F, CR = np.array(successes).T
        weights[position] = (gain * F**2).sum() / (gain * F).sum()
        rates[position] = (gain * CR**2).sum() / (gain * CR).sum()
        position = (position + 1) % len(weights)
    keep = np.argsort(new_cost, kind="stable")[:size] if size < population else np.arange(population)
    own_archive = own_archive[: int(1.4 * size)]
    return new[keep], new_cost[keep], (weights, rates, position), own_archive, from_archive


def test_generations_of_l_shade_are_those_of_the_paper():
    """current-to-pbest/1 with the archive, memories by the Lehmer mean, the population smaller from step to step."""
    problem, optimizer = ShiftedSphere(), ShadeCma(population=20, evaluations=1000, memory=3, smallest=5)
    rng, twin = Streams(3, [0]), Streams(3, [0])
    x = problem.lower + (problem.upper - problem.lower) * Streams(1, [0]).uniform(20, 4)
    state = optimizer.init(problem, x, rng)
    x, fx, archive, used = x[0], state.fx[0], [], 20
    memory, from_archive, sizes = (np.full(3, 0.5), np.full(3, 0.5), 0), 0, []
    for _ in range(28):
        state = optimizer.step(problem, state, rng)
        population = len(x)
        used += population
        size = max(5, round(20 + (5 - 20) * used / 650.0))
        u = twin.uniform(population, 4 + 6)[0]
        normal, replace = twin.normal(population, 1)[0, :, 0], twin.uniform(population, 1)[0, :, 0]
        x, fx, memory, archive, some = _by_hand(x, fx, memory, archive, u, normal, replace, problem, size)
        from_archive += some
        sizes.append(len(archive))
        np.testing.assert_allclose(state.x[0], x, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(state.fx[0], fx, rtol=1e-9)
        np.testing.assert_allclose(state.weights[0], memory[0], rtol=1e-9)
        np.testing.assert_allclose(state.rates[0], memory[1], rtol=1e-9)
        assert (state.position[0], state.archived[0]) == (memory[2], len(archive))
        np.testing.assert_allclose(state.archive[0, : len(archive)], archive, rtol=1e-9, atol=1e-12)
    assert from_archive > 20
    assert len(x) < 15 < max(sizes)
    assert sizes[-1] == int(1.4 * len(x))  # it was full and lost entries


def test_a_generation_of_cma_es_is_that_of_the_tutorial():
    """[hansen2016] eq. 39 to 47 and table 1, with a mean of the best half, paths, rank-one and rank-mu updates."""
    problem, D, samples = ShiftedSphere(), 4, 8
    x = problem.lower + (problem.upper - problem.lower) * Streams(1, [0]).uniform(20, D)
    x = problem.solution + 0.05 * (x - problem.solution)
    rng, twin = Streams(3, [0]), Streams(3, [0])
    state = _cma_start(x, problem.cost(x), samples, 0)
    centred = x[0] - x[0].mean(axis=0)
    covariance = centred.T @ centred / 20
    variance = np.trace(covariance) / D
    np.testing.assert_allclose(state.C[0], 0.5 * covariance / variance + 0.5 * np.eye(D), rtol=1e-12)
    np.testing.assert_allclose(state.sigma[0], np.sqrt(variance), rtol=1e-12)
    m, sigma, C, ps, pc = (
        x[0, problem.cost(x)[0].argmin()],
        state.sigma[0],
        state.C[0],
        np.zeros(D),
        np.zeros(D),
    )

    mu = samples // 2
    raw = [np.log((samples + 1) / 2) - np.log(i) for i in range(1, mu + 1)]
    w = np.array(raw) / sum(raw)
    mu_eff = 1 / (w**2).sum()
    cs = (mu_eff + 2) / (D + mu_eff + 5)
    ds = 1 + 2 * max(0.0, np.sqrt((mu_eff - 1) / (D + 1)) - 1) + cs
    cc = (4 + mu_eff / D) / (D + 4 + 2 * mu_eff / D)
    c1 = 2 / ((D + 1.3) ** 2 + mu_eff)
    cmu = min(1 - c1, 2 * (mu_eff - 2 + 1 / mu_eff) / ((D + 2) ** 2 + mu_eff))
    chi = np.sqrt(D) * (1 - 1 / (4 * D) + 1 / (21 * D**2))
    stalled = 0
    for g in range(12):
        if g == 6:  # a path as after many steps in one direction: h_sigma is 0
            state = dataclasses.replace(state, path_sigma=np.full((1, D), 4.0))
            ps = np.full(D, 4.0)
        z = twin.normal(samples, D)[0]
        y = [state.axes[0] @ (state.lengths[0] * z[k]) for k in range(samples)]
        points = np.array([m + sigma * step for step in y])
        assert ((points > problem.lower) & (points < problem.upper)).all()
        best = np.argsort(problem.cost(points[None])[0], kind="stable")[:mu]
        step = sum(w[i] * y[best[i]] for i in range(mu))
        values, B = np.linalg.eigh(C)
        whitened = B @ np.diag(values**-0.5) @ B.T @ step
        m = m + sigma * step
        ps = (1 - cs) * ps + np.sqrt(cs * (2 - cs) * mu_eff) * whitened
        short = np.linalg.norm(ps) / np.sqrt(1 - (1 - cs) ** (2 * (g + 1))) < (1.4 + 2 / (D + 1)) * chi
        stalled += not short
        sigma = sigma * np.exp(cs / ds * (np.linalg.norm(ps) / chi - 1))
        pc = (1 - cc) * pc + short * np.sqrt(cc * (2 - cc) * mu_eff) * step
        C = (1 + c1 * (1 - short) * cc * (2 - cc) - c1 - cmu) * C + c1 * np.outer(pc, pc)
        C = C + cmu * sum(w[i] * np.outer(y[best[i]], y[best[i]]) for i in range(mu))
        state = _cma_step(problem, state, rng, 10_000)
        np.testing.assert_allclose(state.x[0], points, rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(state.mean[0], m, rtol=1e-9, atol=1e-13)
        np.testing.assert_allclose(state.sigma[0], sigma, rtol=1e-9)
        np.testing.assert_allclose(state.path_sigma[0], ps, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(state.path_c[0], pc, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(state.C[0], C, rtol=1e-8, atol=1e-12)
    assert 0 < stalled < 12


def test_the_phases_take_their_parts_of_the_budget():
    """L-SHADE up to phase_one of the evaluations, then `samples` or `smallest` points a generation to the end."""
    for samples, expected in ((None, 6), (9, 9)):
        optimizer = ShadeCma(population=20, evaluations=1000, phase_one=0.5, smallest=6, samples=samples)
        problem, rng = ShiftedSphere(), Streams(3, [0])
        x = problem.lower + (problem.upper - problem.lower) * rng.uniform(20, 4)
        state, used = optimizer.init(problem, x, rng), [20]
        while not isinstance(state, CmaState) or state.status[0] == Status.RUNNING:
            state = optimizer.step(problem, state, rng)
            used.append(state.used)
            if isinstance(state, CmaState) and state.generation == 1:
                assert used[-2] + expected > 500
                assert used[-2] <= 500
                assert state.x.shape == (1, expected, 4)
        assert 1000 - expected < used[-1] <= 1000


def _phase_two(D=4, samples=8, **changes):
    x = Streams(1, [0]).normal(20, D)
    problem = ShiftedSphere(D)
    return problem, dataclasses.replace(_cma_start(x, problem.cost(x), samples, 0), **changes)


def test_many_samples_damp_more():
    """[hansen2016] table 1: d_sigma with mu_eff above D + 2, where its square root counts."""
    constants = _Constants.of(40, 2)
    mu = constants.mu_eff
    assert mu > 4
    expected = 1 + 2 * (np.sqrt((mu - 1) / 3) - 1) + (mu + 2) / (2 + mu + 5)
    assert constants.d_sigma == pytest.approx(expected, rel=1e-12)


def test_the_step_grows_where_the_best_samples_cost_the_same():
    constants = _Constants.of(8, 4)
    usual = np.exp(constants.c_sigma / constants.d_sigma * (3.0 / constants.chi - 1))
    grown = usual * np.exp(0.2 + constants.c_sigma / constants.d_sigma)
    for ranked, factor in (
        ([1.0] * 8, grown),
        ([1.0, 1, 1, 1, 1, 1, 2, 3], grown),  # 70 % of eight are six
        ([1.0, 1, 1, 1, 1, 2, 2, 3], usual),
        ([0.5, 1, 1, 1, 1, 1, 2, 3], usual),
    ):
        sigma = _step_size(ShiftedSphere(), np.array([0.1]), np.array([3.0]), np.array([ranked]), constants)
        assert sigma[0] == pytest.approx(0.1 * factor, rel=1e-12)


def test_phase_two_ends_when_the_longest_axis_underflows():
    problem, state = _phase_two()
    tiny = dataclasses.replace(
        state, sigma=np.array([1e-200]), lengths=np.full((1, 4), 1e-150), C=state.C * 1e-300
    )
    assert _cma_step(problem, tiny, Streams(3, [0]), 10_000).status.tolist() == [Status.CONVERGED]
    short = dataclasses.replace(state, sigma=np.array([1e-200]))
    assert _cma_step(problem, short, Streams(3, [0]), 10_000).status.tolist() == [Status.RUNNING]
