"""Logs as devices write them give the sensor that they were simulated with."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import DetectSettings, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.errors import DataError
from accelcal_cli.io.reader import PLAIN, ReadOptions
from accelcal_cli.io.readings import read_readings
from accelcal_cli.sensor.model import OUTPUT_OF_1_G, STANDARD_GRAVITY
from accelcal_cli.sensor.poses import directions

K = np.array([[1.013, 0, 0], [0.004, 0.991, 0], [-0.006, 0.008, 1.021]])
D = np.array([0.21, -0.13, 0.35])
"""Truth A of ../shared/cases: lower gauge, m/s^2."""

SIGMAS = 4.5
LM = Settings("levenberg-marquardt", weights="auto")


@dataclass(frozen=True)
class Case:
    """A log, local gravity in its unit, output of 1 m/s^2 over that of K, and what has to be said of it.

    An `ideal` one is of a sensor without errors.
    """

    name: str
    g: float | None = None
    scale: float = 1.0
    options: ReadOptions = PLAIN
    said: str = ""
    refused: str = ""
    ideal: bool = False


CASES = (
    Case("actigraph_ts.csv", said="10 lines above the table skipped: rate 50 Hz"),
    Case("geneactiv.csv", said="lines above the table skipped"),
    Case("xsens_mt.txt", said="60 rows per second, as stated above the table"),
    Case("betaflight_explorer.csv", 1.0, 2048, said="5 lines above the table skipped"),
    Case("shimmer.csv", said="the readings are in m/s^2 by the file"),
    Case("unitrow.csv", said="the readings are in m/s^2 by the file"),
    Case("sec_only.csv", said="the rate is that of rows over span, 50 rows"),
    Case("matlabtime.csv", 1.0, said="time taken as d"),
    Case("axivity_excel.csv", 1.0, said="the rate is that of rows over span, 50 rows"),
    Case("sparse.csv", said="rows left out: their cells of the readings are empty"),
    Case("nan.csv", options=ReadOptions(skip_bad=True), said="line 4323", refused="line 4323"),
    Case("glitch.csv", options=ReadOptions(skip_bad=True), said="line 3002", refused="line 3002"),
    Case("restart.csv", said="the header is repeated and left out: line 5002"),
    Case("cut.csv", said="the last line, 9,813, left out"),
    Case("serial_bursts.csv", ideal=True, said="the rate is that of rows over span, 100 rows"),
    Case(
        "long.csv",
        options=ReadOptions(where=("sensor=accelerometer",)),
        said="time taken as ms: 100 rows per second",
        refused="--where sensor=accelerometer",
    ),
    Case("serial_adafruit.txt", said='"Acceleration X:" taken'),
    Case("serial_razor.txt", 1.0, 256, said='"#A-R=" taken'),
)


def calibrated(source, stdin=None, g=None, options=PLAIN):
    log = open_raw_log(source, stdin=stdin, options=options)
    try:
        local = g or OUTPUT_OF_1_G.get(log.columns.unit or "", STANDARD_GRAVITY)
        found = detect(log, DetectSettings(g=local))
    finally:
        log.close()
    return calibrate(found.readings(), Settings("levenberg-marquardt", g=local, weights="auto")), found


def assert_truth(result, scale=1.0, ideal=False):
    lower = np.tril_indices(3)
    truth, bias = (np.eye(3), np.zeros(3)) if ideal else (K, D if result.g > 2 else D / STANDARD_GRAVITY)
    away = np.abs(result.K_a - scale * truth)[lower] / result.sigma.K_a[lower]
    assert away.max() < SIGMAS
    assert (np.abs(result.D_a - scale * bias) / result.sigma.D_a).max() < SIGMAS


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_a_log_of_a_device_gives_its_sensor(case):
    path = Path(__file__).parents[3] / "shared" / "cases" / case.name
    if not path.exists():
        pytest.skip("needs ../shared/cases")
    if case.refused:
        with pytest.raises(DataError, match=case.refused):
            calibrated(path, g=case.g)
    result, found = calibrated(path, g=case.g, options=case.options)
    assert_truth(result, case.scale, case.ideal)
    assert any(case.said in note for note in found.notes), found.notes


CASE_FILES = Path(__file__).parents[3] / "shared" / "cases"


@pytest.mark.skipif(not CASE_FILES.is_dir(), reason="needs ../shared/cases")
def test_the_log_that_warms_keeps_the_temperature_of_each_pose():
    result, found = calibrated(CASE_FILES / "temperature_log.csv")
    assert (np.diff(found.intervals.temperature) > 0.5).all()
    assert any("Temperature column not used: 14 poses are too few" in note for note in result.notes)


@pytest.mark.skipif(not CASE_FILES.is_dir(), reason="needs ../shared/cases")
def test_a_running_number_is_no_count():
    readings = read_readings(CASE_FILES / "running_number_samples.csv")
    assert readings.count is None
    assert 'column "n_samples" numbers the rows, so it is no count' in readings.notes


def simulated_rows(rate=50.0, seed=4):
    """Rows of a sensor with truth A, shape (n, 3), m/s^2, in sixteen holds of 4 s with 2 s of moving between."""
    numbers = np.random.default_rng(seed)
    parts, hold, move = [], round(4 * rate), round(2 * rate)
    u = directions(16, "fibonacci", np.empty((0, 3)))
    for here, there in zip(u, np.roll(u, -1, axis=0), strict=True):
        way = np.linspace(0, 1, move)[:, None]
        turn = (1 - way) * here + way * there + 0.2 * np.sin(9 * way) * np.cross(here, there)
        parts += [np.repeat(here[None], hold, axis=0), turn]
    force = STANDARD_GRAVITY * np.concatenate(parts)
    return force @ K.T + D + numbers.normal(scale=0.01, size=force.shape)


STAMPS = {
    "2024-12-11 17:59:40.000": lambda t: str(np.datetime64("2024-12-11T17:59:40", "ms") + t).replace(
        "T", " "
    ),
    "11/12/2024 23:59:30.000": lambda t: _written(
        np.datetime64("2024-12-11T23:59:30", "ms") + t, "{d}/{m}/{y} {c}"
    ),
    "12/11/2024 11:59:30 PM": lambda t: _written(
        np.datetime64("2024-12-11T23:59:30", "ms") + t, "{m}/{d}/{y} {half}"
    ),
    "11.12.2024 17:41:40,000": lambda t: _written(
        np.datetime64("2024-12-11T17:41:40", "ms") + t, "{d}.{m}.{y} {c}"
    ).replace(".000", ",000"),
    "11-Dec-2024 17:41:40.000": lambda t: _written(
        np.datetime64("2024-12-11T17:41:40", "ms") + t, "{d}-Dec-{y} {c}"
    ),
    "20241211 174140.000": lambda t: _written(
        np.datetime64("2024-12-11T17:41:40", "ms") + t, "{y}{m}{d} {bare}"
    ),
    "17:41:40:000": lambda t: _written(np.datetime64("2024-12-11T23:59:40", "ms") + t, "{c}")[::-1].replace(
        ".", ":", 1
    )[::-1],
    "41:40.0": lambda t: _written(np.datetime64("2024-12-11T17:59:40", "ms") + t, "{c}")[3:],
    "2024-12-11T17:41:40.000Z": lambda t: f"{np.datetime64('2024-12-11T17:41:40', 'ms') + t}Z",
    "2024-12-11T17:41:40+01:00": lambda t: f"{np.datetime64('2024-12-11T17:41:40', 'ms') + t}+01:00",
    "epoch s": lambda t: f"{1733938900 + t / 1000:.3f}",
    "epoch ms": lambda t: str(1733938900000 + t),
    "epoch us": lambda t: str((1733938900000 + t) * 1000),
    "epoch ns": lambda t: str((1733938900000 + t) * 1000000),
    "Excel days": lambda t: f"{45637.5 + t / 86400000:.9f}",
    "MATLAB days": lambda t: f"{739597.5 + t / 86400000:.9f}",
    "millis": lambda t: str(5000 + t),
    "durations": lambda t: f"{t / 1000:.2f} sec",
}


def _written(stamp, form):
    date, clock = str(stamp).split("T")
    y, m, d = date.split("-")
    hours = int(clock[:2])
    half = f"{hours % 12 or 12}{clock[2:]} {'AM' if hours < 12 else 'PM'}"
    return form.format(y=y, m=m, d=d, c=clock, half=half, bare=clock.replace(":", ""))


@pytest.mark.parametrize("style", STAMPS)
def test_time_in_any_style_tells_the_rate(style):
    rows = simulated_rows()
    lines = [f"{STAMPS[style](20 * k)};{x:.4f};{y:.4f};{z:.4f}" for k, (x, y, z) in enumerate(rows)]
    data = "\n".join(["time;ax;ay;az", *lines, ""]).encode()
    result, found = calibrated("-", io.BytesIO(data))
    assert found.rate == pytest.approx(50.0, rel=5e-3)
    assert_truth(result)


def test_minutes_by_their_unit_bursts_and_days_that_are_not_told():
    rows = simulated_rows()
    minutes = [f"{k / 3000:.7f},{x:.4f},{y:.4f},{z:.4f}" for k, (x, y, z) in enumerate(rows)]
    result, found = calibrated("-", io.BytesIO("\n".join(["time [min],ax,ay,az", *minutes, ""]).encode()))
    assert found.rate == pytest.approx(50.0, rel=1e-3)
    assert_truth(result)
    bursts = [
        f"{k // 10 * 0.2 + k % 10 * 0.001:.3f},{x:.4f},{y:.4f},{z:.4f}" for k, (x, y, z) in enumerate(rows)
    ]
    result, found = calibrated("-", io.BytesIO("\n".join(["t,ax,ay,az", *bursts, ""]).encode()))
    assert found.rate == pytest.approx(50.0, rel=1e-3)
    assert_truth(result)
    ask = [f"{3 if k < 9 else 6}/{4 if k < 9 else 5}/2024 17:00:0{k % 9},1,2,{k}" for k in range(20)]
    with pytest.raises(
        DataError, match='line 11, column "time": "6/5/2024" after "3/4/2024" may begin with the day'
    ):
        open_raw_log("-", stdin=io.BytesIO("\n".join(["time,ax,ay,az", *ask, ""]).encode()))


def test_the_temperature_of_each_pose_is_kept_and_a_slower_one_is_carried_on():
    rows = simulated_rows()
    own = [f"{0.02 * k:.2f},{x:.4f},{y:.4f},{z:.4f},{20 + k / 500:.4f}" for k, (x, y, z) in enumerate(rows)]
    _, found = calibrated("-", io.BytesIO("\n".join(["t,ax,ay,az,temperature", *own, ""]).encode()))
    middle = (found.intervals.start + found.intervals.end) / 2 - 1
    np.testing.assert_allclose(found.intervals.temperature, 20 + middle / 500, atol=0.02)
    slow = []
    for k, (x, y, z) in enumerate(rows):
        slow += [f"{0.02 * k:.2f},,,,{20 + k / 500:.4f}"] * (k % 25 == 0)
        slow.append(f"{0.02 * k:.2f},{x:.4f},{y:.4f},{z:.4f},")
    _, merged = calibrated("-", io.BytesIO("\n".join(["t,ax,ay,az,temperature", *slow, ""]).encode()))
    np.testing.assert_allclose(merged.intervals.temperature, found.intervals.temperature, atol=0.06)
    np.testing.assert_array_equal(merged.intervals.mean, found.intervals.mean)


WORDS = {
    "AcX = {} | AcY = {} | AcZ = {}": "",
    "Acceleration X: {}, Y: {}, Z: {} m/s^2\nGyro X: 0.1, Y: 0.2, Z: 0.3 rad/s\nTemp: 21.5": "",
    "#A-R={},{},{}\n#G-R=1,2,3": "",
    "Raw: {}, {}, {}": "",
    "12:30:01.250 -> aX:{} aY:{} aZ:{}": "",
    "S1 {} {} {}\nS2 1 2 3": "S1 ",
}


@pytest.mark.parametrize("form", WORDS)
def test_lines_of_words_are_read_from_a_file_and_by_capture_alike(form):
    from accelcal_cli.io.serial import file_lines, readings

    rows = np.round(simulated_rows()[:400], 3)
    data = "".join(form.format(*row) + "\n" for row in rows.tolist()).encode()
    prefix = WORDS[form] or None
    log = open_raw_log("-", stdin=io.BytesIO(data), time="none", options=ReadOptions(line=prefix))
    np.testing.assert_array_equal(np.concatenate(list(log.blocks()))[:, :3], rows)
    log.close()
    live = list(readings(file_lines(io.BytesIO(data)), [0, 1, 2], "port", prefix))
    np.testing.assert_array_equal(live, rows)
