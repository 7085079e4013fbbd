"""Sigma is what repeated noise gives, where noise differs between poses, rows follow each other, or noise biases."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy import special

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.distributions import f_chance
from accelcal_cli.calibration.noise import _digamma, _inverse_trigamma, _trigamma
from accelcal_cli.calibration.observability import moved_sensor
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses

G = 9.80665
K = np.array([[101.3, 0, 0], [0.4, 99.1, 0], [-0.6, 0.8, 102.1]])
D = np.array([21.0, -13.0, 35.0])
FAST = Settings(optimizer="levenberg-marquardt", g=G)
SPHERE = poses.fibonacci(24)


def errors(result):
    """The nine parameters less the truth, over their sigma."""
    E = np.linalg.solve(result.K_a, K) - np.eye(3)
    off = np.concatenate([G * E[[0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]], (result.D_a - D) / np.diagonal(K)])
    return off / np.sqrt(np.diagonal(result.covariance))


def covered(make, draws, settings=FAST):
    """Part of the 95 % intervals that hold the truth."""
    found = [calibrate(make(seed), settings) for seed in range(draws)]
    return np.mean([np.abs(errors(result)) < result.coverage_factor for result in found]), found


def means(seed, counts, noise, tremor=0.0):
    """Means, scatter and covariances of repeated readings; a tremor turns each of them."""
    z = Streams(seed, [0]).normal(int(np.sum(counts)), 6)[0]
    mean, scatter, cross, first = [], [], [], 0
    for u, n in zip(SPHERE, counts, strict=True):
        part, first = z[first : first + n], first + n
        angle = tremor * part[:, 3:]
        turned = u + np.cross(angle, u) + 0.5 * np.cross(angle, np.cross(angle, u))
        turned = turned / np.linalg.norm(turned, axis=1, keepdims=True)
        N = (G * turned + noise * part[:, :3]) @ K.T + D
        C = np.cov(N.T)
        mean.append(N.mean(axis=0))
        scatter.append(np.sqrt(np.diagonal(C)))
        cross.append(C[[0, 0, 1], [1, 2, 2]])
    return Readings.from_array(mean, count=counts, scatter=scatter, cross=cross)


@pytest.mark.parametrize("weights", ["none", "n", "sd", "auto"])
def test_noise_ratio_and_intervals_hold_for_uneven_counts(weights):
    counts = np.tile([4, 300], 12)
    part, found = covered(
        lambda seed: means(seed, counts, 0.02), 40, dataclasses.replace(FAST, weights=weights)
    )
    assert 0.91 < part < 0.99
    assert np.median([result.residual_noise_ratio for result in found]) == pytest.approx(1.0, abs=0.12)


def test_noise_of_axes_that_differ():
    noise = 0.02 * np.array([1.0, 1.0, 4.0])
    part, _ = covered(
        lambda seed: means(seed, np.full(24, 30), noise), 60, dataclasses.replace(FAST, weights="sd")
    )
    assert 0.91 < part < 0.98


def test_what_a_tremor_takes_is_given_back():
    """20 mrad shorten the means by 400 ppm, ten times their noise."""
    part, found = covered(lambda seed: means(seed, np.full(24, 150), 0.002, 0.02), 30)
    assert 0.9 < part < 0.99
    for result in found:
        (notice,) = [notice for notice in result.warnings if notice.key == "tremor"]
        assert notice.severity == "note"


def test_rows_that_follow_each_other():
    """Twenty-four attitudes of eighty rows, each with nine tenths of the noise of the row before."""

    def make(seed):
        z = Streams(seed, [0]).normal(24 * 80, 3)[0]
        for t in range(1, len(z)):
            z[t] = 0.9 * z[t - 1] + np.sqrt(1 - 0.81) * z[t]
        return Readings.from_array((G * np.repeat(SPHERE, 80, axis=0) + 0.02 * z) @ K.T + D)

    part, found = covered(make, 40)
    assert 0.91 < part < 0.99
    assert all("correlated" in {notice.key for notice in result.warnings} for result in found)
    assert all(result.coverage_factor > 2.04 for result in found)  # never by the number of rows


def test_independent_rows_are_not_taken_for_correlated():
    z = Streams(1, [0]).normal(2400, 3)[0]
    result = calibrate(Readings.from_array((G * np.repeat(SPHERE, 100, axis=0) + 0.02 * z) @ K.T + D), FAST)
    assert "correlated" not in {notice.key for notice in result.warnings}


@pytest.mark.parametrize("power", [2, 3])
def test_a_sensor_that_is_not_linear_makes_a_result_suspect(power):
    u = poses.fibonacci(30)
    bent = u + 0.005 * u**power
    clean, faulty = (
        calibrate(Readings.from_array((G * v + 0.002 * Streams(1, [0]).normal(30, 3)[0]) @ K.T + D), FAST)
        for v in (u, bent)
    )
    assert clean.verdict == "good"
    assert faulty.verdict == "suspect"
    assert any("bend with the direction" in notice.text for notice in faulty.warnings)


def test_a_bias_that_drifts_makes_a_result_suspect():
    u = poses.fibonacci(30)[np.argsort(Streams(3, [0]).uniform(1, 30)[0, 0])]
    drift = 0.05 * np.linspace(0, 1, 30)[:, None] * np.array([1.0, -0.5, 0.7])
    result = calibrate(
        Readings.from_array((G * u + drift + 0.002 * Streams(1, [0]).normal(30, 3)[0]) @ K.T + D), FAST
    )
    assert any("drift from the first pose" in notice.text for notice in result.warnings)


def test_functions_of_the_noise_are_those_of_scipy():
    z = Streams(1, [0]).uniform(300, 3)[0]
    first, second, x = np.exp(7 * z[:, 0] - 0.5), np.exp(7 * z[:, 1] - 0.5), np.exp(4 * z[:, 2] - 2)
    np.testing.assert_allclose(f_chance(x, first, second), special.fdtrc(first, second, x), atol=1e-11)
    np.testing.assert_allclose(_digamma(x), special.digamma(x), atol=1e-8)
    np.testing.assert_allclose(_trigamma(x), special.polygamma(1, x), rtol=1e-7)
    np.testing.assert_allclose(_inverse_trigamma(_trigamma(x)), x, rtol=1e-9)


def test_a_value_of_the_f_distribution_does_not_see_its_company():
    x, first, second = np.array([0.3, 2.5]), np.array([3.0, 900.0]), np.array([700.0, 2.5])
    alone = [f_chance(x[k : k + 1], first[k : k + 1], second[k : k + 1])[0] for k in range(2)]
    assert f_chance(x, first, second).tolist() == alone


def test_a_step_of_the_parameters_moves_the_force_as_it_says():
    step = 1e-4 * np.arange(1.0, 10.0)[None]
    moved, bias = moved_sensor(K[None], D[None], step, G)
    E = np.zeros((3, 3))
    E[[0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]] = step[0, :6] / G
    np.testing.assert_allclose(np.linalg.inv(moved[0]), (np.eye(3) + E) @ np.linalg.inv(K), rtol=1e-12)
    np.testing.assert_allclose((bias[0] - D) / np.diagonal(K), step[0, 6:], rtol=1e-9)
