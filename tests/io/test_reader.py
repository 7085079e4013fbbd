"""The fast parser means what the careful parser means: same numbers, same lines, same errors; what is no row."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from accelcal_cli.errors import DataError
from accelcal_cli.io.dialect import Dialect
from accelcal_cli.io.reader import CarefulParser, FastParser, ReadOptions, Selection
from accelcal_cli.io.readings import Readings, read_readings
from accelcal_cli.io.stream import ByteSource

ODD_CELLS = [
    "", " ", "nan", "NaN", "inf", "-inf", "1e999", "1e101", "-1e100", "abc", "1_000", "0x10", "1.5.2", "+",
    "-", ".", "e5", "1e", "1e+", "5.", ".5", "+5", "-0", "1e-400", "1,5", "-2,25", "1.234,5", '"1.5"',
    '"1', '1"', "# 3", "#", "1 2", " 7 ", "7\t", "\t7", "\x00", "é", "٣", "1\r", "\r", "infinity", "true",
    "None", "1d5", "--1", "00012", "1e5", "123456789012345678901234567890", "0.1",
    "2.2250738585072014e-308", "\x0b1", "1\x0c", "1\x85", "\u20031", ";", ",",
]  # fmt: skip
PLAIN_CELLS = st.one_of(
    st.floats(-1e6, 1e6).map(repr),
    st.floats(allow_nan=False, allow_infinity=False).map(repr),
    st.integers(-(10**6), 10**6).map(str),
)


@st.composite
def tables(draw: st.DrawFn) -> tuple[bytes, Dialect, Selection]:
    """Mostly plain tables, with some cells, rows and lines that are not."""
    separator = draw(st.sampled_from([",", ";", "\t", " "]))
    decimal_comma = draw(st.booleans())
    width = draw(st.integers(1, 5))
    cells = PLAIN_CELLS.map(lambda text: text.replace(".", ",") if decimal_comma else text)
    oddity = draw(st.sampled_from([0, 0, 1, 3]))
    lines = [
        separator.join(row)
        for row in draw(st.lists(st.lists(cells, min_size=width, max_size=width), max_size=12))
    ]
    if draw(st.booleans()):
        lines = [draw(quoted(line, separator)) for line in lines]
    for _ in range(oddity if lines else 0):
        at = draw(st.integers(0, len(lines) - 1))
        lines[at] = draw(odd_lines(lines[at], separator))
    data = draw(st.sampled_from(["\n", "\r\n"])).join([*lines, ""] if draw(st.booleans()) else lines).encode()
    numbers = draw(st.lists(st.integers(0, width - 1), min_size=1, max_size=4))
    texts = draw(st.sampled_from([(), (), *((k,) for k in range(width)), (width - 1, 0)]))
    gaps = frozenset(draw(st.lists(st.sampled_from(numbers), max_size=2)))
    names = draw(st.sampled_from([None, tuple(f"c{k}" for k in range(width))]))
    first = tuple("0" * width)
    return data, Dialect(separator, decimal_comma, names, 0, first), Selection(tuple(numbers), gaps, texts)


@st.composite
def odd_lines(draw: st.DrawFn, line: str, separator: str) -> str:
    """A line with something wrong or unusual in it."""
    cells = line.split(separator)
    match draw(st.integers(0, 6)):
        case 0:
            cells[draw(st.integers(0, len(cells) - 1))] = draw(st.sampled_from(ODD_CELLS))
        case 1:
            cells.append(draw(st.sampled_from(ODD_CELLS)))
        case 2:
            cells.pop()
        case 3:
            return draw(
                st.sampled_from(["", " ", "\t", "# note", " # 1,2,3", separator * 2, "\ufeff", "\n\n"])
            )
        case 4:
            return line + draw(st.sampled_from(["\n", "\n\n", "\r", " ", "\t", separator]))
        case 5:
            return draw(st.sampled_from(["\n", " ", "\t", "#", separator])) + line
        case _:
            return draw(st.sampled_from([" ", "  ", "\t", " \t "])).join(["", *cells, ""])
    return separator.join(cells)


@st.composite
def quoted(draw: st.DrawFn, line: str, separator: str) -> str:
    """A line with some of its cells in quotes, not all of them in the usual way."""
    forms = [
        "{}",
        '"{}"',
        '"{}"',
        '"{}"',
        '" {}"',
        '"{}""1"',
        '""{}""',
        '"{}"x',
        'x"{}"',
        '"a{}',
        '"a, b;{}"',
        '""',
    ]
    usual = draw(st.integers(1, len(forms)))
    return separator.join(draw(st.sampled_from(forms[:usual])).format(cell) for cell in line.split(separator))


Outcome = tuple[list[tuple[str, ...]], list[tuple[str, ...]], list[int]] | str


def outcome(data: bytes, dialect: Dialect, selection: Selection, fast: bool, block: int) -> Outcome:
    """Everything a parser says of a table: numbers, text and line of every row, or its error."""
    careful = CarefulParser("f", dialect, selection)
    parse = FastParser(careful).parse if fast else careful.parse
    numbers: list[tuple[str, ...]] = []
    text: list[tuple[str, ...]] = []
    head = data.find(b"\n") + 1 + block  # the first line end tells lone carriage returns from line ends
    source = ByteSource(io.BytesIO(data), "f", head=head, block=block)
    try:
        for piece in source.blocks():
            rows = parse(piece)
            assert rows.start == len(numbers)
            numbers += [tuple(value.hex() for value in row) for row in rows.numbers.tolist()]
            text += zip(*rows.texts, strict=True)
    except DataError as problem:
        return str(problem)
    finally:
        source.close()
    return numbers, text, [careful.lines.line(row) for row in range(len(numbers))]


@settings(max_examples=300, deadline=None)
@given(tables(), st.integers(16, 200))
@example((b"1,2,3\n\n", Dialect(",", False, None, 0, ("0",) * 3), Selection((0, 1, 2))), 50)
@example((b"\n1,2,3\n4,5,6\n", Dialect(",", False, None, 0, ("0",) * 3), Selection((0, 1, 2))), 16)
@example((b"#1,2,3\n4,5,6\n", Dialect(",", False, None, 0, ("0",) * 3), Selection((1, 2))), 50)
@example((b"1,2\n3,4,5,6\n", Dialect(",", False, None, 0, ("0",) * 3), Selection((0, 1))), 50)
@example((b"1;2.5\n", Dialect(";", True, None, 0, ("0",) * 2), Selection((0, 1))), 50)
def test_fast_equals_careful(table: tuple[bytes, Dialect, Selection], block: int) -> None:
    """Both say the same, wherever the blocks are cut."""
    data, dialect, selection = table
    said = outcome(data, dialect, selection, fast=True, block=block)
    assert said == outcome(data, dialect, selection, fast=False, block=1 << 20)


@pytest.mark.parametrize(
    ("separator", "comma", "row"),
    [
        (",", False, "1.25,-2,3e2"),
        (",", False, "1.25, -2 ,\t3e2"),
        (";", True, "1,25;-2;3e2"),
        ("\t", True, "1,25\t-2\t3e2"),
        (" ", False, "   1.25   -2 \t 3e2 "),
        (" ", True, "1,25 -2 3e2"),
    ],
)
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_plain_tables_take_the_fast_path(separator: str, comma: bool, row: str, end: str) -> None:
    """Without this, the property above would hold for a fast parser that always declines."""
    dialect = Dialect(separator, comma, None, 0, ("0",) * 3)
    careful = CarefulParser("f", dialect, Selection((0, 1, 2)))
    careful.parse = None  # type: ignore[method-assign, assignment]
    rows = FastParser(careful).parse((row + end).encode() * 50)
    assert rows.numbers.tolist() == [[1.25, -2.0, 300.0]] * 50


def test_other_columns_take_the_fast_path_too() -> None:
    """A log with words in columns that are not read."""
    careful = CarefulParser("f", Dialect(",", False, None, 0, ("0",) * 3), Selection((1,), texts=(2,)))
    careful.parse = None  # type: ignore[method-assign, assignment]
    rows = FastParser(careful).parse('état,2.5,üp side\n"a b","2.5","üp side"\n'.encode() * 50)
    assert rows.numbers.tolist() == [[2.5]] * 100
    assert rows.texts == (["üp side"] * 100,)


ROWS = [[round(9.8 * np.cos(k), 3), round(9.8 * np.sin(k), 3), round(0.1 * k + 0.05, 3)] for k in range(14)]
BODY = "".join(f"{x},{y},{z}\n" for x, y, z in ROWS)


def read(text: str, **options: object) -> Readings:
    return read_readings("-", stdin=io.BytesIO(text.encode()), options=ReadOptions(**options))


def test_broken_rows_are_left_out_on_request() -> None:
    many = "ax,ay,az\n" + BODY * 4
    broken = many.replace("\n", "\n1,2-3,4\n", 1)
    with pytest.raises(DataError, match='line 2, column "ay": "2-3" is not a number; --skip-bad leaves out'):
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


@pytest.mark.parametrize(
    ("line", "seen"),
    [
        ("nan,1,2", "is not a finite number"),
        ("1,2", "has 2 cells"),
        ("1,,3", "is empty"),
        ('1,"2,3', "quotation mark"),
    ],
)
def test_a_refusal_names_the_option_that_helps(line: str, seen: str) -> None:
    lines = BODY * 40
    with pytest.raises(DataError, match=f"line 5[,:].*{seen}.*; --skip-bad leaves out broken rows$"):
        read("ax,ay,az\n" + lines.replace("\n", f"\n{line}\n", 3).replace(f"{line}\n", "", 2))
    with pytest.raises(
        DataError, match=f"line 2[,:].*{seen}"
    ) as told:  # every third row: the option would not help
        read("ax,ay,az\n" + f"{line}\n1,2,3\n3,2,1\n" * 30)
    assert "--skip-bad" not in str(told.value)
