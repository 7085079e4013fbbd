"""DE-PSO against the numbers of its paper, seen through the points it evaluates."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from known_problems import ShiftedSphere, Watched

from accelcal_cli.optimization.algorithms.de_pso import HybridSwarm
from accelcal_cli.rng import Streams


class Flat(ShiftedSphere):
    """A box of [-1, 1]^3 whose cost says nothing, so that positions alone are seen."""

    def __init__(self):
        self.lower, self.upper = -np.ones(3), np.ones(3)

    def cost(self, x):
        return np.zeros(x.shape[:2])


def _state(optimizer, problem, iteration, **changes):
    rng = Streams(1, [0])
    x = problem.lower + (problem.upper - problem.lower) * rng.uniform(
        optimizer.population, problem.dimensions
    )
    state = optimizer.init(problem, x, rng)
    return dataclasses.replace(state, iteration=iteration, **changes), rng


def inertia(iteration, **settings):
    """The factor on the old velocity, seen where nothing else pulls: own best, common best and position agree."""
    optimizer, problem = HybridSwarm(population=20, speed=100.0, **settings), Watched(Flat())
    at_rest = np.full((1, 20, 3), 0.1)
    old = np.full((1, 10, 3), 0.01)
    state, rng = _state(optimizer, problem, iteration)
    state = dataclasses.replace(
        state,
        x=at_rest,
        velocity=old,
        memory=at_rest,
        leader=np.full((1, 3), 0.1),
    )
    problem.seen.points.clear()
    optimizer.step(problem, state, rng)
    factors = (problem.seen.all()[:10] - 0.1) / 0.01
    np.testing.assert_allclose(factors, factors[0, 0], rtol=1e-10)
    return factors[0, 0]


def own_share(iteration, **settings):
    """The share of the own position in a mutant, seen where all individuals agree and every gene is taken."""
    optimizer, problem = HybridSwarm(population=20, crossover=0.0, **settings), Watched(Flat())
    state, rng = _state(optimizer, problem, iteration)
    memory = np.full((1, 20, 3), 0.5)
    state = dataclasses.replace(state, memory=memory, leader=np.full((1, 3), -0.5))
    problem.seen.points.clear()
    optimizer.step(problem, state, rng)
    shares = problem.seen.all()[10:] + 0.5
    np.testing.assert_allclose(shares, shares[0, 0], rtol=1e-12)
    return shares[0, 0]


@pytest.mark.parametrize(("iteration", "value"), [(0, 1.3613), (250, 0.2574), (500, 0.2001)])
def test_the_inertia_falls_along_the_s_curve(iteration, value):
    assert inertia(iteration, iterations=500) == pytest.approx(value, abs=5e-5)


@pytest.mark.parametrize(("iteration", "value"), [(0, 0.9710), (500, 0.1001)])
def test_the_own_share_falls_along_the_s_curve(iteration, value):
    assert own_share(iteration, iterations=500) == pytest.approx(value, abs=5e-5)


def test_the_swarm_explodes_for_the_first_fifth():
    """Inertia below 1 from iteration 106 of 500 on, below the constriction's 0.7298 from 143 on."""
    assert inertia(105) > 1.0 > inertia(106)
    assert inertia(142) > 0.7298 > inertia(143)


def test_the_curve_stretches_with_the_iterations():
    assert inertia(1000, iterations=2000) == pytest.approx(inertia(250, iterations=500), rel=1e-9)


def test_the_halves_start_in_different_halves_of_the_box():
    optimizer, problem = HybridSwarm(population=40), Watched(Flat())
    state, _ = _state(optimizer, problem, 0)
    assert (state.x[:, :20, 0] <= 0).all()
    assert (state.x[:, 20:, 0] >= 0).all()
    assert (np.abs(state.x) <= 1).all()
    assert not state.velocity.any()
    assert state.x[0, :, 1].min() < -0.5
    assert state.x[0, :, 1].max() > 0.5


def test_the_better_half_leads_both():
    """The common best is the best point that either half has seen, after every step."""
    optimizer, problem = HybridSwarm(population=20), Watched(ShiftedSphere())
    state, rng = _state(optimizer, problem, 0)
    led_by_evolution = 0
    for _ in range(30):
        state = optimizer.step(problem, state, rng)
        seen = problem.seen.all()[None]
        cost = problem.problem.cost(seen)
        best = seen[0, cost.argmin()]
        np.testing.assert_array_equal(state.leader[0], best)
        led_by_evolution += (state.x[0, 10:] == best).all(axis=1).any()
    assert 0 < led_by_evolution < 30


def test_the_evolving_half_never_gets_worse_and_the_swarm_moves_on():
    optimizer, problem = HybridSwarm(population=20), ShiftedSphere()
    state, rng = _state(optimizer, problem, 0)
    swarm_got_worse = False
    for _ in range(30):
        after = optimizer.step(problem, state, rng)
        assert (after.memory_cost <= state.memory_cost).all()
        np.testing.assert_allclose(after.fx, problem.cost(after.x), rtol=1e-12)
        np.testing.assert_allclose(after.memory_cost, problem.cost(after.memory), rtol=1e-12)
        swarm_got_worse |= (after.fx[:, :10] > state.fx[:, :10]).any()
        state = after
    assert swarm_got_worse


def test_the_velocity_keeps_its_limit():
    optimizer, problem = HybridSwarm(population=20, speed=0.05), ShiftedSphere()
    state, rng = _state(optimizer, problem, 0)
    limit = 0.05 * 0.5 * (problem.upper - problem.lower)
    reached = False
    for _ in range(20):
        after = optimizer.step(problem, state, rng)
        move = np.abs(after.x - state.x)[:, :10]
        assert (move <= limit * (1 + 1e-12)).all()
        reached |= (np.abs(after.velocity) == limit).any()
        state = after
    assert reached


def test_an_odd_population_has_its_odd_point_in_the_evolving_half():
    optimizer, problem = HybridSwarm(population=21, iterations=5), Watched(Flat())
    state, rng = _state(optimizer, problem, 0)
    after = optimizer.step(problem, state, rng)
    assert after.velocity.shape == (1, 10, 3)
    assert after.x.shape == (1, 21, 3)
