"""Readings: what a file says, pose by pose, and one clear message for every file that says nothing."""

from __future__ import annotations

import hashlib
import io
import os
import pickle
import subprocess
import sys
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from accelcal_cli.errors import DataError
from accelcal_cli.io import readings as collect
from accelcal_cli.io import stream as spool
from accelcal_cli.io.readings import LabelledMeans, Readings, read_readings

GOOD = "ax,ay,az\n1,2,3\n4,5,6\n7,8,9.5\n"


def read(text: str | bytes, columns: list[str] | None = None) -> Readings:
    data = text.encode() if isinstance(text, str) else text
    return read_readings("-", columns, stdin=io.BytesIO(data))


def test_what_a_file_says(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(GOOD)
    readings = read_readings(path)
    assert readings.source == str(path)
    assert readings.sha256 == hashlib.sha256(GOOD.encode()).hexdigest()
    assert readings.columns == ("ax", "ay", "az")
    assert readings.poses == 3
    assert readings.lower.tolist() == [1, 2, 3]
    assert readings.upper.tolist() == [7, 8, 9.5]
    assert readings.output().tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9.5]]
    assert [readings.where(pose) for pose in range(3)] == ["line 2", "line 3", "line 4"]
    assert (readings.labels, readings.count, readings.scatter) == (None, None, None)
    assert (readings.reference, readings.temperature, readings.notes) == (None, None, ())


def test_blocks_can_be_read_again_and_again() -> None:
    readings = read(GOOD)
    for _ in range(2):
        blocks = [(start, block.tolist()) for start, block in readings.blocks(2)]
        assert blocks == [(0, [[1, 2, 3], [4, 5, 6]]), (2, [[7, 8, 9.5]])]


def test_readings_travel_to_another_process() -> None:
    readings = pickle.loads(pickle.dumps(read(GOOD)))
    assert readings.output().tolist() == [[1, 2, 3], [4, 5, 6], [7, 8, 9.5]]
    assert readings.where(1) == "line 3"


def test_lines_are_counted_as_in_the_file() -> None:
    readings = read("\n# by hand\nax ay az\n\n1 2 3\n# moved\n4 5 6\n7 8 9\n\n \n1 1 1\n")
    assert [readings.where(pose) for pose in range(4)] == ["line 5", "line 7", "line 8", "line 11"]


def test_every_optional_column() -> None:
    header = "pose,n,ax,ay,az,sx,sy,sz,fx,fy,fz,T\n"
    readings = read(header + "up,3,1,2,3,.1,.2,.3,0,0,9,20\ndown,1,4,5,6,,nan,0.5,0,0,-9,\n")
    assert readings.labels == ("up", "down")
    assert readings.where(1) == 'position "down"'
    assert readings.count is not None
    assert readings.count.tolist() == [3, 1]
    np.testing.assert_array_equal(readings.scatter, [[0.1, 0.2, 0.3], [np.nan, np.nan, 0.5]])
    np.testing.assert_array_equal(readings.reference, [[0, 0, 9], [0, 0, -9]])
    np.testing.assert_array_equal(readings.temperature, [20, np.nan])


