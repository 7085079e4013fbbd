"""The closed form: exact where it can be, NaN where the poses fix no ellipsoid."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, MEMS, noise, rotation

from accelcal_cli.calibration.problem import compress_each, fit_ellipsoid
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel

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
