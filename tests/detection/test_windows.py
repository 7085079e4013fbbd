"""Lengths, windows, gaps in the time column, and the envelope of a raw log."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raw_logs import in_blocks, opened, simulated, text

from accelcal_cli.detection.detect import DetectSettings, TooFewPosesError, detect
from accelcal_cli.detection.intervals import find_intervals, find_level
from accelcal_cli.detection.windows import (
    MOST_BINS,
    Envelope,
    Gaps,
    RowLengths,
    Span,
    Spans,
    Tiles,
    longest_step,
    parse_span,
    windows,
)
from accelcal_cli.errors import UsageError
from accelcal_cli.io.clock import Clock

ROWS = RowLengths(tile=10, width=10, still=None, least=100, trim=50)
LOG, HOLDS = simulated(gyro=False)
START, END = HOLDS[6]


def late(row, seconds):
    """The log with the rows from `row` on (from 0) that much later."""
    numbers = LOG.copy()
    numbers[row:, -1] += seconds
    return numbers


def found(numbers, sizes=(4096,)):
    tiles = Tiles(ROWS.tile, gyro=False, timed=True, longest=longest_step(Clock(100.0), ROWS))
    for raw in in_blocks(numbers, sizes):
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
    lengths = RowLengths(tile=max(1, window // 10), width=min(10, window), still=None, least=1, trim=0)
    gaps = Gaps(longest_step(Clock(1000.0, "ms"), lengths))
    time = np.array([[0.0, 1.0], [1.0 + rows, 2.0 + rows], [3.0 + rows, 3.0 + 2 * rows]])
    gaps.add(time)
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


def test_windows_have_the_variance_of_their_rows():
    log, _ = simulated()
    tiles = Tiles(10, gyro=True, timed=True)
    for raw in in_blocks(log[:1500], (4096,)):
        tiles.add(raw)
    (block,) = windows(tiles, 10)
    for k in (0, 7, len(block.variance) - 1):
        rows = log[10 * k : 10 * k + 100]
        assert block.variance[k] == pytest.approx(np.linalg.norm(rows[:, :3].var(axis=0)), rel=1e-9)
        assert block.spread[k] == pytest.approx(rows[:, 3:6].var(axis=0).sum(), rel=1e-9)
        np.testing.assert_allclose(block.mean[k], rows[:, :3].mean(axis=0), rtol=1e-12)
    (sparse,) = windows(tiles, 10, step=3)
    np.testing.assert_array_equal(sparse.variance, block.variance[::3])


def test_an_envelope_stays_small_and_loses_no_peak():
    envelope, rows = Envelope(1), 5 * MOST_BINS + 77
    values = np.sin(np.arange(rows * 3.0).reshape(rows, 3))
    values[12_345] = 9.0
    for first in range(0, rows, 1000):
        part = values[first : first + 1000]
        envelope.add(part.T[:, :, None].copy(), None)
    at, low, high = envelope.bins()
    assert len(at) <= MOST_BINS + 1
    width = int(at[1])
    for k in (0, 5, len(at) - 1):
        part = values[k * width : (k + 1) * width]
        np.testing.assert_array_equal(low[k], part.min(axis=0))
        np.testing.assert_array_equal(high[k], part.max(axis=0))
    assert high[12_345 // width].max() == 9.0


@pytest.mark.parametrize(
    ("text", "span"),
    [
        ("1", Span(1)),
        ("1.5s", Span(1.5)),
        ("2 sec", Span(2)),
        ("101rows", Span(101, True)),
        ("5 samples", Span(5, True)),
    ],
)
def test_spans_are_seconds_or_rows(text, span):
    assert parse_span(text, "--window") == span


@pytest.mark.parametrize("text", ["", "x", "-1", "nan", "inf", "1.5rows", "1 minute"])
def test_other_spans_are_refused(text):
    with pytest.raises(UsageError, match="--window"):
        parse_span(text, "--window")


def test_lengths_come_from_the_rate_or_from_rows():
    assert Spans().rows(None) == RowLengths(10, 10, None, 100, 50)
    assert Spans().rows(200.0) == RowLengths(20, 10, None, 200, 100)
    assert Spans(window=Span(7, True), trim=Span(0)).rows(100.0) == RowLengths(1, 7, None, 100, 0)
    with pytest.raises(UsageError, match="state --rate"):
        Spans(still=Span(5)).rows(None)
    with pytest.raises(UsageError, match="too few to have a variance"):
        Spans(window=Span(0.001)).rows(100.0)
    with pytest.raises(UsageError, match="fewer than the 100 of a window"):
        Spans(still=Span(50, True)).rows(100.0)
