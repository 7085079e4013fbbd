"""The recordings on which readings measured nothing, or were of several sensors, as a person meets them."""

import json
from pathlib import Path

import numpy as np
import pytest

CASES = Path(__file__).parents[3] / "shared" / "cases"
A = np.array([[1.013, 0, 0], [0.004, 0.991, 0], [-0.006, 0.008, 1.021]]), np.array([0.21, -0.13, 0.35])
B = np.array([1693.48, 1662.05, 1648.5]), np.array([512.0, -387.0, 941.0])

pytestmark = pytest.mark.skipif(not CASES.is_dir(), reason="the recordings are not beside the project")


@pytest.fixture
def calibrated(run):
    def call(name, *options, code=0):
        done = run("calibrate", str(CASES / name), *options, "--format", "json", "--optimizer", "ellipsoid")
        assert done.code == code, done.err
        return json.loads(done.out) if done.out else done.err

    return call


def told(record):
    return {notice["key"]: notice for notice in record["warnings"]}


def test_two_devices(calibrated, run):
    message = calibrated("two_devices.csv", code=2)
    assert 'column "device" has 2 values (0, 1)' in message
    assert "--where device=0" in message
    assert "accelcal fleet --sensor-column device" in message
    record = calibrated("two_devices.csv", "--where", "device=0")
    assert np.abs(np.array(record["K_a"]) - A[0]).max() < 1e-3
    assert run("fleet", str(CASES / "two_devices.csv"), "--sensor-column", "device").code == 0


def test_two_instances_of_a_log(calibrated):
    assert "--where I=0" in calibrated("two_imu_log.csv", "--raw", code=2)
    record = calibrated("two_imu_log.csv", "--raw", "--where", "I=0")
    assert np.abs(np.diag(record["K_a"]) - B[0]).max() < 1


def test_a_log_with_one_sensor_a_row(calibrated):
    assert "--where sensor=accelerometer" in calibrated("long.csv", "--raw", code=2)
    record = calibrated("long.csv", "--raw", "--where", "sensor=accelerometer")
    assert np.abs(np.array(record["K_a"]) - A[0]).max() < 2e-4


def test_thousands(calibrated):
    message = calibrated("thousands.csv", code=2)
    assert '"33,368" has a thousands separator' in message
    assert "33368" in message


@pytest.mark.parametrize(
    ("name", "options", "poses"), [("clipped.csv", (), 3), ("clip_raw.csv", ("--raw",), 3)]
)
def test_clipped(calibrated, name, options, poses):
    record = calibrated(name, *options, code=1)
    assert record["verdict"] == "suspect"
    notice = told(record)["clipped"]
    assert notice["severity"] == "warning"
    assert f"in {poses} of" in notice["text"]
    assert '"ax" at 8191, "ay" at -8192, "az" at 8191' in notice["text"]


def test_an_idle_logger(calibrated, run):
    record = calibrated("idle_zero_log.csv", "--raw")
    notice = told(record)["zero-rows"]
    assert notice["severity"] == "note"
    assert "4,500 rows" in notice["text"]
    assert "line 2501 to line 4000" in notice["text"]
    assert np.abs(np.diag(record["K_a"]) - B[0]).max() < 1
    assert np.abs(np.array(record["D_a"]) - B[1]).max() < 4
    done = run("detect", str(CASES / "idle_zero_log.csv"), "--format", "json")
    assert [notice["key"] for notice in json.loads(done.out)["warnings"]] == ["zero-rows"]
    assert "zero in all three axes" in done.err


def test_gyroscope_columns(calibrated):
    message = calibrated("gyro_first_no_header.csv", "--raw", code=2)
    assert "gravity does not turn in columns 2, 3, 4" in message
    assert "columns 5, 6, 7 look like acceleration" in message
    record = calibrated("gyro_first_no_header.csv", "--raw", "--columns", "5,6,7", "--gyro", "2,3,4")
    assert np.abs(np.diag(record["K_a"]) - B[0]).max() < 1


def test_a_sensor_that_never_moved(calibrated):
    message = calibrated("never_moved.csv", "--raw", code=2)
    assert "the sensor was never turned" in message
    assert "one attitude" in message


def test_rows_of_one_sensor_are_written_alone(run, tmp_path):
    """apply --where writes the rows of that sensor, and those alone, as they were."""
    case = str(CASES / "two_devices.csv")
    assert run("calibrate", case, "--where", "device=0", "-o", "zero.yaml").code == 0
    assert run("apply", "zero.yaml", case, "--where", "device=0", "-o", "out.csv").code == 0
    lines = (tmp_path / "out.csv").read_text().splitlines()
    source = [line for line in Path(case).read_text().splitlines() if line.split(",")[1] != "1"]
    assert [line.rsplit(",", 3)[0] for line in lines] == source
    force = np.array([line.split(",")[-3:] for line in lines[1:]], dtype=float)
    assert np.abs(np.linalg.norm(force, axis=1) - 9.80665).max() < 0.01
    assert run("verify", "zero.yaml", case, "--where", "device=0").code == 0
    assert run("plan", case, "--where", "device=0").code in (0, 1)
