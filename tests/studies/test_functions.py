"""The test functions against their literature: minima, known values, squares, shift and rotation."""

from __future__ import annotations

import numpy as np
import pytest

from accelcal_cli.errors import ConfigError
from accelcal_cli.studies.functions import FUNCTIONS, PAPER, TestFunction, rotations, select

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


def test_a_shift_moves_the_box_of_the_starting_points():
    """As far as the optimum, which stays where it was in it; what would leave the box ends at its wall."""
    plain = TestFunction("modified-rosenbrock", D)
    moved = TestFunction("modified-rosenbrock", D, shift=True, seed=3)
    offset = moved.optimum - plain.optimum
    assert (np.abs(offset) > 1).any()
    for own, other, wall in zip(moved.start, plain.start, ("upper", "lower"), strict=True):
        np.testing.assert_allclose(own, np.clip(other + offset, moved.lower, moved.upper), rtol=1e-12)
        assert (own != getattr(moved, wall)).all()


def test_rotations_are_uniform_over_all_rotations():
    """Orthogonal, determinant 1; images of the axes uniform on the sphere: moments 1 / D and 3 / (D (D + 2))."""
    Q = rotations(np.random.default_rng(1).standard_normal((20_000, 3, 3)))
    np.testing.assert_allclose(Q @ Q.swapaxes(1, 2), np.broadcast_to(np.eye(3), Q.shape), atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(Q), 1.0, rtol=1e-12)
    for column in range(3):
        for row in range(3):
            entry = Q[:, row, column]
            assert abs(entry.mean()) < 0.02
            assert (entry**2).mean() == pytest.approx(1 / 3, abs=0.01)
            assert (entry**4).mean() == pytest.approx(1 / 5, abs=0.01)
    trace = np.einsum("kii->k", Q)  # the angle of a Haar rotation in 3-D: E tr = 0, E tr^2 = 1
    assert (trace.mean(), (trace**2).mean()) == pytest.approx((0.0, 1.0), abs=0.03)


@pytest.mark.parametrize("name", ["griewank", "modified-rosenbrock", "zakharov"])
def test_runs_have_instances_of_their_own(name):
    many = TestFunction(name, D, shift=True, rotate=True, seed=4, instances=[3, 1, 2])
    x = np.random.default_rng(0).uniform(many.lower, many.upper, (3, 7, D))
    for row, instance in enumerate([3, 1, 2]):
        one = TestFunction(name, D, shift=True, rotate=True, seed=4, instances=[instance])
        part = many.take(np.array([row]))
        np.testing.assert_array_equal(one.optimum, many.optimum[row, 0])
        np.testing.assert_allclose(many.cost(x)[row], one.cost(x[row : row + 1])[0], rtol=1e-12)
        np.testing.assert_allclose(part.cost(x[row : row + 1]), one.cost(x[row : row + 1]), rtol=1e-12)
        if many.has_residuals:
            np.testing.assert_allclose(many.jacobian(x)[row], one.jacobian(x[row : row + 1])[0], rtol=1e-9)
        if many.start is not None:
            np.testing.assert_array_equal(part.start[0][0, 0], one.start[0])
    assert len({float(value) for value in many.cost(0 * x)[:, 0]}) == 3


def test_functions_are_chosen_by_name():
    assert select([]) == PAPER
    everyone = tuple(name for name in FUNCTIONS if name != "modified-rosenbrock")
    assert select(["sphere", "all"]) == everyone  # Rosenbrock's counts once
    assert set(select(["all", "modified-rosenbrock"])) == set(FUNCTIONS)
    assert select(["levy", "sphere"]) == ("levy", "sphere")
    with pytest.raises(ConfigError, match='did you mean "griewank"'):
        select(["griewangk"])
