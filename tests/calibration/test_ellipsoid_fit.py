"""The closed form: exact where it can be, NaN where the poses fix no ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, MEMS, noise, rotation

from accelcal_cli.calibration import problem as problem_module
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.problem import compress_each, fit_ellipsoid
from accelcal_cli.calibration.search import half_widths
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel, misalignment

G = 9.8


def _fit(output):
    """K in gauge lower and D, in the readings' units."""
    triangle = compress_each(np.atleast_3d(output) if output.ndim == 3 else output[None])
    K, d = fit_ellipsoid(triangle)
    scale = triangle.scale[:, None]
    return K * scale[..., None] / G, d * scale + triangle.centre


@pytest.mark.parametrize("scheme", ["faces_edges", "edges", "icosahedron", "turns"])
@pytest.mark.parametrize("model", [DPSO, MEMS])
def test_noise_free_readings_are_fitted_exactly(model, scheme):
    K, D = _fit(model.output(G * getattr(poses, scheme)()))
    truth = model.in_gauge("lower")
    unit = np.abs(truth.K).max()
    np.testing.assert_allclose(K[0], truth.K, atol=1e-11 * unit)
    np.testing.assert_allclose(D[0], truth.D, atol=1e-10 * unit * G)
    assert (K[0][np.triu_indices(3, 1)] == 0).all()


@given(st.integers(0, 10**6), st.integers(9, 40))
def test_any_sensor_in_general_poses_is_found(seed, count):
    """Scale factors apart by up to half, 0.1 rad of misalignment, a bias of up to g, any body frame."""
    rng = np.random.Generator(np.random.SFC64(seed))
    K = (np.eye(3) + 0.1 * rng.uniform(-1, 1, (3, 3))) * rng.uniform(0.8, 1.2, 3)[:, None] * 1000
    model = ErrorModel(K @ rotation(seed), 1000 * G * rng.uniform(-1, 1, 3))
    # A turned even spread of 16 directions is always in general position; more directions only add to it.
    u = np.concatenate([poses.fibonacci(16) @ rotation(seed + 1).T, poses.fibonacci(count)])
    K, D = _fit(model.output(G * u))
    truth = model.in_gauge("lower")
    np.testing.assert_allclose(K[0], truth.K, atol=1e-9 * 1000)
    np.testing.assert_allclose(D[0], truth.D, atol=1e-9 * 1000 * G)


def _ring(count):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1)


def _cone(count):
    """Directions on a circle of latitude: with their mirror image they lie on other quadrics too."""
    angle = 2 * np.pi * np.arange(count) / count
    one = np.stack([0.6 * np.cos(angle), 0.6 * np.sin(angle), np.full(count, 0.8)], axis=1)
    return np.concatenate([one, -one])


@pytest.mark.parametrize(
    "u",
    [
        poses.faces(),
        np.repeat(poses.faces(), 4, axis=0),
        _ring(24),
        _cone(12),
        poses.fibonacci(8),
        poses.faces()[:2],
    ],
    ids=["faces", "faces four times", "ring", "two circles", "eight poses", "two poses"],
)
@pytest.mark.parametrize("model", [DPSO, MEMS])
def test_poses_that_fix_no_ellipsoid_give_nan(model, u):
    K, D = _fit(model.output(G * u))
    assert np.isnan(K).all()
    assert np.isnan(D).all()


def test_noise_that_makes_no_ellipsoid_gives_nan():
    """Nearly planar readings drowned in noise: a hyperboloid, or an absurd ellipsoid, is refused."""
    outcomes = []
    for seed in range(40):
        u = _ring(24)
        u[:, 0] = 0.01 * np.sin(5 * np.arange(24))
        K, _ = _fit(MEMS.output(G * u + noise(24, 0.5, seed)))
        outcomes.append(np.isnan(K).all())
        if not outcomes[-1]:
            assert np.linalg.cond(K[0]) <= 4.0 * (1 + 1e-9)
    assert any(outcomes)


def test_the_trivial_minimum_is_not_fitted():
    """Many noisy readings: the answer is the sensor, never a sensor that reads g whatever happens."""
    u = poses.fibonacci(3000)
    K, D = _fit(DPSO.output(G * u + noise(3000, 0.8, 1)))
    truth = DPSO.in_gauge("lower")
    np.testing.assert_allclose(K[0], truth.K, atol=0.03 * 5.67e5)
    np.testing.assert_allclose(D[0], truth.D, atol=0.03 * 5.67e5 * G)


