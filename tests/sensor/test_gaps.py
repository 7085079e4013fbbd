"""Gaps in the time column: no interval goes across one, and the largest is told."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raw_logs import in_blocks, opened, simulated, text

from accelcal_cli.detection.detect import DetectSettings, TooFewPosesError, detect
from accelcal_cli.detection.intervals import find_intervals, find_level
from accelcal_cli.detection.rawlog import Clock
from accelcal_cli.detection.windows import Gaps, Limit, Rows, Tiles

ROWS = Rows(tile=10, width=10, still=None, least=100, trim=50)
LOG, HOLDS = simulated(gyro=False)
START, END = HOLDS[6]


def late(row, seconds):
    """The log with the rows from `row` on (from 0) that much later."""
    numbers = LOG.copy()
    numbers[row:, -1] += seconds
    return numbers


def found(numbers, sizes=(4096,)):
    tiles = Tiles(ROWS.tile, gyro=False, timed=True, limit=Limit.of(Clock(100.0), ROWS))
    for raw in in_blocks(numbers, sizes, gyro=False):
        tiles.add(raw)
    (seen,) = find_intervals(tiles, ROWS, find_level(tiles, ROWS, "log"), (4.0,))
    return seen.intervals, tiles.gaps


@pytest.mark.parametrize("inside", [0, 1, 5, 9])
def test_an_interval_ends_at_a_gap_and_another_begins(inside):
    row = (START + END) // 20 * 10 + inside
    plain, _ = found(LOG)
    intervals, gaps = found(late(row, 3600.0))
    assert len(intervals) == len(plain) + 1
    assert gaps.count == 1
    assert gaps.largest == pytest.approx(3600.01)
    assert gaps.after == pytest.approx(LOG[row - 1, -1], abs=0.1)
    k = int(np.searchsorted(intervals.start, START))
    assert intervals.end[k] <= row < intervals.start[k + 1]
    assert row - intervals.end[k] < ROWS.window
    assert intervals.start[k + 1] - row < ROWS.window
    assert (np.ptp(intervals.time, axis=1) < 10).all()
    rest = np.delete(np.arange(len(intervals)), [k, k + 1])
    np.testing.assert_array_equal(intervals.start[rest], np.delete(plain.start, k))
    np.testing.assert_array_equal(intervals.mean[rest], np.delete(plain.mean, k, axis=0))


@given(st.lists(st.integers(1, 700), min_size=1, max_size=6))
def test_the_size_of_the_blocks_changes_no_gap(sizes):
    numbers = late(START + 200, 50.0)
    numbers[END + 7 :, -1] += 20.0
    one, many = found(numbers), found(numbers, sizes)
    np.testing.assert_array_equal(one[0].start, many[0].start)
    assert [vars(one[1])[name] for name in ("count", "largest", "after")] == [
        vars(many[1])[name] for name in ("count", "largest", "after")
    ]
    assert one[1].count == 2


def test_blocks_of_the_store_change_no_gap(monkeypatch):
    numbers = late(START + 205, 50.0)
    whole, _ = found(numbers)
    monkeypatch.setattr("accelcal_cli.detection.windows.BLOCK", 37)
    np.testing.assert_array_equal(found(numbers)[0].start, whole.start)


@pytest.mark.parametrize(("rows", "window", "count"), [(99, 100, 0), (101, 100, 1), (9, 2, 0), (11, 2, 1)])
def test_a_step_is_a_gap_beyond_a_window_and_ten_periods(rows, window, count):
    lengths = Rows(tile=max(1, window // 10), width=min(10, window), still=None, least=1, trim=0)
    gaps = Gaps(Limit.of(Clock(1000.0, "ms"), lengths))
    time = np.array([[0.0, 1.0], [1.0 + rows, 2.0 + rows], [3.0 + rows, 3.0 + 2 * rows]])
    gaps.see(time)
    assert gaps.count == 2 * count
    assert gaps.largest == rows * count


def detected(numbers, **more):
    log = opened(text(numbers, names="ax,ay,az,t_ms"), **more)
    try:
        return detect(log, DetectSettings())
    finally:
        log.close()


def test_the_largest_gap_is_told_in_one_note():
    numbers = late(START + 200, 3600.0)
    numbers[END + 7 :, -1] += 20.0
    numbers[:, -1] = np.round(numbers[:, -1] * 1000)
    (note,) = [note for note in detected(numbers).notes if "gap" in note]
    assert note.startswith("the time column has 2 gaps, the largest of 3600 s after time ")
    assert note.endswith("no pose goes across them")
    one = late(START + 199, 3600.0) * [1, 1, 1, 1000]
    (note,) = [note for note in detected(one).notes if "gap" in note]
    assert note.startswith("the time column has a gap of 3600 s after time ")


def test_without_time_there_is_no_gap():
    numbers = late(START + 200, 3600.0) * [1, 1, 1, 1000]
    plain = detected(LOG * [1, 1, 1, 1000], time=None)
    without = detected(numbers, time="none")
    assert not any("gap" in note for note in (*plain.notes, *without.notes))
    np.testing.assert_array_equal(plain.intervals.start, without.intervals.start)


def test_gaps_everywhere_are_told_when_nothing_is_found():
    numbers = LOG * [1, 1, 1, 1000]
    numbers[1000:, -1] = numbers[1000, -1] + 2000.0 * np.arange(len(LOG) - 1000)
    with pytest.raises(TooFewPosesError, match=r"; the time column has [\d,]+ gaps, the largest of 2 s"):
        detected(numbers)
