"""Native logs from the command line: calibrated, detected, corrected and exported as they are."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from native_logs import write_arrow, write_bag, write_flash, write_ulg
from raw_logs import simulated

TURN = {"CAL_ACC0_ID": 2424842, "CAL_ACC0_XOFF": 0.5, "SENS_BOARD_ROT": 0}


@pytest.fixture(scope="module")
def held():
    """Times and readings, m/s^2, of a simulated log of 14 poses."""
    numbers, _ = simulated(gyro=False, hold=3.0, move=1.0, rate=50.0)
    return numbers[:, 3], numbers[:, :3] / 1670.0


def test_a_px4_log_goes_from_detection_to_an_export(run, held):
    write_ulg(Path("a.ulg"), {("sensor_combined", 0): held}, TURN)
    outcome = run("detect", "a.ulg", "--gyro", "none", "-o", "poses.csv")
    assert (outcome.code, "14 still intervals found" in outcome.out.replace("\n", " ")) == (0, True)
    raw = ("calibrate", "a.ulg", "--raw", "--gyro", "none", "--optimizer", "levenberg-marquardt")
    outcome = run(*raw, "-o", "result.yaml", "--format", "json")
    assert outcome.code == 0
    record = json.loads(outcome.out)
    assert record["data"]["source_format"] == "ulg"
    assert record["data"]["correction"]["offset"] == [0.5, 0, 0]
    assert "sensor_combined taken" in record["notes"]
    assert any(
        note.startswith("PX4 corrected the readings by its CAL_ACC0, device 2424842")
        for note in record["notes"]
    )
    outcome = run("export", "result.yaml", "--to", "px4")
    assert "CAL_ACC0_ID\t2424842\t6" in outcome.out
    outcome = run("export", "result.yaml", "--to", "ardupilot")
    assert "INS_ACC_ID" not in outcome.out
    # Readings of single poses, and a new log of them.
    assert run("verify", "result.yaml", "poses.csv", "-q").code == 0


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_apply_writes_a_table_of_any_log(run, held, suffix):
    times, force = held[0][:3000], held[1][:3000]
    run("calibrate", str(ROOT / "docs/sample.csv"), "-q", "-o", "result.yaml")
    write_ulg(Path("a.ulg"), {("sensor_combined", 0): (times, force)}, TURN)
    write_flash(Path("a.BIN"), {0: (times, force), 1: (times, force)}, {})
    write_arrow(Path("a.arrow"), times, force)
    for name, more in (("a.ulg", ()), ("a.BIN", ("--accelerometer", "IMU[1]")), ("a.arrow", ())):
        outcome = run("apply", "result.yaml", name, "-o", f"out{suffix}", "--force", *more)
        assert outcome.code == 0, outcome.err
        frame = pl.read_csv(f"out{suffix}") if suffix == ".csv" else pl.read_parquet(f"out{suffix}")
        assert frame.columns[:4] == ["time", "ax", "ay", "az"]
        assert frame.columns[-3:] == ["fx", "fy", "fz"]
        assert len(frame) == len(times)
        np.testing.assert_allclose(frame["ax"].to_numpy(), force[:, 0], rtol=1e-6)
        assert "ax is 0.9" not in outcome.err
        assert ("taken" in outcome.err) == (name != "a.arrow")
        assert (
            run("apply", "result.yaml", name, "-o", f"in{suffix}", "--replace", "--force", "-q", *more).code
            == 0
        )


@pytest.mark.parametrize(
    "command",
    [
        ("calibrate", "a.BIN", "--raw"),
        ("calibrate", "a.BIN"),
        ("detect", "a.BIN"),
        ("apply", "result.yaml", "a.BIN"),
        ("verify", "result.yaml", "a.BIN"),
        ("plan", "a.BIN"),
        ("compare", "a.BIN"),
    ],
)
def test_every_command_that_reads_logs_takes_the_accelerometer(run, held, command):
    run("calibrate", str(ROOT / "docs/sample.csv"), "-q", "-o", "result.yaml")
    write_flash(Path("a.BIN"), {0: held, 1: held}, {})
    outcome = run(*command)
    assert outcome.code == 2
    assert "a.BIN: has several accelerometers (IMU[0], IMU[1]); choose one" in outcome.err
    outcome = run(*command, "--accelerometer", "IMU[7]")
    assert outcome.code == 2
    assert '--accelerometer "IMU[7]": a.BIN has none of that name' in outcome.err
    assert len(outcome.err.splitlines()) == 1


def test_a_fleet_of_native_logs(run, held):
    for k in range(2):
        write_ulg(Path(f"{k}.ulg"), {("sensor_combined", 0): held}, TURN)
    outcome = run("fleet", "0.ulg", "1.ulg", "--raw", "--gyro", "none", "--format", "json", "-q")
    assert outcome.code == 0, outcome.err
    write_flash(Path("a.BIN"), {0: held, 1: held}, {})
    outcome = run("fleet", "a.BIN", "--raw", "--gyro", "none", "--format", "json", "-q")
    assert (outcome.code, "Has several accelerometers (IMU[0], IMU[1])" in outcome.out) == (1, True)
    more = ("--accelerometer", "IMU[1]", "--format", "json", "-q")
    assert run("fleet", "a.BIN", "--raw", "--gyro", "none", *more).code == 0


def test_a_damaged_log_is_one_line(run, held):
    path = write_ulg(Path("a.ulg"), {("sensor_combined", 0): held}, TURN)
    path.write_bytes(path.read_bytes()[:300])
    outcome = run("detect", "a.ulg")
    assert (outcome.code, len(outcome.err.splitlines())) == (2, 1)


def test_a_bag_without_its_extra_is_one_line(run, held, monkeypatch):
    pytest.importorskip("rosbags")
    write_bag(Path("a.bag"), {"/imu": (held[0][:10], held[1][:10])}, "rosbag1")
    monkeypatch.setattr("accelcal_cli.io.formats.base.find_spec", lambda name: None)
    outcome = run("detect", "a.bag")
    assert outcome.code == 2
    assert outcome.err == (
        "accelcal: a.bag: is a ROS 1 bag; to read it, install the extra ros: python -m pip install rosbags\n"
    )


ROOT = Path(__file__).parents[2]
