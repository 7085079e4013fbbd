"""ArduPilot logs: the numbers of pymavlink, the choice of the sensor in binary and text, what ArduPilot had done."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest
from native_logs import flash_format, write_flash

from accelcal_cli.errors import DataError, UsageError
from accelcal_cli.io.formats.base import NativeTable
from accelcal_cli.io.reader import ReadOptions, Selection, open_table
from accelcal_cli.io.stream import ByteSource
from accelcal_cli.sensor.triad import rotation

SHARED = Path(__file__).parents[4] / "shared"
TIMES = np.arange(400) / 50
FORCE = np.random.default_rng(4).normal(size=(400, 3)).astype(np.float32).astype(float)
BOTH = {0: (TIMES, FORCE), 1: (TIMES, FORCE + 1)}
PARAMETERS = {
    **{f"INS_ACC2OFFS_{axis}": value for axis, value in zip("XYZ", (0.25, -0.5, 0.125), strict=True)},
    **{f"INS_ACC2SCAL_{axis}": value for axis, value in zip("XYZ", (1.0, 0.5, 2.0), strict=True)},
    "INS_ACC2_ID": 1442826.0,
    "AHRS_ORIENTATION": 8.0,
    "INS_ACC_ID": 1246730.0,
}


def sample() -> Path:
    path = SHARED / "data/native/ardupilot_sample.BIN"
    if not path.is_file():
        pytest.skip("shared data are not there")
    return path


def read(source: object, accelerometer: str | None = None) -> tuple[NativeTable, np.ndarray]:
    table = open_table(source, options=ReadOptions(accelerometer=accelerometer))
    rows = np.concatenate([b.numbers for b in table.blocks(Selection(tuple(range(len(table.names)))))])
    table.close()
    return table, rows


@pytest.mark.parametrize("name", ["IMU", "IMU2"])
def test_a_real_log_gives_the_numbers_of_pymavlink(name):
    reader = pytest.importorskip("pymavlink.DFReader")
    log = reader.DFReader_binary(str(sample()))
    messages = []
    while (message := log.recv_match(type=name)) is not None:
        messages.append(message)
    log.filehandle.close()
    table, rows = read(sample(), name)
    assert len(rows) == len(messages) == 45
    fields = ("AccX", "AccY", "AccZ", "GyrX", "GyrY", "GyrZ", "T")
    np.testing.assert_array_equal(rows[:, 1:], [[getattr(m, f) for f in fields] for m in messages])
    times = np.array([m.TimeUS for m in messages])
    np.testing.assert_allclose(rows[:, 0], (times - times[0]) / 1e6, atol=1e-9)
    assert table.names == ("time", "ax", "ay", "az", "gx", "gy", "gz", "temperature")
    assert (
        table.correction.device_id,
        table.correction.doubt,
        round(table.correction.offset[0], 6),
    ) == ((1246730, "", -0.031697) if name == "IMU" else (1442826, "", 0.045086))
    np.testing.assert_allclose(table.correction.turn, rotation(180, 0, 0), atol=1e-12)


def test_a_real_log_of_several_accelerometers_is_refused_with_the_list():
    with pytest.raises(
        DataError, match=r"several accelerometers \(IMU, IMU2\); choose one, as in --accelerometer 'IMU'"
    ):
        read(sample())


@pytest.mark.parametrize("old", [False, True])
def test_one_of_several_is_chosen_by_either_name(tmp_path, old):
    path = write_flash(tmp_path / "a.BIN", BOTH, PARAMETERS, old=old)
    for name, more in (("IMU[0]", 0), ("IMU[1]", 1), ("IMU2", 1), ("imu[1]", 1)):
        table, rows = read(path, name)
        np.testing.assert_array_equal(rows[:, 1:4], (FORCE + more).astype(np.float32))
        np.testing.assert_allclose(rows[:, 0], TIMES, atol=1e-9)
        assert table.correction.instance == more
    with pytest.raises(UsageError, match="has none of that name"):
        read(path, "IMU3")
    with pytest.raises(DataError if not old else UsageError):
        read(path, None if not old else "IMU[2]")
    _, rows = read(write_flash(tmp_path / "b.BIN", {0: (TIMES, FORCE)}, old=old))
    assert len(rows) == 400


def text_of(both: dict, letters: str = "QBffffffIIfBBHH") -> str:
    columns = "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,GHz,AHz"
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 129, 31, PARM, QNf, TimeUS,Name,Value",
    ]
    lines.append(f"FMT, 140, 50, IMU, {letters}, {columns}")
    lines += [f"PARM, 5, {name}, {value}" for name, value in PARAMETERS.items()]
    for t, time in enumerate(TIMES.tolist()):
        for k, (_, force) in both.items():
            x, y, z = force[t].tolist()
            lines.append(f"IMU, {round(1e6 * time)}, {k}, 0, 0, 0, {x!r}, {y!r}, {z!r}, 0, 0, 20, 1, 1, 1, 1")
    return "\n".join([*lines, ""])


def test_a_text_log_has_the_same_names_and_the_same_correction(tmp_path):
    path = tmp_path / "a.log"
    path.write_text(text_of(BOTH))
    binary, _ = read(write_flash(tmp_path / "a.BIN", BOTH, PARAMETERS), "IMU[1]")
    for name in ("IMU[1]", "IMU2"):
        table = open_table(path, options=ReadOptions(accelerometer=name))
        rows = np.concatenate([b.numbers for b in table.blocks(Selection((5, 6, 7)))])
        np.testing.assert_array_equal(rows, FORCE + 1)
        assert table.correction == binary.correction
        assert binary.correction.in_words() in table.notes
        table.close()
    with pytest.raises(UsageError, match=r"it has IMU\[0\], IMU\[1\]"):
        open_table(path, options=ReadOptions(accelerometer="IMU[7]"))
    table = open_table(path, options=ReadOptions(where=("I=1",)))
    table.close()
    assert table.correction is None  # whose it is, the rows tell later
    path.write_text("ax,ay,az\n0,0,1\n")
    with pytest.raises(UsageError, match=r'--accelerometer "IMU": .* is a table'):
        open_table(path, options=ReadOptions(accelerometer="IMU"))


def test_columns_that_a_vehicle_has_corrected_are_told_without_its_parameters(tmp_path):
    path = tmp_path / "dump.csv"
    for header, vehicle in (
        ("timestamp,TimeUS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "ArduPilot"),
        ("timestamp,gyro_rad[0],gyro_rad[1],gyro_rad[2],accelerometer_m_s2[0],accelerometer_m_s2[1],"
         "accelerometer_m_s2[2],x", "PX4"),
    ):  # fmt: skip
        path.write_text(header + "\n" + "1,2,3,4,5,6,7,8\n" * 3)
        (note,) = notes_of(path)
        assert note.startswith(f"{vehicle} corrected the readings by its")
    path.write_text("time,ax,ay,az\n1,2,3,4\n")
    assert notes_of(path) == ()


def notes_of(path: Path) -> tuple[str, ...]:
    table = open_table(path)
    table.close()
    return table.notes


def test_blocks_of_any_size_mean_the_same(tmp_path):
    data = write_flash(tmp_path / "a.BIN", BOTH, PARAMETERS).read_bytes()
    table = NativeTable(
        ByteSource(io.BytesIO(data), "f", head=3000, block=700), None, ReadOptions(accelerometer="IMU2")
    )
    rows = np.concatenate([b.numbers for b in table.blocks(Selection((1, 2, 3)))])
    np.testing.assert_array_equal(rows, (FORCE + 1).astype(np.float32))


def test_damaged_bytes_lose_few_rows_and_are_told(tmp_path):
    data = bytearray(write_flash(tmp_path / "a.BIN", {0: (TIMES, FORCE)}).read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = b"\x01" * 200
    path = tmp_path / "b.BIN"
    path.write_bytes(bytes(data) + b"\0" * 1000)
    table, rows = read(path)
    assert 393 <= len(rows) < 400
    assert any("damaged bytes passed over" in note for note in table.notes)
    known = {tuple(row) for row in FORCE.tolist()}
    assert all(tuple(row) in known for row in rows[:, 1:4].tolist())


def test_a_log_without_acceleration_is_refused(tmp_path):
    path = tmp_path / "a.BIN"
    path.write_bytes(flash_format(128, "FMT", "BBnNZ", "Type,Length,Name,Format,Columns"))
    with pytest.raises(DataError, match="is an ArduPilot log without messages of acceleration"):
        read(path)


@pytest.mark.parametrize(
    ("parameters", "changed", "doubt"),
    [
        ({}, {}, "the log has no INS_ACC2OFFS_X"),
        (PARAMETERS, {"INS_ACC2SCAL_Y": 0.75}, "INS_ACC2SCAL_Y changes in the log"),
        ({**PARAMETERS, "AHRS_ORIENTATION": 100.0}, {}, "AHRS_ORIENTATION 100 has no known rotation"),
        (PARAMETERS, {"INS_ACC3SCAL_Y": 0.75}, ""),
    ],
)
def test_a_correction_in_doubt_is_told(tmp_path, parameters, changed, doubt):
    table, _ = read(write_flash(tmp_path / "a.BIN", BOTH, parameters, changed=changed), "IMU2")
    assert table.correction.doubt == doubt
