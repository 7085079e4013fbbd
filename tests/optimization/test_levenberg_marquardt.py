"""Levenberg-Marquardt against scipy's least squares, at walls, in valleys and in batches."""

from __future__ import annotations

import numpy as np
import pytest
from known_problems import Decay, Watched
from scipy.optimize import least_squares
from simulated import DPSO, MEMS, dpso_box, loetters, noise

from accelcal_cli.calibration.problem import Box, Loetters, compress_each, pack
from accelcal_cli.optimization.algorithms.levenberg_marquardt import LevenbergMarquardt
from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.sensor import poses

G = 9.8


def _scipy(problem, start, walls=True):
    """scipy's answer on the same residuals; its own finite differences, so that our Jacobian is not trusted.

    With walls its trust-region solver, without them MINPACK, which is at home in a valley.
    """

    def residuals(u):
        # MINPACK wants as many residuals as unknowns, and the compressed ones are 11.
        return np.append(problem.residuals(u[None, None])[0, 0], 0.0)

    return least_squares(
        residuals,
        start,
        jac="3-point",
        bounds=(problem.lower, problem.upper) if walls else (-np.inf, np.inf),
        method="trf" if walls else "lm",
        xtol=1e-15,
        ftol=1e-15,
        gtol=1e-15,
        max_nfev=1000,
    )


def _ours(problem, start):
    return minimize(problem, LevenbergMarquardt(), runs=len(start), start=start[:, None, :])


def _starts(problem, count=4, part=0.8):
    u = np.random.Generator(np.random.SFC64(3)).uniform(-part, part, (count, problem.dimensions))
    return 0.5 * (problem.lower + problem.upper) + 0.5 * u * (problem.upper - problem.lower)


def _noisy(unknowns):
    output = DPSO.output(G * poses.turns() + noise(24, 2e-3, 5))
    return loetters(output, G, dpso_box(unknowns))


def test_a_noisy_fit_agrees_with_scipy():
    problem = Decay(noise=0.05)
    starts = _starts(problem)
    run = _ours(problem, starts)
    for i, start in enumerate(starts):
        reference = _scipy(problem, start)
        assert run.cost[i] == pytest.approx(2.0 * reference.cost, rel=1e-10)
        np.testing.assert_allclose(run.x[i], reference.x, atol=1e-6)
    assert set(run.status) == {Status.CONVERGED}


def test_nine_unknowns_agree_with_scipy():
    problem = _noisy(9)
    starts = _starts(problem)
    run = _ours(problem, starts)
    for i, start in enumerate(starts):
        reference = _scipy(problem, start)
        assert run.cost[i] == pytest.approx(2.0 * reference.cost, rel=1e-8)
        np.testing.assert_allclose(run.x[i], reference.x, atol=2e-5)


def test_twelve_unknowns_agree_with_scipy_in_what_is_observable():
    """J^T J has three zero singular values; cost, K K^T and D do not depend on the place in the valley."""
    problem = _noisy(12)
    starts = _starts(problem, part=0.5)
    run = _ours(problem, starts)
    assert set(run.status) == {Status.CONVERGED}
    assert (np.abs(run.x) < 1).all()
    least = _ours(_noisy(9), _starts(_noisy(9), 1)).cost[0]
    for i, start in enumerate(starts):
        reference = _scipy(problem, start, walls=False)
        assert run.cost[i] == pytest.approx(2.0 * reference.cost, rel=1e-7)
        assert run.cost[i] == pytest.approx(least, rel=1e-9)
        K, D = problem.parameters(np.stack([run.x[i], reference.x]))
        products = K @ K.swapaxes(1, 2)
        np.testing.assert_allclose(products[0], products[1], atol=1e-8 * 5.6e5**2)
        np.testing.assert_allclose(D[0], D[1], atol=1e-8 * 5.6e5 * G)


def test_different_starts_end_in_different_points_of_the_valley():
    run = _ours(_noisy(12), _starts(_noisy(12), part=0.5))
    assert np.ptp(run.x[:, 6:9], axis=0).max() > 0.01
    assert run.cost.max() == pytest.approx(run.cost.min(), rel=1e-9)


