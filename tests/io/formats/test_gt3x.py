"""ActiGraph files: the maker's own export and pygt3x of a real one, records by the published format, damage."""

from __future__ import annotations

import io
import logging
import struct
import zipfile

import numpy as np
import pytest
from damage import check_damage

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.reader import ReadOptions, Selection, open_table

RNG = np.random.default_rng(5)
RATE, START = 30, 1_421_142_129
INFO = (
    "Serial Number: {serial}\r\nFirmware: 3.2.1\r\nBattery Voltage: 4.2\r\nSample Rate: 30\r\n"
    "Start Date: 635567389290000000\r\nAcceleration Min: -8.0\r\nAcceleration Max: 8.0\r\n"
)


def record(kind, second, payload):
    raw = struct.pack("<BBIH", 0x1E, kind, START + second, len(payload)) + payload
    return raw + bytes([~np.bitwise_xor.reduce(np.frombuffer(raw, np.uint8)) & 0xFF])


def packed(counts):
    """Return rows of three numbers, 12 bits each, most significant first."""
    bits = "".join(f"{value & 0xFFF:012b}" for value in counts.ravel().tolist())
    bits += "0" * (-len(bits) % 8)
    return bytes(int(bits[k : k + 8], 2) for k in range(0, len(bits), 8))


def archive(records, serial="MOS2D33140095", **members):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as made:
        made.writestr("log.bin", records)
        made.writestr("info.txt", INFO.format(serial=serial))
        for name, data in members.items():
            made.writestr(name, data)
    return file.getvalue()


def read(data):
    table = open_table("-", io.BytesIO(data))
    try:
        rows = [block.numbers for block in table.blocks(Selection((0, 1, 2, 3)))]
        return table, np.concatenate([np.empty((0, 4)), *rows])
    finally:
        table.close()


def test_the_makers_export_and_pygt3x_of_a_real_file(shared_data):
    path = shared_data / "native" / "actigraph_neo.gt3x"
    table = open_table(path)
    rows = np.concatenate([block.numbers for block in table.blocks(Selection((0, 1, 2, 3)))])
    assert (table.source_format, table.facts.serial, table.facts.rate) == ("gt3x", "NEO1C04110003", 30)
    table.close()
    maker = np.loadtxt(path.with_suffix(".csv"), delimiter=",", skiprows=11)
    np.testing.assert_array_equal(rows[:, 1:], maker)
    reader = pytest.importorskip("pygt3x.reader")
    logging.getLogger("pygt3x").setLevel(logging.CRITICAL)
    with reader.FileReader(str(path)) as theirs:
        np.testing.assert_array_equal(theirs.acceleration[:, 1:4], rows[:, 1:])
        np.testing.assert_allclose(
            theirs.acceleration[:, 0] - theirs.acceleration[0, 0], rows[:, 0], atol=1e-6
        )


@pytest.mark.parametrize("kind", [0x00, 0x1A, 0x1B])
def test_a_second_of_acceleration_of_each_kind(kind):
    counts = RNG.integers(-2000, 2000, (100, RATE, 3))
    payloads = [
        rows.astype("<i2").tobytes() if kind == 0x1A else packed(rows[:, [1, 0, 2]] if kind == 0 else rows)
        for rows in counts
    ]
    table, rows = read(archive(b"".join(record(kind, k, p) for k, p in enumerate(payloads))))
    np.testing.assert_allclose(rows[:, 1:], counts.reshape(-1, 3) / 256.0, rtol=1e-14)
    np.testing.assert_allclose(rows[:, 0], np.arange(len(rows)) / RATE, atol=1e-9)
    assert (
        "rate 30 Hz, start 2015-01-13 09:42:09, serial number MOS2D33140095, range -8.0 to 8.0 g"
        in table.notes[0]
    )


def test_the_published_example_of_packed_numbers():
    example = bytes.fromhex("006008EBD007009EBF007008EBF0")
    _, rows = read(archive(record(0, 0, example), serial="NEO1C16110020"))
    expected = [[0.023, 0.018, -0.947], [0.026, 0.021, -0.941], [0.023, 0.021, -0.941]]  # EBF is -321
    np.testing.assert_array_equal(np.round(rows[:, 1:], 3), expected)


def test_the_scale_of_the_parameters():
    scale = struct.pack("<HHI", 0, 55, 0x09400000)  # 256 as the maker writes it
    payload = RNG.integers(-500, 500, (RATE, 3)).astype("<i2").tobytes()
    for serial in ("NEO1", "MOS2", "ABC1"):
        _, rows = read(archive(record(0x15, 0, scale) + record(0x1A, 0, payload), serial=serial))
        np.testing.assert_allclose(rows[:, 1:] * 256, np.frombuffer(payload, "<i2").reshape(-1, 3))


def test_idle_sleep_is_a_gap_and_what_is_no_acceleration_is_passed_over():
    second = np.ones((RATE, 3), "<i2").tobytes()
    records = [
        record(6, 0, b"{}"),
        *(record(0x1A, k, second) for k in range(10)),
        record(3, 10, b"\x08"),
        record(3, 100, b"\x09"),
        b"\0\0\0",
        record(0x1A, 99, b"\0"),  # plugged in
        *(record(0x1A, k, second) for k in range(100, 110)),
        record(0x1A, 105, second),  # again
    ]
    table, rows = read(archive(b"".join(records)))
    assert len(rows) == 20 * RATE
    assert rows[10 * RATE, 0] == 100
    assert table.notes[1:] == (
        "1 record of a second that was read already left out",
        "idle sleep mode began 1 times",
        "acceleration is missing at 1 place, the longest 90 s",
    )


def test_broken_records_are_left_out():
    second = RNG.integers(-500, 500, (RATE, 3)).astype("<i2").tobytes()
    log = bytearray(b"".join(record(0x1A, k, second) for k in range(100)))
    size = len(log) // 100
    log[20 * size + 30] ^= 4  # in a payload
    log[40 * size] = 0x55  # a mark
    table, rows = read(archive(bytes(log)))
    assert len(rows) == 98 * RATE
    assert any("broken record" in note for note in table.notes)
    assert (np.diff(rows[:, 0]) > 0).all()


def test_records_over_the_edge_of_a_part(monkeypatch):
    second = RNG.integers(-500, 500, (100, RATE, 3)).astype("<i2")
    data = archive(b"".join(record(0x1A, k, rows.tobytes()) for k, rows in enumerate(second)))
    _, whole = read(data)
    monkeypatch.setattr("accelcal_cli.io.formats.gt3x.PART", 997)
    table, parts = read(data)
    np.testing.assert_allclose(parts, whole, atol=1e-12)
    assert len(table.notes) == 1


def test_what_is_no_log():
    data = archive(b"")
    assert not len(read(data)[1])
    with pytest.raises(DataError, match="whose archive is damaged or ends early; copy the file anew"):
        read(data[:-30])
    with pytest.raises(UsageError, match="has one accelerometer"):
        open_table("-", io.BytesIO(data), options=ReadOptions(accelerometer="x"))
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as made:
        made.writestr("log.bin", b"")
        made.writestr("info.txt", "Serial Number: X\n")
    with pytest.raises(DataError, match=r"info.txt states no sample rate"):
        read(file.getvalue())


def test_damage_is_one_line_or_leaves_rows(shared_data):
    second = RNG.integers(-500, 500, (200, RATE, 3)).astype("<i2")
    check_damage(archive(b"".join(record(0x1A, k, rows.tobytes()) for k, rows in enumerate(second))))
    check_damage((shared_data / "native" / "actigraph_neo.gt3x").read_bytes(), every=20_000)