def test_a_degenerate_sensor_does_not_disturb_its_neighbours():
    good, bad = DPSO.output(G * poses.turns()), DPSO.output(G * _ring(24))
    K, _ = _fit(np.stack([good, bad, 2 * good]))
    assert np.isnan(K[1]).all()
    np.testing.assert_allclose(K[0], _fit(good)[0][0], rtol=1e-12, atol=1e-6)
    np.testing.assert_allclose(K[2], 2 * K[0], rtol=1e-10, atol=1e-4)


def _scaled(factors, seed=None):
    """A sensor whose axes differ in scale by these factors, with misalignments up to 0.05 rad."""
    turn = np.eye(3) if seed is None else rotation(seed)
    K = np.array([[1.0, 0.0, 0.0], [0.03, 1.0, 0.0], [-0.05, 0.04, 1.0]])
    return ErrorModel(100.0 * np.array(factors)[:, None] * K @ turn, 30.0 * np.array(factors))


FACTORS = [(1, 1, 5), (5, 1, 1), (1, 20, 3), (1, 1, 100)]


def test_a_column_of_another_size_is_no_axis():
    K, _ = _fit(_scaled((1, 1, 1e5)).output(G * poses.turns()))
    assert np.isnan(K).all()


@pytest.mark.parametrize("factors", FACTORS)
@pytest.mark.parametrize("scheme", ["edges", "turns", "icosahedron"])
def test_axes_of_very_different_scale_are_fitted(factors, scheme):
    model = _scaled(factors, seed=3)
    u = poses.fibonacci(40)[5:] if scheme == "edges" else getattr(poses, scheme)()
    K, D = _fit(model.output(G * u))
    truth = model.in_gauge("lower")
    for i, factor in enumerate(factors):
        np.testing.assert_allclose(K[0][i], truth.K[i], atol=1e-8 * 100 * factor)
    np.testing.assert_allclose(D[0], truth.D, rtol=1e-7)


@pytest.mark.parametrize("factors", FACTORS)
@pytest.mark.parametrize("gauge", ["lower", "symmetric", "full"])
@pytest.mark.parametrize("sigma", [0.0, 0.02])
def test_axes_of_very_different_scale_are_calibrated(factors, gauge, sigma):
    model = _scaled(factors)
    output = model.output(G * poses.turns() + noise(24, sigma, 1))
    result = calibrate(Readings.from_array(output), Settings(g=G, gauge=gauge))
    assert result.verdict == "good"
    size = np.linalg.norm(model.K, axis=1)
    np.testing.assert_allclose(np.linalg.norm(result.K_a, axis=1) / size, 1.0, atol=3 * sigma / G + 1e-9)
    np.testing.assert_allclose(misalignment(result.K_a), misalignment(model.K), atol=5 * sigma / G + 1e-9)


@pytest.mark.parametrize("scheme", ["turns", "edges", "icosahedron"])
def test_alike_axes_have_the_box_and_the_fit_they_always_had(scheme):
    """To the last bit: what is done for other axes is not done for them."""
    box = BoxSettings()
    scale = np.array([[1.0, 1.9, 1.2], [1.0, 2.5, 1.2]])
    half = half_widths(scale, box, G, 9)
    np.testing.assert_array_equal(half[0, 3:6], box.misalignment * scale[0].mean())
    np.testing.assert_array_equal(half[1, 3:6], box.misalignment * scale[1, [1, 2, 2]])
    triangle = compress_each(MEMS.output(G * getattr(poses, scheme)())[None])
    first = problem_module._ellipsoid(triangle.nearest)
    np.testing.assert_array_equal(fit_ellipsoid(triangle)[0], first[0])


def _thin(seed):
    """Readings in an oblique plane, or of an axis that does not answer, and noise."""
    rng = np.random.Generator(np.random.SFC64(seed))
    u = _ring(12 + 12 * (seed % 3)) @ (rotation(seed) if seed % 2 else np.eye(3))
    output = MEMS.output(G * u)
    if seed % 4 == 0:
        output = MEMS.output(G * poses.fibonacci(20 + seed % 7))
        output[:, seed % 3] = 0.3
    return output + G * 10.0 ** rng.uniform(-4, -1.3) * rng.normal(size=output.shape)


def test_thin_quadrics_of_noise_are_refused():
    accepted = 0
    for seed in range(240):
        output = _thin(seed)
        K, _ = _fit(output)
        if np.isfinite(K).all() and np.linalg.cond(K[0]) > 4.0:
            accepted += 1
            result = calibrate(Readings.from_array(output), Settings(g=G, optimizer="levenberg-marquardt"))
            assert result.verdict == "undetermined"
    assert accepted <= 3
