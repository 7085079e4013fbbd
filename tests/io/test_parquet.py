"""Parquet files, from disk and from standard input."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from accelcal_cli.arrays import Float
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io import parquet
from accelcal_cli.io.columns import choose
from accelcal_cli.io.reader import ReadOptions, Selection, TextTable
from accelcal_cli.io.readings import read_readings
from accelcal_cli.io.rewrite import Change, rewrite
from accelcal_cli.io.stream import ByteSource

ROWS = np.random.default_rng(5).normal(size=(1000, 3))


def write(path: Path, **columns: Any) -> Path:
    axes = {name: ROWS[:, k] for k, name in enumerate(("ax", "ay", "az"))}
    pl.DataFrame({**axes, **columns}).write_parquet(path, row_group_size=300)
    return path


def test_same_rows_from_disk_and_standard_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parquet, "ROWS", 170)
    path = write(tmp_path / "poses.parquet", t=np.arange(1000))
    for source in (str(path), "-"):
        with path.open("rb") as stream:
            readings = read_readings(source, stdin=stream)
        np.testing.assert_array_equal(readings.output(), ROWS)
        assert readings.sha256 == hashlib.sha256(path.read_bytes()).hexdigest()
        assert readings.where(0) == "row 1"
        assert readings.where(999) == "row 1000"


def test_known_by_its_bytes_not_its_name(tmp_path: Path) -> None:
    assert read_readings(write(tmp_path / "poses.dat")).poses == 1000


def test_labels_and_whole_numbers(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.parquet", pose=np.arange(1000) % 20, n=np.full(1000, 2))
    readings = read_readings(path)
    assert readings.labels == tuple(str(k) for k in range(20))
    np.testing.assert_allclose(readings.output(), ROWS.reshape(50, 20, 3).mean(axis=0), rtol=1e-12)
    assert readings.count is not None
    assert readings.count.tolist() == [100] * 20


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ({"ax": [*ROWS[:7, 0], None, *ROWS[8:, 0]]}, 'row 8, column "ax": is empty or nan'),
        ({"ay": [*ROWS[:7, 0], np.inf, *ROWS[8:, 0]]}, 'row 8, column "ay": inf is too large or infinite'),
        ({"az": ["up"] * 1000}, 'column "az": does not hold numbers'),
        (
            {"pose": [[1, 2]] * 1000},
            'column "pose": holds List\\(Int64\\); text or numbers were expected as labels',
        ),
        ({"pose": [b"\xff\xfe"] * 1000}, 'column "pose": holds Binary; text or numbers were expected'),
        ({"pose": ["up", None] * 500}, 'row 2, column "pose": is empty'),
    ],
)
def test_bad_cells(tmp_path: Path, columns: dict[str, Any], message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_readings(write(tmp_path / "poses.parquet", **columns))


def test_bytes_that_are_text_are_labels(tmp_path: Path) -> None:
    readings = read_readings(write(tmp_path / "poses.parquet", pose=[b"up", b"down"] * 500))
    assert readings.labels == ("up", "down")


def test_no_such_column(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match='no column "aq"'):
        read_readings(write(tmp_path / "poses.parquet"), ["ax", "ay", "aq"])


def test_no_rows(tmp_path: Path) -> None:
    path = tmp_path / "poses.parquet"
    pl.DataFrame({"ax": [], "ay": [], "az": []}).write_parquet(path)
    with pytest.raises(DataError, match="no readings"):
        read_readings(path)


def test_broken_files(tmp_path: Path) -> None:
    path = write(tmp_path / "poses.parquet")
    data = path.read_bytes()
    for broken in (
        data[: len(data) // 2],
        b"PAR1",
        b"not Parquet at all",
        b"PAR1" + b"\0" * 50 + b"PAR1",
        b"",
    ):
        path.write_bytes(broken)
        with pytest.raises(DataError, match=r"poses\.parquet: cannot be read as Parquet \(.+\)$"):
            read_readings(path)


# Text logs written as Parquet


def third(numbers: Float) -> Float:
    """Return fractions of many digits."""
    return numbers[:, :3] / 3.0


def changed(
    data: str, path: Path, *, replace: bool = False, blocks: bool = False, **options: Any
) -> tuple[pl.DataFrame, bytes]:
    """Return a text log with new columns as Parquet and as text; `blocks` reads it in small ones."""
    sizes = {"head": 200, "block": 150} if blocks else {}

    def table() -> tuple[TextTable, Change]:
        source = ByteSource(io.BytesIO(data.encode()), "log.csv", **sizes)
        table = TextTable(source, ReadOptions(**options))
        output = choose(table).output
        return table, Change(Selection(output), third, ("fx", "fy", "fz"), output if replace else ())

    with path.open("wb") as file:
        parquet.to_parquet(*table(), file)
    text = io.BytesIO()
    rewrite(*table(), text)
    return pl.read_parquet(path), text.getvalue()


HEADER = "t,ax,ay,az,remark,n\n"
BODY = [f"{1_700_000_000_000_000_000 + k},{k}.125,-{k}.5,9.81,note-{k},{k}\n" for k in range(40)]
LOGS = {
    "plain": HEADER + "".join(BODY),
    "no last line end": (HEADER + "".join(BODY)).rstrip("\n"),
    "carriage returns": (HEADER + "".join(BODY)).replace("\n", "\r\n"),
    "empty cells": HEADER + "".join(BODY[:20]) + "5,1,2,3,,\n" + "".join(BODY[20:]),
    "quotes": HEADER + "".join(BODY[:20]) + '5,1,2,3,"a, b",7\n' + "".join(BODY[20:]),
}


@pytest.mark.parametrize("blocks", [False, True], ids=["whole", "blocks"])
@pytest.mark.parametrize("replace", [False, True], ids=["added", "in place"])
@pytest.mark.parametrize("name", LOGS)
def test_text_as_parquet_is_the_text_with_types(
    tmp_path: Path, name: str, replace: bool, blocks: bool
) -> None:
    made, text = changed(LOGS[name], tmp_path / "out.parquet", replace=replace, blocks=blocks)
    assert made.equals(pl.read_csv(text))
    assert made.schema["t"] == pl.Int64
    assert made["t"][0] == 1_700_000_000_000_000_000


@pytest.mark.parametrize("blocks", [False, True], ids=["whole", "blocks"])
def test_a_column_is_what_all_of_its_cells_are(tmp_path: Path, blocks: bool) -> None:
    header = "ax,ay,az,whole,mixed,late,code,empty,sparse\n"
    rows = [f"{k},{k}.5,9.8,{k},{k},{k},{k:03d},,\n" for k in range(60)]
    rows[41] = "1,2,3,-7,4.25,n/a,007,,12\n"
    made, _ = changed(header + "".join(rows), tmp_path / "out.parquet", blocks=blocks)
    kinds = {name: made.schema[name] for name in made.columns[:9]}
    number, text = pl.Float64, pl.String
    assert list(kinds.values()) == [number, number, number, pl.Int64, number, text, text, text, pl.Int64]
    assert (made["whole"][41], made["mixed"][41], made["late"][41], made["code"][3]) == (
        -7,
        4.25,
        "n/a",
        "003",
    )
    assert made["empty"].null_count() == 60
    assert made["sparse"].drop_nulls().to_list() == [12]


def test_decimal_commas_are_points_in_parquet(tmp_path: Path) -> None:
    rows = [f"0,{k};{k},5;{k},25;-9,8;1,{k % 10};x,{k};1.234\n" for k in range(30)]
    made, _ = changed("t;ax;ay;az;u;s;w\n" + "".join(rows), tmp_path / "out.parquet", blocks=True)
    assert made.row(7)[:7] == (0.7, 7.5, 7.25, -9.8, 1.7, "x,7", "1.234")


def test_lines_that_are_no_rows_are_not_in_parquet(tmp_path: Path) -> None:
    rows = [f"{k},{k}.5,9.8,{k},# {k}\n" for k in range(60)]
    rows[30] = "1,bad,2,3,4\n"
    rows[20:20] = ["ax,ay,az,n,remark\n", "\n", "# a comment\n"]
    data = "Exported by X\n\nax,ay,az,n,remark\ng,g,g,,\n" + "".join(rows) + "7,8"
    made, _ = changed(data, tmp_path / "out.parquet", skip_bad=True)
    assert made.columns == ["ax", "ay", "az", "n", "remark", "fx", "fy", "fz"]
    assert made["n"].to_list() == [k for k in range(60) if k != 30]
    with pytest.raises(DataError, match='column "ay": "bad" is not a number'):
        changed(data, tmp_path / "out.parquet")


def test_columns_without_a_name_of_their_own_get_their_numbers(tmp_path: Path) -> None:
    made, _ = changed("".join(f"{k},{k}.5,9.8\n" for k in range(9)), tmp_path / "out.parquet")
    assert made.columns == ["1", "2", "3", "fx", "fy", "fz"]
    data = ",ax,ay,az,s,s\n" + "".join(f"{k},{k}.5,9.8,1,2,3\n" for k in range(9))
    made, _ = changed(data, tmp_path / "out.parquet")
    assert made.columns == ["1", "ax", "ay", "az", "s", "s_6", "fx", "fy", "fz"]
