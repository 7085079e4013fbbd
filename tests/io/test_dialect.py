"""Tables written in any dialect, below any preamble, read back as the same numbers."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import sniff
from accelcal_cli.io.reader import ReadOptions
from accelcal_cli.io.readings import Readings, read_readings

NUMBERS = st.floats(-1e9, 1e9).map(lambda value: value + 0.0)
# Rows of zeros are no readings: they are left out.
ROWS = st.lists(st.tuples(NUMBERS, NUMBERS, NUMBERS).filter(any), min_size=2, max_size=12)


@st.composite
def written(draw: st.DrawFn) -> tuple[bytes, list[tuple[float, float, float]]]:
    """Rows, and the bytes of a file that holds them in some dialect."""
    turned = ROWS.map(lambda rows: [row for row in rows if any(row)])  # zeros in all axes are no readings
    rows = draw(turned.filter(lambda rows: len(set(rows)) > 1))
    separator = draw(st.sampled_from([",", ";", "\t", "  ", " ", ", ", " \t"]))
    comma = draw(st.booleans())
    quoted = comma if separator.strip() == "," else draw(st.sampled_from([False, False, True]))
    lines = [separator.join(_cell(value, comma, quoted) for value in row) for row in rows]
    if draw(st.booleans()):
        lines.insert(0, separator.join(draw(st.sampled_from([("ax", "ay", "az"), ("u", "v", "w")]))))
    for _ in range(draw(st.integers(0, 2))):
        lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(["", "  ", "# 1,5; note"])))
    if draw(st.booleans()):
        lines = ["  " + line for line in lines]
    text = draw(st.sampled_from(["\n", "\r\n", "\r"])).join([*lines, ""] if draw(st.booleans()) else lines)
    return draw(st.sampled_from([b"", b"\xef\xbb\xbf"])) + text.encode(), rows


def _cell(value: float, comma: bool, quoted: bool) -> str:
    text = repr(value).replace(".", ",") if comma else repr(value)
    return f'"{text}"' if quoted else text


@settings(max_examples=300, deadline=None)
@given(written())
def test_same_numbers_in_every_dialect(table: tuple[bytes, list[tuple[float, float, float]]]) -> None:
    data, rows = table
    readings = read_readings("-", stdin=io.BytesIO(data))
    np.testing.assert_array_equal(readings.output(), np.array(rows))


@pytest.mark.parametrize(
    ("text", "separator", "decimal_comma", "names"),
    [
        ("1,2,3\n4,5,6\n", ",", False, None),
        ("1.5, 2, 3\n4, 5, 6\n", ",", False, None),
        ("1,5 2,5 3,5\n4 5 6\n", " ", True, None),
        ("a;b;c\n1,5;2;3\n", ";", True, ("a", "b", "c")),
        ("a;b;c\n1.5;2;3\n", ";", False, ("a", "b", "c")),
        ("1\t\t2\t3\n10\t\t2\t3\n", " ", False, None),
        ("a\tb\tc\n1\t\t3\n1\t2\t3\n", "\t", False, ("a", "b", "c")),
        ("up side,1,2,3\ndown side,4,5,6\n", ",", False, None),
        ("2024-01-01 10:00:00,1,2,3\n2024-01-01 10:00:01,1,2,3\n", ",", False, None),
        ("ax [m/s^2] ay [m/s^2] az\n1 2 3\n", " ", False, ("ax [m/s^2]", "ay [m/s^2]", "az")),
        ("# t ax ay az\n0 1 2 3\n", " ", False, ("t", "ax", "ay", "az")),
        ("# made by hand\n0 1 2 3\n", " ", False, None),
        (",0,1,2\n0,1.5,2.5,3.5\n", ",", False, ("", "0", "1", "2")),
        ("0,1,2\n3,4,5\n", ",", False, None),
        ("a,b,c,\n1,2,3,\n", ",", False, ("a", "b", "c")),
        ("a,b,c,d\n1,2,3,\n", ",", False, ("a", "b", "c", "d")),
        ('"a","b","c"\n"1,5","2","3"\n', ",", True, ("a", "b", "c")),
    ],
)
def test_dialect(text: str, separator: str, decimal_comma: bool, names: Sequence[str] | None) -> None:
    found = sniff(text.encode(), "f")
    assert (found.separator, found.decimal_comma, found.names) == (separator, decimal_comma, names)


def test_width_of_a_headerless_table_leaves_out_the_trailing_separator() -> None:
    assert sniff(b"1,2,3,\n4,5,6,\n", "f").width == 3


@pytest.mark.parametrize("data", [b"", b"\n \n\t\n", b"# only a comment\n", b",,,\n;;\n", b"\xef\xbb\xbf"])
def test_nothing_in_it(data: bytes) -> None:
    with pytest.raises(DataError, match="f: is empty"):
        sniff(data, "f")


def test_thousands_separators_are_no_numbers() -> None:
    with pytest.raises(DataError, match=r'line 2, column 1: "1\.234,5" is not a number here: .* comma'):
        read_readings("-", stdin=io.BytesIO(b"1,5;2;3\n1.234,5;2;3\n"))


def test_decimal_mark_must_stay_the_same() -> None:
    with pytest.raises(DataError, match=r'line 2, column 2: "2,5" is not a number here: .* point'):
        read_readings("-", stdin=io.BytesIO(b"1.5;2;3\n1;2,5;3\n"))


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("header", [True, False])
def test_the_separator_that_spreadsheets_note_above_a_table_is_no_row(separator, header, tmp_path):
    rows = [[1.5, 2, 3], [4, 5, 6], [7, 8.25, 10]]
    lines = [f"sep={separator}", *[separator.join(["ax", "ay", "az"])] * header]
    lines += [separator.join(map(str, row)) for row in rows]
    (tmp_path / "sheet.csv").write_text("\r\n".join(lines))
    np.testing.assert_array_equal(read_readings(tmp_path / "sheet.csv").output(), rows)


POSES = [[round(9.8 * np.cos(k), 3), round(9.8 * np.sin(k), 3), round(0.1 * k + 0.05, 3)] for k in range(14)]
BODY = "".join(f"{x},{y},{z}\n" for x, y, z in POSES)


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
        "*NAME\nLogger 7\n\n*CHANNEL\nax,ay,az\n\n*UNIT\nm/s^2,m/s^2,m/s^2\n*DATA\n",
        "Channels,3,,\nSamples,14,14,14\nDate,a,b,c\nX0,0,0,0\nDelta,1,1,1\n***End***,,,\nax,ay,az,Comment\n",
        '"ax, GMT-05:00","ay, g (S/N: 1)","az, g (S/N: 1)"\n',
    ],
)
def test_what_stands_above_a_table_is_no_row(above: str) -> None:
    np.testing.assert_array_equal(read(above + BODY).output(), POSES)


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
    np.testing.assert_array_equal(readings.output(), POSES)
    assert "the first 2 lines skipped (--skip-rows)" in readings.notes
