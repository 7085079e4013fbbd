"""Simulated readings: the sensor's equation, noise of the stated size, seeds, and configurations."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import DPSO

from accelcal_cli.config import load_mapping, shipped
from accelcal_cli.errors import ConfigError
from accelcal_cli.schema import from_mapping
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.simulation import Sensor, Spread, load_sensor, simulate

G = 9.8
SENSOR = Sensor(name="s", K_a=tuple(map(tuple, DPSO.K)), D_a=tuple(DPSO.D))


def test_without_noise_it_is_the_equation():
    u = poses.faces_edges()
    readings = simulate(SENSOR, u, G, 1, 0.0, 0)
    np.testing.assert_array_equal(readings.force, G * u)
    for j in range(12):
        np.testing.assert_allclose(readings.output[j], DPSO.K @ (G * u[j]) + DPSO.D, rtol=1e-13)
    assert readings.pose.tolist() == list(range(1, 13))


def test_samples_of_a_pose_follow_one_another():
    readings = simulate(SENSOR, poses.faces(), G, 3, 0.1, 0)
    assert readings.pose.tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4, 5, 5, 5, 6, 6, 6]
    assert readings.output.shape == readings.force.shape == (18, 3)
    np.testing.assert_array_equal(readings.force[3], readings.force[5])
    assert (readings.output[3] != readings.output[5]).all()


def test_noise_is_white_and_of_the_stated_size_in_force():
    """Independent from axis to axis and sample to sample, N(0, sigma) in m/s^2 before the sensor's matrix."""
    sigma = 0.02
    readings = simulate(SENSOR, poses.faces(), G, 5000, sigma, 7)
    noise = (DPSO.specific_force(readings.output) - readings.force) / sigma
    n = len(noise)
    assert np.abs(noise.mean(axis=0)).max() < 4 / np.sqrt(n)
    np.testing.assert_allclose(np.cov(noise.T), np.eye(3), atol=0.03)
    assert abs((noise[1:] * noise[:-1]).mean()) < 4 / np.sqrt(3 * n)
    assert abs((noise**4).mean() - 3) < 0.1
    exact = simulate(SENSOR, poses.faces(), G, 5000, 0.0, 7)
    np.testing.assert_array_equal(exact.force, readings.force)


def test_a_seed_repeats_and_another_does_not():
    first, same, other = (simulate(SENSOR, poses.faces(), G, 2, 0.1, seed).output for seed in (3, 3, 4))
    assert first.tobytes() == same.tobytes()
    assert (first != other).all()


def test_twice_the_noise_is_the_same_noise_twice():
    base, one, two = (simulate(SENSOR, poses.faces(), G, 2, s, 3).output for s in (0.0, 0.1, 0.2))
    np.testing.assert_allclose(two - base, 2 * (one - base), rtol=1e-6)


@pytest.mark.parametrize("name", ["dpso", "mems", "navigation"])
def test_shipped_sensors(name):
    """Each has a source and a unit, is invertible, and lies within the default search box of its own readings."""
    assert name in shipped("sensors")
    sensor = load_sensor(name)
    assert sensor.name
    assert sensor.source
    assert sensor.unit
    K = sensor.model.K
    assert np.linalg.cond(K) < 1.2
    off = K / np.diagonal(K)[:, None] - np.eye(3)
    assert np.abs(off).max() < 0.06
    assert (np.abs(sensor.model.D / np.diagonal(K)) < 0.98).all()
    assert sensor.noise < 0.1
    assert isinstance(sensor.spread, Spread)
    assert min(sensor.spread.scale, sensor.spread.misalignment, sensor.spread.bias) > 0


def test_the_sensor_of_the_paper():
    sensor = load_sensor("dpso")
    np.testing.assert_array_equal(sensor.model.K, DPSO.K)
    np.testing.assert_array_equal(sensor.model.D, DPSO.D)


def test_every_sensor_of_the_configurations_is_tested():
    assert set(shipped("sensors")) == {"dpso", "mems", "navigation"}


@pytest.mark.parametrize(
    ("stated", "words"),
    [
        ({}, "K_a: missing"),
        ({"K_a": [[1, 0, 0], [0, 1, 0], [0, 0, 0]]}, "singular"),
        ({"K_a": [[1, 0, 0], [0, 1, 0], [0, 0, float("nan")]]}, "K_a"),
        ({"K_a": [[1, 0, 0], [0, 1, 0]]}, "expected 3 values, not 2"),
        ({"K_a": [[1, 0], [0, 1], [1, 1]]}, r"K_a\[0\]: expected 3 values"),
        ({"K_a": np.eye(3).tolist(), "noise": -1}, "noise"),
        ({"K_a": np.eye(3).tolist(), "D_a": [0, 0]}, "D_a: expected 3"),
        ({"K_a": np.eye(3).tolist(), "spread": {"scale": 2}}, "spread"),
        ({"K_a": np.eye(3).tolist(), "nois": 1}, 'did you mean "noise"'),
    ],
)
def test_a_sensor_that_cannot_be_is_refused(stated, words):
    with pytest.raises(ConfigError, match=words):
        from_mapping(Sensor, stated, "s.yaml")


def test_an_unknown_sensor_is_answered():
    with pytest.raises(ConfigError, match=r'unknown sensor "mem" \(did you mean "mems"\?\)'):
        load_sensor("mem")
    with pytest.raises(ConfigError, match="no such file"):
        load_sensor("nowhere/sensor.yaml")


def test_a_sensor_of_ones_own(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("name: mine\nK_a: [[2, 0, 0], [0, 2, 0], [0.1, 0, 2]]\nD_a: [1, 2, 3]\nnoise: 1e-3\n")
    sensor = load_sensor(str(file))
    assert sensor.name == "mine"
    assert sensor.K_a[2] == (0.1, 0.0, 2.0)
    assert sensor.noise == 1e-3
    assert load_mapping(file)["name"] == "mine"
