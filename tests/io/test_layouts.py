"""Every row of the table of layouts in the documentation is read as it says."""

from __future__ import annotations

import csv
import io
import re
from pathlib import Path

import pytest

from accelcal_cli.io.columns import choose
from accelcal_cli.io.reader import TextTable
from accelcal_cli.io.stream import ByteSource

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "read-your-log.md"
LAYOUTS = re.findall(
    r"^\| (.+?) \| `(.+)` \| ([\d,]+) \| (\d*) ?\| ?(.*?) ?\|$", PAGE.read_text(), re.MULTILINE
)


def test_there_are_sixty_layouts() -> None:
    assert len(LAYOUTS) >= 60


@pytest.mark.parametrize(("tool", "header", "axes", "time", "unit"), LAYOUTS, ids=[row[0] for row in LAYOUTS])
def test_a_layout_is_known(tool: str, header: str, axes: str, time: str, unit: str) -> None:
    separator = ";" if ";" in header else ","
    width = len(next(csv.reader([header], delimiter=separator)))
    rows = [separator.join(str((7 * k + 3 * row) % 50 + 0.5) for k in range(width)) for row in range(4)]
    table = TextTable(ByteSource(io.BytesIO("\n".join([header, *rows, ""]).encode()), "f"))
    columns = choose(table)
    found = ",".join(str(k + 1) for k in columns.output)
    assert (found, "" if columns.time is None else str(columns.time + 1), columns.unit or "") == (
        axes,
        time,
        unit,
    )
