"""GENEActiv files by the maker's description: gains and offsets, pages, temperature, damage."""

from __future__ import annotations

import io
import warnings
from datetime import datetime, timedelta

import numpy as np
import pytest
from damage import check_damage

from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.reader import ReadOptions, Selection, open_table

RNG = np.random.default_rng(4)
GAIN, OFFSET = np.array([25875, 25734, 25538]), np.array([439, -662, -3056])
HEADER = """Device Identity
Device Unique Serial Code:012967
Device Type:GENEActiv
Device Model:1.1
Device Firmware Version:Ver1.30 date 05Aug11
Calibration Date:2012-04-03 11:08:52:000

Device Capabilities
Accelerometer Range:-8 to 8
Accelerometer Resolution:0.0039
Accelerometer Units:g
Light Meter Range:0 to 5000
Light Meter Resolution:5
Light Meter Units:lux
Temperature Sensor Range:0 to 70
Temperature Sensor Resolution:0.1
Temperature Sensor Units:deg. C

Configuration Info
Measurement Frequency:50.0 Hz
Measurement Period:216 Hours
Start Time:2013-05-30 10:12:49:500
Time Zone:GMT +01:00

Trial Info
Study Centre:
Study Code:
Investigator ID:
Exercise Type:
Config Operator ID:2
Config Time:2013-05-23 14:02:12:642
Config Notes:Notes
Extract Operator ID:
Extract Time:2013-6-11 17:25:40:479
Extract Notes:

Subject Info
Device Location Code:
Subject Code:
Date of Birth:1800-1-1
Sex:
Height:
Weight:
Handedness Code:
Subject Notes:

Calibration Data
x gain:25875
x offset:439
y gain:25734
y offset:-662
z gain:25538
z offset:-3056
Volts:300
Lux:800

Memory Status
Number of Pages:{pages}

"""
PAGES = 30


def written(pages=PAGES, period=6.0, gap=None, mark="."):
    """Return a file, and the counts in it, shape (pages, 300, 3)."""
    counts = RNG.integers(-2048, 2048, (pages, 300, 3))
    texts = [HEADER.format(pages=pages)]
    for k in range(pages):
        at = datetime(2013, 5, 30, 10, 12, 54, 500_000) + timedelta(
            seconds=period * k + (60 if gap and k >= gap else 0)
        )
        rows = "".join(
            f"{x & 0xFFF:03X}{y & 0xFFF:03X}{z & 0xFFF:03X}{0x123:03X}" for x, y, z in counts[k].tolist()
        )
        texts.append(
            f"Recorded Data\nDevice Unique Serial Code:012967\nSequence Number:{k}\n"
            f"Page Time:{at:%Y-%m-%d %H:%M:%S}:{at.microsecond // 1000:03d}\nUnassigned:\n"
            f"Temperature:{20 + 0.1 * k:.1f}\nBattery voltage:4.1493\nDevice Status:Recording\n"
            f"Measurement Frequency:50.0\n{rows}\n".replace(".", mark)
        )
    return "".join(texts).encode(), counts


def read(data):
    table = open_table("-", io.BytesIO(data))
    rows = [block.numbers for block in table.blocks(Selection((0, 1, 2, 3, 4), frozenset({4})))]
    return table, np.concatenate([np.empty((0, 5)), *rows])


def test_counts_become_g_by_gain_and_offset():
    data, counts = written()
    table, rows = read(data)
    assert (table.source_format, table.names) == ("geneactiv", ("time", "ax", "ay", "az", "temperature"))
    assert str(table.facts) == "rate 50 Hz, start 2013-05-30 10:12:54, serial number 012967, range -8 to 8 g"
    np.testing.assert_allclose(rows[:, 1:4], (counts.reshape(-1, 3) * 100.0 - OFFSET) / GAIN, rtol=1e-13)
    np.testing.assert_allclose(rows[:, 4], np.repeat(20 + 0.1 * np.arange(PAGES), 300))
    np.testing.assert_allclose(rows[:, 0], np.arange(len(rows)) / 50, atol=1e-9)
    assert table.notes == ("a GENEActiv log (.bin): " + str(table.facts),)


def test_time_is_that_of_the_pages():
    data, _ = written(period=6.006, gap=20)
    table, rows = read(data)
    np.testing.assert_allclose(rows[:5700, 0], np.arange(5700) * 6.006 / 300, atol=1.1e-3)
    assert rows[6000, 0] == pytest.approx(20 * 6.006 + 60, abs=1e-3)
    assert any(note.startswith("pages are missing at 1 place, the longest 60") for note in table.notes)
    assert open_raw_log("-", stdin=io.BytesIO(data)).clock.rate == pytest.approx(300 / 6.006, rel=1e-3)


def test_a_decimal_comma_and_line_ends_of_windows():
    data, counts = written(mark=",")
    np.testing.assert_array_equal(read(data)[1], read(written_again(counts))[1])
    np.testing.assert_array_equal(read(data.replace(b"\n", b"\r\n"))[1], read(data)[1])


def written_again(counts):
    global RNG
    RNG = type("Fixed", (), {"integers": lambda *_: counts})()
    try:
        return written()[0]
    finally:
        RNG = np.random.default_rng(4)


def test_broken_pages_are_left_out_and_counted():
    data, _counts = written()
    place = data.index(b"Sequence Number:7\n") + 400
    table, rows = read(data[:place] + b"?" + data[place + 1 :])
    assert len(rows) == 300 * (PAGES - 1)
    assert f"1 broken page left out: number 8 of {PAGES}" in table.notes
    table, rows = read(data[:-1001])  # the last page is cut off between two rows, or within one
    assert len(rows) in range(300 * (PAGES - 1), 300 * PAGES)
    table, rows = read(data[: data.index(b"Sequence Number:20") - 80])
    assert len(rows) == 300 * 19  # the page before lacks its end
    assert any(note.startswith("the file is cut: it has 20 of 30 pages") for note in table.notes)


def test_what_is_no_log():
    data, _ = written(pages=1)
    with pytest.raises(DataError, match="is a GENEActiv log without page of data"):
        read(data[: data.index(b"Recorded")])
    with pytest.raises(DataError, match="without y gain"):
        read(data.replace(b"y gain", b"y_gain"))
    with pytest.raises(DataError, match="a gain of 0"):
        read(data.replace(b"y gain:25734", b"y gain:0"))
    with pytest.raises(UsageError, match="has one accelerometer"):
        open_table("-", io.BytesIO(data), options=ReadOptions(accelerometer="x"))


def test_damage_is_one_line_or_leaves_rows():
    data, _ = written(pages=12)
    assert check_damage(data) > 30
    check_damage(data[:3000], every=37)


def test_skdh_reads_the_same(tmp_path):
    skdh = pytest.importorskip("skdh.io")
    data, _ = written(pages=100)
    path = tmp_path / "a.bin"
    path.write_bytes(data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        theirs = skdh.ReadBin().predict(file=str(path))
    _, rows = read(data)
    n = len(theirs["accel"])
    assert n >= 300 * 99
    np.testing.assert_allclose(theirs["accel"], rows[:n, 1:4], atol=1e-9)
    np.testing.assert_allclose(theirs["time"] - theirs["time"][0], rows[:n, 0], atol=1e-3)
    np.testing.assert_allclose(theirs["temperature"], rows[:n, 4], atol=1e-6)
