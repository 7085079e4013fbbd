"""The cost, its residuals and its Jacobian against the formula of the paper."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, direct_cost, dpso_box, loetters, noise, rotation

from accelcal_cli.calibration.problem import Box, Loetters, compress_each, pack, unpack
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import to_gauge

G = 9.8
OUTPUT = DPSO.output(G * poses.turns() + noise(24, 0.02, 3))


def _points(unknowns, count=7, runs=1):
    return Streams(4, range(runs)).uniform(count, unknowns) * 2 - 1


@pytest.mark.parametrize("unknowns", [9, 12])
def test_cost_is_the_papers_sum(unknowns):
    problem = loetters(OUTPUT, G, dpso_box(unknowns))
    u = _points(unknowns)
    got = problem.cost(u)
    assert got.shape == (1, 7)
    for i in range(7):
        K, D = problem.parameters(u[:, i])
        assert got[0, i] == pytest.approx(direct_cost(K[0], D[0], OUTPUT, G), rel=1e-11)


@pytest.mark.parametrize("unknowns", [9, 12])
def test_residuals_square_to_the_cost(unknowns):
    problem = loetters(OUTPUT, G, dpso_box(unknowns))
    u = _points(unknowns)
    r = problem.residuals(u)
    assert r.shape == (1, 7, 11)
    np.testing.assert_allclose((r**2).sum(axis=2), problem.cost(u), rtol=1e-12)


@pytest.mark.parametrize("unknowns", [9, 12])
def test_jacobian_is_the_derivative_of_the_residuals(unknowns):
    problem = loetters(OUTPUT, G, dpso_box(unknowns))
    u, h = _points(unknowns, 3), 1e-5
    jacobian = problem.jacobian(u)
    assert jacobian.shape == (1, 3, 11, unknowns)
    for i in range(unknowns):
        step = np.zeros(unknowns)
        step[i] = h
        numeric = (problem.residuals(u + step) - problem.residuals(u - step)) / (2 * h)
        np.testing.assert_allclose(jacobian[..., i], numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())


@pytest.mark.parametrize("unknowns", [9, 12])
def test_gradient_of_the_cost(unknowns):
    """J^T r against differences of the direct sum: a check that bypasses the compression."""
    problem = loetters(OUTPUT, G, dpso_box(unknowns))
    u, h = _points(unknowns, 1), 1e-5
    gradient = 2 * np.einsum("rpmd,rpm->rpd", problem.jacobian(u), problem.residuals(u))[0, 0]
    for i in range(unknowns):
        step = np.zeros(unknowns)
        step[i] = h
        costs = []
        for side in (step, -step):
            K, D = problem.parameters(u[0] + side)
            costs.append(direct_cost(K[0], D[0], OUTPUT, G))
        assert (costs[0] - costs[1]) / (2 * h) == pytest.approx(gradient[i], rel=1e-5, abs=1e-5)


@given(st.integers(0, 10**6))
def test_a_rotation_of_the_body_frame_changes_no_cost(seed):
    """K R^T with D unchanged costs the same, for every rotation R: three of twelve unknowns are free."""
    K, D = DPSO.K * (1 + 0.01 * Streams(seed, [0]).normal(3, 3)[0]), DPSO.D
    box = Box(np.zeros((1, 12)), np.ones((1, 12)))
    problem = loetters(OUTPUT, G, box)
    turned = K @ rotation(seed).T
    u = np.stack([problem.coordinates(k[None], D[None]) for k in (K, turned)], axis=1)
    costs = problem.cost(u)[0]
    assert costs[0] == pytest.approx(costs[1], rel=1e-9)
    assert costs[0] > 1e-3
    moved = problem.cost(problem.coordinates(turned[None], 1.001 * D[None])[:, None])[0, 0]
    assert moved != pytest.approx(costs[0], rel=1e-9)


@pytest.mark.parametrize("gauge", ["lower", "upper", "symmetric"])
def test_every_gauge_costs_the_same(gauge):
    problem = loetters(OUTPUT, G, Box(np.zeros((1, 12)), np.ones((1, 12))))
    here = problem.cost(problem.coordinates(DPSO.K[None], DPSO.D[None])[:, None])
    there = problem.cost(problem.coordinates(to_gauge(DPSO.K, gauge)[None], DPSO.D[None])[:, None])
    np.testing.assert_allclose(there, here, rtol=1e-8)


def test_nine_and_twelve_unknowns_agree_on_a_triangular_matrix():
    nine, twelve = loetters(OUTPUT, G, dpso_box(9)), loetters(OUTPUT, G, dpso_box(12))
    u = _points(9)
    K, D = unpack(nine.box.centre[:, None] + nine.box.half[:, None] * u)
    v = np.stack([twelve.coordinates(K[:, i], D[:, i]) for i in range(7)], axis=1)
    np.testing.assert_allclose(twelve.cost(v), nine.cost(u), rtol=1e-10)


def test_the_trivial_minimum_is_outside_the_box():
    """K_A = 0 with |f_0| = g costs nothing at all; no point of the box comes near it."""
    assert direct_cost(1e12 * np.eye(3), np.array([0, 0, G * 1e12]), OUTPUT, G) < 1e-6
    problem = loetters(OUTPUT, G, dpso_box(12))
    K, D = problem.parameters(_points(12, 500)[0])
    f_0 = np.linalg.solve(K, D[..., None])[..., 0]
    assert np.abs(f_0).max() < 0.02 * G
    assert np.linalg.norm(np.linalg.inv(K), axis=(1, 2)).min() > 0.9 * np.sqrt(3) / 5.67e5


@pytest.mark.parametrize("unknowns", [9, 12])
def test_parameters_and_coordinates_are_inverse(unknowns):
    problem = loetters(OUTPUT, G, dpso_box(unknowns))
    u = _points(unknowns, 1)[:, 0]
    K, D = problem.parameters(u)
    np.testing.assert_allclose(problem.coordinates(K, D), u, atol=1e-10)
    if unknowns == 9:
        assert (K[:, [0, 0, 1], [1, 2, 2]] == 0).all()


@given(st.integers(0, 10**6), st.sampled_from([9, 12]))
def test_packing_loses_nothing(seed, unknowns):
    theta = Streams(seed, [0]).normal(4, unknowns)
    K, D = unpack(theta)
    np.testing.assert_array_equal(pack(K, D, unknowns), theta)


def test_the_closed_form_in_coordinates_is_the_truth():
    problem = loetters(DPSO.output(G * poses.turns()), G, dpso_box(9))
    truth = DPSO.in_gauge("lower")
    expected = problem.coordinates(truth.K[None], truth.D[None])
    np.testing.assert_allclose(problem.closed_form(), expected, atol=1e-8)
    assert np.abs(expected).max() < 1


def test_sensors_of_a_batch_keep_to_themselves():
    outputs = np.stack([OUTPUT, 1.01 * OUTPUT, OUTPUT[::-1] + 500.0])
    box = Box(np.repeat(dpso_box(9).centre, 3, axis=0), np.repeat(dpso_box(9).half, 3, axis=0))
    problem, u = Loetters(compress_each(outputs), G, box), _points(9, 5, 3)
    whole = [problem.cost(u), problem.residuals(u), problem.jacobian(u), problem.closed_form()]
    for i in range(3):
        index = np.array([i])
        one, v = problem.take(index), u[index]
        alone = [one.cost(v), one.residuals(v), one.jacobian(v), one.closed_form()]
        for a, b in zip(whole, alone, strict=True):
            np.testing.assert_allclose(a[index], b, rtol=1e-12, atol=1e-12 * np.abs(b).max())
    assert whole[0][0, 0] != whole[0][1, 0]


def test_one_sensor_serves_every_run():
    problem = loetters(OUTPUT, G, dpso_box(9))
    u = _points(9, 5, 4)
    assert problem.cost(u).shape == (4, 5)
    assert problem.take(np.array([2, 3])) is problem
    np.testing.assert_allclose(problem.cost(u)[2], problem.cost(u[2:3])[0], rtol=1e-13)


def test_it_says_what_it_offers():
    problem = loetters(OUTPUT, G, dpso_box(9))
    assert problem.has_residuals
    assert problem.has_closed_form
    assert problem.dimensions == 9
    assert (problem.lower == -1).all()
    assert (problem.upper == 1).all()
    np.testing.assert_array_equal(problem.units, dpso_box(9).half)


def test_a_singular_matrix_is_the_fate_of_its_run_alone():
    """K with a zero on its diagonal, in a box that reaches so far."""
    box = dpso_box(9)
    wide = Box(box.centre, np.where(np.arange(9) == 0, box.centre, box.half))
    problem = loetters(OUTPUT, G, wide)
    u = np.zeros((1, 2, 9))
    u[0, 1, 0] = -1.0
    with np.errstate(all="ignore"):
        jacobian = problem.jacobian(u)
        gradient, hessian = problem.gradient_hessian(u)
    np.testing.assert_allclose(jacobian[:, :1], problem.jacobian(u[:, :1]), rtol=1e-15)
    for found in (jacobian, gradient, hessian):
        assert np.isfinite(found[0, 0]).all()
        assert not np.isfinite(found[0, 1]).all()
