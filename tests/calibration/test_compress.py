"""Compressed readings cost what the readings themselves cost."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, direct_cost, dpso_box, loetters, noise

from accelcal_cli.calibration.problem import Loetters, Triangle, compress, compress_each, quadric_rows
from accelcal_cli.rng import Streams

G = 9.8


def _readings(count, seed, sigma=0.05):
    u = Streams(seed, [0], purpose=5).normal(count, 3)[0]
    u /= np.linalg.norm(u, axis=1)[:, None]
    return DPSO.output(G * u + noise(count, sigma, seed))


def _middle(output):
    low, high = output.min(axis=0), output.max(axis=0)
    return 0.5 * (low + high)[None], np.array([0.5 * (high - low).max()])


def _compressed(output, weights, chunk):
    centre, scale = _middle(output)
    blocks = (
        (output[None, i : i + chunk], None if weights is None else weights[None, i : i + chunk])
        for i in range(0, len(output), chunk)
    )
    return compress(blocks, centre, scale, np.array([len(output)]))


def _agrees(triangle, output, weights, seed, tolerance=1e-11):
    problem = Loetters(triangle, G, dpso_box(9))
    u = Streams(seed, [0], purpose=6).uniform(6, 9) * 2 - 1
    got = problem.cost(u)[0]
    for i in range(6):
        K, D = problem.parameters(u[:, i])
        assert got[i] == pytest.approx(direct_cost(K[0], D[0], output, G, weights), rel=tolerance)


@given(
    st.sampled_from([2, 3, 9, 10, 11, 12, 24, 100, 511, 512, 513, 1024, 1500, 2048, 5000]),
    st.integers(1, 3000),
    st.integers(0, 10**6),
    st.booleans(),
)
def test_any_chunks_cost_the_direct_sum(count, chunk, seed, weighted):
    output = _readings(count, seed)
    weights = Streams(seed, [0], purpose=7).uniform(count, 1)[0, :, 0] * 5 if weighted else None
    triangle = _compressed(output, weights, max(chunk, count // 20))
    assert triangle.poses == count
    assert triangle.R.shape == (1, 11, 11)
    _agrees(triangle, output, weights, seed)


@given(st.integers(2, 40), st.integers(1, 4), st.integers(0, 10**6), st.booleans())
def test_sensors_in_a_batch_cost_the_direct_sum(count, sensors, seed, weighted):
    outputs = np.stack([_readings(count, seed + i) for i in range(sensors)])
    weights = Streams(seed, [0], purpose=8).uniform(sensors, count)[0] * 3 if weighted else None
    triangle = compress_each(outputs, weights)
    assert triangle.R.shape == (sensors, 11, 11)
    for i in range(sensors):
        one = triangle.take(np.array([i]))
        _agrees(one, outputs[i], None if weights is None else weights[i], seed)


def test_a_weight_of_zero_removes_a_reading_and_one_of_two_doubles_it():
    output = _readings(20, 1)
    weights = np.ones(20)
    weights[3], weights[5] = 0.0, 2.0
    others = np.concatenate([np.delete(output, 3, axis=0), output[5:6]])
    problem = loetters(output, G, dpso_box(9), weights)
    plain = loetters(others, G, dpso_box(9))
    u = Streams(2, [0]).uniform(4, 9) * 2 - 1
    np.testing.assert_allclose(problem.cost(u), plain.cost(u), rtol=1e-11)


def test_the_floor_at_the_truth_is_rounding():
    """Noise-free readings cost next to nothing at the truth: centring and scaling keep the digits."""
    output = DPSO.in_gauge("lower").output(G * _directions(4000))
    problem = Loetters(_compressed(output, None, 700), G, dpso_box(9))
    truth = DPSO.in_gauge("lower")
    u = problem.coordinates(truth.K[None], truth.D[None])
    assert problem.cost(u[:, None])[0, 0] < 1e-26 * 4000 * G**4


def _directions(count):
    u = Streams(9, [0]).normal(count, 3)[0]
    return u / np.linalg.norm(u, axis=1)[:, None]


def test_a_large_offset_costs_no_digits():
    """Raw counts around 33000 with a scale of 400: the bias is eight times gravity."""
    K, D = np.diag([414.0, 412.0, 415.0]), np.array([33123.0, 33275.0, 32364.0])
    output = (G * _directions(50)) @ K.T + D
    triangle = _compressed(output, None, 50)
    box = dpso_box(9)
    centre = np.array([*np.diagonal(K), 0, 0, 0, *D])[None]
    problem = Loetters(triangle, G, type(box)(centre, np.full((1, 9), 1.0)))
    assert problem.cost(np.zeros((1, 1, 9)))[0, 0] < 1e-20


@given(st.integers(0, 10**6))
def test_rows_are_linear_in_the_quadratic_form(seed):
    """phi(x) q is h^T Q h with h = (x, 1), for any symmetric Q."""
    rng = Streams(seed, [0])
    x, q = rng.normal(5, 3)[0], rng.normal(4, 4)[0]
    q = q + q.T
    packed = np.array(
        [q[0, 0], q[1, 1], q[2, 2], q[0, 1], q[0, 2], q[1, 2], q[0, 3], q[1, 3], q[2, 3], q[3, 3]]
    )
    h = np.concatenate([x, np.ones((5, 1))], axis=1)
    np.testing.assert_allclose(
        quadric_rows(x)[:, :10] @ packed, np.einsum("ji,ik,jk->j", h, q, h), rtol=1e-12
    )
    assert (quadric_rows(x)[:, 10] == 1.0).all()


def test_taking_sensors():
    triangle = compress_each(np.stack([_readings(12, seed) for seed in range(4)]))
    part = triangle.take(np.array([2, 0]))
    assert isinstance(part, Triangle)
    np.testing.assert_array_equal(part.R, triangle.R[[2, 0]])
    np.testing.assert_array_equal(part.centre, triangle.centre[[2, 0]])
    np.testing.assert_array_equal(part.scale, triangle.scale[[2, 0]])
    assert part.poses.tolist() == [12] * len(part.scale)
