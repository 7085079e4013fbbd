"""Gross errors in up to a quarter of the poses are found whatever their size, and clean poses stay."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.consensus import consensus
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses

FAST = Settings(optimizer="levenberg-marquardt", g=9.8)
ROBUST = Settings(optimizer="levenberg-marquardt", g=9.8, robust="huber")


SIGMA = 2e-3
"""Noise of a pose, m/s^2."""


def spoilt(at, factor, seed=1, count=24):
    output = readings(poses.fibonacci(count), sigma=SIGMA, seed=seed).output().copy()
    output[at] = output[at] * np.asarray(factor).reshape(-1, 1)
    return Readings.from_array(output)


def agreeing(data):
    found = consensus(Sample.of([data]), FAST)
    assert found is not None
    return found


@pytest.mark.parametrize("factor", [0.05, 1.1, 1.3, 1.6, 2.0, 10.0])
def test_one_wrong_pose_is_the_one_that_disagrees(factor):
    found = [agreeing(spoilt([3], factor, seed)) for seed in range(5)]
    assert all(not part[3] for part in found)
    assert np.sum([~part for part in found]) <= 6


def test_a_quarter_may_be_wrong():
    factors = 1.0 + 0.05 * np.array([1, -1, 2, -2, 3, 0.5])
    at = [0, 5, 9, 13, 18, 22]
    for seed in range(3):
        assert np.flatnonzero(~agreeing(spoilt(at, factors, seed))).tolist() == at


def test_a_quarter_may_be_wrong_by_little():
    """Sound poses happen to agree with some that are off by ten to thirty times the noise; the likelihood tells."""
    rng = np.random.default_rng(3)
    hits = 0
    for seed in range(20):
        at = rng.choice(24, 6, replace=False)
        errors = rng.choice([-1.0, 1.0], 6) * rng.uniform(10, 30, 6) * SIGMA
        hits += not agreeing(spoilt(at, 1.0 + errors / FAST.g, seed))[at].any()
    assert hits >= 18


def test_clean_poses_all_agree():
    found = [agreeing(readings(poses.fibonacci(24), sigma=SIGMA, seed=seed)) for seed in range(20)]
    assert np.mean([part.all() for part in found]) >= 0.9


def test_too_few_poses_have_no_consensus():
    assert consensus(Sample.of([readings(poses.edges(), sigma=1e-3)]), FAST) is None


def test_a_robust_fit_is_that_without_the_wrong_poses():
    data = spoilt([3, 7], [1.6, 0.05])
    result = calibrate(data, ROBUST)
    rest = calibrate(Readings.from_array(np.delete(data.output(), [3, 7], axis=0)), ROBUST)
    assert result.outliers == (3, 7)
    assert result.verdict == "good"
    assert result.freedom == rest.freedom == 24 - 2 - 9
    np.testing.assert_allclose(result.K_a, rest.K_a, rtol=1e-6, atol=1e-6 * result.K_a.max())
    assert {notice.key: notice.severity for notice in result.warnings} == {"outliers": "note"}


def test_wrong_poses_of_a_plain_fit_are_named_by_agreement():
    """One doubled pose bends the fit until sound poses look wrong."""
    result = calibrate(spoilt([3], 1.3, count=40), FAST)
    assert result.outliers == (3,)
    assert result.verdict == "suspect"


def test_many_rows_are_searched_among_a_part_of_them():
    u = Streams(5, [0]).normal(5000, 3)[0]
    output = readings(u / np.linalg.norm(u, axis=1, keepdims=True), sigma=2e-2).output().copy()
    output[::20] *= 2.0
    found = agreeing(Readings.from_array(output))
    assert not found[::20].any()
    assert found.sum() >= 0.999 * 4750
