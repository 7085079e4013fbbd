"""The error model, the gauges of its matrix, engineering units, and local gravity."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, direct_cost, noise, rotation

from accelcal_cli.errors import UsageError
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import model as units
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import GAUGES, ErrorModel, check_gravity, normal_gravity, to_gauge

ABOVE, BELOW = np.triu_indices(3, 1), np.tril_indices(3, -1)


def _model(seed):
    rng = Streams(seed, [0])
    K = np.diag([1.0, 0.8, 1.3]) + 0.1 * rng.normal(3, 3)[0]
    return ErrorModel(50.0 * K @ rotation(seed), 20.0 * rng.normal(1, 3)[0, 0])


@given(st.integers(0, 10**6))
def test_output_and_specific_force_are_inverse(seed):
    model, f = _model(seed), 10 * Streams(seed, [1]).normal(6, 3)[0]
    np.testing.assert_allclose(model.specific_force(model.output(f)), f, atol=1e-11)
    np.testing.assert_allclose(model.output(model.specific_force(f)), f, atol=1e-10)


def test_output_is_equation_10_and_force_equation_11():
    f = np.array([1.0, -2.0, 9.0])
    N = DPSO.output(f)
    for i in range(3):
        assert N[i] == pytest.approx(sum(DPSO.K[i, j] * f[j] for j in range(3)) + DPSO.D[i], rel=1e-14)
    np.testing.assert_allclose(DPSO.K_A @ N - DPSO.f_0, f, atol=1e-13)
    np.testing.assert_allclose(DPSO.K_A @ DPSO.K, np.eye(3), atol=1e-14)
    assert DPSO.output(np.zeros((4, 5, 3))).shape == (4, 5, 3)


@given(st.integers(0, 10**6), st.sampled_from(GAUGES))
def test_a_gauge_is_a_rotation_of_the_body_frame(seed, gauge):
    """K K^T and the bias stay; what is turned is a proper rotation; every modulus stays as it was."""
    model = _model(seed)
    other = model.in_gauge(gauge)
    np.testing.assert_allclose(other.K @ other.K.T, model.K @ model.K.T, rtol=1e-11)
    turn = np.linalg.solve(other.K, model.K)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-11)
    np.testing.assert_array_equal(other.D, model.D)
    N = 100 * Streams(seed, [2]).normal(5, 3)[0]
    np.testing.assert_allclose(
        np.linalg.norm(other.specific_force(N), axis=1),
        np.linalg.norm(model.specific_force(N), axis=1),
        rtol=1e-11,
    )


@given(st.integers(0, 10**6))
def test_the_forms_of_the_gauges(seed):
    model = _model(seed)
    lower, upper, symmetric = (model.in_gauge(gauge).K for gauge in ("lower", "upper", "symmetric"))
    assert (lower[ABOVE] == 0).all()
    assert (np.diagonal(lower) > 0).all()
    np.testing.assert_allclose(upper[BELOW], 0, atol=1e-12)
    assert (np.diagonal(upper) > 0).all()
    np.testing.assert_allclose(symmetric, symmetric.T, rtol=1e-12, atol=1e-11)
    assert (np.linalg.eigvalsh(symmetric) > 0).all()
    np.testing.assert_array_equal(model.in_gauge("full").K, model.K)


@given(st.integers(0, 10**6), st.sampled_from(GAUGES[:3]), st.sampled_from(GAUGES[:3]))
def test_gauges_convert_exactly_into_one_another(seed, first, second):
    model = _model(seed)
    direct = model.in_gauge(second).K
    np.testing.assert_allclose(model.in_gauge(first).in_gauge(second).K, direct, atol=1e-10)
    turned = ErrorModel(model.K @ rotation(seed + 7).T, model.D)
    np.testing.assert_allclose(turned.in_gauge(second).K, direct, atol=1e-10)


def test_a_sensor_already_in_a_gauge_stays():
    for gauge in GAUGES[:3]:
        K = to_gauge(DPSO.K, gauge)
        np.testing.assert_allclose(to_gauge(K, gauge), K, rtol=1e-13, atol=1e-7)


def test_the_symmetric_gauge_is_closest_to_no_rotation():
    model = _model(3)
    root = to_gauge(model.K, "symmetric")
    near = np.linalg.norm(model.K - root @ np.linalg.solve(root, model.K))
    assert near < 1e-10
    for gauge in ("lower", "upper"):
        K = to_gauge(model.K, gauge)
        turn = np.linalg.solve(root, K)
        assert np.trace(np.linalg.solve(np.diag(np.diagonal(root)), root)) == pytest.approx(3.0)
        assert np.linalg.norm(turn - np.eye(3)) > 1e-3


@given(st.integers(0, 10**6))
def test_a_gauge_changes_no_cost(seed):
    model = _model(seed)
    output = model.output(9.8 * poses.turns() + noise(24, 0.1, seed))
    costs = [direct_cost(model.in_gauge(gauge).K, model.D, output, 9.8) for gauge in GAUGES]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-9)
    assert costs[0] > 0.1


def test_gauges_of_many_matrices_at_once():
    many = np.stack([_model(seed).K for seed in range(6)]).reshape(2, 3, 3, 3)
    for gauge in GAUGES:
        each = np.stack([to_gauge(K, gauge) for K in many.reshape(-1, 3, 3)]).reshape(many.shape)
        np.testing.assert_allclose(to_gauge(many, gauge), each, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("gauge", ["lower", "upper", "symmetric"])
def test_a_matrix_that_is_all_but_singular_has_its_gauges(gauge):
    """K K^T has no digits of the smallest singular value left: its factor would be noise, or none."""
    K = rotation(1) @ np.diag([1e3, 1.0, 1e-7]) @ rotation(2)
    found = to_gauge(np.stack([K, np.eye(3), np.diag([1.0, 0.0, 2.0])]), gauge)
    np.testing.assert_allclose(found[0] @ found[0].T, K @ K.T, atol=1e-9)
    turn = np.linalg.solve(found[0], K)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-5)
    np.testing.assert_array_equal(found[0], to_gauge(K, gauge))
    np.testing.assert_array_equal(found[1], np.eye(3))
    np.testing.assert_allclose(found[2] @ found[2].T, np.diag([1.0, 0.0, 4.0]))


# Engineering units


def test_engineering_units():
    assert units.STANDARD_GRAVITY == 9.80665
    assert pytest.approx(206264.806247, rel=1e-12) == units.ARCSEC
    assert (units.PPM, units.MRAD, units.MICRO_G) == (1e6, 1e3, 1e6)


def test_scale_factors_misalignments_and_biases_by_hand():
    K = np.array([[102.0, 0.0, 0.0], [30.0, 40.0, 0.0], [0.0, 28.0, 96.0]])
    np.testing.assert_allclose(units.sensitivity(K), [102.0, 50.0, 100.0])
    np.testing.assert_allclose(
        units.scale_error(K, np.array([100.0, 50.0, 80.0])), [0.02, 0.0, 0.25], atol=1e-15
    )
    np.testing.assert_allclose(units.misalignment(K), np.arcsin([0.6, 0.0, 0.8 * 0.28]), atol=1e-15)
    np.testing.assert_allclose(units.bias_force(K, np.array([204.0, -25.0, 10.0])), [2.0, -0.5, 0.1])


@given(st.lists(st.floats(-0.2, 0.2), min_size=6, max_size=6))
def test_misalignments_are_what_two_axes_miss_of_90_degrees_in_any_gauge(off):
    K = np.diag([3.0, 5.0, 4.0]) @ (np.eye(3) + np.array([[0, *off[:2]], [off[2], 0, off[3]], [*off[4:], 0]]))
    rows = K / np.linalg.norm(K, axis=1)[:, None]
    missed = [np.pi / 2 - np.arccos(rows[i] @ rows[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    for gauge in units.GAUGES:
        seen = units.to_gauge(K, gauge)
        np.testing.assert_allclose(units.misalignment(seen), missed, atol=1e-12)
        np.testing.assert_allclose(units.sensitivity(seen), units.sensitivity(K), rtol=1e-12)


@pytest.mark.parametrize(
    ("latitude", "g"),
    [(0.0, 9.7803253359), (45.0, 9.8061977694), (90.0, 9.8321849379), (-90.0, 9.8321849379)],
)
def test_normal_gravity_on_the_ellipsoid(latitude, g):
    assert normal_gravity(latitude) == pytest.approx(g, abs=2e-10)


@given(st.floats(-90, 90))
def test_normal_gravity_is_somiglianas(latitude):
    """The closed form of Somigliana with the constants of WGS84."""
    s = np.sin(np.radians(latitude)) ** 2
    somigliana = 9.7803253359 * (1 + 0.00193185265241 * s) / np.sqrt(1 - 0.00669437999013 * s)
    assert normal_gravity(latitude) == pytest.approx(somigliana, abs=1e-9)
    assert normal_gravity(latitude) == pytest.approx(normal_gravity(-latitude), abs=1e-12)


@pytest.mark.parametrize("latitude", [0.0, 30.0, 60.0, 90.0])
def test_gravity_falls_with_height(latitude):
    """By about 3.086e-6 per second squared near the ground, and less than linearly."""
    ground, hill, mountain = (normal_gravity(latitude, h) for h in (0.0, 100.0, 5000.0))
    assert (ground - hill) / 100 == pytest.approx(3.086e-6, rel=5e-3)
    assert 0.99 < (ground - mountain) / (50 * (ground - hill)) < 1.0
    valley = normal_gravity(latitude, -400.0)  # the Dead Sea; no warning for being below the ellipsoid
    assert (valley - ground) / 400 == pytest.approx(3.086e-6, rel=5e-3)


@pytest.mark.parametrize(
    ("latitude", "height", "word"),
    [
        (91, 0, "--latitude 91"),
        (-90.1, 0, "--latitude"),
        (float("nan"), 0, "--latitude"),
        (0, 2e5, "--height"),
    ],
)
def test_places_that_do_not_exist_are_refused(latitude, height, word):
    with pytest.raises(UsageError, match=word):
        normal_gravity(latitude, height)


@pytest.mark.parametrize("g", [0.0, -9.8, float("nan"), float("inf")])
def test_gravity_that_cannot_be_is_refused(g):
    with pytest.raises(UsageError, match="--g"):
        check_gravity(g)


@pytest.mark.parametrize("g", [1.0, 9.81, 1.62])
def test_gravity_that_can_be_passes(g):
    assert check_gravity(g) == g
