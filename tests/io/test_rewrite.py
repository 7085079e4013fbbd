"""Logs written anew: every byte that is not computed stays."""

from __future__ import annotations

import csv
import io

import numpy as np
import polars as pl
import pytest

from accelcal_cli.errors import DataError
from accelcal_cli.io import rewrite as module
from accelcal_cli.io.columns import choose
from accelcal_cli.io.reader import Selection, TextTable, open_table
from accelcal_cli.io.rewrite import Change, rewrite
from accelcal_cli.io.stream import ByteSource


def third(numbers):
    """Return fractions of many digits."""
    return numbers[:, :3] / 3.0


def run(data: bytes, *, replace=False, small=True, wanted=None, monkeypatch=None):
    """Return the changed log, by the careful writer, or by polars in small blocks."""
    sizes = {} if small else {"head": 200, "block": 150}
    if not small:
        monkeypatch.setattr(module, "SMALL", 0)
    table = TextTable(ByteSource(io.BytesIO(data), "log.csv", **sizes))
    columns = choose(table, wanted)
    change = Change(Selection(columns.output), third, ("fx", "fy", "fz"), columns.output if replace else ())
    out = io.BytesIO()
    rewrite(table, change, out)
    return out.getvalue()


def body(rows, separator=",", end="\n", start=0):
    cells = [
        [f"{k / 100:.2f}", f"{k}.125", f"-{k}.5", "9.81", f"note-{k}"] for k in range(start, start + rows)
    ]
    return "".join(separator.join(row) + end for row in cells)


HEADER = "t,ax,ay,az,remark\n"
LOGS = {
    "plain": HEADER + body(40),
    "no last line end": (HEADER + body(40)).rstrip("\n"),
    "carriage returns": (HEADER + body(40)).replace("\n", "\r\n"),
    "mixed line ends": HEADER + body(20) + body(20, end="\r\n", start=20),
    "semicolons": HEADER.replace(",", ";") + body(40, ";"),
    "tabs": HEADER.replace(",", "\t") + body(40, "\t"),
    "blanks around cells": "t, ax, ay, az, remark\n" + body(40, " , "),
    "comment and blank lines": HEADER + body(20) + "# a remark\n\n" + body(20, start=20) + "\n\n",
    "quotes": HEADER + body(40).replace("note-7", '"note, 7"').replace("note-9", '"x ""y"""'),
    "byte order mark": "\ufeff" + HEADER + body(40),
    "umlauts": HEADER + body(40).replace("note-3", "Prüfling 3"),
    "control characters": HEADER + body(40).replace("note-3", "a\x01b"),
    "empty last cells": HEADER + body(40).replace("note-1", ""),
}


def old_lines(text):
    return text.encode().splitlines(keepends=True)


def data_lines(text):
    return [line for line in text.splitlines()[1:] if line.strip(" ,;\t") and not line.startswith("#")]


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
@pytest.mark.parametrize("name", LOGS)
def test_columns_are_added_and_every_byte_stays(name, small, monkeypatch):
    text = LOGS[name]
    separator = next(s for s in (";", "\t", ",") if s in text.splitlines()[0])
    out = run(text.encode(), small=small, monkeypatch=monkeypatch)
    lines = out.splitlines(keepends=True)
    assert len(lines) == len(old_lines(text))
    rows = 0
    for old, new in zip(old_lines(text), lines, strict=True):
        plain = old.rstrip(b"\r\n")
        assert new.startswith(plain)
        assert new[len(new.rstrip(b"\r\n")) :] == old[len(plain) :]
        added = new.rstrip(b"\r\n")[len(plain) :].decode()
        if old.strip() == b"" or old.startswith(b"#"):
            assert added == ""
        elif rows == 0:
            assert added == separator + separator.join(("fx", "fy", "fz"))
            rows = 1
        else:
            k = rows - 1
            assert [float(v) for v in added.split(separator)[1:]] == [
                (k + 0.125) / 3,
                -(k + 0.5) / 3,
                9.81 / 3,
            ]
            rows += 1
    assert rows == 41


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
@pytest.mark.parametrize("name", LOGS)
def test_readings_are_replaced_and_the_other_cells_stay(name, small, monkeypatch):
    text = LOGS[name]
    separator = next(s for s in (";", "\t", ",") if s in text.splitlines()[0])
    out = run(text.encode(), replace=True, small=small, monkeypatch=monkeypatch).decode()
    old, new = text.splitlines(), out.splitlines()
    assert len(new) == len(old)
    assert [c.strip() for c in new[0].split(separator)][1:4] == ["fx", "fy", "fz"]
    for k, (before, after) in enumerate(zip(data_lines(text), data_lines(out), strict=True)):
        first, *_, last = before.split(separator, 4)
        cells = after.split(separator, 4)
        assert (cells[0], cells[4]) == (first, last)
        assert [float(c) for c in cells[1:4]] == [(k + 0.125) / 3, -(k + 0.5) / 3, 9.81 / 3]


