"""Parquet files, from disk and from standard input."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
import pytest

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io import parquet
from accelcal_cli.io.readings import read_readings

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
