"""Chances of differences: exact where theory is, honest where it is not."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from accelcal_cli.calibration.distributions import Noise, Pair, combined, holm, student_quantile
from accelcal_cli.calibration.observability import design
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses

SETS = {
    "12": poses.faces_edges(),
    "24": poses.turns(),
    "12 twice": np.repeat(poses.faces_edges(), 2, axis=0),
    "60": poses.fibonacci(60),
}


def cofactor(u):
    return np.linalg.inv(design(u).T @ design(u))


def test_without_a_noise_of_its_own_the_second_is_the_first():
    """F(k, n) exactly: Hotelling's test with a known second covariance."""
    A, B, d = cofactor(SETS["24"]), cofactor(SETS["12"]), np.linspace(-2, 3, 9)
    chance = Pair.of(Noise(4.0, 15), Noise(0.0, 0)).chance(d, A, B)
    statistic = d @ np.linalg.solve(A + B, d) / 9 / 4.0
    assert chance == pytest.approx(stats.f.sf(statistic, 9, 15), rel=1e-12)
    assert np.isnan(Pair.of(Noise(4.0, 15), Noise(0.0, 0)).noise_chance())


def test_with_many_degrees_of_freedom_it_is_chi_square():
    A, B, d = cofactor(SETS["24"]), cofactor(SETS["12"]), np.linspace(-2, 3, 9)
    chance = Pair.of(Noise(1.0, 10**7), Noise(4.0, 10**7)).chance(d, A, B)
    assert chance == pytest.approx(stats.chi2.sf(d @ np.linalg.solve(A + 4.0 * B, d), 9), rel=1e-3)


def test_one_parameter_and_equal_noise_is_nearly_students():
    d, A = np.array([2.5]), np.eye(1)
    chance = Pair.of(Noise(1.0, 15), Noise(1.0, 15)).chance(d, A, A)
    assert chance == pytest.approx(2 * stats.t.sf(2.5 / np.sqrt(2), 30), rel=0.05)


def test_the_noises_are_compared_by_an_f_test():
    pair = Pair.of(Noise(1.0, 15), Noise(4.0, 3))
    assert pair.noise_chance() == pytest.approx(2 * stats.f.sf(4.0, 3, 15), rel=1e-12)
    assert Pair.of(Noise(1.0, 15), Noise(1.0, 15)).noise_chance() == pytest.approx(1.0, abs=0.02)
    assert pair.weights.sum() == pytest.approx(1.0)


def test_equal_chances_combine_to_themselves():
    for p in (1e-200, 1e-12, 1e-6, 0.03, 0.5, 0.9):
        assert combined(np.full(10, p)) == pytest.approx(p, rel=1e-9)
    assert combined(np.array([1e-12, 1.0 - 1e-3])) == pytest.approx(2e-12, rel=1e-6)


def test_holm_is_the_step_down_of_bonferroni():
    np.testing.assert_allclose(holm(np.array([0.01, 0.04, 0.03, 0.005])), [0.03, 0.06, 0.06, 0.02])
    assert holm(np.array([0.6, 0.7])).tolist() == [1.0, 1.0]


@pytest.mark.parametrize(
    ("old", "new"), [("12", "12"), ("24", "12"), ("24", "24"), ("12 twice", "12 twice"), ("60", "12")]
)
def test_unchanged_sensors_are_called_changed_as_often_as_the_level_says(old, new):
    """Estimates drawn from their exact distribution; 700 of them at 5 % scatter by 0.8 %."""
    count = 700
    u, v = SETS[old], SETS[new]
    A, B, n_a, n_b = cofactor(u), cofactor(v), len(u) - 9, len(v) - 9
    draws = Streams(3, [0], purpose=910).normal(count, 9 + n_a + n_b)[0]
    d = draws[:, :9] @ np.linalg.cholesky(A + B).T
    a, b = (draws[:, 9 : 9 + n_a] ** 2).mean(axis=1), (draws[:, 9 + n_a :] ** 2).mean(axis=1)
    hits = 0
    for j in range(count):
        pair = Pair.of(Noise(a[j], n_a), Noise(b[j], n_b))
        single = [pair.chance(d[j, [p]], A[[p]][:, [p]], B[[p]][:, [p]]) for p in range(9)]
        hits += combined(np.array([*single, pair.chance(d[j], A, B)])) < 0.05
    assert 0.025 <= hits / count <= 0.075


@pytest.mark.parametrize("probability", [0.025, 0.5, 0.6, 0.9, 0.975, 0.995, 0.9995])
def test_the_student_quantile_is_that_of_scipy(probability):
    for freedom in (1, 1.3, 2, 2.7, 3, 5, 9.9, 15, 30, 99.5, 150, 199, 201, 250, 1000, 1e4, 1e6, 1e8):
        expected = stats.t.ppf(probability, freedom)
        assert student_quantile(probability, freedom) == pytest.approx(expected, rel=1e-9, abs=1e-15)


def test_there_is_no_quantile_below_one_degree_of_freedom():
    with pytest.raises(ValueError, match="expected 1 or more"):
        student_quantile(0.975, 0.5)
