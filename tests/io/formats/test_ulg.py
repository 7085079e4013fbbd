"""PX4 logs: the numbers of pyulog, the choice of the topic, what is lost, and what PX4 had done to the readings."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from native_logs import write_ulg

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import NativeTable
from accelcal_cli.io.formats.ulg import _UlogScanner
from accelcal_cli.io.reader import ReadOptions, Selection, open_table
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.sensor.triad import rotation

SHARED = Path(__file__).parents[4] / "shared"
TIMES = np.arange(500) / 100
FORCE = np.random.default_rng(4).normal(size=(500, 3)).astype(np.float32).astype(float)
SLOW = np.arange(5.0)
CAL = {
    **{f"CAL_ACC0_{axis}OFF": value for axis, value in zip("XYZ", (0.25, -0.5, 0.125), strict=True)},
    **{f"CAL_ACC0_{axis}SCALE": value for axis, value in zip("XYZ", (1.0, 0.5, 2.0), strict=True)},
    "CAL_ACC0_ID": 2424842,
    "CAL_ACC1_ID": 3670050,
    "SENS_BOARD_ROT": 4,
    "SENS_BOARD_X_OFF": 2.0,
}


def sensors(*others: int) -> dict:
    accel = {("sensor_accel", k): (SLOW, FORCE[:5] + k) for k in others}
    return {("sensor_combined", 0): (TIMES, FORCE), **accel}


def rows_of(table) -> np.ndarray:
    columns = tuple(range(len(table.names)))
    rows = np.concatenate([b.numbers for b in table.blocks(Selection(columns, frozenset(columns[-1:])))])
    table.close()
    return rows


def opened(path: object, accelerometer: str | None = None) -> NativeTable:
    return open_table(path, options=ReadOptions(accelerometer=accelerometer))


def sample() -> Path:
    path = SHARED / "data/native/px4_sample.ulg"
    if not path.is_file():
        pytest.skip("shared data are not there")
    return path


@pytest.mark.parametrize("chosen", [None, "sensor_accel[0]", "sensor_accel[2]"])
def test_a_real_log_gives_the_numbers_of_pyulog(chosen):
    pyulog = pytest.importorskip("pyulog")
    table = opened(sample(), chosen)
    rows = rows_of(table)
    name, _, number = (chosen or "sensor_combined").partition("[")
    data = pyulog.ULog(str(sample())).get_dataset(name, int(number[:-1] or 0) if number else 0).data
    fields = (
        [f"accelerometer_m_s2[{k}]" for k in range(3)] + [f"gyro_rad[{k}]" for k in range(3)]
        if chosen is None
        else ["x", "y", "z", "temperature"]
    )
    assert len(rows) == (1298 if chosen is None else 6)
    np.testing.assert_array_equal(rows[:, 1 : 1 + len(fields)], np.column_stack([data[f] for f in fields]))
    times = data["timestamp"].astype(np.int64)
    np.testing.assert_allclose(rows[:, 0], (times - times[0]) / 1e6, rtol=0, atol=1e-9)


def test_what_px4_did_to_a_real_log_is_what_its_parameters_say():
    """The raw readings of the selected accelerometer, corrected as the docs of VehicleCorrection say, are combined."""
    combined, raw = opened(sample()), opened(sample(), "sensor_accel[0]")
    correction, mean = combined.correction, rows_of(combined)[:, 1:4].mean(axis=0)
    assert (correction.instance, correction.device_id, correction.doubt) == (0, 2424842, "")
    driver = rows_of(raw)[:, 1:4].mean(axis=0)
    made = np.array(correction.turn) @ ((driver - correction.offset) * correction.scale)
    assert np.abs(made - mean).max() < 0.025  # six rows of a vehicle that vibrates
    assert np.abs(driver - mean).max() > 0.4
    assert raw.correction.is_none
    assert raw.correction.device_id == 2424842
    assert combined.notes[0].startswith("a PX4 log (.ulg): serial number 0006")
    assert (
        "sensor_combined taken; --accelerometer takes sensor_accel[0], sensor_accel[1]" in combined.notes[1]
    )
    assert combined.notes[2].startswith("1 dropout of 0.03")


def test_sensor_combined_is_taken_and_others_on_demand(tmp_path):
    path = write_ulg(tmp_path / "a.ulg", sensors(0, 1), CAL, dropouts=(20, 30))
    table = opened(path)
    rows = rows_of(table)
    assert table.names == ("time", "ax", "ay", "az", "gx", "gy", "gz", "temperature")
    # That of the device which is combined, from its own topic, which is slower.
    np.testing.assert_allclose(rows[:, 7], 20 + np.floor(TIMES) / 100, atol=1e-5)
    np.testing.assert_array_equal(rows[:, 1:4], FORCE)
    np.testing.assert_allclose(rows[:, 0], TIMES, atol=1e-9)
    assert table.source_format == "ulg"
    assert "2 dropouts of 0.05 s in total: the logger fell behind" in table.notes
    table = opened(path, "sensor_accel[1]")
    np.testing.assert_array_equal(rows_of(table)[:, 1:4], (FORCE[:5] + 1).astype(np.float32))
    assert table.names[-1] == "temperature"
    with pytest.raises(UsageError, match=r"it has sensor_accel\[0\], sensor_accel\[1\], sensor_combined"):
        opened(path, "sensor_gyro")
    with pytest.raises(UsageError):
        opened(path, "sensor_accel")


def test_without_sensor_combined_several_are_refused_and_one_has_a_short_name(tmp_path):
    accel = {("sensor_accel", k): (SLOW, FORCE[:5] + k) for k in range(2)}
    with pytest.raises(DataError, match=r"several accelerometers \(sensor_accel\[0\], sensor_accel\[1\]\)"):
        opened(write_ulg(tmp_path / "a.ulg", accel))
    path = write_ulg(tmp_path / "b.ulg", {("sensor_accel", 0): (SLOW, FORCE[:5])})
    for name in (None, "sensor_accel", "sensor_accel[0]"):
        assert len(rows_of(opened(path, name))) == 5
    with pytest.raises(DataError, match="is a PX4 log without sensor_combined or sensor_accel"):
        opened(write_ulg(tmp_path / "c.ulg", {}))


def test_blocks_of_any_size_mean_the_same(tmp_path):
    data = write_ulg(tmp_path / "a.ulg", sensors(0), CAL).read_bytes()
    source = ByteSource(io.BytesIO(data), "f", head=3000, block=700)
    table = NativeTable(source, None)
    rows = rows_of(table)
    np.testing.assert_array_equal(rows[:, 1:4], FORCE)
    np.testing.assert_allclose(rows[:, 7], 20 + np.floor(TIMES) / 100, atol=1e-5)
    assert table.correction.offset == (0.25, -0.5, 0.125)


def test_rows_behind_a_message_that_power_off_cut_are_read(tmp_path):
    data = write_ulg(tmp_path / "a.ulg", sensors(0), CAL, resumed=True).read_bytes()
    for head in (4 << 20, 3000):
        table = NativeTable(ByteSource(io.BytesIO(data), "f", head=head, block=700), None)
        np.testing.assert_array_equal(rows_of(table)[:, 1:4], FORCE)
        assert not any("damaged" in note for note in table.notes)


def test_damaged_bytes_lose_few_rows_and_are_told(tmp_path):
    data = bytearray(write_ulg(tmp_path / "a.ulg", sensors(), CAL).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)
    table = opened_bytes(bytes(data))
    rows = rows_of(table)
    assert 490 <= len(rows) < 500
    assert any("damaged bytes passed over" in note for note in table.notes)
    known = {tuple(row) for row in FORCE.tolist()}
    assert all(tuple(row) in known for row in rows[:, 1:4].tolist())
    table = opened_bytes(bytes(data[:-7]))
    assert rows_of(table)[-1, 0] == pytest.approx(TIMES[-2])
    assert "the last message is cut off and left out" in table.notes


def opened_bytes(data: bytes) -> NativeTable:
    return NativeTable(ByteSource(io.BytesIO(data), "f"), None)


def test_a_topic_within_a_topic_has_its_size():
    scanner = _UlogScanner()
    scanner.formats = {
        "inner": "float x;uint8_t[4] pad",
        "outer": "uint64_t timestamp;inner[3] parts;double d",
    }
    places, size = scanner._layout("outer")
    assert (places["d"].offset, size) == (32, 40)
    scanner.formats["outer"] += ";outer again"
    with pytest.raises(ValueError):
        scanner._layout("outer")


def test_the_correction_is_that_of_the_device_that_was_combined(tmp_path):
    own = {f"CAL_ACC1_{axis}OFF": 0.5 for axis in "XYZ"}
    path = write_ulg(tmp_path / "a.ulg", sensors(0, 1), {**CAL, **own}, selected=3670050)
    table = opened(path)
    rows_of(table)
    correction = table.correction
    assert (correction.instance, correction.device_id, correction.offset) == (1, 3670050, (0.5, 0.5, 0.5))
    np.testing.assert_allclose(correction.turn, rotation(2, 0, 0) @ rotation(0, 0, 180), atol=1e-12)
    path = write_ulg(tmp_path / "b.ulg", sensors(0, 1), {**CAL, "CAL_ACC1_ROT": 8}, selected=3670050)
    table = opened(path)
    rows_of(table)
    np.testing.assert_allclose(table.correction.turn, rotation(180, 0, 0), atol=1e-12)  # it is external


@pytest.mark.parametrize(
    ("parameters", "changed", "doubt"),
    [
        ({}, {}, "the log has no such parameters"),
        (CAL, {"CAL_ACC0_YOFF": 0.75}, "CAL_ACC0_YOFF changes in the log"),
        (CAL, {"SENS_BOARD_ROT": 2}, "SENS_BOARD_ROT changes in the log"),
        ({**CAL, "SENS_BOARD_ROT": 77}, {}, "the rotation has no known number"),
        (CAL, {"CAL_ACC2_YOFF": 0.75}, ""),
    ],
)
def test_a_correction_in_doubt_is_told(tmp_path, parameters, changed, doubt):
    table = opened(write_ulg(tmp_path / "a.ulg", sensors(0), parameters, changed=changed))
    rows_of(table)
    assert table.correction.doubt == doubt
    assert bool(doubt) == any("not known" in note for note in table.notes)


def test_temperature_compensation_is_told(tmp_path):
    table = opened(write_ulg(tmp_path / "a.ulg", sensors(0), {**CAL, "TC_A_ENABLE": 1}))
    rows_of(table)
    assert table.correction.thermal
