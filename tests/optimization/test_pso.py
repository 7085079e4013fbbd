"""The swarm against its equations, written as a literal loop."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from known_problems import ShiftedSphere, Watched

from accelcal_cli.optimization.algorithms.pso import ParticleSwarm, velocity
from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.operators import better_of
from accelcal_cli.rng import Streams


@given(st.integers(0, 10**6), st.floats(0, 2), st.floats(0, 4), st.floats(0, 4))
def test_velocity_is_equation_1(seed, w, c1, c2):
    """c1 goes with the common best; a random number for every particle and every dimension."""
    runs, population, dimensions = 2, 5, 3
    rng = Streams(seed, range(runs))
    x, v, memory = (rng.normal(population, dimensions) for _ in range(3))
    leader = rng.normal(1, dimensions)[:, 0]
    r1, r2 = rng.uniform(population, dimensions), rng.uniform(population, dimensions)
    arguments = (x, v, memory, leader, r1, r2)
    before = [a.copy() for a in arguments]
    got = velocity(*arguments, w, c1, c2)
    for run in range(runs):
        for i in range(population):
            for d in range(dimensions):
                expected = (
                    w * v[run, i, d]
                    + c1 * r1[run, i, d] * (leader[run, d] - x[run, i, d])
                    + c2 * r2[run, i, d] * (memory[run, i, d] - x[run, i, d])
                )
                assert got[run, i, d] == pytest.approx(expected, rel=1e-12, abs=1e-12)
    for old, new in zip(before, arguments, strict=True):
        np.testing.assert_array_equal(old, new)


def test_better_of_keeps_the_better():
    x = np.array([[[1.0], [2.0], [3.0]]])
    memory = np.array([[[10.0], [20.0], [30.0]]])
    kept, cost = better_of(memory, np.array([[5.0, 5.0, 5.0]]), x, np.array([[4.0, 5.0, np.inf]]))
    assert kept[0, :, 0].tolist() == [1.0, 20.0, 30.0]
    assert cost.tolist() == [[4.0, 5.0, 5.0]]


def _steps(count, **settings):
    optimizer, problem = ParticleSwarm(population=10, **settings), Watched(ShiftedSphere())
    rng = Streams(2, [0])
    x = problem.lower + (problem.upper - problem.lower) * rng.uniform(10, 4)
    states = [optimizer.init(problem, x, rng)]
    for _ in range(count):
        states.append(optimizer.step(problem, states[-1], rng))
    return problem, states


def test_the_swarm_moves_by_its_velocity_and_remembers():
    problem, states = _steps(25)
    assert not states[0].velocity.any()
    for before, after in itertools.pairwise(states):
        moved = np.clip(before.x + after.velocity, problem.lower, problem.upper)
        np.testing.assert_array_equal(after.x, moved)
        np.testing.assert_allclose(after.fx, problem.problem.cost(after.x), rtol=1e-12)
        np.testing.assert_array_equal(after.memory_cost, np.minimum(before.memory_cost, after.fx))
        column = int(after.memory_cost[0].argmin())
        np.testing.assert_array_equal(after.leader[0], after.memory[0, column])
    assert states[-1].memory_cost.min() < 0.1 * states[0].memory_cost.min()


def test_the_velocity_keeps_its_limit_and_needs_it():
    _, states = _steps(15, speed=0.05)
    limit = 0.05 * 0.5 * (ShiftedSphere().upper - ShiftedSphere().lower)
    speeds = np.abs(np.concatenate([state.velocity for state in states]))
    assert (speeds <= limit).all()
    assert (speeds == limit).any()


def test_velocity_is_not_zeroed_at_the_wall():
    """The swarm of an early step lives on its limits: a particle on a wall still carries its speed."""
    optimizer, problem = ParticleSwarm(population=4, inertia=1.0, social=0.0, cognitive=0.0), ShiftedSphere()
    rng = Streams(0, [0])
    x = np.broadcast_to(problem.upper, (1, 4, 4)).copy()
    state = optimizer.init(problem, x, rng)
    state = dataclasses.replace(state, velocity=np.full((1, 4, 4), 0.1))
    after = optimizer.step(problem, state, rng)
    np.testing.assert_array_equal(after.x, x)
    np.testing.assert_array_equal(after.velocity, state.velocity)


def test_the_printed_weights_stall_and_the_constriction_converges():
    """c1 = c2 = 2 with w = 0.7298 is beyond the order-2 stability bound of 3.35."""
    printed = ParticleSwarm(population=30, iterations=150, social=2.0, cognitive=2.0)
    constricted = ParticleSwarm(population=30, iterations=150)
    assert constricted.social + constricted.cognitive < 24 * (1 - 0.7298**2) / (7 - 5 * 0.7298)
    stalled = minimize(ShiftedSphere(), printed, runs=4, seed=1).cost
    converged = minimize(ShiftedSphere(), constricted, runs=4, seed=1).cost
    assert np.median(converged) < 1e-4 * np.median(stalled)
