"""Rest in days of wear: what is rest and what is a pose, and the sigma of poses that follow in time."""

from __future__ import annotations

import io
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.detection.worn import RestWindows, WornSettings, at_usual_temperature, find_wear, join
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.worn import rms

RATE = 10


def directions(n, seed=0):
    u = np.random.default_rng(seed).standard_normal((n, 3))
    return u / np.linalg.norm(u, axis=1, keepdims=True)


def windows(mean, number=None, temperature=None):
    mean = np.asarray(mean, dtype=float)
    number = np.arange(len(mean)) if number is None else np.asarray(number)
    time = np.stack([10.0 * number, 10.0 * number + 9.9], axis=1)
    return RestWindows(number, mean, np.full_like(mean, 100 * 0.002**2), time, temperature, 100)


def log(parts, seconds=10.0, names="time,ax [g],ay [g],az [g]"):
    """Return the log of parts, each rows of acceleration (n, 3) and how they are noisy; one every 0.1 s."""
    rng = np.random.default_rng(1)
    rows = np.concatenate(
        [np.asarray(rows) + noise * rng.standard_normal(np.shape(rows)) for rows, noise in parts]
    )
    table = np.column_stack([np.arange(len(rows)) / RATE, rows])
    text = names + "\n" + "\n".join(",".join(f"{v:.5f}" for v in row) for row in table)
    return open_raw_log("-", stdin=io.BytesIO(text.encode()))


def held(u, seconds):
    return np.repeat(np.atleast_2d(u), int(seconds * RATE), axis=0)


def wandering(seconds, seed=2):
    n = int(seconds * RATE)
    return np.random.default_rng(seed).normal(0, 0.6, (n, 3))


def test_hours_in_one_attitude_are_one_pose():
    u = directions(3)
    poses = join(windows(np.repeat(u, [2000, 3, 500], axis=0)), 1.0, 1.0)
    assert poses.n.tolist() == [200_000, 300, 50_000]
    np.testing.assert_allclose(poses.mean, u)
    np.testing.assert_allclose(poses.scatter, 0.002 * np.sqrt(100 / 99))
    assert poses.where(1) == "time 20000 to 20029.9"


def test_a_pose_ends_where_a_window_is_missing_and_where_it_turns_or_warms():
    u = np.tile([0.0, 0.0, 1.0], (40, 1))
    assert len(join(windows(u, np.r_[0:20, 21:41]), 1.0, 1.0)) == 2
    degrees = np.linspace(20, 24.9, 40)
    poses = join(windows(u, temperature=degrees), 1.0, 1.0)
    assert len(poses) == 5
    assert (poses.temperature[:-1] < poses.temperature[1:]).all()
    angle = np.radians(np.linspace(0, 4, 40))
    tilted = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    poses = join(windows(tilted), 1.0, 1.0)
    assert len(poses) in (4, 5)
    assert (
        np.abs(np.linalg.norm(poses.mean, axis=1) - 1.0).max() < 5e-5
    )  # a cap of 1 degree shortens by 0.04 mg


def test_idle_repeated_and_interrupted_windows_are_no_rest():
    u = directions(14)
    parts = [part for k in range(14) for part in ((held(u[k], 60), 0.003), (wandering(20, k), 0.0))]
    idle = [(held([0, 0, 0], 300), 0.0), (held([0.3, 0.2, 0.9], 300), 0.0)]
    wear = find_wear(log([*parts, *idle]), WornSettings(g=1.0))
    assert len(wear.windows) in range(14 * 4, 14 * 6 + 1)
    assert len(wear.intervals) == 14
    assert {notice.key for notice in wear.warnings} == {"zero-rows", "frozen"}
    assert "29 windows of 10 s repeat one reading" in str(wear.warnings[1]) or "30 windows" in str(
        wear.warnings[1]
    )
    assert wear.hours == pytest.approx((14 * 80 + 600) / 3600, rel=0.02)
    assert wear.rest_hours == pytest.approx(len(wear.windows) / 360)


def test_a_noisy_sensor_sets_its_own_limit():
    u = directions(14)
    parts = [part for k in range(14) for part in ((held(u[k], 60), 0.03), (wandering(20, k), 0.0))]
    wear = find_wear(log(parts), WornSettings(g=1.0))
    assert 0.03 < wear.limit < 0.045
    assert len(wear.windows) > 14 * 3


def test_the_size_of_1_g_is_told_by_the_quietest_windows_where_no_unit_tells():
    u = directions(14)
    parts = [part for k in range(14) for part in ((256 * held(u[k], 60), 0.8), (256 * wandering(20, k), 0.0))]
    wear = find_wear(log(parts, names="time,ax,ay,az"), WornSettings())
    assert wear.size == pytest.approx(256, rel=0.02)
    result = calibrate(wear.readings(), Settings(optimizer="levenberg-marquardt", g=1.0, weights="auto"))
    assert np.isnan(wear.figures(result).error_before)


def test_poses_of_an_unusual_temperature_stay_only_where_they_tell_slopes():
    u = directions(200)
    warm = np.full(200, 32.0) + np.random.default_rng(0).uniform(-0.1, 0.1, 200)
    once = join(
        windows(
            np.vstack([u, np.tile(u[:1], (30, 1))]), temperature=np.append(warm, np.linspace(30, 20, 30))
        ),
        1,
        1,
    )
    kept, notes = at_usual_temperature(once, slopes=True)
    assert kept.temperature.min() > 29
    assert len(notes) == 1
    assert "not within 2.5 degrees of the usual" in notes[0]
    often = join(windows(u, temperature=np.where(np.arange(200) % 2, warm, warm - 10)), 1, 1)
    assert at_usual_temperature(often, slopes=True) == (often, ())
    assert len(at_usual_temperature(often, slopes=False)[0]) < len(often)


def test_what_cannot_be_calibrated_is_said():
    with pytest.raises(
        DataError, match=r"no window of 10 s in 0.0833 hours is at rest: the quietest scatters by 0\.\d+"
    ):
        find_wear(log([(wandering(300), 0.0)]), WornSettings(g=1.0))
    with pytest.raises(
        DataError, match=r"rests in 1 attitude within 0.278 hours, fewer than 12; a recording of days"
    ):
        find_wear(log([(held([0, 0, 1], 1000), 0.003)]), WornSettings(g=1.0))
    with pytest.raises(DataError, match="fewer than one window of 100"):
        find_wear(log([(held([0, 0, 1], 5), 0.003)]), WornSettings(g=1.0))


def drifting(seed, poses=300):
    """Return readings of a perfect sensor whose bias drifts over some five poses."""
    rng = np.random.default_rng(seed)
    drift = np.zeros((poses, 3))
    for k in range(1, poses):
        drift[k] = 0.8 * drift[k - 1] + 0.6 * 3e-4 * rng.standard_normal(3)
    return Readings.from_array(
        directions(poses, seed) + drift + 5e-5 * rng.standard_normal((poses, 3)), warnings=()
    )


def test_sigma_counts_with_drift_where_poses_follow_in_time():
    settings = Settings(optimizer="levenberg-marquardt", g=1.0)
    z = {True: [], False: []}
    for seed in range(12):
        for in_time, deviations_ in z.items():
            result = calibrate(replace(drifting(seed), in_time=in_time), settings)
            deviations_.append(result.D_a / result.sigma.D_a)
    assert rms(np.array(z[False])) > 1.8
    assert rms(np.array(z[True])) < 1.5
