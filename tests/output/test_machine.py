"""Tables and results for programs: all digits, nothing for what is missing, and names that any system can have."""

from __future__ import annotations

import io
import json
import math

import pytest

from accelcal_cli.output.machine import file_name, json_rows, write_csv, write_table
from accelcal_cli.views.blocks import Column, Table

TABLE = Table(
    "T",
    (Column("word"), Column("count", format="d"), Column("value", format=".2g", key="value_m")),
    (("a", 1, 1 / 3), ("b", None, math.nan), ("", 3, math.inf)),
)
RECORDS = [
    {"word": "a", "count": 1, "value_m": 1 / 3},
    {"word": "b", "count": None, "value_m": None},
    {"word": "", "count": 3, "value_m": None},
]
CSV = "word,count,value_m\na,1,0.3333333333333333\nb,,\n,3,\n"


def test_the_rows_of_a_table():
    assert json_rows([TABLE, TABLE]) == 2 * RECORDS
    file = io.StringIO()
    write_csv(TABLE, file)
    assert file.getvalue() == CSV


def test_a_table_is_written_by_the_ending_of_the_name(tmp_path):
    polars = pytest.importorskip("polars")
    for ending in ("csv", "json", "parquet"):
        write_table(TABLE, str(tmp_path / f"t.{ending}"))
    assert (tmp_path / "t.csv").read_text() == CSV
    assert json.loads((tmp_path / "t.json").read_text()) == RECORDS
    frame = polars.read_parquet(tmp_path / "t.parquet")
    assert frame.to_dicts() == RECORDS
    assert frame.dtypes == [polars.String, polars.Int64, polars.Float64]


@pytest.mark.parametrize(
    ("label", "name"), [("S 1", "S 1"), ("a/b", "a%2Fb"), ("50%", "50%25"), ("\n", "%0A")]
)
def test_a_label_becomes_a_file_name(label, name):
    assert file_name(label) == name
