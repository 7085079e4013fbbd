"""Axivity files by the published format: packed and wide, with gyroscope, damaged, cut, and as skdh reads them."""

from __future__ import annotations

import io
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from damage import check_damage

from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.reader import ReadOptions, Selection, open_table

sys.path.insert(0, str(Path(__file__).parents[3]))

from benchmarks.worn_logs import cwa_blocks, cwa_header, sealed

RNG = np.random.default_rng(3)
RATE, BLOCKS = 100, 40


def written(packing=0, actual=98.8, gyro=None, blocks=BLOCKS):
    """Return a file, and the readings in it, (P, rows, 3) in g."""
    rows = 120 if packing == 0 else 80 if gyro is None else 40
    output = RNG.normal(0, 1, (blocks, rows, 3))
    output[0, 0] = 7.9, -7.9, 0.0
    degrees = np.linspace(20, 30, blocks)
    turning = None if gyro is None else RNG.normal(0, 100, (blocks, rows, 3))
    made = cwa_blocks(output, degrees, 0, RATE, actual, packing, turning)
    return cwa_header(RATE, gyro=gyro is not None) + made.tobytes(), output, made, turning


def read(data):
    """Return the table and all its columns."""
    table = open_table("-", io.BytesIO(data))
    columns = tuple(range(len(table.names)))
    rows = [block.numbers for block in table.blocks(Selection(columns, frozenset(columns)))]
    return table, np.concatenate([np.empty((0, len(columns))), *rows])


def test_packed_numbers_keep_their_exponent():
    data, output, _, _ = written()
    table, rows = read(data)
    assert table.source_format == "cwa"
    assert table.names == ("time", "ax", "ay", "az", "temperature")
    assert str(table.facts).startswith(
        "rate 100 Hz, start 2025-06-15 15:06:40, serial number 12345, range +-8 g"
    )
    largest = np.abs(output.reshape(-1, 3)).max(axis=1, keepdims=True)
    step = np.where(largest >= 4, 4, np.where(largest >= 2, 2, 1)) / 256  # 10 bits of the largest axis
    assert (np.abs(rows[:, 1:4] - output.reshape(-1, 3)) <= step + 0.5 / 256).all()
    small = largest[:, 0] < 1.9
    np.testing.assert_array_equal(rows[small, 1:4], np.round(output.reshape(-1, 3)[small] * 256) / 256)
    assert np.abs(rows[:, 4] - np.repeat(np.linspace(20, 30, BLOCKS), 120)).max() < 0.15


def test_the_time_is_that_of_the_sensor_not_the_nominal_one():
    data, _, _, _ = written(actual=98.8)
    _, rows = read(data)
    assert rows[0, 0] == 0
    assert np.abs(rows[:-120, 0] - np.arange(len(rows) - 120) / 98.8).max() < 2 / 32768
    assert open_raw_log("-", stdin=io.BytesIO(data)).clock.rate == pytest.approx(98.8, rel=1e-4)


def test_wide_numbers_and_the_gyroscope_of_an_ax6():
    data, output, _, turning = written(2, gyro=True)
    table, rows = read(data)
    assert table.names == ("time", "ax", "ay", "az", "gx", "gy", "gz", "temperature")
    assert table.units == ("s", "g", "g", "g", "deg/s", "deg/s", "deg/s", "degC")
    np.testing.assert_allclose(rows[:, 1:4], output.reshape(-1, 3), atol=0.5 / 4096)
    np.testing.assert_allclose(rows[:, 4:7], turning.reshape(-1, 3), atol=1000 / 32768)
    data, output, _, _ = written(2)
    np.testing.assert_allclose(read(data)[1][:, 1:4], output.reshape(-1, 3), atol=0.5 / 4096)


def test_broken_blocks_are_left_out_and_counted():
    data, _output, _, _ = written()
    broken = bytearray(data)
    for block in (3, 4, 20):
        broken[1024 + 512 * block + 100] ^= 1
    table, rows = read(bytes(broken))
    kept = np.delete(np.arange(BLOCKS), [3, 4, 20])
    assert len(rows) == 120 * len(kept)
    np.testing.assert_array_equal(
        rows[:, 1:4], read(data)[1].reshape(BLOCKS, 120, 5)[kept][..., 1:4].reshape(-1, 3)
    )
    assert "3 broken blocks left out: number 4, 5, 21 of 40" in table.notes
    assert any(note.startswith("blocks are missing at 2 places, the longest 2.4") for note in table.notes)
    np.testing.assert_allclose(rows[360, 0], 5 * 120 / 98.8, atol=1e-3)  # time goes on behind the gap


def test_memory_that_was_never_written_is_no_fault():
    data, _, _, _ = written()
    table, rows = read(data + b"\xff" * 2048)
    assert len(rows) == 120 * BLOCKS
    assert not any("broken" in note for note in table.notes)


def test_a_file_that_is_cut_within_a_block_says_so():
    data, _, _, _ = written()
    table, rows = read(data[:-100])
    assert len(rows) == 120 * (BLOCKS - 1)
    assert "the file is cut: 412 bytes at its end are no whole block" in table.notes


def test_short_blocks_and_those_of_another_rate():
    _, _, made, _ = written()
    made["count"][7] = 50
    made["rate"][9] = 9
    table, rows = read(cwa_header(RATE) + sealed(made).tobytes())
    assert len(rows) == 120 * (BLOCKS - 2) + 50
    assert any("1 block of another rate or packing left out" in note for note in table.notes)
    assert (np.diff(rows[:, 0]) > 0).all()


def test_a_clock_that_is_set_back_goes_on():
    _, _, made, _ = written()
    made["stamp"][20:] -= 30
    table, rows = read(cwa_header(RATE) + sealed(made).tobytes())
    assert (np.diff(rows[:, 0]) > 0).all()
    assert any("the clock of the logger was set back once" in note for note in table.notes)


def test_what_is_no_log():
    data, _, _, _ = written()
    with pytest.raises(DataError, match=r"without a sound block of data; copy the file anew"):
        open_table("-", io.BytesIO(data[:1024]))
    with pytest.raises(UsageError, match="has one accelerometer; leave it out"):
        open_table("-", io.BytesIO(data), options=ReadOptions(accelerometer="second"))


@pytest.mark.parametrize("gyro", [None, True])
def test_damage_is_one_line_or_leaves_rows(gyro):
    data, *_ = written(2 if gyro else 0, gyro=gyro, blocks=12)
    check_damage(data)


@pytest.mark.parametrize(("packing", "gyro"), [(0, None), (2, None), (2, True)])
def test_skdh_reads_the_same(tmp_path, packing, gyro):
    skdh = pytest.importorskip("skdh.io")
    data, *_ = written(packing, gyro=gyro, blocks=100)
    path = tmp_path / "a.cwa"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = skdh.ReadCwa().predict(file=str(path))
    _, rows = read(data)
    np.testing.assert_array_equal(theirs["accel"], rows[:, 1:4])
    if gyro:
        np.testing.assert_allclose(theirs["gyro"], rows[:, 4:7], rtol=1e-12)
    # Theirs is the nominal rate within a block, and loses the fraction of a second.
    assert np.abs(theirs["time"] - theirs["time"][0] - rows[:, 0]).max() < 0.03
