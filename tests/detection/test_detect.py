"""From a log to poses: the threshold that is kept, close poses, weights, and real recordings."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from raw_logs import G, opened, simulated, text
from simulated import MEMS, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import attitudes
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import shared_variance, state
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.detection.detect import MULTIPLIERS, TIE, CandidateThreshold, DetectSettings, best, detect
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.detection.windows import Span, Spans
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.poses import fibonacci
from accelcal_cli.sensor.simulation import load_sensor

XSENS = ErrorModel(
    np.array([[414.441645, 0, 0], [1.477289, 412.122680, 0], [3.832964, 8.841874, 414.507889]]),
    np.array([33123.830748, 33275.155024, 32364.493739]),
)
IMU0 = ErrorModel(
    np.array([[1.00366706, 0, 0], [0.00045546, 1.00307871, 0], [0.00561164, 0.00198516, 1.00633170]]),
    np.array([0.10344547, 0.09662583, 0.34399053]),
)
IMU1 = ErrorModel(
    np.array([[1.00458482, 0, 0], [-0.00009467, 1.00473874, 0], [0.00239229, -0.00481136, 1.00936966]]),
    np.array([0.08988208, 0.06984718, 0.33806652]),
)
"""The sensors of the recordings, by an independent solver from other intervals."""

IMU_TK = DetectSettings(
    spans=Spans(window=Span(101, True), still=Span(50.0), least=Span(100, True)),
    multipliers=tuple(float(k) for k in range(2, 11)),
)
"""The settings that imu_tk uses for its recording."""

ONE = DetectSettings(multipliers=(5.0,))
"""One multiplier, for what does not depend on the choice."""

RECORDINGS = [
    ("imu_tk_xsens/xsens_acc.txt", 9.81744, DetectSettings(g=9.81744), XSENS, 30, 1.2e-3),
    ("imu_tk_xsens/xsens_acc.txt", 9.81744, IMU_TK, XSENS, 30, 1.2e-3),
    ("mikoff_mpu9150/imu0.log", 9.81, DetectSettings(g=9.81), IMU0, 20, 3.5e-3),
    ("mikoff_mpu9150/imu1.log", 9.81, DetectSettings(g=9.81), IMU1, 20, 3.5e-3),
]


def _weights(readings):
    """Weights auto, shape (J,)."""
    return state(Sample.of([readings]), Settings(g=9.8, weights="auto")).weights[0]


def detected(numbers, settings=None, **more):
    log = opened(text(numbers, **more))
    try:
        return detect(log, settings or DetectSettings())
    finally:
        log.close()


def assert_within(result, sensor, sigmas=3.0):
    lower = np.tril_indices(3)
    away = np.abs(result.K_a - sensor.K)[lower] / result.sigma.K_a[lower]
    assert away.max() < sigmas
    assert (np.abs(result.D_a - sensor.D) / result.sigma.D_a).max() < sigmas


@pytest.mark.parametrize(("name", "g", "settings", "sensor", "poses", "rms"), RECORDINGS)
def test_a_real_recording_gives_the_known_sensor(shared_data, name, g, settings, sensor, poses, rms):
    log = open_raw_log(shared_data / name)
    found = detect(log, settings)
    log.close()
    result = calibrate(found.readings(), Settings(g=g, weights="auto"))
    assert result.verdict == "good"
    assert result.poses >= poses
    assert result.rms < rms
    assert_within(result, sensor)


def test_the_published_multiplier_finds_the_published_intervals(shared_data):
    """imu_tk's multiplier 6 gives 38 intervals; ours begin and end within its window of theirs."""
    settings = DetectSettings(spans=IMU_TK.spans, multipliers=(6.0,))
    log = open_raw_log(shared_data / "imu_tk_xsens/xsens_acc.txt")
    found = detect(log, settings).intervals
    log.close()
    published = np.genfromtxt(shared_data / "imu_tk_xsens/static_means.csv", delimiter=",", names=True)
    assert len(found) == len(published) == 38
    np.testing.assert_allclose(found.time[:, 0], published["t_start"], atol=1.01)
    np.testing.assert_allclose(found.time[:, 1], published["t_end"], atol=1.01)


def test_a_simulated_sensor_is_found():
    numbers, holds = simulated(18, tremor=0.02, seed=8)
    found = detected(numbers)
    assert len(found.intervals) == len(holds)
    result = calibrate(found.readings(), Settings(g=G, weights="auto"))
    assert_within(result, load_sensor("mems").model.in_gauge("lower"), 4.0)
    assert result.poses_fit[0].where.startswith("time 0.5 to ")
    assert result.data["sha256"] == found.sha256
    assert result.notes[-1] == found.summary()
    assert "18 still intervals found" in found.summary()


