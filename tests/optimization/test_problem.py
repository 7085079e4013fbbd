"""Counting evaluations and remembering the best point."""

from __future__ import annotations

import numpy as np
import pytest
from known_problems import Decay, ShiftedSphere

from accelcal_cli.optimization.problem import Counted, Problem


def _points(problem, runs, population, seed=0):
    u = np.random.Generator(np.random.SFC64(seed)).random((runs, population, problem.dimensions))
    return problem.lower + (problem.upper - problem.lower) * u


def test_every_point_counts_once():
    problem = Decay()
    counted = Counted(problem, 2)
    x = _points(problem, 2, 5)
    counted.cost(x)
    assert counted.evaluations.tolist() == [5, 5]
    counted.residuals(x[:, :3])
    assert counted.evaluations.tolist() == [8, 8]
    counted.jacobian(x[:, :1])
    assert counted.evaluations.tolist() == [9, 9]


def test_the_best_point_of_every_run_is_remembered():
    problem = ShiftedSphere()
    counted = Counted(problem, 3)
    points = [_points(problem, 3, 7, seed) for seed in range(4)]
    for x in points:
        counted.cost(x)
    every = np.concatenate(points, axis=1)
    cost = problem.cost(every)
    np.testing.assert_array_equal(counted.best_cost, cost.min(axis=1))
    np.testing.assert_array_equal(counted.best_x, every[np.arange(3), cost.argmin(axis=1)])


def test_residual_calls_are_remembered_as_costs():
    problem = Decay()
    counted = Counted(problem, 1)
    x = _points(problem, 1, 6)
    counted.residuals(x)
    np.testing.assert_allclose(counted.best_cost, problem.cost(x).min(axis=1), rtol=1e-14)


def test_nan_is_never_the_best():
    class Patchy(ShiftedSphere):
        def cost(self, x):
            fx = super().cost(x)
            return np.where(np.arange(fx.shape[1]) % 2 == 0, np.nan, fx)

    problem = Patchy()
    counted = Counted(problem, 2)
    x = _points(problem, 2, 6)
    fx = counted.cost(x)
    assert np.isinf(fx[:, ::2]).all()
    assert np.isfinite(fx[:, 1::2]).all()
    np.testing.assert_array_equal(counted.best_cost, fx.min(axis=1))
    nowhere = Counted(problem, 1)
    nowhere.cost(x[:1, :1])
    assert np.isinf(nowhere.best_cost[0])
    assert np.isnan(nowhere.best_x).all()


def test_infinite_costs_do_not_hide_a_nan():
    class Mixed(ShiftedSphere):
        def cost(self, x):
            return np.array([[np.inf, np.nan, -np.inf, 3.0]])

    fx = Counted(Mixed(), 1).cost(_points(Mixed(), 1, 4))
    assert not np.isnan(fx).any()


def test_taking_runs_keeps_their_counts_and_best_points():
    problem = ShiftedSphere()
    counted = Counted(problem, 4)
    counted.cost(_points(problem, 4, 5))
    part = counted.take(np.array([1, 3]))
    np.testing.assert_array_equal(part.best_cost, counted.best_cost[[1, 3]])
    part.cost(_points(problem, 2, 2, seed=9))
    assert part.evaluations.tolist() == [7, 7]
    assert counted.evaluations.tolist() == [5, 5, 5, 5]


def test_a_problem_offers_only_what_it_has():
    sphere = ShiftedSphere()
    assert sphere.dimensions == 4
    x = _points(sphere, 1, 1)
    for call in (lambda: sphere.residuals(x), lambda: sphere.jacobian(x), sphere.closed_form):
        with pytest.raises(NotImplementedError, match="shifted sphere"):
            call()
    assert sphere.take(np.array([0])) is sphere
    assert isinstance(sphere, Problem)


def test_a_wrapped_problem_shows_units_and_groups():
    class Scaled(ShiftedSphere):
        @property
        def units(self):
            return np.array([1.0, 2.0, 3.0, 4.0])

        @property
        def groups(self):
            return np.array([0, 0, 1, 1])

    assert Counted(Scaled(), 1).units.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert Counted(Scaled(), 1).groups.tolist() == [0, 0, 1, 1]
    assert ShiftedSphere().units.tolist() == [1.0] * 4
    assert ShiftedSphere().groups.tolist() == [0] * 4


@pytest.mark.parametrize("make", [ShiftedSphere, Decay])
def test_differences_of_the_cost(make):
    """Gradient and Hessian by central differences: exact ones of the sphere, J^T J and J^T r of residuals near it."""
    problem = make()
    x = np.broadcast_to(problem.solution, (2, 3, problem.dimensions)) + 1e-3 * np.arange(6).reshape(2, 3, 1)
    counted = Counted(problem, 2)
    gradient, hessian = counted.gradient_hessian(x)
    if make is ShiftedSphere:
        np.testing.assert_allclose(gradient, 2 * (x - problem.solution), atol=1e-6)
        np.testing.assert_allclose(hessian, np.broadcast_to(2 * np.eye(4), hessian.shape), atol=1e-5)
    else:
        J, r = problem.jacobian(x), problem.residuals(x)
        np.testing.assert_allclose(gradient, 2 * np.einsum("rpmd,rpm->rpd", J, r), atol=1e-5)
        np.testing.assert_allclose(hessian[0, 0], 2 * J[0, 0].T @ J[0, 0], rtol=1e-4)
    D = problem.dimensions
    assert counted.evaluations.tolist() == [3 * (1 + 2 * D + D * (D - 1))] * 2


def test_an_analytic_hessian_counts_once():
    class Known(ShiftedSphere):
        def gradient_hessian(self, x):
            return 2 * (x - self.solution), np.broadcast_to(2 * np.eye(4), (*x.shape, 4))

    counted = Counted(Known(), 1)
    counted.gradient_hessian(_points(Known(), 1, 5))
    assert counted.evaluations.tolist() == [5]
