"""Scale factors and biases linear in temperature."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from simulated import MEMS, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.calibration.temperature import _linearised
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses

G, SIGMA = 9.8, 2e-3
SETTINGS = Settings(optimizer="levenberg-marquardt", g=G)
U = np.concatenate([poses.turns(), poses.fibonacci(24)])
DEGREES = np.repeat([10.0, 40.0], 24)
LOWER = MEMS.in_gauge("lower")
SCALE, BIAS = np.array([1e-4, -5e-5, 2e-4]), np.array([3e-3, -2e-3, 1e-3])


def warm(seed=1, sigma=SIGMA, degrees=DEGREES, u=U, **more):
    t = (degrees - 25.0)[:, None]
    output = (1 + SCALE * t) * ((G * u + noise(len(u), sigma, seed)) @ LOWER.K.T) + LOWER.D + BIAS * t
    return Readings.from_array(output, temperature=degrees, **more)


def test_slopes_are_found_and_the_others_hold_at_the_mean_temperature():
    result = calibrate(warm(sigma=0.0), SETTINGS)
    slopes = result.temperature
    assert slopes.reference == 25.0
    assert (slopes.low, slopes.high) == (10.0, 40.0)
    np.testing.assert_allclose(slopes.scale, SCALE, rtol=1e-8)
    np.testing.assert_allclose(slopes.bias, BIAS, rtol=1e-8)
    np.testing.assert_allclose(result.K_a, LOWER.K, atol=1e-10)
    np.testing.assert_allclose(result.D_a, LOWER.D, atol=1e-10)
    assert result.freedom == 48 - 15
    assert any("linear in temperature" in note for note in result.notes)


def test_sigmas_are_what_repeated_noise_gives():
    runs = [calibrate(warm(seed=k), SETTINGS) for k in range(150)]
    first = runs[0]
    factor = np.sqrt(np.mean([r.s**2 for r in runs])) / first.s
    for value, sigma in (("scale", "sigma_scale"), ("bias", "sigma_bias")):
        spread = np.std([getattr(r.temperature, value) for r in runs], axis=0)
        np.testing.assert_allclose(spread, getattr(first.temperature, sigma) * factor, rtol=0.2)
    np.testing.assert_allclose(np.std([r.D_a for r in runs], axis=0), first.sigma.D_a * factor, rtol=0.2)
    assert factor * first.s == pytest.approx(SIGMA, rel=0.05)


def test_the_jacobian_is_the_derivative():
    N, t, p = warm().output(), (DEGREES - 25.0) / 15.0, np.zeros(15)
    _, J = _linearised(N, t, LOWER, p, G)
    for k in range(15):
        step = 1e-6 * np.eye(15)[k]
        ends = [_linearised(N, t, LOWER, p + side * step, G)[0] for side in (1, -1)]
        np.testing.assert_allclose(J[:, k], (ends[0] - ends[1]) / 2e-6, atol=1e-6)


def test_the_record_goes_round():
    result = calibrate(warm(), SETTINGS)
    record = json.loads(json.dumps(result.record()))
    again = Calibration.from_record(record, "r")
    assert again.record() == result.record()
    np.testing.assert_array_equal(again.temperature.bias, result.temperature.bias)
    record["temperature"]["scale"] = [1, 2]
    with pytest.raises(DataError, match="temperature: scale: expected 3 numbers"):
        Calibration.from_record(record, "r")
    del record["temperature"]["scale"]
    with pytest.raises(DataError, match="temperature: missing: scale"):
        Calibration.from_record(record, "r")


def test_a_record_without_the_block_is_a_plain_one():
    record = calibrate(warm(), dataclasses.replace(SETTINGS, temperature=False)).record()
    assert record.pop("temperature") is None
    assert Calibration.from_record(record, "r").temperature is None


def _gap():
    degrees = DEGREES.copy()
    degrees[3] = np.nan
    return degrees


@pytest.mark.parametrize(
    ("data", "settings", "words"),
    [
        (lambda: warm(degrees=np.linspace(20, 21, 48)), {}, "differ by 1 degrees"),
        (lambda: Readings.from_array(warm().output(), temperature=_gap()), {}, "missing in 1 poses"),
        (lambda: warm(degrees=DEGREES[12:36:2], u=U[12:36:2]), {}, "12 poses are too few"),
        # every attitude at one temperature of its own: cold faces, warm corners
        (lambda: warm(degrees=np.r_[[10.0], np.full(47, 40.0)]), {}, "do not determine slopes"),
    ],
)
def test_where_the_data_do_not_determine_slopes_the_model_is_plain(data, settings, words):
    result = calibrate(data(), dataclasses.replace(SETTINGS, **settings))
    assert result.temperature is None
    assert any("Temperature column not used" in note and words in note for note in result.notes)


def _expected(degrees, u, s):
    """One-sigma of the twelve numbers K_a and D_a in gauge lower, from all fifteen, differences of |f| alone."""
    low = np.tril_indices(3)
    t = (degrees - degrees.mean())[:, None]
    output = (1 + SCALE * t) * ((G * u) @ LOWER.K.T) + LOWER.D + BIAS * t

    def length(p):
        K = np.zeros((3, 3))
        K[low] = p[:6]
        plain = (output - p[6:9] - p[12:] * t) / (1 + p[9:12] * t)
        return np.linalg.norm(np.linalg.solve(K, plain.T), axis=0)

    point, steps = np.concatenate([LOWER.K[low], LOWER.D, SCALE, BIAS]), np.full(15, 1e-5)
    J = np.stack([(length(point + d) - length(point - d)) / 2e-5 for d in np.diag(steps)], axis=1)
    sigma = s * np.sqrt(np.diagonal(np.linalg.inv(J.T @ J)))
    K = np.zeros((3, 3))
    K[low] = sigma[:6]
    return K, sigma[6:9]


def test_the_slopes_take_their_part_of_the_information():
    """Colder the further z points down: the slopes are hard to tell from scale factor and bias of z.

    The information of the nine is that of the readings at the mean temperature, to a part k t of what they say: where
    the slopes take nearly all of it, some per cent of what is left.
    """
    degrees = 25.0 + 12.0 * U[:, 2] + 3.0 * np.cos(np.arange(48.0))
    result = calibrate(warm(degrees=degrees, sigma=1e-5), SETTINGS)
    K, D = _expected(degrees, U, result.s)
    np.testing.assert_allclose(result.sigma.D_a, D, rtol=0.04)
    np.testing.assert_allclose(result.sigma.K_a, K, rtol=0.04, atol=1e-9)
    plain = calibrate(warm(degrees=degrees, sigma=1e-5), dataclasses.replace(SETTINGS, temperature=False))
    assert D[2] / result.s > 1.5 * plain.sigma.D_a[2] / plain.s


def warmed_through(order, drift, seed, span=30.0):
    """Means of 14 poses, 0.02 mg each, whose temperature rises evenly; a bias drifts with it, by mg in all."""
    rng = np.random.default_rng(seed)
    u = poses.directions(14, "fibonacci", np.empty((0, 3)))[order(rng)]
    t = np.linspace(-0.5, 0.5, 14)
    force = G * u + np.outer(t, [0.0, 0.0, drift * 1e-3 * G]) + 2e-4 * rng.normal(size=(14, 3))
    scatter = LOWER.K[0, 0] * 2e-3 * np.sqrt(rng.chisquare(99, (14, 3)) / 99)
    return Readings.from_array(
        MEMS.output(force), count=np.full(14, 100), scatter=scatter, temperature=25 + span * t
    )


def drifts(readings_):
    return [notice for notice in calibrate(readings_, SETTINGS).warnings if notice.key == "drift"]


def test_a_temperature_that_goes_with_the_attitude_hides_a_drift():
    """A spiral from +z to -z while the sensor warms up: the drift of one bias is a scale factor."""
    (notice,) = drifts(warmed_through(lambda _: np.arange(14), 20.0, 1))
    assert notice.severity == "warning"
    assert "would move a parameter" in notice.text
    assert not drifts(warmed_through(lambda _: np.arange(14), 0.0, 1, span=4.0))


def test_a_temperature_that_does_not_go_with_the_attitude_hides_nothing():
    alarms = sum(
        bool(drifts(warmed_through(lambda rng: rng.permutation(14), 0.0, seed))) for seed in range(40)
    )
    assert alarms <= 4


def test_a_drift_that_shows_is_told_of():
    told = [drifts(warmed_through(lambda rng: rng.permutation(14), 20.0, seed)) for seed in range(20)]
    assert sum(bool(one) for one in told) >= 17
