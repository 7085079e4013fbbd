"""Curves in the terminal: where the dots and letters stand."""

from __future__ import annotations

import pytest

from accelcal_cli.output.curve import draw, draw_several

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
    found = dots(draw(DECADES, width=6, height=3), 3)  # 12 columns, 12 rows, 11 points
    expected = {(round(k * 11 / 10), round(k * 11 / 10)) for k in range(11)}
    assert expected <= found
    for column, row in found - expected:  # between two points the line goes down
        assert (column, row + 1) in found


@pytest.mark.parametrize("cost", [0.0, 1e-10])
def test_the_least_cost_and_none_at_all_are_on_the_floor(cost):
    found = dots(draw([*DECADES, (11.0, cost)], width=6, height=3), 3)
    assert max(row for column, row in found if column == 11) == 11
    assert min(row for column, row in found if column == 0) == 0


def test_every_curve_is_at_the_height_of_its_cost():
    level = [(0.0, 1e-5), (10.0, 1e-5)]
    rows = cells(draw_several({"falls": DECADES, "stays": level}, width=11, height=11), 11)
    for k in range(11):
        assert rows[k][k] in ("a", "b" if k == 5 else "a")
    assert set(rows[5]) == {"a", "b"}
    assert all("b" not in row for k, row in enumerate(rows) if k != 5)