def test_rows_of_one_label_are_averaged() -> None:
    readings = read("label,ax,ay,az\nup,1,2,3\ndown,0,0,1\nup,3,2,3\nup,5,2,6\n")
    assert readings.labels == ("up", "down")
    np.testing.assert_allclose(readings.output(), [[3, 2, 4], [0, 0, 1]], rtol=1e-15)
    np.testing.assert_allclose(readings.scatter, [[2, 0, np.sqrt(3)], [np.nan] * 3], rtol=1e-15)
    assert readings.count is not None
    assert readings.count.tolist() == [3, 1]
    assert readings.lower.tolist() == [0, 0, 1]
    assert "4 rows averaged into 2 positions by label" in readings.notes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "<stdin>: is empty"),
        ("ax,ay,az\n", "<stdin>: has a header but no readings"),
        ("u,v,w,p\n", "<stdin>: has a header but no readings"),
        ("1,2,3\n", "only one pose"),
        ("label,ax,ay,az\nup,1,2,3\nup,4,5,6\n", "only one pose"),
        ("1,2,3\n1,2,3\n", r"all 2 readings are equal, \(1, 2, 3\)"),
        (GOOD + "1,two,3\n", '<stdin>, line 5, column "ay": "two" is not a number'),
        ("1,2,3\n1,2,3e\n", '<stdin>, line 2, column 3: "3e" is not a number'),
        (GOOD + f"1,2,{'y' * 99}\n", f'"{"y" * 40}..." is not a number'),
        (GOOD + "1,,3\n", 'line 5, column "ay": is empty; a number was expected'),
        (GOOD + "1,nan,3\n", '"nan" is not a finite number'),
        (GOOD + "1,-inf,3\n", '"-inf" is not a finite number'),
        (GOOD + "1,1e999,3\n", '"1e999" is not a finite number'),
        (GOOD + "1,2e100,3\n", '"2e100" is too large'),
        (GOOD + "1,1_000,3\n", '"1_000" is not a number'),
        (GOOD + "1,2\n", "line 5: has 2 cells where the header has 3"),
        (GOOD + "1\n", "line 5: has 1 cell where the header has 3"),
        (GOOD + "1,2,3,4\n", "line 5: has 4 cells where the header has 3"),
        ("1,2,3\n1,2,3,4\n", "line 2: has 4 cells where the first row has 3"),
        (GOOD + '1,"2,3\n', "line 5: a quotation mark is not closed"),
        (GOOD.encode() + b"1,\xe9,3\n", 'line 5, column "ay": "é" is not a number'),
        (
            b"PK\x03\x04.......",
            "Excel workbook, that cannot be read .*; unpack it, or export the sheet as CSV",
        ),
        (b"\x1f\x8b.......", "gzip data are damaged"),
        (GOOD.encode() + b"1,\0,3\n", "line 5: holds NUL bytes"),
        (b"1," * 600_000, "line 1: is longer than 1 MB"),
        (GOOD.encode() + b"1," * 600_000, "line 5: is longer than 1 MB"),
        ("n,ax,ay,az\n1,1,2,3\n0,4,5,6\n", 'line 3, column "n": a count of 1 or more'),
        ("n,ax,ay,az\n1,1,2,3\n1.5,4,5,6\n", 'line 3, column "n": a count of 1 or more'),
        ("ax,ay,az,sx,sy,sz\n1,2,3,1,1,1\n1,2,3,1,-1,1\n", 'line 3, column "sy": a standard deviation of 0'),
        ("ax,ay,az,fx,fy,fz\n1,2,3,1,1,1\n1,2,3,1,,1\n", 'line 3, column "fy": is empty'),
        ("label,ax,ay,az\nup,1,2,3\n,4,5,6\n", 'line 3, column "label": is empty'),
    ],
)
def test_one_clear_message(text: str | bytes, message: str) -> None:
    with pytest.raises(DataError) as problem:
        read(text)
    assert "\n" not in str(problem.value)
    problem.match(message)


