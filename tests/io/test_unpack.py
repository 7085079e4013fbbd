"""Packed files and other encodings read as the text that they hold, and keep the hash of their own bytes."""

from __future__ import annotations

import gzip
import hashlib
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.errors import DataError
from accelcal_cli.io import stream
from accelcal_cli.io.readings import read_readings

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
    monkeypatch.setattr(stream, "HEAD", head)
    path = tmp_path / "log.bin"
    path.write_bytes(data)
    for source in (str(path), "-"):
        with path.open("rb") as stdin:
            readings = read_readings(source, stdin=stdin)
        np.testing.assert_array_equal(readings.output()[:, 0], np.arange(40))
        assert readings.sha256 == hashlib.sha256(data).hexdigest()
        assert readings.form.source_format.endswith(form)


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