def test_the_kept_multiplier_is_the_stillest_of_the_best():
    found = detected(simulated(16, seed=2)[0])
    assert tuple(c.multiplier for c in found.candidates) == MULTIPLIERS
    (kept,) = [c for c in found.candidates if c.multiplier == found.multiplier]
    good = [c for c in found.candidates if c.verdict == "good" and c.attitudes >= 12]
    assert kept.sigma <= TIE * min(c.sigma for c in good)
    assert all(c.sigma > TIE * min(c.sigma for c in good) for c in good if c.multiplier < kept.multiplier)


def test_a_log_need_not_begin_still():
    numbers, holds = simulated(16, seed=4)
    found = detected(numbers[holds[0, 1] + 40 :])
    assert len(found.intervals) == len(holds) - 1


def test_poses_without_time_are_named_by_rows():
    found = detected(simulated(14, gyro=False, timed=False)[0], names="ax,ay,az")
    assert found.rate is None
    assert found.readings().where(0) == f"rows {found.intervals.start[0]} to {found.intervals.end[0]}"


def twice(seed=6):
    """A log in which every attitude is held twice."""
    one, _ = simulated(13, seed=seed, timed=False)
    two, _ = simulated(13, seed=seed + 1, timed=False)
    return np.concatenate([one, two[: len(two)]])


@pytest.mark.parametrize("how", ["merge", "thin"])
def test_close_poses_become_one_on_request(how):
    names = "ax,ay,az,wx,wy,wz"
    every = detected(twice(), ONE, names=names).intervals
    few = detected(twice(), dataclasses.replace(ONE, **{how: 1.0}), names=names).intervals
    assert len(every) == 26
    assert len(few) == 13
    if how == "merge":
        assert few.n.sum() == every.n.sum()
    else:
        assert set(few.start) <= set(every.start)
        assert few.n.sum() < every.n.sum()


def test_attitudes_go_to_the_longest_pose():
    u = np.array([[1.0, 0, 0], [0, 1, 0], [np.cos(0.01), np.sin(0.01), 0], [-1, 0, 0]])
    groups = attitudes(u, np.array([5, 9, 7, 1]), 1.0)
    assert [list(group) for group in groups] == [[1], [2, 0], [3]]


@pytest.mark.parametrize(
    ("settings", "positions", "said"),
    [
        (DetectSettings(), 5, "5 still poses in 5 attitudes, fewer than 12.*record more poses"),
        (
            DetectSettings(spans=Spans(least=Span(30.0))),
            14,
            "no still pose, 12 are needed.*14 stretches.*hold each pose longer",
        ),
        (DetectSettings(least_poses=13, multipliers=(5.0,)), 12, "12 still poses.*multiplier 5"),
    ],
)
def test_too_few_poses_are_explained(settings, positions, said):
    numbers, _ = simulated(positions)
    with pytest.raises(DataError, match=said) as error:
        detected(numbers, settings)
    assert "quietest variance" in str(error.value)
    assert "longest still stretch" in str(error.value)


def test_one_attitude_held_often_is_not_enough():
    one, _ = simulated(2, seed=1, timed=False)
    with pytest.raises(DataError, match=r"turn the sensor to more attitudes.*--min-poses"):
        detected(np.concatenate([one] * 8), ONE, names="ax,ay,az,wx,wy,wz")


def test_a_log_that_never_rests_is_told_so():
    t = np.arange(4000.0)[:, None] / 20
    moving = 9 * np.sin(t * [1.0, 1.3, 1.7]) + np.sin(40 * t)
    with pytest.raises(DataError, match="no part of the log is still"):
        detected(moving, names="ax,ay,az")


def moving(seconds, speed, noise):
    """Readings in m/s^2 at 100 Hz, shape (n, 3), of a sensor that turns without a rest."""
    t = np.arange(100.0 * seconds)[:, None] / 100
    u = np.sin(speed * t * [0.9, 1.3, 1.1] + [0.0, 1.0, 2.0])
    return G * u / np.linalg.norm(u, axis=1, keepdims=True) + noise * np.random.default_rng(1).normal(
        size=u.shape
    )


