"""Still intervals: found where they are, measured exactly, whatever blocks the log comes in."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raw_logs import in_blocks, simulated

from accelcal_cli.detection.intervals import Intervals, find_intervals, find_level, merge
from accelcal_cli.detection.windows import Envelope, RowLengths, Tiles
from accelcal_cli.errors import DataError

ROWS = RowLengths(tile=10, width=10, still=None, least=100, trim=50)


def tiled(numbers, sizes=(4096,), *, gyro=True, timed=True, size=10, envelope=None):
    tiles = Tiles(size, gyro, timed)
    for raw in in_blocks(numbers, sizes):
        tiles.add(raw, envelope)
    return tiles


def found(tiles, rows=ROWS, multipliers=(4.0,)):
    return find_intervals(tiles, rows, find_level(tiles, rows, "log"), multipliers)


LOG, HOLDS = simulated()


@given(st.lists(st.integers(1, 700), min_size=1, max_size=6))
def test_the_size_of_the_blocks_changes_no_bit(sizes):
    numbers = LOG[:4000]
    one, many = Envelope(10), Envelope(10)
    whole, parts = tiled(numbers, envelope=one), tiled(numbers, sizes, envelope=many)
    a, b = found(whole)[0], found(parts)[0]
    for field in dataclasses.fields(Intervals):
        np.testing.assert_array_equal(getattr(a.intervals, field.name), getattr(b.intervals, field.name))
    np.testing.assert_array_equal(a.short, b.short)
    for left, right in zip(one.bins(), many.bins(), strict=True):
        np.testing.assert_array_equal(left, right)


@pytest.mark.parametrize("gyro", [True, False])
def test_simulated_holds_are_found_within_a_window(gyro):
    numbers = LOG if gyro else np.delete(LOG, [3, 4, 5], axis=1)
    (seen,) = found(tiled(numbers, gyro=gyro))
    poses = seen.intervals
    assert len(poses) == len(HOLDS)
    assert (poses.start >= HOLDS[:, 0]).all()
    assert (poses.end <= HOLDS[:, 1]).all()
    assert (poses.start - HOLDS[:, 0] <= ROWS.window).all()
    assert (HOLDS[:, 1] - poses.end <= ROWS.window).all()


@pytest.mark.parametrize("least", [10, 350, 10_000])
def test_mean_and_scatter_are_those_of_the_rows(least):
    (seen,) = found(tiled(LOG), dataclasses.replace(ROWS, least=least))
    poses = seen.intervals
    assert (poses.n >= least).all()
    assert len(poses) + len(seen.short) >= len(HOLDS)
    for i in range(len(poses)):
        rows = LOG[poses.start[i] - 1 : poses.end[i]]
        assert poses.n[i] == len(rows)
        np.testing.assert_allclose(poses.mean[i], rows[:, :3].mean(axis=0), rtol=1e-12)
        np.testing.assert_allclose(poses.scatter[i], rows[:, :3].std(axis=0, ddof=1), rtol=1e-9)
        np.testing.assert_array_equal(poses.time[i], rows[[0, -1], -1])


def test_a_large_offset_cancels_nothing():
    """Noise of 1 on readings of 1e9: sums of squares would have lost it."""
    shifted = LOG.copy()
    shifted[:, :3] += 1e9
    plain, far = found(tiled(LOG))[0].intervals, found(tiled(shifted))[0].intervals
    np.testing.assert_array_equal(plain.start, far.start)
    np.testing.assert_allclose(far.scatter, plain.scatter, rtol=1e-6)


def test_several_multipliers_agree_with_each_alone():
    tiles, several = tiled(LOG), (2.0, 5.0, 50.0)
    for one, alone in zip(found(tiles, multipliers=several), several, strict=True):
        (single,) = found(tiles, multipliers=(alone,))
        np.testing.assert_array_equal(one.intervals.start, single.intervals.start)
        np.testing.assert_allclose(one.intervals.mean, single.intervals.mean, rtol=1e-14)
        np.testing.assert_allclose(one.intervals.scatter, single.intervals.scatter, rtol=1e-11)


def test_blocks_of_the_store_change_nothing(monkeypatch):
    """Tiles are read back in blocks as well; runs and intervals go over their borders."""
    (whole,) = found(tiled(LOG))
    monkeypatch.setattr("accelcal_cli.detection.windows.BLOCK", 37)
    (parts,) = found(tiled(LOG))
    np.testing.assert_array_equal(whole.intervals.start, parts.intervals.start)
    np.testing.assert_array_equal(whole.intervals.end, parts.intervals.end)
    np.testing.assert_array_equal(whole.intervals.time, parts.intervals.time)
    np.testing.assert_allclose(whole.intervals.mean, parts.intervals.mean, rtol=1e-13)
    np.testing.assert_allclose(whole.intervals.scatter, parts.intervals.scatter, rtol=1e-10)


def turning_slowly():
    """Poses of an accelerometer so noisy that a slow turn about its own axis hides in it."""
    numbers, holds = simulated(noise=0.3, seed=5)
    start, end = holds[6]
    numbers[start + 150 : end - 150, 3:6] += [0.05, 0.0, 0.0]
    return numbers, holds


def test_a_gyroscope_sees_what_noise_hides():
    numbers, holds = turning_slowly()
    (without,) = found(tiled(np.delete(numbers, [3, 4, 5], axis=1), gyro=False))
    (with_gyro,) = found(tiled(numbers))
    middle = holds[6].mean()

    def covers(poses):
        return ((poses.start <= middle) & (poses.end >= middle)).any()

    assert covers(without.intervals)
    assert not covers(with_gyro.intervals)


@pytest.mark.parametrize(("degrees", "still"), [(2.0, True), (10.0, False)])
def test_a_pose_that_turns_while_it_lasts_is_none(degrees, still):
    """So slowly that no window sees it, and without a gyroscope."""
    numbers, holds = simulated(noise=0.05, seed=5, gyro=False, timed=False, hold=8.0)
    start, end = holds[6]
    mean = numbers[start - 1 : end, :3].mean(axis=0)
    aside = np.linalg.norm(mean) * np.cross(mean, [1, 0, 0]) / np.linalg.norm(np.cross(mean, [1, 0, 0]))
    numbers[start - 1 : end, :3] += (
        np.radians(degrees) * np.linspace(-0.5, 0.5, end - start + 1)[:, None] * aside
    )
    (seen,) = found(tiled(numbers, gyro=False, timed=False), multipliers=(20.0,))
    assert len(seen.intervals) == len(holds) - (not still)
    assert ((seen.intervals.start >= start) & (seen.intervals.end <= end)).any() == still
    assert len(seen.turning) == (not still)
    assert seen.turning.sum() == pytest.approx(0 if still else end - start, abs=ROWS.window)


def test_noise_is_no_turning():
    """Halves of short poses differ by more than the limit when the sensor is noisy enough."""
    numbers, holds = simulated(noise=4.0, seed=2)
    (seen,) = found(tiled(numbers))
    assert len(seen.turning) == 0
    assert len(seen.intervals) == len(holds)


def test_a_constant_turning_rate_is_a_bias():
    biased = LOG.copy()
    biased[:, 3:6] += [0.3, -0.2, 0.1]
    np.testing.assert_array_equal(
        found(tiled(biased))[0].intervals.start, found(tiled(LOG))[0].intervals.start
    )


def test_the_still_period_sets_the_level():
    numbers, _ = simulated(hold=8.0, seed=3)
    tiles = tiled(numbers)
    rows = dataclasses.replace(ROWS, still=500)
    level = find_level(tiles, rows, "log")
    assert level.variance == pytest.approx(np.linalg.norm(numbers[:500, :3].var(axis=0)), rel=1e-9)
    with pytest.raises(DataError, match=r"first 1,500 rows are not still.*--still"):
        find_level(tiles, dataclasses.replace(ROWS, still=1500), "log")
    with pytest.raises(DataError, match="fewer than the still period"):
        find_level(tiles, dataclasses.replace(ROWS, still=10**6), "log")


def test_a_stuck_stretch_is_not_the_quietest():
    """A sensor that repeats one value for a while says nothing of its noise."""
    numbers = LOG.copy()
    start, end = HOLDS[2]
    numbers[start:end, :3] = numbers[start, :3]
    assert len(found(tiled(numbers))[0].intervals) == len(HOLDS)


def test_logs_without_information_are_refused():
    with pytest.raises(DataError, match="log: has 95 rows, fewer than one window of 100"):
        found(tiled(LOG[:95]))
    with pytest.raises(DataError, match="all readings are equal"):
        found(tiled(np.ones((3000, 7))))


def test_overlapping_runs_share_their_tiles_once():
    """Without trimming the windows of neighbouring runs overlap."""
    (seen,) = found(tiled(LOG), dataclasses.replace(ROWS, trim=0, least=1), (1.2,))
    assert len(seen.intervals) > len(HOLDS)
    assert (seen.intervals.start[1:] > seen.intervals.end[:-1]).all()


def test_merging_takes_rows_together():
    (seen,) = found(tiled(LOG))
    poses = seen.intervals
    joined = merge(poses, [np.array([3, 1]), np.array([2])])
    np.testing.assert_array_equal(joined.n, [poses.n[1] + poses.n[3], poses.n[2]])
    np.testing.assert_array_equal(joined.start, poses.start[[1, 2]])
    np.testing.assert_array_equal(joined.end, poses.end[[3, 2]])
    np.testing.assert_array_equal(joined.time, [[poses.time[1, 0], poses.time[3, 1]], poses.time[2]])
    mean = (poses.n[[1, 3], None] * poses.mean[[1, 3]]).sum(axis=0) / joined.n[0]
    np.testing.assert_allclose(joined.mean, [mean, poses.mean[2]], rtol=1e-12)
    pooled = ((poses.n[[1, 3], None] - 1) * poses.scatter[[1, 3]] ** 2).sum(axis=0) / (joined.n[0] - 2)
    np.testing.assert_allclose(joined.scatter[0], np.sqrt(pooled), rtol=1e-12)
