"""The console draws any block, and every table whole on a terminal of any width."""

from __future__ import annotations

import io

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from accelcal_cli.output.console import show
from accelcal_cli.table import Column, Table
from accelcal_cli.views.blocks import BLANK, Conclusion, Convergence, Paragraph, notes

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
    assert drawn(Paragraph("aaa bbb ccc", indent=2), width=10) == "  aaa bbb\n  ccc\n"


def test_a_conclusion_has_its_reasons_and_its_cautions():
    text = drawn(Conclusion("weak", ["Because."], ["Look."], "Verdict so far"))
    assert text == "Verdict so far: weak\n  Because.\nCaution: Look.\n"


@pytest.mark.parametrize(("cautions", "code"), [((), "32"), (("But.",), "33")])
def test_there_is_no_green_light_with_a_caution_under_it(cautions, code):
    assert f"\x1b[1;{code}mgood" in drawn(Conclusion("good", (), cautions), color="standard")


def test_a_table_has_units_and_aligned_numbers():
    assert drawn(TABLE).splitlines() == [
        "Sensors",
        "",
        "               rms     sigma",
        "  sensor   [m/s^2]   [m/s^2]   verdict",
        " " + "\u2500" * 43,
        "  S1        0.0123     0.001   good",
        "  S2             -         -   undetermined",
        "",
        "A note.",
        "",
    ]
    assert " " + "-" * 43 in drawn(TABLE, encoding="ascii").splitlines()


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