def test_missing_file_names_its_neighbour(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(GOOD)
    with pytest.raises(DataError, match=r'pose\.csv: no such file \(did you mean "poses\.csv"\?\)'):
        read_readings(tmp_path / "pose.csv")
    with pytest.raises(DataError, match=r"no such file; the folder .* does not exist either"):
        read_readings(tmp_path / "nowhere" / "poses.csv")


def test_foreign_file(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_bytes(b"PK\x03\x04")
    with pytest.raises(DataError, match=r"poses\.csv: is a zip archive"):
        read_readings(path)


def test_folder_and_locked_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="is a directory"):
        read_readings(tmp_path)
    with pytest.raises(DataError, match="cannot be opened"):
        read_readings("a\0b")
    locked = tmp_path / "locked.csv"
    locked.write_text(GOOD)
    locked.chmod(0)
    if os.access(locked, os.R_OK):
        pytest.skip("this user may read everything")
    with pytest.raises(DataError, match="no permission"):
        read_readings(locked)


class Endless(io.RawIOBase):
    """A head, then one line again and again; counts what was asked of it."""

    def __init__(self, head: bytes, line: bytes) -> None:
        self.head, self.line, self.given = io.BytesIO(head), line, 0

    def read(self, size: int = -1) -> bytes:
        if head := self.head.read(size):
            return head
        at = self.given % len(self.line)
        self.given += size
        return (self.line * (size // len(self.line) + 2))[at : at + size]


@pytest.mark.parametrize(
    ("line", "most", "message"),
    [
        (b"\0", 8 << 20, "NUL"),
        (b"7", 8 << 20, "longer than 1 MB"),
        (b"0,0,0\n", 80 << 20, "first [0-9,]+ readings are all equal"),
        (b"up,0,0,0\n", 80 << 20, "first [0-9,]+ readings are all equal"),
    ],
)
def test_endless_nonsense_is_cut_off(line: bytes, most: int, message: str) -> None:
    head = b"label,ax,ay,az\n" if line.startswith(b"up") else b""
    stream = Endless(head, line)
    with pytest.raises(DataError, match=message):
        read_readings("-", stdin=cast(BinaryIO, stream))
    assert stream.given <= most


def test_more_rows_than_memory_takes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(collect, "IN_MEMORY", 100)
    monkeypatch.setattr(spool.RowStore.__init__, "__defaults__", (3, 100))
    rows = np.random.default_rng(1).normal(size=(1000, 4))
    path = tmp_path / "long.csv"
    np.savetxt(path, rows, delimiter=",", header="ax,ay,az,T", comments="", fmt="%.17g")
    readings = read_readings(path)
    np.testing.assert_array_equal(readings.output(), rows[:, :3])
    np.testing.assert_array_equal(np.concatenate([block for _, block in readings.blocks(7)]), rows[:, :3])
    assert readings.temperature is None
    assert "columns other than the readings are not used: more than 100 poses" in readings.notes


def test_large_file_in_several_blocks(tmp_path: Path) -> None:
    """Beyond the head polars takes over; numbers, lines and hash do not notice."""
    rows = np.random.default_rng(2).normal(size=(150_000, 3)).round(9)
    lines = [f"{x},{y},{z}" for x, y, z in rows.tolist()]
    lines.insert(100_000, "# a pause")
    data = ("ax,ay,az\n" + "\n".join(lines)).encode()
    assert len(data) > 4 << 20
    path = tmp_path / "large.csv"
    path.write_bytes(data)
    readings = read_readings(path)
    np.testing.assert_array_equal(readings.output(), rows)
    assert readings.sha256 == hashlib.sha256(data).hexdigest()
    assert readings.where(99_999) == "line 100001"
    assert readings.where(100_000) == "line 100003"
    path.write_bytes(data + b"\n1,2,oops\n")
    with pytest.raises(DataError, match=r'line 150003, column "az": "oops" is not a number'):
        read_readings(path)


def test_small_files_do_without_polars(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text(GOOD)
    code = (
        "import sys; from accelcal_cli.io.readings import read_readings; "
        f"read_readings({str(path)!r}); sys.exit('polars' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_from_array() -> None:
    readings = Readings.from_array(
        [[1, 2, 3], [4, 5, 6]],
        labels=["a", "b"],
        count=[1, 2],
        scatter=[[1, 1, 1], [np.nan, 0, 0]],
        reference=[[0, 0, 1], [0, 1, 0]],
        temperature=[20, np.nan],
    )
    assert readings.output().tolist() == [[1, 2, 3], [4, 5, 6]]
    assert readings.upper.tolist() == [4, 5, 6]
    assert readings.where(0) == 'position "a"'
    assert Readings.from_array([[1, 2, 3], [4, 5, 6]]).where(1) == "pose 2"
    assert len(readings.sha256) == 64


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"output": [[1, 2], [3, 4]]}, r"output: an array of shape \(J, 3\) was expected, not \(2, 2\)"),
        ({"output": [[1, 2, 3], [4, np.nan, 6]]}, "output: row 1 is not finite"),
        ({"output": [[1, 2, 3]]}, "only one pose"),
        ({"output": [[1, 2, 3]] * 2}, "are equal"),
        ({"labels": ["a"]}, "2 different labels"),
        ({"labels": ["a", "a"]}, "2 different labels"),
        ({"count": [1, 0]}, "count: whole numbers of 1 or more"),
        ({"count": [1]}, r"count: an array of shape \(2,\) was expected, not \(1,\)"),
        ({"scatter": [1, 2]}, r"scatter: an array of shape \(2, 3\)"),
        ({"reference": [[1, 2, 3], [1, 2, np.nan]]}, "reference: row 1"),
    ],
)
def test_from_array_checks(arguments: dict[str, object], message: str) -> None:
    given = {"output": [[1, 2, 3], [4, 5, 6]], **arguments}
    with pytest.raises(DataError, match=message):
        Readings.from_array(**given)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "columns", "poses", "first"),
    [
        ("imu_tk_xsens/static_means.csv", ("Nx", "Ny", "Nz"), 38, [33102.2268, 33330.5509, 36433.7506]),
        (
            "mikoff_mpu9150/imu0_static_means.csv",
            ("ax", "ay", "az"),
            23,
            [-8.4194935, -0.073803939, 5.234753],
        ),
        ("mikoff_mpu9150/imu1_static_means.csv", ("ax", "ay", "az"), 24, [8.5788284, 0.056866601]),
        (
            "ctu_innalabs/static_24.csv",
            ("ax_g", "ay_g", "az_g"),
            24,
            [-0.0350271198, -0.0602452213, 1.01959592],
        ),
    ],
)
def test_real_recordings(
    shared_data: Path, name: str, columns: tuple[str, ...], poses: int, first: list[float]
) -> None:
    readings = read_readings(shared_data / name)
    assert (readings.columns, readings.poses) == (columns, poses)
    assert readings.output()[0].tolist()[: len(first)] == first


