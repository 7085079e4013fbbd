"""Raw logs that show what is no rest: zeros, frozen stretches, clipped holds, no gravity, sensors in turn."""

import numpy as np
import pytest
from raw_logs import opened, simulated, text

from accelcal_cli.detection.detect import DetectSettings, TooFewPosesError, detect
from accelcal_cli.detection.log_screening import alternating
from accelcal_cli.errors import DataError

SETTINGS = DetectSettings(rate=100.0, least_poses=10)


def detected(numbers, names="ax,ay,az", settings=SETTINGS):
    log = opened(text(numbers, names))
    try:
        return detect(log, settings)
    finally:
        log.close()


def keys(detection):
    return {notice.key: notice for notice in detection.readings().warnings}


@pytest.fixture(scope="module")
def log():
    return simulated(14, seed=4, gyro=False, timed=False)


def test_an_honest_log_is_silent(log):
    assert keys(detected(log[0])) == {}


def test_forty_honest_logs_raise_no_alarm(capsys):
    """Four noises by five resolutions, up to 16 mg, twice."""
    alarms, logs = [], 0
    for seed in range(2):
        for noise in (0.0002, 0.002, 0.02, 0.2):  # m/s^2
            numbers, _ = simulated(12, seed=seed, noise=noise, gyro=False, timed=False)
            for step in (0.0, 0.01, 0.05, 0.1, 0.157):
                size = step * 1670  # counts of the sensor `mems`
                rows = numbers if not step else size * np.round(numbers / size)
                logs += 1
                try:
                    alarms += [
                        (noise, step, key)
                        for key, n in keys(detected(rows)).items()
                        if n.severity == "warning"
                    ]
                except DataError as fault:
                    alarms += [(noise, step, "refused")] * ("gravity" in str(fault) or "never" in str(fault))
    with capsys.disabled():
        print(f"\nfalse alarms in raw logs: {len(alarms)} of {logs} {alarms}")  # noqa: T201
    assert not alarms


def test_zeros_are_left_out(log):
    numbers, holds = log
    rows = numbers.copy()
    middle = holds[2, 0] + 100
    rows = np.insert(rows, [middle] * 700, 0.0, axis=0)
    found = detected(rows)
    notice = keys(found)["zero-rows"]
    assert notice.severity == "note"
    assert f"700 rows are zero in all three axes (line {middle + 2} to line {middle + 701})" in notice.text
    assert np.abs(found.intervals.mean).max(axis=1).min() > 1000
    assert len(found.intervals) in (14, 15)  # the rest of the hold may be too short


def test_frozen_stretches_are_no_rest(log):
    numbers, holds = log
    rows = numbers.copy()
    moving = (holds[3, 1] + holds[4, 0]) // 2
    rows = np.insert(rows, [moving] * 600, rows[moving], axis=0)
    found = detected(rows)
    assert keys(found)["frozen"].severity == "note"
    assert len(found.intervals) == 14
    assert not ((found.intervals.start > moving) & (found.intervals.end <= moving + 600)).any()


def test_a_frozen_axis_is_no_rest(log):
    numbers, holds = log
    rows = numbers.copy()
    a, b = holds[5]
    rows[a - 1 : b, 1] = rows[a, 1]
    found = detected(rows)
    assert "frozen" in keys(found)
    assert len(found.intervals) == 13


def test_steps_near_the_noise_do_not_end_poses():
    """Of five rows with a noise of 0.8 steps now and then all are equal."""
    numbers, holds = simulated(14, seed=4, gyro=False, timed=False)
    still = np.concatenate([numbers[a - 1 : b] - numbers[a - 1 : b].mean(axis=0) for a, b in holds])
    step = float(still.std()) / 0.8
    found = detected(step * np.round(numbers / step))
    assert keys(found) == {}
    assert len(found.intervals) == 14


def test_coarse_readings_are_not_frozen(log):
    rows = 400 * np.round(log[0] / 400)
    found = keys(detected(rows))
    assert set(found) == {"quantised"}
    assert found["quantised"].severity == "note"
    assert "steps of 400," in found["quantised"].text


def test_a_log_with_too_few_poses_says_what_spoils_it(log):
    """Why poses are missing: the sensor slept through them."""
    rows, holds = log[0].copy(), log[1]
    for a, b in holds[:5]:
        rows[a - 1 : b] = 0.0
    with pytest.raises(TooFewPosesError, match="rows are zero in all three axes"):
        detected(rows)


@pytest.mark.parametrize("part", [0.9, 0.97])
def test_clipped_holds_are_named(log, part):
    numbers, _ = log
    honest = detected(numbers).intervals.mean
    limit = part * np.abs(honest).max()
    found = detected(np.clip(numbers, -limit, limit))
    notice = keys(found)["clipped"]
    assert notice.severity == "warning"
    assert f"in {np.count_nonzero((np.abs(honest) > limit).any(axis=1))} of" in notice.text


def test_turning_rates_in_place_of_acceleration():
    numbers, _ = simulated(14, seed=5, gyro=True, timed=False)
    swapped = numbers[:, [3, 4, 5, 0, 1, 2]]
    with pytest.raises(
        DataError, match=r"gravity does not turn in columns 1, 2, 3.*--columns 4,5,6 --gyro 1,2,3"
    ):
        detected(swapped, "")


def test_a_sensor_that_was_never_turned():
    rows = np.array([0.1, 0.2, 9.8]) + np.random.default_rng(1).normal(0, 0.02, (3000, 3))
    with pytest.raises(DataError, match="never turned: all readings show one attitude"):
        detected(rows)


def test_linear_acceleration():
    rng = np.random.default_rng(2)
    rows = rng.normal(0, 0.02, (9000, 3))
    for start in range(300, 9000, 900):
        rows[start : start + 300] += 2 * np.sin(np.linspace(0, 12, 300))[:, None] * rng.normal(size=3)
    with pytest.raises(DataError, match="gravity does not turn in columns ax, ay, az"):
        detected(rows)


def test_sensors_in_turn(log):
    numbers, _ = log
    other = numbers * [1.01, 0.99, 1.02] + [300, -200, 100]
    rows = np.stack([numbers, other], axis=1).reshape(-1, 3)
    notice = keys(detected(rows))["several-sensors"]
    assert "from 2 sensors in turn" in notice.text
    assert alternating(numbers, None) == ()
    times = np.repeat(np.arange(len(numbers)), 2)
    assert "equal times" in alternating(rows, times)[0].text


@pytest.mark.parametrize("rate", [23.3, 33.7, 45.0, 48.5])
def test_a_vibration_is_not_several_sensors(rate):
    numbers, _ = simulated(14, seed=6, gyro=False, timed=False)
    waves = 5000 * np.sin(2 * np.pi * rate * np.arange(len(numbers))[:, None] / 100 + [0.0, 1.0, 2.0])
    assert alternating(numbers + waves, None) == ()