def test_both_writers_read_back_to_the_same_numbers(monkeypatch):
    text = (HEADER + body(60)).encode()
    slow, fast = run(text), run(text, small=False, monkeypatch=monkeypatch)
    frames = [pl.read_csv(out) for out in (slow, fast)]
    assert frames[0].equals(frames[1])


def test_polars_is_used_for_plain_blocks(monkeypatch):
    monkeypatch.setattr(module._LineWriter, "_careful", lambda self, block, values: pytest.fail("not needed"))
    monkeypatch.setattr(module, "SMALL", 0)
    text = body(60).encode()
    assert run(text, wanted=["2", "3", "4"], small=False, monkeypatch=monkeypatch).count(b"\n") == 60


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
def test_blanks_between_the_cells(small, monkeypatch):
    text = "t    ax  ay\taz\n" + "".join(f"{k}   1.5  {k}.25\t9.8\n" for k in range(40))
    added = run(text.encode(), small=small, monkeypatch=monkeypatch).decode().splitlines()
    assert added[0] == "t    ax  ay\taz fx fy fz"
    assert added[5].startswith("4   1.5  4.25\t9.8 0.5 ")
    replaced = run(text.encode(), replace=True, small=small, monkeypatch=monkeypatch).decode().splitlines()
    assert replaced[0] == "t    fx  fy\tfz"
    assert replaced[5].startswith("4   0.5  1.41666")


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
@pytest.mark.parametrize("replace", [True, False])
def test_fractions_with_a_comma(small, replace, monkeypatch):
    text = "t;ax;ay;az\n" + "".join(f"{k},5;1,5;{k},25;9,8\n" for k in range(40))
    out = run(text.encode(), replace=replace, small=small, monkeypatch=monkeypatch).decode().splitlines()
    cells = out[5].split(";")
    assert cells[0] == "4,5"
    assert [float(c.replace(",", ".")) for c in cells[-3:]] == [0.5, 4.25 / 3, 9.8 / 3]
    assert "." not in out[5]


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
@pytest.mark.parametrize("replace", [True, False])
def test_fractions_with_a_comma_between_commas_are_quoted(small, replace, monkeypatch):
    text = "t,ax,ay,az\n" + "".join(f'"{k},5","1,5","{k},25","9,8"\n' for k in range(40))
    out = run(text.encode(), replace=replace, small=small, monkeypatch=monkeypatch).decode()
    rows = list(csv.reader(io.StringIO(out)))
    assert {len(row) for row in rows} == {4 if replace else 7}
    assert [float(c.replace(",", ".")) for c in rows[5][-3:]] == [0.5, 4.25 / 3, 9.8 / 3]


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
def test_a_separator_at_the_end_of_the_lines_is_no_column(small, monkeypatch):
    text = "ax,ay,az,\n" + "".join(f"1.5,{k}.25,9.8,\n" for k in range(40))
    out = run(text.encode(), small=small, monkeypatch=monkeypatch).decode().splitlines()
    assert out[0] == "ax,ay,az,fx,fy,fz"
    assert out[5].split(",")[:4] == ["1.5", "4.25", "9.8", "0.5"]