@pytest.mark.parametrize(
    ("speed", "noise", "said"),
    [(1.0, 0.5, "no part of the log is still"), (0.03, 0.05, r"turns while they last.*put the sensor down")],
)
def test_turning_is_no_pose_however_slow_or_noisy(speed, noise, said):
    with pytest.raises(DataError, match=said):
        detected(moving(300, speed, noise), names="ax,ay,az")


def test_a_vibration_is_no_motion():
    """A fan of 23 Hz and 3 m/s^2: the poses are there, and their scatter says what they are worth."""
    numbers, holds = simulated(16, seed=3)
    numbers[:, :3] += 1670 * 3 * np.sin(2 * np.pi * 23.3 * numbers[:, -1:] + [0.0, 1.0, 2.0])
    found = detected(numbers)
    assert len(found.intervals) == len(holds)
    result = calibrate(found.readings(), Settings(g=G, weights="auto"))
    assert result.verdict == "good"
    assert_within(result, load_sensor("mems").model.in_gauge("lower"), 4.0)


def test_fewer_poses_may_be_accepted():
    found = detected(simulated(6)[0], DetectSettings(least_poses=6))
    assert len(found.intervals) == 6
    assert calibrate(found.readings(), Settings(g=G, weights="auto")).verdict == "undetermined"


def test_the_shared_variance_has_its_expectation():
    own = np.array([1e-6, 1e-6, 4e-6, 9e-6] * 10)
    errors = np.sqrt(own + 3e-6)  # squares exactly as expected
    assert shared_variance(errors, own, 40) == pytest.approx(3e-6, rel=1e-6)
    assert shared_variance(np.sqrt(own), own, 40) == pytest.approx(0.0, abs=1e-9)
    assert shared_variance(0.5 * np.sqrt(own), own, 40) == 0.0


def unequal(shared, seed):
    """40 poses: half of 100 readings, half of 10 000, with noise of 0.1 m/s^2 a reading and an error they share."""
    u, count = fibonacci(40), np.tile([100.0, 10_000.0], 20)
    force = 9.8 * u + noise(40, 1.0, seed) * (0.1 / np.sqrt(count))[:, None]
    output = MEMS.output(force + u * noise(40, shared, seed + 100)[:, :1])
    return Readings.from_array(output, count=count, scatter=np.full((40, 3), 0.1))


def test_weights_follow_the_noise_and_level_off():
    noisy = _weights(unequal(0.0, 1))
    model = _weights(unequal(0.05, 1))
    assert noisy[1] / noisy[0] > 5
    assert model[1] / model[0] < 1.5
    assert noisy.mean() == pytest.approx(1.0)


def test_auto_weights_need_count_and_scatter():
    plain = Readings.from_array(MEMS.output(9.8 * fibonacci(20)))
    with pytest.raises(DataError, match="--weights auto needs"):
        calibrate(plain, Settings(g=9.8, weights="auto"))


@pytest.mark.parametrize("shared", [0.0, 0.01])
def test_auto_weights_come_near_the_better_of_the_others(shared):
    """Mean square error of the bias over 12 sets, against no weights and weights by count."""

    def error(choice):
        settings = Settings(g=9.8, optimizer="ellipsoid", weights=choice)
        found = [calibrate(unequal(shared, seed), settings).D_a - MEMS.D for seed in range(12)]
        return float(np.mean(np.square(found)))

    assert error("auto") < 2.0 * min(error("none"), error("n"))


def test_of_candidates_as_good_the_stillest_is_kept():
    found = [
        CandidateThreshold(m, 20, 20, 0.01, sigma, "good")
        for m, sigma in ((5.0, 1.0), (3.0, 1.04), (2.0, 1.06))
    ]
    assert best([0, 1, 2], found) == 1
    assert best([0, 2], found) == 0


def test_a_pose_of_many_readings_is_not_taken_for_free_of_error():
    """Scatter that explains the errors alone: the weights are 1 / (v_j / n_j and a hundredth of its mean)."""
    u, scatter = fibonacci(24), 0.1
    count = np.array([10.0, 1e6] * 12)
    plain = ErrorModel(np.eye(3), np.zeros(3))
    data = Readings.from_array(
        plain.output(G * u + noise(24, 1e-4, 1)), count=count, scatter=np.full((24, 3), scatter)
    )
    own = [scatter**2 / n for n in count]
    expected = np.array([1.0 / (v + 0.01 * sum(own) / 24) for v in own])
    weights = _weights(data)
    np.testing.assert_allclose(weights, expected / expected.mean(), rtol=1e-3)
    assert weights.max() / weights.min() < 250
