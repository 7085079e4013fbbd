"""A native log is a table like any other: found by content, its faults named, its rows before a fault kept."""

from __future__ import annotations

import gzip
import io
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.columns import choose_raw, restrict
from accelcal_cli.io.formats.base import LOG_FORMATS, LogFormat, choose_accelerometer
from accelcal_cli.io.reader import ReadOptions, Selection, open_table
from accelcal_cli.io.stream import find_native
from accelcal_cli.io.vocabulary import Facts

MAGIC = b"TOY\0"


@pytest.fixture(autouse=True)
def toy():
    """A format that another package might bring: rows of seven floats behind four bytes."""

    @LOG_FORMATS.register("toy")
    class Toy(LogFormat):
        title = "a toy log"
        names = ("time", "ax", "ay", "az", "gx", "gy", "gz", "temperature")
        units = ("s", "g", "g", "g", *["rad/s"] * 3, "degC")

        @classmethod
        def recognises(cls, head: bytes) -> bool:
            return head.startswith(MAGIC)

        def __init__(self, source, path, accelerometer) -> None:
            self.source, self.facts = source, Facts(serial="7", unit="g")
            if accelerometer is not None:
                choose_accelerometer(source.name, ["first", "second"], accelerometer)

        def blocks(self) -> Iterator[np.ndarray]:
            rest = self.source.head[4:] + b"".join(self.source.rest())
            for at in range(0, len(rest), 64 * 100):
                part = rest[at : at + 64 * 100]
                yield np.array([struct.unpack_from("<8d", part, k) for k in range(0, len(part), 64)]).reshape(
                    -1, 8
                )

    yield Toy
    del LOG_FORMATS._classes["toy"]


ROWS = np.column_stack(
    [np.arange(1000) / 50, np.random.default_rng(1).normal(size=(1000, 6)), np.full(1000, np.nan)]
)
ROWS[::100, 7] = 20 + np.arange(10)
DATA = MAGIC + ROWS.astype("<f8").tobytes()


def opened(data: bytes = DATA, **options):
    return open_table("-", io.BytesIO(data), options=ReadOptions(**options))


def test_a_log_is_a_table(tmp_path: Path) -> None:
    path = tmp_path / "x.csv"
    path.write_bytes(DATA)
    table = open_table(path)
    assert (table.source_format, table.has_rows) == ("toy", True)
    columns = choose_raw(table)
    assert (columns.names, columns.time, columns.gyro, columns.temperature, columns.unit) == (
        ("ax", "ay", "az"),
        0,
        (4, 5, 6),
        7,
        "g",
    )
    blocks = list(table.blocks(columns.selection()))
    assert [block.start for block in blocks] == list(range(0, 1000, 100))
    rows = np.concatenate([block.numbers for block in blocks])
    np.testing.assert_array_equal(rows[:, [7, 0, 1, 2, 3, 4, 5]], ROWS[:, :7])
    np.testing.assert_array_equal(rows[:, 6], 20 + np.arange(1000) // 100)  # a slower sensor's last value
    assert table.notes == ("a toy log: serial number 7",)
    assert table.where(8) == "row 9"
    assert len(table.sha256) == 64
    table.close()


def test_it_may_be_packed_and_is_hashed_as_it_came() -> None:
    packed = gzip.compress(DATA, mtime=0)
    for data in (DATA, packed):
        table = opened(data)
        assert len(np.concatenate([b.numbers for b in table.blocks(Selection((1, 2, 3)))])) == 1000
        import hashlib

        assert table.sha256 == hashlib.sha256(data).hexdigest()
    assert table.notes[0] == "unpacked from gzip"


def test_rows_are_chosen_by_conditions() -> None:
    table = opened()
    restrict(table, ["time=0.5"])
    (rows,) = [block for block in table.blocks(Selection((1, 2, 3))) if len(block.numbers)]
    np.testing.assert_array_equal(rows.numbers[0], ROWS[25, 1:4])
    assert table.where(0) == "row 26"
    table = opened()
    restrict(table, ["time=up"])
    with pytest.raises(DataError, match='no row has column "time" = up'):
        list(table.blocks(Selection((1, 2, 3))))


def test_what_a_damaged_file_raises_is_one_message_or_ends_the_rows() -> None:
    table = opened(DATA[:-5])  # struct.error in the last block
    assert len(np.concatenate([b.numbers for b in table.blocks(Selection((1, 2, 3)))])) == 900
    assert "damaged behind row 900" in table.notes[-1]
    with pytest.raises(DataError, match=r"is a toy log, which is damaged .*; copy the file anew"):
        opened(DATA[:60]).has_rows  # noqa: B018
    rows = ROWS.copy()
    rows[150, 2] = np.nan
    with pytest.raises(DataError, match='row 151, column "ay": is missing or nan'):
        list(opened(MAGIC + rows.tobytes()).blocks(Selection((1, 2, 3))))
    assert not opened(MAGIC).has_rows


def test_it_goes_through_the_commands_readers() -> None:
    log = open_raw_log("-", stdin=io.BytesIO(DATA))
    assert sum(map(len, log.blocks())) == 1000
    assert log.clock.rate == pytest.approx(50)
    assert log.form.source_format == "toy"


def test_the_accelerometer_is_chosen_in_the_same_words() -> None:
    names = ["IMU[0]", "IMU[1]"]
    with pytest.raises(
        DataError, match=r"x: has several accelerometers \(IMU\[0\], IMU\[1\]\); choose one, as in --acc"
    ):
        choose_accelerometer("x", names, None)
    assert choose_accelerometer("x", names, " imu[1]") == "IMU[1]"
    assert choose_accelerometer("x", names, None, "IMU[1]") == "IMU[1]"
    assert choose_accelerometer("x", names[:1], None, "none of it") == "IMU[0]"
    with pytest.raises(UsageError, match=r'--accelerometer "IMU2": x has none of that name'):
        choose_accelerometer("x", names, "IMU2")
    with pytest.raises(UsageError, match="it has first, second"):
        opened(accelerometer="third")
    with pytest.raises(DataError, match="x: has no accelerometer"):
        choose_accelerometer("x", [], None)


def test_text_loads_no_format(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("accelcal_cli.io.formats.base.recognise", lambda head: pytest.fail("asked"))
    for head in (b"ax,ay,az\n1,2,3\n", b"", b"PAR1\0", gzip.compress(b"1,2,3"), "1,2\n".encode("utf-16")):
        assert find_native(head) is None


def test_carriage_returns_of_a_log_are_its_own() -> None:
    rows = np.where(np.isnan(ROWS[:10]), 0.0, np.round(ROWS[:10]))
    rows[3, 2] = struct.unpack("<d", b"\r" * 8)[0]
    data = MAGIC + rows.tobytes()
    assert b"\n" not in data
    (block,) = opened(data).blocks(Selection((1, 2, 3)))
    np.testing.assert_array_equal(block.numbers, rows[:, 1:4])


def test_a_text_with_zero_bytes_is_still_text() -> None:
    with pytest.raises(DataError, match="line 4: holds NUL bytes; this is binary data, not a text table"):
        opened(b"ax,ay,az\n0,0,1\n0,1,0\n\0\0\0")
