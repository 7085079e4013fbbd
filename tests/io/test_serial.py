"""Lines of a live stream: the numbers that they hold."""

from __future__ import annotations

import io

import numpy as np
import pytest

from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError
from accelcal_cli.io.serial import file_lines, numbers, pick, readings


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("1 2 3", [1, 2, 3]),
        ("-1.5,+2e-3;\t.5", [-1.5, 0.002, 0.5]),
        ("acc: x=0.1 y=-0.2 z=9.8 (m/s^2)", [0.1, -0.2, 9.8]),
        ('{"t": 12, "a": [1, 2, 3]}', [12, 1, 2, 3]),
        ("ax1 2 3 4", [2, 3, 4]),
        ("nothing here", []),
        ("", []),
    ],
)
def test_numbers_of_a_line(line, expected):
    assert numbers(line) == expected


def test_columns_are_picked_and_what_is_not_finite_is_not_taken():
    np.testing.assert_array_equal(pick("9 8 7 6", [3, 0, 1]), [6, 9, 8])
    assert pick("9 8", [0, 1, 2]) is None
    assert pick("9 nan 7", [0, 1, 2]) is None
    assert pick("9 inf 7", [0, 1, 2]) is None


def test_headers_and_comments_are_passed_over():
    file = io.BytesIO(b"# a log\nax,ay,az\n1,2,3\n\n\xff\xfe 4,5\n4,5,6\r\n7,8,9")
    found = list(readings(file_lines(file), [0, 1, 2], "log"))
    np.testing.assert_array_equal(found, [[1, 2, 3], [4, 5, 6], [7, 8, 9]])


def test_a_stream_of_something_else_is_refused():
    with pytest.raises(DataError, match=r'log: 100 lines in a row without 4 numbers, as "1 2 3"'):
        list(readings([b"1 2 3"] * 200, [1, 2, 3], "log"))


AXES = [[1.5, -2.25, 9.5], [0.5, 9.25, -1.5], [-9.5, 0.25, 1.0]] * 5


@pytest.mark.parametrize(
    "form",
    [
        '{{"t": 20, "ax": {}, "ay": {}, "az": {}}}',
        '{{"ts":20,"accel":{{"x":{},"y":{},"z":{}}},"gyro":{{"x":0.1,"y":0.2,"z":0.3}}}}',
        "12:30:01.250 -> Acc: {} {} {}\n12:30:01.260 -> Gyro: 0.1 0.2 0.3",
        "2026-03-04 12:30:01.25: IMU {{TimeUS : 20, I : 0, GyrX : 0.01, GyrY : 0.02, GyrZ : 0.3, AccX : {}, AccY : {},"
        " AccZ : {}, T : 30.1}}\n2026-03-04 12:30:01.26: ATT {{TimeUS : 20, Roll : 1, Pitch : 2, Yaw : 3}}",
        "gx:0.1,gy:0.2,gz:0.4,ax:{},ay:{},az:{}",
        "$ACC,{},{},{}*5A\n$GYR,0.1,0.2,0.3*58",
    ],
)
def test_words_name_the_axes(form):
    text = "".join(form.format(*row) + "\n" for row in AXES)
    found = list(readings(file_lines(io.BytesIO(text.encode())), None, "port"))
    np.testing.assert_array_equal(found, AXES)
    log = open_raw_log("-", stdin=io.BytesIO(text.encode()), time="none")
    np.testing.assert_array_equal(np.concatenate(list(log.blocks()))[:, :3], AXES)


def test_without_words_the_first_three_numbers_are_taken():
    assert next(readings([b"1 2 3 4"] * 20, None, "port")).tolist() == [1, 2, 3]
    assert next(readings([b"v 1 2 3 4"] * 20, None, "port")).tolist() == [1, 2, 3]


def test_a_line_of_a_start_up_is_no_kind_of_lines():
    start = [b"ets Jun  8 2016 00:22:57", b"rst:0x1 (POWERON_RESET),boot:0x13", b"MPU6050 ready"]
    rows = [b"a/g:\t%d\t-5\t16000\t5\t-3\t2" % k for k in range(20)]
    assert [row.tolist() for row in readings([*start, *rows], None, "port")] == [
        [k, -5, 16000] for k in range(20)
    ]


def test_several_kinds_are_said():
    lines = [
        b"Acceleration X: 1, Y: 2, Z: 3 m/s^2",
        b"Rotation X: 4, Y: 5, Z: 6 rad/s",
        b"Temperature: 28.5 degC",
    ]
    said: list[str] = []
    assert next(readings(lines * 9, None, "port", tell=said.append)).tolist() == [1, 2, 3]
    assert said == [
        'port: lines are of several kinds: "Acceleration X:" taken, "Rotation X:", "Temperature:" left out; '
        "--line PREFIX takes others"
    ]
    with pytest.raises(DataError, match='could be "A:" or "G:"; say which with --line, as in --line "A:"'):
        next(readings([b"A:1,2,3", b"G:4,5,6"] * 9, None, "port"))
    alone = [b"Accel X: 1.5", b"Accel Y: 2.5", b"Accel Z: 9.5"] * 9
    seen = 'no line has three numbers; lines are of the kinds "Accel X:", "Accel Y:", "Accel Z:"'
    with pytest.raises(DataError, match=seen):
        next(readings(alone, None, "port"))
    with pytest.raises(DataError, match=seen):
        open_raw_log("-", stdin=io.BytesIO(b"\n".join(alone)))
    stamped = [b"12:30:01.250 -> a 1 2 3", b"12:30:01.260 -> b 4 5 6"] * 9
    assert next(readings(stamped, None, "port", "b")).tolist() == [4, 5, 6]


@pytest.mark.parametrize(
    "form", ["{} {} {} {}", "$ACC,{},{},{},{}*5A\n$GYR,1,0.1,0.2,0.3*58", "{},{},{},{},7,8,9"]
)
def test_a_first_number_that_increases_is_time(form):
    said: list[str] = []
    text = "".join(form.format(20 * k, *row) + "\n" for k, row in enumerate(AXES))
    found = list(readings(file_lines(io.BytesIO(text.encode())), None, "port", tell=said.append))
    np.testing.assert_array_equal(found, AXES)
    assert "port: the first number of each line taken as time: it increases" in said
