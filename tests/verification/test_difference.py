"""Differences of two results: their size, and how often their intervals hold."""

from __future__ import annotations

import numpy as np
import pytest

from accelcal_cli.calibration.calibrate import calibrate, calibrate_many
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.simulation import load_sensor
from accelcal_cli.verification.difference import absolute, difference

G = 9.81
TRUE = load_sensor("mems").model


def _output(seed, shift=0.0, sigma=3e-3, directions=None):
    f = G * (poses.turns() if directions is None else directions)
    noise = np.random.default_rng(seed).normal(0.0, sigma, f.shape)
    return TRUE.output(f + noise) + shift


def test_intervals_hold_at_their_rate():
    """Of 9 x 200 differences of a sensor that did not change, 95 % lie within their intervals."""
    first = calibrate_many([_output(s) for s in range(200)], g=G, optimizer="ellipsoid")
    second = calibrate_many([_output(1000 + s, sigma=1e-2) for s in range(200)], g=G, optimizer="ellipsoid")
    inside = [
        np.abs(d) <= half for d, half in (difference(*pair) for pair in zip(first, second, strict=True))
    ]
    assert 0.93 < np.mean(inside) < 0.97


def test_a_change_of_bias_is_found_where_it_is():
    shift = np.array([0.0, 16.0, 0.0])  # about 1 milli-g
    before, after = (calibrate(_output(s, shift * s), g=G, optimizer="ellipsoid") for s in (0, 1))
    change, half = difference(before, after)
    assert change[7] == pytest.approx(16.0 / np.linalg.norm(before.K_a[1]) / G, rel=0.5)
    assert abs(change[7]) > half[7]
    np.testing.assert_allclose(difference(after, before)[0], -change)


def test_without_sigma_there_is_no_interval():
    few = calibrate(_output(0, directions=poses.faces()), g=G, misalignment=False, optimizer="ellipsoid")
    change, half = difference(few, calibrate(_output(1), g=G, optimizer="ellipsoid"))
    assert np.isnan(half).all()
    assert np.isnan(change[3:6]).all()  # misalignments were not estimated
    assert np.isfinite(change[[0, 1, 2, 6, 7, 8]]).all()


def test_it_is_relative_to_no_nominal_sensor():
    result = calibrate(
        _output(0), g=G, optimizer="ellipsoid", nominal={"scale": [1700.0] * 3, "bias": [500.0] * 3}
    )
    plain = calibrate(_output(0), g=G, optimizer="ellipsoid")
    for ours, theirs in zip(absolute(result), absolute(plain), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6)
    np.testing.assert_allclose(
        absolute(plain)[0][6:], plain.D_a / np.linalg.norm(plain.K_a, axis=1) / G, rtol=1e-2
    )
