"""An export from a vehicle's log replaces what the vehicle had done: driver, log, calibration, export, vehicle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from native_logs import write_flash, write_ulg
from raw_logs import G

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration, Temperature
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.config import parse_mapping
from accelcal_cli.detection.detect import DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.io.reader import ReadOptions
from accelcal_cli.output.machine import json_text
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import directions
from accelcal_cli.sensor.simulation import Handling, Sensor, load_sensor, simulate_log
from accelcal_cli.sensor.triad import rotation
from accelcal_cli.sensor.vehicle import VehicleCorrection, as_rows, board_turn

SCALE, BIAS = np.array([1.02, 0.97, 1.05]), np.array([0.4, -0.3, 0.2])
"""Of the sensor, m/s^2 per m/s^2 and m/s^2."""

OFFSET, FACTOR = np.array([0.25, -0.125, 0.5]), np.array([0.9375, 1.0625, 0.96875])
"""Of the vehicle before, m/s^2; its own calibration was a poor one. They are exact in 32 bits."""

DEVICE = 3670050


def driver_log() -> tuple[Float, Float]:
    """Times, s, shape (n,), and readings of the driver, m/s^2, shape (n, 3)."""
    sensor: Sensor = replace(load_sensor("mems"), K_a=np.diag(SCALE), D_a=BIAS)
    parts = list(
        simulate_log(sensor, directions(14, "fibonacci", np.empty((0, 3))), G, Handling(rate=50.0), 1e-3, 3)
    )
    return np.concatenate([p.time for p in parts]), np.concatenate([p.output for p in parts])


def px4(path: Path, times: Float, force: Float) -> Path:
    own = {f"CAL_ACC1_{axis}OFF": float(v) for axis, v in zip("XYZ", OFFSET, strict=True)}
    own |= {f"CAL_ACC1_{axis}SCALE": float(v) for axis, v in zip("XYZ", FACTOR, strict=True)}
    own |= {"CAL_ACC1_ID": DEVICE, "CAL_ACC0_ID": 77, "SENS_BOARD_ROT": 12, "CAL_ACC0_XOFF": 9.0}
    return write_ulg(path, {("sensor_combined", 0): (times, force)}, own, selected=DEVICE)


def ardupilot(path: Path, times: Float, force: Float) -> Path:
    own = {f"INS_ACC2OFFS_{axis}": float(v) for axis, v in zip("XYZ", OFFSET, strict=True)}
    own |= {f"INS_ACC2SCAL_{axis}": float(v) for axis, v in zip("XYZ", FACTOR, strict=True)}
    own |= {"INS_ACC2_ID": float(DEVICE), "AHRS_ORIENTATION": 12.0}
    return write_flash(path, {0: (times, 0 * force + [0, 0, 9.8]), 1: (times, force)}, own)


VEHICLES: dict[str, tuple[Callable[[Path, Float, Float], Path], str | None, str, str]] = {
    "px4": (px4, None, "CAL_ACC1_{}OFF", "CAL_ACC1_{}SCALE"),
    "ardupilot": (ardupilot, "IMU[1]", "INS_ACC2OFFS_{}", "INS_ACC2SCAL_{}"),
}


@pytest.fixture(scope="module")
def calibrated(tmp_path_factory):
    """By vehicle: its calibration, the readings of the driver, and those that it logged."""
    times, driver = driver_log()
    turn = board_turn(12)
    assert turn is not None
    logged = (driver - OFFSET) * FACTOR @ turn.T
    results = {}
    for name, (write, sensor, *_) in VEHICLES.items():
        log = open_raw_log(
            write(tmp_path_factory.mktemp(name) / "log", times, logged),
            gyro=["none"],
            options=ReadOptions(accelerometer=sensor),
        )
        settings = Settings(g=G, optimizer="levenberg-marquardt")
        result = calibrate(detect(log, DetectSettings(g=G)).readings(), settings)
        log.close()
        results[name] = Calibration.from_record(parse_mapping(json_text(result.record()), name), name)
    return results, driver, logged, turn


def values(content: bytes) -> dict[str, float]:
    lines = [line for line in content.decode().splitlines() if not line.startswith("#")]
    rows = [line.split("\t")[2:4] if "\t" in line else line.split(",") for line in lines]
    return {name: float(value) for name, value in rows}


@pytest.mark.parametrize("name", VEHICLES)
def test_what_the_vehicle_makes_of_the_drivers_readings_is_our_calibrated_force(calibrated, name):
    results, driver, logged, turn = calibrated
    result, (_, _, offset, scale) = results[name], VEHICLES[name]
    export = EXPORTERS.get(name)().export(result)
    found = values(export.content)
    o, s = (np.array([found[key.format(axis)] for axis in "XYZ"]) for key in (offset, scale))
    np.testing.assert_allclose(o, BIAS, atol=2e-3)  # of the sensor itself, whatever the vehicle had done
    np.testing.assert_allclose(s, 1 / SCALE, atol=1e-4)
    vehicle = (driver - o) * s @ turn.T
    ours = result.model.specific_force(logged)
    assert (
        np.abs(vehicle - ours).max() < 2e-3
    )  # misalignments that noise makes, which the vehicle does not have
    plain = values(EXPORTERS.get(name)().export(replace(result, data={})).content)
    assert abs(plain[offset.replace("1", "0").replace("2", "").format("X")] - BIAS[0]) > 0.1
    assert not any("not known" in warning for warning in export.warnings)


@pytest.mark.parametrize(("name", "parameter"), [("px4", "CAL_ACC1_ID"), ("ardupilot", "INS_ACC2_ID")])
def test_device_and_number_come_from_the_log(calibrated, name, parameter):
    result = calibrated[0][name]
    found = values(EXPORTERS.get(name)().export(result).content)
    assert found[parameter] == DEVICE
    assert result.data["correction"]["device_id"] == DEVICE
    content = EXPORTERS.get(name)(instance=0).export(result).content
    stated = "CAL_ACC0_ID" if name == "px4" else "INS_ACC_ID"
    assert (values(content)[stated], parameter in values(content)) == (DEVICE, False)
    assert f"# {'PX4' if name == 'px4' else 'ArduPilot'} corrected the readings by its" in content.decode()


def test_a_result_of_another_vehicle_or_of_none_is_exported_as_it_is(calibrated):
    result = calibrated[0]["px4"]
    ardupilot = EXPORTERS.get("ardupilot")
    bare = replace(result, data={k: v for k, v in result.data.items() if k != "correction"})
    assert values(ardupilot().export(result).content) == values(ardupilot().export(bare).content)
    broken = replace(result, data={**result.data, "correction": {"system": "px4", "offset": [1]}})
    assert values(EXPORTERS.get("px4")().export(broken).content) == values(
        EXPORTERS.get("px4")().export(bare).content
    )


@pytest.mark.parametrize("name", VEHICLES)
def test_a_doubtful_correction_is_a_warning(calibrated, name):
    result = calibrated[0][name]
    told = {**result.data["correction"], "doubt": "it changes in the log"}
    export = EXPORTERS.get(name)().export(replace(result, data={**result.data, "correction": told}))
    assert any("not known: it changes in the log" in warning for warning in export.warnings)


@pytest.mark.parametrize("name", VEHICLES)
def test_slopes_are_of_the_drivers_readings_or_left_to_the_vehicle(calibrated, name):
    results, *_, turn = calibrated
    three = np.ones(3)
    drift = Temperature(25.0, 5.0, 45.0, 0 * three, np.array([0.01, 0.02, -0.03]), *(three,) * 5)
    drift = replace(drift, dop=np.ones(6))
    result = replace(results[name], temperature=drift)
    found = values(EXPORTERS.get(name)().export(result).content)
    keys = [f"TC_A1_X1_{k}" for k in range(3)] if name == "px4" else [f"INS_TCAL2_ACC1_{a}" for a in "XYZ"]
    unit = 1.0 if name == "px4" else 1e6
    expected = turn.T @ drift.bias / FACTOR
    np.testing.assert_allclose([found[key] / unit for key in keys], expected, atol=1e-8)
    told = {**result.data["correction"], "thermal": True}
    export = EXPORTERS.get(name)().export(replace(result, data={**result.data, "correction": told}))
    assert keys[0] not in values(export.content)
    assert any("the vehicle compensated temperature" in warning for warning in export.warnings)


def test_a_correction_undone_is_the_sensor_itself():
    turn = rotation(3, -2, 180)
    correction = VehicleCorrection("px4", 0, 1, tuple(OFFSET), tuple(FACTOR), as_rows(turn))
    sensor = ErrorModel(np.array([[1.1, 0, 0], [0.02, 0.9, 0], [0.01, -0.03, 1.0]]), BIAS)
    f = np.random.default_rng(1).normal(size=(20, 3))
    N = (sensor.output(f) - OFFSET) * FACTOR @ turn.T
    parts = np.linalg.lstsq(np.column_stack([f, np.ones(20)]), N, rcond=None)[0]
    K, D = correction.of_driver(parts[:3].T, parts[3])
    np.testing.assert_allclose(K, sensor.K, atol=1e-12)
    np.testing.assert_allclose(D, sensor.D, atol=1e-12)
    record = {"system": "px4", "offset": list(OFFSET), "scale": list(FACTOR), "turn": turn.tolist()}
    assert VehicleCorrection.from_record(record) == replace(
        correction, device_id=None, turn=tuple(map(tuple, turn.tolist()))
    )
    for broken in (None, {}, {**record, "turn": [[1.0]]}, {**record, "extra": 1}, {**record, "system": "x"}):
        assert VehicleCorrection.from_record(broken) is None
