"""No table is misread in silence, whichever way it is written."""

from __future__ import annotations

from hunt import hunt

RENDERINGS = 1000
"""`make hunt` tries ten times as many."""


def test_a_thousand_renderings_of_a_table_read_back_or_are_refused() -> None:
    counts, bad = hunt(RENDERINGS)
    assert [one for one in bad if one[1] == "misread"] == []
    assert counts["refused"] < 0.02 * RENDERINGS, bad
