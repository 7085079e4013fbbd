"""Lines of a live stream: the numbers that they hold."""

from __future__ import annotations

import io

import numpy as np
import pytest

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