def test_real_repeats(shared_data: Path) -> None:
    readings = read_readings(shared_data / "imu_tk_xsens" / "static_means.csv")
    assert readings.count is not None
    assert readings.scatter is not None
    assert (readings.count[0], readings.scatter[0].tolist()) == (5141, [3.3517388, 3.18831612, 3.38025597])


def test_real_raw_log(shared_data: Path) -> None:
    readings = read_readings(shared_data / "imu_tk_xsens" / "xsens_acc.txt", ["2", "3", "4"])
    assert (readings.poses, readings.columns) == (51175, ("2", "3", "4"))
    assert readings.output()[0].tolist() == [33108, 33329, 36429]


# Averages of repeated readings, against the plain formulas on all rows at once


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 6), st.integers(1, 15))
def test_blocks_do_not_matter(seed: int, rows: int, labels: int, block: int) -> None:
    rng = np.random.default_rng(seed)
    names = rng.integers(0, labels, rows).astype(str)
    values = rng.normal(1e6, 1.0, (rows, 4))  # an offset that would spoil sums of squares
    means = LabelledMeans("f", 4)
    for start in range(0, rows, block):
        means.add(names[start : start + block].tolist(), values[start : start + block])
    scatter = means.scatter()
    for label, k in means.index.items():
        own = values[names == label]
        np.testing.assert_allclose(means.mean[k], own.mean(axis=0), rtol=1e-14)
        if len(own) > 1:
            assert scatter is not None
            np.testing.assert_allclose(scatter[k], own[:, :3].std(axis=0, ddof=1), rtol=1e-8)


def test_means_of_raw_readings_pool_to_the_raw_readings() -> None:
    """Rows that are means with n and a standard deviation give what their raw readings would have given."""
    rng = np.random.default_rng(3)
    parts = [rng.normal(10, 2, (n, 3)) for n in (5, 1, 40)]
    means = LabelledMeans("f", 3)
    with np.errstate(all="raise"):
        for part in parts:
            spread = part.std(axis=0, ddof=1) if len(part) > 1 else np.full(3, np.nan)
            means.add(["up"], part.mean(axis=0)[None], np.array([len(part)]), spread[None])
    whole = np.concatenate(parts)
    count, scatter = means.count(), means.scatter()
    assert count is not None
    assert scatter is not None
    assert count.tolist() == [46]
    np.testing.assert_allclose(means.mean[0], whole.mean(axis=0), rtol=1e-14)
    np.testing.assert_allclose(scatter[0], whole.std(axis=0, ddof=1), rtol=1e-12)


def test_means_without_spread_tell_it_by_their_own_scatter() -> None:
    """The variance of means of n readings is that of one reading over n."""
    rng = np.random.default_rng(4)
    means = LabelledMeans("f", 3)
    size = 20_000
    means.add(["up"] * size, rng.normal(0, 3 / np.sqrt(25), (size, 3)), np.full(size, 25.0))
    scatter = means.scatter()
    assert scatter is not None
    np.testing.assert_allclose(scatter[0], 3, rtol=0.05)


def test_equal_rows_scatter_not_at_all() -> None:
    means = LabelledMeans("f", 3)
    for _ in range(3):
        means.add(["up", "up"], np.full((2, 3), 0.1))
    assert means.mean[0].tolist() == [0.1, 0.1, 0.1]
    scatter = means.scatter()
    assert scatter is not None
    assert scatter[0].tolist() == [0, 0, 0]


def test_single_rows_keep_what_they_state() -> None:
    means = LabelledMeans("f", 3)
    means.add(["a", "b"], np.ones((2, 3)), np.array([1.0, 7.0]), np.array([[0.5] * 3, [0.1] * 3]))
    scatter = means.scatter()
    assert scatter is not None
    assert scatter.tolist() == [[0.5] * 3, [0.1] * 3]
    assert not means.repeated


def test_too_many_labels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(collect, "MOST_LABELS", 3)
    with pytest.raises(DataError, match="f: more than 3 different position labels"):
        LabelledMeans("f", 3).add(["a", "b", "c", "d"], np.ones((4, 3)))
