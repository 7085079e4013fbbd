"""The console draws any block, every table whole on a terminal of any width, and curves of dots and letters."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from accelcal_cli.notices import Notice
from accelcal_cli.output.console import draw_curve, draw_curves, show
from accelcal_cli.views.blocks import BLANK, Column, Conclusion, Convergence, Paragraph, Table, notes

TABLE = Table(
    "Sensors",
    (
        Column("sensor"),
        Column("rms", "m/s^2", ".3g"),
        Column("sigma", "m/s^2", ".2g", beside=True),
        Column("verdict"),
    ),
    (("S1", 0.0123456, 0.001, "good"), ("S2", None, float("nan"), "undetermined")),
    ("A note.",),
)


def drawn(*blocks, width=80, encoding="utf-8", color=None):
    file = io.TextIOWrapper(io.BytesIO(), encoding=encoding)
    show(blocks, Console(file=file, width=width, color_system=color, force_terminal=color is not None))
    file.flush()
    return file.buffer.getvalue().decode(encoding)


def test_blocks_stand_one_under_the_other():
    blocks = (
        Paragraph("rest", heading="Head: "),
        BLANK,
        Paragraph("a b", indent=2),
        *notes(["One.", "Two."]),
    )
    assert drawn(*blocks) == "Head: rest\n\n  a b\nNote: One.\nNote: Two.\n"


def test_a_paragraph_with_an_indent_is_wrapped_in_line():
    assert drawn(Paragraph("aaa bbbb cccc ddddd", indent=2), width=20) == "  aaa bbbb cccc\n  ddddd\n"


def test_a_conclusion_has_its_reasons_and_its_warnings():
    text = drawn(
        Conclusion(
            "weak",
            ["Because."],
            [Notice("log", "warning", "Look.", "Do."), Notice("box", "note", "Fine.")],
            "Verdict so far",
        )
    )
    assert text == "Verdict so far: weak\n  Because.\nWarning: Look. Do.\nNote: Fine.\n"


@pytest.mark.parametrize(("verdict", "code"), [("good", "32"), ("weak", "33"), ("suspect", "31")])
def test_a_verdict_has_its_colour(verdict, code):
    assert f"\x1b[1;{code}m{verdict}" in drawn(Conclusion(verdict, ()), color="standard")


def test_a_table_has_units_and_aligned_numbers():
    assert drawn(TABLE).splitlines() == [
        "Sensors",
        "",
        "              rms    sigma",
        "  sensor  [m/s^2]  [m/s^2]  verdict",
        " " + "\u2500" * 39,
        "  S1       0.0123    0.001  good",
        "  S2            -        -  undetermined",
        "",
        "A note.",
        "",
    ]
    assert " " + "-" * 39 in drawn(TABLE, encoding="ascii").splitlines()


@given(st.integers(12, 60))
def test_no_number_is_lost_on_a_narrow_terminal(width):
    text = drawn(TABLE, width=width)
    assert all(word in text.split() for word in ("S1", "0.0123", "0.001", "good", "S2", "undetermined"))
    if width >= 30:
        assert max(len(line) for line in text.splitlines()) <= width


CURVE = [(1, 100.0), (50, 1.0), (100, 0.01)]


@pytest.mark.parametrize(
    ("curves", "width", "encoding", "seen"),
    [
        ({"": CURVE}, 40, "utf-8", True),
        ({"": CURVE}, 39, "utf-8", False),
        ({"": CURVE}, 80, "ascii", False),
        ({"pso": CURVE, "de": CURVE}, 48, "ascii", True),
        ({"pso": CURVE}, 47, "utf-8", False),
    ],
)
def test_a_curve_is_drawn_where_there_is_room_for_it(curves, width, encoding, seen):
    text = drawn(Convergence("Title", curves), width=width, encoding=encoding)
    assert text.startswith("Title\n") if seen else text == ""
    assert ("a pso" in text) == (seen and "pso" in curves)


DECADES = [(float(k), 10.0**-k) for k in range(11)]
"""A cost that falls by ten at every evaluation: a straight line from corner to corner."""


def cells(plot, height):
    """The rows of a plot without labels, of the same length."""
    rows = [line.partition("|")[2] for line in plot.splitlines()[:height]]
    return [row.ljust(max(map(len, rows))) for row in rows]


def dots(plot, height):
    """Places (column, row) of the Braille dots, left and right halves of a cell apart."""
    numbers = {(0, 0): 1, (0, 1): 2, (0, 2): 3, (1, 0): 4, (1, 1): 5, (1, 2): 6, (0, 3): 7, (1, 3): 8}
    return {
        (2 * column + x, 4 * row + y)
        for row, line in enumerate(cells(plot, height))
        for column, cell in enumerate(line)
        for (x, y), number in numbers.items()
        if cell != " " and (ord(cell) - 0x2800) >> (number - 1) & 1
    }


def test_a_straight_line_is_drawn_from_corner_to_corner():
    found = dots(draw_curve(DECADES, width=6, height=3), 3)  # 12 columns, 12 rows, 11 points
    expected = {(round(k * 11 / 10), round(k * 11 / 10)) for k in range(11)}
    assert expected <= found
    for column, row in found - expected:  # between two points the line goes down
        assert (column, row + 1) in found


@pytest.mark.parametrize("cost", [0.0, 1e-10])
def test_the_least_cost_and_none_at_all_are_on_the_floor(cost):
    found = dots(draw_curve([*DECADES, (11.0, cost)], width=6, height=3), 3)
    assert max(row for column, row in found if column == 11) == 11
    assert min(row for column, row in found if column == 0) == 0


def test_every_curve_is_at_the_height_of_its_cost():
    level = [(0.0, 1e-5), (10.0, 1e-5)]
    rows = cells(draw_curves({"falls": DECADES, "stays": level}, width=11, height=11), 11)
    for k in range(11):
        assert rows[k][k] in ("a", "b" if k == 5 else "a")
    assert set(rows[5]) == {"a", "b"}
    assert all("b" not in row for k, row in enumerate(rows) if k != 5)