@pytest.mark.parametrize("small", [True, False], ids=["careful", "polars"])
def test_no_header_and_names_in_a_comment(small, monkeypatch):
    rows = "".join(f"{k},1.5,{k}.25,9.8\n" for k in range(40))
    plain = run(rows.encode(), small=small, wanted=["2", "3", "4"], monkeypatch=monkeypatch).decode()
    assert plain.splitlines()[4].startswith("4,1.5,4.25,9.8,0.5,")
    named = run(("# t,ax,ay,az\n" + rows).encode(), small=small, monkeypatch=monkeypatch).decode()
    assert named.splitlines()[0] == "# t,ax,ay,az,fx,fy,fz"
    again = run(named.encode(), small=small, wanted=["ax", "ay", "az"], monkeypatch=monkeypatch).decode()
    assert again.splitlines()[0] == "# t,ax,ay,az,fx,fy,fz,fx,fy,fz"


def test_a_wrong_cell_is_named_after_any_number_of_rows(monkeypatch):
    text = (HEADER + body(60) + "1,2,nan,4,x\n").encode()
    for small in (True, False):
        with pytest.raises(DataError, match=r'log.csv, line 62, column "ay"'):
            run(text, small=small, monkeypatch=monkeypatch)


@pytest.fixture
def parquet(tmp_path):
    frame = pl.DataFrame(
        {
            "t": range(50),
            "ax": np.linspace(0, 1, 50),
            "ay": range(50),
            "az": [9.8] * 50,
            "remark": ["x", None] * 25,
        }
    )
    frame.write_parquet(tmp_path / "log.parquet")
    return tmp_path / "log.parquet", frame


@pytest.mark.parametrize("replace", [True, False])
@pytest.mark.parametrize("rows", [20, 500_000])
def test_parquet_to_parquet_and_to_text(parquet, replace, rows, tmp_path, monkeypatch):
    from accelcal_cli.io import parquet as reader
    from accelcal_cli.io.parquet import to_parquet, to_text

    monkeypatch.setattr(reader, "ROWS", rows)
    path, frame = parquet
    for write, read in ((to_parquet, pl.read_parquet), (to_text, pl.read_csv)):
        table = open_table(path, hashed=False)
        change = Change(Selection((1, 2, 3)), third, ("fx", "fy", "fz"), (1, 2, 3) if replace else ())
        with (tmp_path / "out").open("wb") as file:
            write(table, change, file)
        table.close()
        made = read(tmp_path / "out")
        names = ["t", "fx", "fy", "fz", "remark"] if replace else [*frame.columns, "fx", "fy", "fz"]
        assert made.columns == names
        np.testing.assert_array_equal(made["fx"], frame["ax"].to_numpy() / 3.0)
        assert made["remark"].to_list() == frame["remark"].to_list()


def test_a_wrong_value_in_parquet_is_named(tmp_path, monkeypatch):
    from accelcal_cli.io import parquet as reader
    from accelcal_cli.io.parquet import to_parquet

    monkeypatch.setattr(reader, "ROWS", 10)
    pl.DataFrame({"ax": [1.0] * 40, "ay": [2.0] * 40, "az": [3.0] * 34 + [None] * 6}).write_parquet(
        tmp_path / "a.parquet"
    )
    table = open_table(tmp_path / "a.parquet", hashed=False)
    with (tmp_path / "out").open("wb") as file, pytest.raises(DataError, match=r'row 35, column "az"'):
        to_parquet(table, Change(Selection((0, 1, 2)), third, ("fx", "fy", "fz")), file)
    table.close()
