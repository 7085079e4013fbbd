"""Warnings: what the residuals and the search say against a calibration whose poses determine it."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
from simulated import DPSO, noise, readings

from accelcal_cli.calibration import assess
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import design
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.notices import Notice
from accelcal_cli.sensor import poses

G = 9.8
FAST = Settings(optimizer="levenberg-marquardt", g=G)


def _said(result, words):
    return [words in notice.text for notice in result.warnings]


def test_an_honest_calibration_has_none():
    assert calibrate(readings(poses.turns(), sigma=1e-3), FAST).warnings == ()
    assert calibrate(readings(poses.turns()), FAST).warnings == ()


@pytest.mark.parametrize(("sigma", "expected"), [(0.02, False), (0.1, True)])
def test_residuals_that_are_large_beside_g_are_told(sigma, expected):
    """24 poses of 0.2 % and of 1 % of g: the poses are good for both, the calibration is not."""
    result = calibrate(readings(poses.turns(), sigma=sigma), FAST)
    assert result.verdict == ("suspect" if expected else "good")
    assert any(_said(result, "of g (above 0.5%")) is expected
    if expected:
        assert f"{result.s / G:.2%} of g" in result.warnings[0].text


def test_random_numbers_are_told():
    output = np.random.default_rng(1).uniform(-100, 100, (40, 3))
    result = calibrate(Readings.from_array(output), replace(FAST, g=1.0))
    assert result.verdict == "undetermined" or any(_said(result, "of g (above"))


def test_poses_that_do_not_fit_are_named_by_line():
    u = poses.turns()
    errors = noise(24, 1e-3, 2)
    errors[7] += 0.03 * u[7]
    data = Readings.from_array(DPSO.output(G * u + errors))
    (notice,) = calibrate(data, FAST).warnings
    assert (notice.key, notice.severity) == ("outliers", "warning")
    assert str(notice) == (
        "Outlier: pose 8 does not fit the other poses (p < 0.002). Measure it again or add --robust huber."
    )
    result = calibrate(data, replace(FAST, robust="huber"))
    (notice,) = result.warnings
    assert (notice.key, notice.severity, result.verdict) == ("outliers", "note", "good")
    assert str(notice) == (
        "Outlier: pose 8 does not fit the other poses (p < 0.002). The robust loss counts it little. Measure it again."
    )


def test_many_poses_that_do_not_fit_are_not_all_named():
    names = [f"line {n}" for n in range(2, 14)]
    (notice,) = assess.not_fitting(names, 15)
    assert str(notice) == (
        "Outliers: line 2, line 3, line 4, line 5, line 6, line 7, line 8, line 9 and 4 more do not fit the other "
        "poses (p < 0.002). Measure them again."
    )
    assert assess.not_fitting([], 15) == ()


def test_noise_that_moves_the_scale_factors_is_told():
    """16 000 samples with noise of 5 % of g: sigma falls with their number, the bias of the scale factors does not."""
    u = noise(16_000, 1.0, 3)
    u /= np.linalg.norm(u, axis=1)[:, None]
    result = calibrate(readings(u, sigma=0.5), FAST)
    assert any(_said(result, "of g in each reading biases the parameters"))
    assert not any(_said(calibrate(readings(poses.turns(), sigma=0.02), FAST), "biases"))


def test_warnings_of_readings_come_first_and_make_a_result_suspect():
    for severity, verdict in (("note", "good"), ("warning", "suspect")):
        notice = Notice("log", severity, "These are no poses.")
        result = calibrate(replace(readings(poses.turns(), sigma=1e-3), warnings=(notice,)), FAST)
        assert (result.warnings[0], result.verdict) == (notice, verdict)


def test_what_the_poses_leave_open_is_undetermined_whatever_is_warned_of():
    data = replace(readings(poses.faces(), sigma=1e-3), warnings=(Notice("log", "warning", "No poses."),))
    assert calibrate(data, FAST).verdict == "undetermined"


def test_warnings_come_back_from_a_record():
    record = calibrate(readings(poses.turns(), sigma=0.1), FAST).record()
    said = Calibration.from_record(record, "r").warnings
    assert [dataclasses.asdict(notice) for notice in said] == record["warnings"] != []


@pytest.mark.parametrize("size", [0.5, 0.9, 0.95, 0.99, 1.05, 1.3, 2.0])
def test_a_wrong_pose_is_named_however_wrong_it_is(size):
    """One pose of 24, each in turn, longer or shorter: it comes first, and no other is named.

    By the first-order formula a pose that is 5 % off explains more than there is, and is passed over.
    """
    u = poses.turns()
    for wrong in range(24):
        force = G * u + noise(24, 1e-3, 2)
        force[wrong] *= size
        result = calibrate(Readings.from_array(DPSO.output(force)), FAST)
        assert result.outliers == (wrong,)
        assert np.nanargmax([abs(pose.studentised) for pose in result.poses_fit]) == wrong


def test_a_pose_left_out_is_what_a_calibration_without_it_says():
    u = poses.turns()
    force = G * u + noise(24, 1e-3, 2)
    force[5] *= 0.9
    seen = calibrate(Readings.from_array(DPSO.output(force)), FAST).poses_fit[5]
    others = calibrate(Readings.from_array(DPSO.output(np.delete(force, 5, axis=0))), FAST)
    error = np.linalg.norm(others.model.specific_force(DPSO.output(force[5:6]))) - G
    assert seen.left_out == pytest.approx(error, rel=1e-9)
    (row,) = design(u[5:6])
    h = float(row @ others.covariance @ row) / others.s**2
    assert seen.studentised == pytest.approx(error / (others.s * np.sqrt(1.0 + h)), rel=0.06)


@pytest.mark.parametrize("size", [0.5, 0.99, 1.5])
def test_a_wrong_pose_among_very_many_is_named(size):
    """Of more than 1000 poses none is left out; what explains more than there is, is beyond chance."""
    force = G * poses.fibonacci(1500) + noise(1500, 1e-3, 2)
    force[700] *= size
    assert calibrate(Readings.from_array(DPSO.output(force)), FAST).outliers == (700,)


@pytest.mark.parametrize(("iterations", "told"), [(1, True), (400, False)])
def test_a_search_that_stopped_short_is_told(iterations, told):
    settings = Settings(g=G, polish=False, parameters={"iterations": iterations})
    for sigma in (0.0, 1e-3):
        result = calibrate(readings(poses.turns(), sigma=sigma), settings)
        assert any(_said(result, "stopped short of the minimum")) is told
    polished = calibrate(readings(poses.turns(), sigma=1e-3), replace(settings, polish=True))
    assert not any(_said(polished, "stopped short"))


@pytest.mark.parametrize(
    ("g", "told"), [(9.7803, False), (9.8322, False), (1.0, False), (98.0, True), (0.981, True)]
)
def test_a_gravity_that_is_none_is_told(g, told):
    data = Readings.from_array(DPSO.output(G * poses.turns() + noise(24, 1e-3, 2)))
    assert any(_said(calibrate(data, replace(FAST, g=g)), "neither gravity on Earth")) is told


def test_a_reference_that_points_down_is_told():
    u = poses.turns()
    data = Readings.from_array(DPSO.output(G * u + noise(24, 1e-3, 2)), reference=-G * u)
    assert any(_said(calibrate(data, Settings(g=G, attitudes="known")), "All scale factors are negative"))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda rows: rows.__setitem__((slice(None), 2), 500.0), 'Column "3" is 500 in every pose'),
        (
            lambda rows: rows.__setitem__((slice(None), 2), rows[:, 0]),
            'Columns "1" and "3" are equal in every pose',
        ),
        (
            lambda rows: rows.__setitem__(slice(8), rows[16:]),
            "8 of 24 poses repeat another to the last digit",
        ),
        (lambda rows: rows.__setitem__(slice(4), rows[20:]), "4 of 24 poses repeat another"),
        (lambda rows: rows.__setitem__(slice(2), rows[22:]), None),
    ],
)
def test_dead_and_doubled_axes_and_copies_are_told(spoil, words):
    rows = DPSO.output(G * poses.turns() + noise(24, 1e-3, 2))
    spoil(rows)
    told = Readings.from_array(rows).warnings
    assert [words in notice.text for notice in told] == [True] if words else told == ()


def _measured(seed, sigma, samples):
    """Readings of 24 poses that are means of `samples`, with the scatter of the samples themselves."""
    u = poses.turns()
    each = noise(24 * samples, sigma, seed).reshape(24, samples, 3)
    output = DPSO.output(G * u + each.mean(axis=1))
    return Readings.from_array(
        output, count=np.full(24, samples), scatter=each.std(axis=1, ddof=1) @ np.diag(np.diagonal(DPSO.K))
    )


def test_the_noise_of_forty_clean_sets_is_not_told_of():
    found = [calibrate(_measured(seed, 1e-2, 50), FAST) for seed in range(40)]
    assert not any(any(_said(result, "what the scatter within")) for result in found)
    assert sum(result.residual_noise_ratio > 1.0 for result in found) > 10


@pytest.mark.parametrize(
    ("ratio", "chance", "told"),
    [(1.9, 1e-9, False), (2.1, 1e-9, True), (5.0, 2e-3, False), (5.0, 5e-4, True), (np.nan, np.nan, False)],
)
def test_residuals_are_told_of_where_they_are_twice_their_noise_and_surely(ratio, chance, told):
    for freedom, severity in ((3, "warning"), (4, "note")):
        said = assess.more_than_noise(ratio, chance, freedom)
        assert [f"{ratio:.2g} times what the scatter" in line.text for line in said] == [True] * told
        assert {line.severity for line in said} <= {severity}


@pytest.mark.parametrize("part", [0.01, 0.03])
def test_the_noise_bias_is_taken_off(part):
    """Noise of one sample a pose, in 40 000 poses: without the correction scale factors are 3.5 part^2 too large."""
    u = noise(40_000, 1.0, 3)
    u /= np.linalg.norm(u, axis=1)[:, None]
    result = calibrate(readings(u, sigma=part * G), FAST)
    (notice,) = [notice for notice in result.warnings if notice.key == "noise-bias"]
    assert notice.severity == "warning"
    left = np.mean(np.diagonal(result.K_a) / np.diagonal(DPSO.in_gauge("lower").K) - 1.0)
    assert abs(left) < 0.15 * 3.5 * part**2


def test_large_residuals_are_told_beyond_the_chance_of_their_estimate():
    """Twelve poses at 0.4 % of g, three degrees of freedom: an estimate in four is above 0.5 %, none is told."""
    told = [calibrate(readings(poses.edges(), sigma=0.04, seed=seed), FAST).warnings for seed in range(100)]
    assert sum(any("of g (above" in notice.text for notice in said) for said in told) <= 3
    told = [calibrate(readings(poses.turns(), sigma=0.2, seed=seed), FAST).warnings for seed in range(20)]
    assert all(any("of g (above" in notice.text for notice in said) for said in told)


def test_poses_that_stand_in_for_each_other_are_said_to():
    """Of twelve edges the opposite one takes the blame, too."""
    force = G * poses.edges() + noise(12, 1e-3, 2)
    force[4] *= 1.05
    (notice,) = (
        notice
        for notice in calibrate(Readings.from_array(DPSO.output(force)), FAST).warnings
        if notice.key == "outliers"
    )
    assert "pose 5" in notice.text
    assert notice.text.endswith("With so few poses one can take the blame of another.")


def test_scatter_checks_the_poses_of_a_robust_fit_of_twelve():
    """Three degrees of freedom and a pose of large leverage: residuals that agree with the scatter bear it out."""
    u = poses.edges() + 0.14 * noise(12, 1.0, 32)
    u /= np.linalg.norm(u, axis=1)[:, None]
    settings = Settings(g=G, optimizer="levenberg-marquardt", robust="huber")
    output = DPSO.output(G * u + noise(12, 1e-3, 8))
    alone = calibrate(Readings.from_array(output), settings)
    assert max(pose.leverage for pose in alone.poses_fit) > 0.9
    assert alone.verdict == "weak"
    spread = np.abs(np.diagonal(DPSO.K)) * np.full((12, 3), 1e-2)
    assert (
        calibrate(Readings.from_array(output, count=np.full(12, 100), scatter=spread), settings).verdict
        == "good"
    )
