"""The text logs of ArduPilot are read by their FMT lines."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.detection.rawlog import RawLog, open_raw_log
from accelcal_cli.errors import DataError
from accelcal_cli.io.columns import choose
from accelcal_cli.io.reader import ReadOptions, Selection, TextTable
from accelcal_cli.io.rewrite import Change, rewrite
from accelcal_cli.io.stream import ByteSource

ROWS = np.round(9.8 * np.random.default_rng(2).normal(size=(600, 3)), 4)
FORMATS = """FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 129, 31, PARM, QNff, TimeUS,Name,Value,Default
FMT, 150, 43, ACC, QBQfff, TimeUS,I,SampleUS,AccX,AccY,AccZ
FMT, 163, 60, IMU, QBffffffIIfBB, TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH
FMT, 35, 40, ATT, QccccCC, TimeUS,DesRoll,Roll,DesPitch,Pitch,DesYaw,Yaw
"""
OLD = """1

ArduCopter V2.9.1
Free RAM: 1234
FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns
FMT, 131, 43, IMU, Iffffff, TimeMS,GyrX,GyrY,GyrZ,AccX,AccY,AccZ
"""


def log(instances: int = 1, acc: bool = False, imu: bool = True, end: str = "\n") -> str:
    lines = ["PARM, 333, INS_ACC_BODYFIX, 2, 2", "MSG, 334, ArduCopter V4.3.0 (abc)"]
    for k, row in enumerate(ROWS.tolist()):
        time = 6434350 + 20000 * k
        for which in range(instances):
            x, y, z = (value + which for value in row)
            if imu:
                lines.append(
                    f"IMU, {time}, {which}, 0.01, 0.02, 0.03, {x}, {y}, {z}, 0, 0, {25 + k / 100:.2f}, 1, 1"
                )
            if acc:
                lines.append(f"ACC, {time}, {which}, {time - 90}, {x}, {y}, {z}")
        if k % 5 == 0:
            lines.append(f"ATT, {time}, 0, 1.2, 0, 2.3, 0, 123.4")
    return (FORMATS + "\n".join([*lines, ""])).replace("\n", end)


def opened(text: str, **options: object) -> RawLog:
    return open_raw_log("-", stdin=io.BytesIO(text.encode()), options=ReadOptions(**options))


def read(text: str, **options: object) -> tuple[RawLog, np.ndarray]:
    source = opened(text, **options)
    rows = np.concatenate(list(source.blocks()))
    source.close()
    return source, rows


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_columns_units_and_temperature_are_those_of_the_message(end: str) -> None:
    source, rows = read(log(end=end))
    np.testing.assert_array_equal(rows[:, :3], ROWS)
    np.testing.assert_allclose(rows[:, 6], 25 + np.arange(600) / 100, atol=0.006)
    assert source.columns.names == ("AccX", "AccY", "AccZ")
    assert source.gyro_names() == ("GyrX", "GyrY", "GyrZ")
    assert (source.columns.unit, source.clock.unit, source.clock.rate) == ("m/s^2", "us", pytest.approx(50.0))
    assert source.form.source_format == "csv"
    assert "ArduPilot log: message IMU taken by its FMT line" in source.notes


def test_several_instances_are_refused_and_one_is_chosen() -> None:
    with pytest.raises(DataError, match=r'column "I" has 2 values \(0, 1\): .* --where I=0'):
        read(log(2))
    _, rows = read(log(2), where=("I=1",))
    np.testing.assert_allclose(rows[:, :3], ROWS + 1)


def test_imu_goes_before_acc_and_line_takes_the_other() -> None:
    source, _ = read(log(acc=True))
    assert (
        "ArduPilot log: message IMU taken by its FMT line, ACC left out; --line NAME takes others"
        in source.notes
    )
    for options in ({"line": "ACC"}, {"line": "ACC,"}):
        source, rows = read(log(acc=True), **options)
        np.testing.assert_array_equal(rows[:, :3], ROWS)
        assert rows.shape[1] == 4  # neither gyroscope nor temperature, but time
    _, rows = read(log(acc=True, imu=False))
    np.testing.assert_array_equal(rows[:, :3], ROWS)
    with pytest.raises(
        DataError, match=r'no FMT line defines a message "GYR" \(--line\); acceleration is in IMU'
    ):
        opened(log(), line="GYR")
    with pytest.raises(DataError, match="an ArduPilot log without messages of acceleration"):
        opened(log(imu=False))


def test_old_logs_have_a_preamble_and_milliseconds() -> None:
    lines = [f"IMU, {2000 + 20 * k}, 0, 0, 0, {x}, {y}, {z}" for k, (x, y, z) in enumerate(ROWS.tolist())]
    source, rows = read(OLD + "\n".join([*lines, ""]))
    np.testing.assert_array_equal(rows[:, :3], ROWS)
    assert (source.clock.unit, source.clock.rate) == ("ms", pytest.approx(50.0))


def test_a_wrong_cell_is_named_by_its_line() -> None:
    text = log().replace(f"{ROWS[200, 1]}", "?")
    line = next(k for k, each in enumerate(text.splitlines(), 1) if "?" in each)
    with pytest.raises(DataError, match=rf'line {line}, column "AccY": "\?" is not a number; --skip-bad'):
        read(text)
    source, rows = read(text, skip_bad=True)
    assert len(rows) == 599
    assert source.where(598) == f"line {len(text.splitlines())}"


def test_blocks_of_any_size_mean_the_same() -> None:
    data = log(2, acc=True).encode()
    table = TextTable(ByteSource(io.BytesIO(data), "f", head=9000, block=700), ReadOptions(where=()))
    rows = np.concatenate([block.numbers for block in table.blocks(Selection((5, 6, 7)))])
    np.testing.assert_allclose(rows[::2], ROWS)


def test_a_rewritten_log_is_a_table_of_the_message(tmp_path: Path) -> None:
    table = TextTable(ByteSource(io.BytesIO(log().encode()), "f"))
    columns = choose(table)
    out = io.BytesIO()
    rewrite(table, Change(Selection(columns.output), lambda rows: rows / 2, ("fx", "fy", "fz")), out)
    lines = out.getvalue().decode().splitlines()
    assert lines[0] == "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ,EG,EA,T,GH,AH,fx,fy,fz"
    assert len(lines) == 601
    np.testing.assert_array_equal([[float(v) for v in line.split(",")[-3:]] for line in lines[1:]], ROWS / 2)
