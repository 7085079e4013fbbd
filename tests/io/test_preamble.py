"""Where a table begins: preambles, headers, rows of units, comments, and what is no row below them."""

from __future__ import annotations

import io

import numpy as np
import pytest

from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import sniff
from accelcal_cli.io.reader import ReadOptions
from accelcal_cli.io.readings import Readings, read_readings

ROWS = [[round(9.8 * np.cos(k), 3), round(9.8 * np.sin(k), 3), round(0.1 * k + 0.05, 3)] for k in range(14)]
BODY = "".join(f"{x},{y},{z}\n" for x, y, z in ROWS)


def read(text: str, **options: object) -> Readings:
    return read_readings("-", stdin=io.BytesIO(text.encode()), options=ReadOptions(**options))


@pytest.mark.parametrize(
    "above",
    [
        "ax,ay,az\n",
        "ax,ay,az\nm/s^2,m/s^2,m/s^2\n",
        "Device: A\nSerial Number: 17\n\nax,ay,az\n",
        "----\nRate 50 Hz\n----\nax,ay,az\n[m/s2],[m/s2],[m/s2]\n",
        '"Product","Logger"\n"acc_1G","2048"\n"ax","ay","az"\n',
        "// by hand\n% twice\n; and again\nax,ay,az\n",
        "# ax,ay,az\n",
        "// a note\n# ax, ay, az\n",
        "Logger 7\nax;ay;az\n",
        "100\nax,ay,az\n",
        "1544027283.0,1544027283.0,1544027283.0\n32.0,32.0,32.0\n",
        "Accelerometer,,\nx,y,z\n",
    ],
)
def test_what_stands_above_a_table_is_no_row(above: str) -> None:
    np.testing.assert_array_equal(read(above + BODY).output(), ROWS)


def test_a_note_says_what_was_skipped_and_used() -> None:
    readings = read("Logger 7\nSerial Number: AB12\nSample rate: 50 Hz\nax,ay,az\n" + BODY)
    assert "3 lines above the table skipped: rate 50 Hz, serial number AB12" in readings.notes


def test_a_broken_first_row_is_no_preamble() -> None:
    assert sniff(("1,2\n" + BODY).encode(), "f").first == ("1", "2")
    with pytest.raises(DataError, match="line 2: has 2 cells where the header has 3"):
        read("ax,ay,az\n1,2\n" + BODY)


def test_numbers_above_columns_are_no_pose() -> None:
    rows = "".join(f"{100 * k},{200 - k},{16384 - k}\n" for k in range(12))
    assert read("0,1,2\n" + rows).poses == 12
    assert read("1,2,3\n" + rows).poses == 12
    assert read("0,1,2\n3,4,5\n7,8,9\n").poses == 3


def test_lines_to_skip_may_be_stated() -> None:
    readings = read("1,2,3\n4,5,6\nax,ay,az\n" + BODY, skip_rows=2)
    np.testing.assert_array_equal(readings.output(), ROWS)
    assert "the first 2 lines skipped (--skip-rows)" in readings.notes


def test_broken_rows_are_left_out_on_request() -> None:
    many = "ax,ay,az\n" + BODY * 4
    broken = many.replace("\n", "\n1,2-3,4\n", 1)
    with pytest.raises(DataError, match='line 2, column "ay": "2-3" is not a number'):
        read(broken)
    readings = read(broken, skip_bad=True)
    assert "1 broken row left out (--skip-bad): line 2" in readings.notes
    assert (readings.form.rows, readings.form.rows_skipped) == (56, 1)
    with pytest.raises(DataError, match=r"4 of 60 rows are broken, more than the 5% .*lines 2, 3, 4, 5"):
        read(many.replace("\n", "\n" + "1,x,4\n" * 4, 1), skip_bad=True)


def test_a_cut_last_line_is_forgiven() -> None:
    readings = read("ax,ay,az\n" + BODY + "1.5,2")
    assert readings.poses == len(ROWS)
    assert "the last line, 16, left out: it is cut off" in readings.notes
    with pytest.raises(DataError, match="line 16: has 2 cells"):
        read("ax,ay,az\n" + BODY + "1.5,2\n")


def test_a_repeated_header_and_rows_of_other_sensors_are_no_readings() -> None:
    again = read("ax,ay,az\n" + BODY + "ax,ay,az\n" + BODY)
    assert again.poses == 2 * len(ROWS)
    assert any("header is repeated" in note for note in again.notes)
    merged = "ax,ay,az,alt\n" + "".join(f"{x},{y},{z},\n,,,12\n" for x, y, z in ROWS)
    np.testing.assert_array_equal(read(merged).output(), ROWS)
