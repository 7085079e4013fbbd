"""Tables: cells as text, rows as records."""

from __future__ import annotations

import pytest

from accelcal_cli.views.blocks import Column, Table


@pytest.mark.parametrize(
    ("value", "spec", "text"),
    [
        (1.23456, ".2f", "1.23"),
        (None, ".2f", "-"),
        (float("nan"), ".2f", "-"),
        ("word", ".2f", "word"),
        (7, "", "7"),
    ],
)
def test_cells(value, spec, text):
    assert Column("a", format=spec).text(value) == text


def test_records_are_keyed_by_the_columns():
    table = Table("t", (Column("a"), Column("b", key="b_2")), ((1, 2), (3, 4)))
    assert table.records() == [{"a": 1, "b_2": 2}, {"a": 3, "b_2": 4}]
    with pytest.raises(ValueError):
        Table("t", (Column("a"),), ((1, 2),)).records()
