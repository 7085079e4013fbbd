"""The test functions against their literature: minima, known values, squares, shift and rotation."""

from __future__ import annotations

import numpy as np
import pytest

from accelcal_cli.errors import ConfigError
from accelcal_cli.studies.functions import FUNCTIONS, PAPER, TestFunction, select

D = 5
VARIANTS = [{}, {"shift": True}, {"rotate": True}, {"shift": True, "rotate": True}]
SQUARES = [name for name, definition in FUNCTIONS.items() if definition.residuals]


def at(problem, point):
    return float(problem.cost(np.asarray(point, dtype=float)[None, None, :])[0, 0])


def sample(problem, count, seed=1):
    rng = np.random.default_rng(seed)
    return rng.uniform(problem.lower, problem.upper, (2, count, problem.dimensions))


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_minimum_is_zero_at_the_optimum_and_nowhere_less(name, variant):
    problem = TestFunction(name, D, **variant)
    assert at(problem, problem.optimum) == pytest.approx(0.0, abs=1e-9)
    assert (problem.lower < problem.optimum).all()
    assert (problem.optimum < problem.upper).all()
    x = sample(problem, 2000)
    assert problem.cost(x).shape == (2, 2000)
    assert problem.cost(x).min() > 0
    near = problem.optimum + 1e-3 * np.eye(D)
    assert problem.cost(near[None]).min() > at(problem, problem.optimum)


@pytest.mark.parametrize(
    ("name", "point", "value"),
    [
        ("sphere", [1, 2, 3], 14),
        ("rosenbrock", [0, 0, 0], 2),
        ("rosenbrock", [2, 1, 3], 100 * 9 + 1 + 100 * 4),
        ("modified-rosenbrock", [0, 0, 0], 2),
        ("modified-rosenbrock", [-2, -1, -3], 100 * 9 + 1 + 100 * 4),
        ("rastrigin", [1, 2], 5),
        ("rastrigin", [0.5, 0], 0.25 + 20),
        ("griewank", [np.pi, 0], np.pi**2 / 4000 + 2),
        ("ackley", [1, 1], 20 - 20 * np.exp(-0.2)),
        ("schwefel", [0, 0], 2 * 418.9828872724339),
        ("levy", [5, 1], 1 + 10 * np.sin(1) ** 2),
        ("zakharov", [2, 0], 4 + 1 + 1),
        ("elliptic", [1, 1, 1], 1 + 1e3 + 1e6),
        ("styblinski-tang", [0, 0], 2 * 39.16616570377142),
    ],
)
def test_values_computed_by_hand(name, point, value):
    assert at(TestFunction(name, len(point)), point) == pytest.approx(value, rel=1e-12)


def test_a_shift_moves_every_coordinate_and_the_seed_says_where():
    here, same, other = (TestFunction("sphere", D, shift=True, seed=seed) for seed in (3, 3, 4))
    assert (np.abs(here.optimum) > 0.1).all()
    assert (here.optimum == same.optimum).all()
    assert (here.optimum != other.optimum).all()


def test_a_shift_translates_the_function():
    plain, moved = TestFunction("griewank", D), TestFunction("griewank", D, shift=True, seed=2)
    x = sample(plain, 50) / 10
    assert moved.cost(x + moved.optimum) == pytest.approx(plain.cost(x), rel=1e-12)


def test_a_rotation_keeps_the_sphere_and_changes_what_has_axes():
    x = sample(TestFunction("sphere", D), 50)
    turned = TestFunction("sphere", D, rotate=True).cost(x)
    assert turned == pytest.approx(TestFunction("sphere", D).cost(x), rel=1e-12)
    elliptic = TestFunction("elliptic", D, rotate=True).cost(x)
    assert not np.allclose(elliptic, TestFunction("elliptic", D).cost(x), rtol=0.1)


@pytest.mark.parametrize("name", SQUARES)
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_squares_sum_to_the_function_and_the_jacobian_is_their_derivative(name, variant):
    problem = TestFunction(name, D, **variant)
    x = sample(problem, 3) * 0.3
    r, J = problem.residuals(x), problem.jacobian(x)
    assert (r**2).sum(axis=-1) == pytest.approx(problem.cost(x), rel=1e-9)
    assert J.shape == (*r.shape, D)
    h = 1e-5
    for i in range(D):
        step = h * np.eye(D)[i]
        slope = (problem.residuals(x + step) - problem.residuals(x - step)) / (2 * h)
        np.testing.assert_allclose(J[..., i], slope, rtol=1e-5, atol=1e-4 * np.abs(J).max())


def test_only_sums_of_squares_have_residuals():
    assert {"sphere", "rosenbrock", "modified-rosenbrock", "zakharov"} <= set(SQUARES)
    problem = TestFunction("ackley", D)
    assert not problem.has_residuals
    with pytest.raises(NotImplementedError, match="not a sum of squares"):
        problem.residuals(np.zeros((1, 1, D)))


def test_the_modified_rosenbrock_starts_from_its_own_box():
    low, high = TestFunction("modified-rosenbrock", D).start
    assert (low == -1).all()
    assert (high == 1).all()


def test_functions_are_chosen_by_name():
    assert select([]) == PAPER
    assert select(["sphere", "all"]) == tuple(FUNCTIONS)
    assert select(["levy", "sphere"]) == ("levy", "sphere")
    with pytest.raises(ConfigError, match='did you mean "griewank"'):
        select(["griewangk"])
