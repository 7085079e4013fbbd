"""Tilt from a result: its one-sigma against Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import MEMS, noise, readings

from accelcal_cli.calibration.apply import Tilt
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.known_attitudes import covariance_of_twelve
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses

G, DRAWS = 9.8, 300
HALF = poses.fibonacci(60)[:24]
"""Attitudes on the upper half of the sphere: bias and scale factor of z are nearly one parameter."""
SEEN = np.array([[0.0, 0.0, 1.0], [0.3, -0.2, 0.93], [0.7, 0.1, 0.7], [-0.2, 0.8, 0.3]])


def scatter_and_stated(sets, settings, model=MEMS):
    """Root mean square of roll and pitch errors in degrees, and of what is stated, shape (2, 4, 2)."""
    force = G * SEEN / np.linalg.norm(SEEN, axis=1)[:, None]
    found = []
    for one in sets:
        result = calibrate(one, settings)
        found.append(Tilt.of(result).columns(result.model.specific_force(model.output(force))))
    values = np.array(found)
    return values[..., :2].std(axis=0), np.sqrt((values[..., 2:] ** 2).mean(axis=0))


@pytest.mark.parametrize("u", [HALF, poses.turns()], ids=["half sphere", "turns"])
def test_sigma_of_the_tilt_with_known_attitudes(u):
    assert HALF[:, 2].min() > 0.15
    sets = (
        Readings.from_array(MEMS.output(G * u + noise(len(u), 5e-3, seed)), reference=G * u)
        for seed in range(DRAWS)
    )
    scatter, stated = scatter_and_stated(sets, Settings(g=G, attitudes="known"))
    np.testing.assert_allclose(stated / scatter, 1.0, atol=0.13)  # three sigma of the draws


@pytest.mark.parametrize("gauge", ["lower", "symmetric"])
def test_sigma_of_the_tilt_without(gauge):
    settings = Settings(g=G, optimizer="levenberg-marquardt", gauge=gauge)
    u = poses.turns()
    sets = (readings(u, model=MEMS.in_gauge(gauge), sigma=5e-3, seed=seed) for seed in range(DRAWS))
    scatter, stated = scatter_and_stated(sets, settings, MEMS.in_gauge(gauge))
    np.testing.assert_allclose(stated, scatter, rtol=0.13, atol=1e-9)


def test_the_covariance_of_twelve_is_that_of_the_linear_fit():
    u = HALF * G
    result = calibrate(
        Readings.from_array(MEMS.output(u + noise(24, 5e-3, 1)), reference=u),
        Settings(g=G, attitudes="known"),
    )
    F = np.column_stack([u / G, np.ones(len(u))])
    N = MEMS.output(u + noise(24, 5e-3, 1))
    left = N - u @ result.K_a.T - result.D_a
    axes = np.linalg.solve(result.K_a, np.diag(np.sqrt((left**2).sum(axis=0) / 20)))
    expected = np.kron(axes @ axes.T, np.linalg.inv(F.T @ F))
    np.testing.assert_allclose(covariance_of_twelve(result), expected, rtol=1e-9, atol=1e-9 * expected.max())


def test_without_degrees_of_freedom_the_tilt_has_no_sigma():
    u = G * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [-0.6, -0.6, -0.5]])
    result = calibrate(Readings.from_array(MEMS.output(u), reference=u), Settings(g=9.8, attitudes="known"))
    columns = Tilt.of(result).columns(np.array([[0.1, 0.2, 9.7]]))
    assert np.isnan(columns[0, 2:]).all()