@pytest.mark.parametrize("cut", [0, 4, 7])
def test_a_minimum_beyond_the_wall_is_found_on_the_wall(cut):
    """The box ends short of the unconstrained minimum along one coordinate; scipy's bounded solver is the judge."""
    whole = _noisy(9)
    free = _ours(whole, np.zeros((1, 9))).x[0]
    centre, half = whole.box.centre.copy(), whole.box.half.copy()
    side = -np.sign(free[cut])
    centre[0, cut] += half[0, cut] * (free[cut] + side * 1.3)
    problem = Loetters(whole.triangle, G, Box(centre, half))
    start = np.zeros((1, 9))
    run = _ours(problem, start)
    reference = _scipy(problem, start[0])
    assert abs(run.x[0, cut]) == 1.0
    assert abs(reference.x[cut]) > 0.999
    assert run.cost[0] <= 2.0 * reference.cost * (1 + 1e-7)
    np.testing.assert_allclose(run.x[0], reference.x, atol=1e-3)
    assert run.cost[0] > 1.2 * _ours(whole, start).cost[0]


def test_a_start_on_the_wall_is_left_again():
    problem = Decay()
    run = _ours(problem, np.stack([problem.upper, problem.lower]))
    np.testing.assert_allclose(run.x, np.broadcast_to(problem.solution, (2, 3)), atol=1e-6)


def test_sensors_of_a_batch_are_solved_as_if_alone():
    """Different sensors in one batch: each ends exactly where it ends by itself."""
    forces = G * poses.faces_edges()
    outputs = np.stack([model.output(forces + noise(12, 1e-3, 7)) for model in (MEMS, MEMS, MEMS)])
    outputs[1] *= 1.05
    outputs[2] += 0.1
    centre = pack(np.eye(3), np.zeros(3), 9)[None].repeat(3, axis=0)
    half = np.full((3, 9), 0.3)
    half[:, 6:] = 1.0
    triangle = compress_each(outputs)
    batch = _ours(Loetters(triangle, G, Box(centre, half)), np.zeros((3, 9)))
    for i in range(3):
        one = Loetters(triangle.take(np.array([i])), G, Box(centre[i : i + 1], half[i : i + 1]))
        alone = _ours(one, np.zeros((1, 9)))
        np.testing.assert_allclose(batch.x[i], alone.x[0], atol=1e-10)
    assert batch.cost[0] != batch.cost[1]
    assert np.abs(batch.x[0] - batch.x[1]).max() > 0.01


def test_a_population_of_starts_reports_its_best():
    problem = Watched(Decay())
    run = minimize(problem, LevenbergMarquardt(population=5), runs=2, seed=1)
    np.testing.assert_allclose(run.x, np.broadcast_to(Decay().solution, (2, 3)), atol=1e-6)
    assert problem.seen.evaluations == run.evaluations.sum()


def test_it_stops_when_nothing_is_left_to_gain():
    """On readings without information about some coordinates it still stops, cleanly and early."""
    output = DPSO.output(G * poses.faces())
    problem = loetters(output, G, dpso_box(12))
    run = _ours(problem, _starts(problem, 3, 0.3))
    assert (run.iterations < 100).all()
    assert (run.cost < 1e-15).all()


class Flat(Decay):
    """Decay samples whose residuals do not change with anything where c is negative."""

    def residuals(self, x):
        return np.where(x[..., 2:] < 0, 1.0, super().residuals(x))

    def jacobian(self, x):
        return np.where(x[..., 2:, None] < 0, 0.0, super().jacobian(x))


def test_a_run_without_a_slope_fails_alone():
    starts = np.array([[2.0, 1.0, 0.5], [2.0, 1.0, -0.5], [3.0, 1.0, 0.5]])
    problem = Flat()
    problem.lower, problem.y = np.array([0.5, 0.2, -1.0]), problem.y + 0.8  # the minimum is at c = 0.5
    run = _ours(problem, starts)
    assert run.status == (Status.CONVERGED, Status.FAILED, Status.CONVERGED)
    np.testing.assert_array_equal(run.x[1], starts[1])
    assert run.cost[1] == 20.0
    alone = _ours(problem, starts[[2]])
    np.testing.assert_array_equal(run.x[2], alone.x[0])


def test_a_start_without_a_slope_does_not_end_the_others_of_its_run():
    starts = np.array([[[2.0, 1.0, -0.5], [2.0, 1.0, 0.8]]])
    problem = Flat()
    problem.lower, problem.y = np.array([0.5, 0.2, -1.0]), problem.y + 0.8
    run = minimize(problem, LevenbergMarquardt(population=2), runs=1, start=starts)
    alone = _ours(problem, starts[:, 1])
    assert run.status == alone.status == (Status.CONVERGED,)
    np.testing.assert_allclose(run.x, alone.x, atol=1e-6)
