"""Packed files are read as the text that they hold; the row store gives back what was put in, from memory or disk."""

from __future__ import annotations

import gzip
import hashlib
import io
import tempfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from accelcal_cli.errors import DataError
from accelcal_cli.io import stream
from accelcal_cli.io.readings import read_readings
from accelcal_cli.io.stream import RowStore


@settings(max_examples=50, deadline=None)
@given(st.lists(st.integers(0, 20), max_size=12), st.integers(0, 60), st.integers(1, 30))
def test_rows_come_back_in_order(sizes: list[int], limit: int, block: int) -> None:
    rows = np.random.default_rng(0).normal(size=(sum(sizes), 3))
    store = RowStore(3, limit)
    for end, size in zip(np.cumsum(sizes), sizes, strict=True):
        store.append(rows[end - size : end])
    assert store.rows == len(rows)
    for _ in range(2):
        blocks = list(store.blocks(block))
        assert [start for start, _ in blocks] == list(range(0, len(rows), block))
        np.testing.assert_array_equal(np.concatenate([np.empty((0, 3)), *(b for _, b in blocks)]), rows)
    np.testing.assert_array_equal(store.all(), rows)


def test_two_readers_and_a_late_writer_do_not_disturb_each_other() -> None:
    store = RowStore(1, limit=0)
    store.append(np.arange(6.0)[:, None])
    one, other = store.blocks(2), store.blocks(3)
    assert next(one)[1].ravel().tolist() == [0, 1]
    assert next(other)[1].ravel().tolist() == [0, 1, 2]
    store.append(np.array([[6.0]]))
    assert next(one)[1].ravel().tolist() == [2, 3]
    assert store.all().ravel().tolist() == [0, 1, 2, 3, 4, 5, 6]


def test_what_is_stored_cannot_be_changed_from_outside() -> None:
    rows = np.ones((2, 3))
    store = RowStore()
    store.append(rows)
    rows[:] = 7
    assert store.all().tolist() == [[1, 1, 1], [1, 1, 1]]
    with pytest.raises(ValueError, match="read-only"):
        store.all()[0] = 5


def test_full_disk_is_said_clearly(monkeypatch: pytest.MonkeyPatch) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("needs /dev/full")
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: io.FileIO("/dev/full", "r+"))
    store = RowStore(3, limit=0)
    store.append(np.ones((100_000, 3)))
    with pytest.raises(DataError, match=r"temporary file .* failed \(No space left on device\); free some"):
        store.all()


TEXT = "Gerät: 3 °C\nax,ay,az\n" + "".join(f"{k},{k * k % 17},{20 - k}\n" for k in range(40))


def zipped(**files: str) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return file.getvalue()


@pytest.mark.parametrize(
    ("data", "form"),
    [
        (gzip.compress(TEXT.encode()), "gzip"),
        (zipped(log=TEXT), "zip"),
        (TEXT.encode("utf-16"), "UTF-16"),
        (TEXT.encode("utf-16-le"), "UTF-16"),
        (TEXT.encode("latin-1"), "Latin-1"),
        (gzip.compress(TEXT.encode("utf-16")), "gzip, UTF-16"),
    ],
)
@pytest.mark.parametrize("head", [stream.HEAD, 50])
def test_packed_text_reads_as_it_is(
    data: bytes, form: str, head: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if form == "Latin-1" and head == 50:
        pytest.skip("told by the first block")
    monkeypatch.setitem(stream.ByteSource.__init__.__kwdefaults__, "head", head)
    path = tmp_path / "log.bin"
    path.write_bytes(data)
    for source in (str(path), "-"):
        with path.open("rb") as stdin:
            readings = read_readings(source, stdin=stdin)
        np.testing.assert_array_equal(readings.output()[:, 0], np.arange(40))
        assert readings.sha256 == hashlib.sha256(data).hexdigest()
        assert any(all(part in note for part in form.split(", ")) for note in readings.notes)
        assert readings.form.source_format == "csv"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (zipped(a="1,2,3\n", b="4,5,6\n"), r'zip archive of 2 files \("a", "b"\); unpack it'),
        (zipped(**{"[Content_Types].xml": "x", "xl/a.xml": "y"}), "is an Excel workbook; export the sheet"),
        (gzip.compress(TEXT.encode())[:-20], "gzip data are damaged or end early"),
        (b"\xd0\xcf\x11\xe0....", "is an Excel workbook"),
    ],
)
def test_what_cannot_be_unpacked_is_said(data: bytes, message: str) -> None:
    with pytest.raises(DataError, match=message):
        read_readings("-", stdin=io.BytesIO(data))
