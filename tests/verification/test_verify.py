"""An old result against new readings."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from simulated import MEMS, noise, readings, rotation

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import PARAMETERS, design
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.verification.verify import verify
from accelcal_cli.views.verification import differences, evidence

G, SIGMA = 9.8, 2e-3
FAST = Settings(optimizer="levenberg-marquardt", g=G)
LOWER = MEMS.in_gauge("lower")
TURNS = poses.turns()


def result(u=TURNS, seed=1, **settings):
    return calibrate(readings(u, model=MEMS, sigma=SIGMA, seed=seed), dataclasses.replace(FAST, **settings))


def new(u=TURNS, model=MEMS, sigma=SIGMA, seed=2):
    return readings(u, model=model, sigma=sigma, seed=seed)


def moved(scale=(0, 0, 0), bias=(0, 0, 0)):
    """The sensor with other scale factors (parts) and biases (m/s^2)."""
    K = np.diag(1.0 + np.array(scale)) @ LOWER.K
    return ErrorModel(K, LOWER.D + np.array(bias) * np.diagonal(LOWER.K))


def sigma_of_difference(u, v):
    """One-sigma of the nine differences, m/s^2, from two sets of poses."""
    return SIGMA * np.sqrt(sum(np.diagonal(np.linalg.inv(design(w).T @ design(w))) for w in (u, v)))


@pytest.mark.parametrize("count", [12, 24])
def test_unchanged_sensors_seldom_fail(count):
    """From readings to verdict; 150 sensors at 5 % give 7.5 with a scatter of 2.7. None is left open."""
    u = poses.directions(count, None, np.zeros((0, 3)))
    found = [verify(result(u, 2 * k), new(u, seed=2 * k + 1)).verdict for k in range(150)]
    assert 1 <= found.count("changed") <= 16
    assert found.count("inconclusive") == 0


def test_a_bias_shift_of_five_sigma_is_caught():
    """150 sensors; 95 % of them are 142, with a scatter of 2.7."""
    u = poses.turns()
    shift = 5 * sigma_of_difference(u, u)[8]
    shifted = moved(bias=(0, 0, shift))
    hits = sum(
        verify(result(u, 2 * k), new(u, shifted, seed=2 * k + 1)).verdict == "changed" for k in range(150)
    )
    assert hits >= 138


@pytest.mark.parametrize(
    ("change", "name", "value"),
    [
        ({"bias": (0, 0.02, 0)}, "bias y", 0.02),
        ({"scale": (0, 0, 0.004)}, "scale factor z", -0.004 * G),
    ],
)
def test_what_changed_is_named_and_measured(change, name, value):
    found = verify(result(), new(model=moved(**change)))
    assert found.verdict == "changed"
    assert not found.passed
    assert f"Changed: {name}." in found.reasons
    (named,) = [d for d in found.differences if d.changed]
    assert named.name == name
    assert named.value == pytest.approx(value, abs=5 * named.sigma)
    assert named.sigma == pytest.approx(
        sigma_of_difference(poses.turns(), poses.turns())[PARAMETERS.index(name)], rel=0.5
    )


def test_the_body_frame_and_the_gauge_do_not_matter():
    """A sensor that is mounted otherwise, and a result in another gauge: the same sensor."""
    turned = ErrorModel(MEMS.K @ rotation(4), MEMS.D)
    plain = verify(result(), new(model=turned))
    assert plain.verdict == "unchanged"
    other = verify(result(gauge="symmetric"), new(model=turned))
    assert other.chance == pytest.approx(plain.chance, rel=1e-6)
    assert other.chi_square == pytest.approx(plain.chi_square, rel=1e-6)


def test_six_faces_tell_of_scale_and_bias():
    same = verify(result(), new(poses.faces()))
    assert same.verdict == "unchanged"
    assert same.directions == 6
    assert [d.name for d in same.differences if np.isnan(d.value)] == list(PARAMETERS[3:6])
    assert any("6 of 9 directions" in line for line in same.reasons)
    assert any("leave no degrees of freedom" in line for line in same.reasons)
    changed = verify(result(), new(np.repeat(poses.faces(), 4, axis=0), moved(bias=(0.03, 0, 0))))
    assert changed.verdict == "changed"
    assert any(line == "Changed: bias x." for line in changed.reasons)
    assert changed.freedom == 18


def test_two_poses_are_something():
    u = poses.faces()[:2]
    assert verify(result(), new(u)).verdict == "unchanged"
    assert verify(result(), new(u, moved(bias=(0.05, 0, 0)))).verdict == "changed"


def test_a_little_more_noise_is_said_but_is_no_change():
    found = verify(result(), new(sigma=2 * SIGMA))
    assert found.verdict == "unchanged"
    assert found.noise_chance < 0.01
    assert any("2.1 times the noise of the old ones" in line for line in found.reasons)
    assert found.s_new == pytest.approx(2 * SIGMA, rel=0.5)


@pytest.mark.parametrize(("times", "told"), [(5, "5.1 times"), (100, "101 times"), (1700, "1,0")])
def test_much_more_noise_tells_nothing(times, told):
    """Of 1700 times the noise, a third of g, even the differences are beyond the level: no change for all that."""
    found = verify(result(), new(sigma=times * SIGMA))
    assert (found.verdict, found.passed) == ("inconclusive", False)
    assert any(f"have {told}" in line for line in found.reasons)
    assert any(
        "noise of the new readings hides changes that the result would show. Measure again" in line
        for line in found.reasons
    )
    assert not any(d.changed for d in found.differences)
    assert any("of g (above 0.5%" in line.text for line in found.warnings) == (times > 5)


def test_a_change_that_noise_does_not_hide_is_one():
    found = verify(result(), new(model=moved(bias=(0, 2.0, 0)), sigma=20 * SIGMA))
    assert found.verdict == "changed"
    assert "Changed: bias y." in found.reasons
    assert not any("hides" in line for line in found.reasons)


def test_a_result_of_large_residuals_shows_nothing_unchanged():
    old = calibrate(readings(TURNS, model=MEMS, sigma=0.5, seed=1), FAST)
    assert old.verdict == "suspect"
    found = verify(old, new())
    assert found.verdict == "inconclusive"
    assert any(line.startswith("A typical pose of the result itself is off by 4.") for line in found.reasons)
    assert verify(old, new(model=moved(bias=(0, 8.0, 0)))).verdict == "changed"


def test_rows_of_a_log_are_no_poses():
    """A slow turn with waves in it, 6000 rows: no change is seen in them, and none is excluded."""
    t = np.linspace(0.0, 60.0, 6000)
    a, b = 0.7 * t, 0.31 * t
    u = np.stack([np.cos(a) * np.cos(b), np.sin(a) * np.cos(b), np.sin(b)], axis=1)
    waves = np.stack([np.sin(7 * t), np.cos(5 * t), np.sin(3 * t)], axis=1)
    found = verify(result(), Readings.from_array(MEMS.output(G * u + waves)))
    assert found.freedom < 100
    assert found.verdict == "inconclusive"
    assert any("themselves are doubtful" in line for line in found.reasons)
    assert "6,000 rows are a log" in found.warnings[0].text


@pytest.mark.parametrize(
    "u", [TURNS, poses.faces_edges(), np.repeat(poses.faces(), 4, axis=0)], ids=["24", "12", "faces"]
)
def test_a_pose_that_is_wrong_is_named(u):
    """10 % of one of 24, of 12 that the fit follows, and of faces that leave directions open."""
    output = new(u).output().copy()
    output[3] *= 1.1
    found = verify(result(), Readings.from_array(output))
    assert found.verdict == "inconclusive"
    assert (
        str(found.warnings[-1])
        == "Outlier: pose 4 does not fit the other poses (p < 0.002). Measure it again."
    )


def test_a_pose_that_is_a_little_wrong_is_named_beside_the_verdict():
    output = new().output().copy()
    output[3] *= 1.002
    found = verify(result(), Readings.from_array(output, labels=[f"p{k}" for k in range(24)]))
    assert found.verdict == "unchanged"
    assert [str(notice) for notice in found.warnings] == [
        'Outlier: position "p3" does not fit the other poses (p < 0.002). Measure it again.',
    ]
    assert verify(result(), new()).warnings == ()


def test_readings_without_noise_are_no_change():
    clean = calibrate(readings(poses.turns(), model=MEMS, sigma=0.0), FAST)
    assert verify(clean, new(sigma=0.0)).verdict == "unchanged"
    assert verify(clean, new(model=moved(bias=(1e-4, 0, 0)), sigma=0.0)).verdict == "changed"


def test_the_tolerance_is_on_the_rms_under_the_old_result():
    old = result()
    f = old.model.specific_force(new().output())
    rms = np.sqrt(np.mean((np.linalg.norm(f, axis=1) - G) ** 2))
    found = verify(old, new(), tolerance=2 * rms)
    assert found.rms == pytest.approx(rms, rel=1e-9)
    assert found.passed
    assert not verify(old, new(), tolerance=0.5 * rms).passed


def test_a_large_change_is_no_trouble():
    found = verify(result(), new(model=moved(scale=(0.1, 0, 0), bias=(0, 2, 0))))
    assert found.verdict == "changed"
    assert found.differences[7].value == pytest.approx(2.0, rel=1e-2)


@pytest.mark.parametrize("u", [poses.faces(), poses.fibonacci(9)], ids=["undetermined", "no freedom"])
def test_a_result_without_uncertainty_is_refused(u):
    with pytest.raises(DataError, match=r"no (uncertainty|noise)"):
        verify(result(u), new())


def test_the_record_is_plain_and_the_tables_hold_it():
    found = verify(result(), new(poses.faces()), tolerance=0.01)
    record = json.loads(json.dumps(found.record(), allow_nan=False))
    assert record["schema"] == "accelcal/verification/2"
    assert record["differences"][3]["value"] is None
    assert record["warnings"] == []
    assert record["result"]["sha256"] != record["data"]["sha256"]
    assert len(differences(found).rows) == 9
    assert ("tolerance", "0.01", "m/s^2") in evidence(found).rows


def test_differences_are_those_of_the_matrix_that_the_result_shows():
    """K_a and D_a of the later sensor minus those of the earlier, in gauge lower and in an engineer's units."""
    later = moved(scale=(0.002, 0, 0), bias=(0, 0.05, 0))
    later = ErrorModel(later.K + np.array([[0, 0, 0], [0, 0, 0], [0.003 * LOWER.K[2, 2], 0, 0]]), later.D)
    clean = calibrate(readings(poses.turns(), model=MEMS, sigma=1e-6), FAST)
    rows = differences(verify(clean, new(model=later, sigma=1e-6))).rows
    expected = np.zeros(9)
    expected[[0, 4, 7]] = 2000.0, 3000.0, 0.05 / G * 1e6
    np.testing.assert_allclose([row[1] for row in rows], expected, atol=0.02 * 3000)
    assert [row[3] for row in rows] == ["ppm"] * 3 + ["micro-rad"] * 3 + ["micro-g"] * 3


def test_temperatures_are_brought_to_that_of_the_result():
    u = np.concatenate([poses.turns(), poses.turns()])
    degrees = np.repeat([10.0, 40.0], 24)
    slopes = 2e-3 * (degrees - 25.0)[:, None] * [1.0, -1.0, 0.5]

    def warm(seed):
        output = MEMS.output(G * u + noise(48, SIGMA, seed)) + slopes
        return Readings.from_array(output, temperature=degrees)

    old = calibrate(warm(1), FAST)
    assert old.temperature is not None
    assert verify(old, warm(2)).verdict == "unchanged"
    cold = Readings.from_array(warm(3).output()[:24])
    found = verify(old, cold)
    assert found.verdict == "changed"
    assert any("no temperatures" in line for line in found.reasons)


def test_a_warm_sensor_is_the_one_that_it_was():
    """Slopes that move a bias by fifteen sigma at 40 degrees, and poses at 40 degrees alone."""
    u = np.concatenate([TURNS, TURNS])
    degrees = np.repeat([10.0, 40.0], 24)
    slopes = 2e-3 * (degrees - 25.0)[:, None] * [1.0, -1.0, 0.5]
    output = MEMS.output(G * u + noise(48, SIGMA, 1)) + slopes
    old = calibrate(Readings.from_array(output, temperature=degrees), FAST)
    later = MEMS.output(G * TURNS + noise(24, SIGMA, 2)) + slopes[24:]
    assert verify(old, Readings.from_array(later, temperature=degrees[24:])).verdict == "unchanged"
    shifted = later + np.array([0.0, 0.03, 0.0])
    found = verify(old, Readings.from_array(shifted, temperature=degrees[24:]))
    assert found.verdict == "changed"
    assert found.differences[7].value == pytest.approx(0.03 / LOWER.K[1, 1], rel=0.2)


@pytest.mark.parametrize(
    ("factor", "told"),
    [
        (16377.0, "most have 0.00[0-9]*; are they in another unit than its readings, or from another sensor"),
        (1e9, "most have .*; are they in another unit"),
        (1e-9, "most have .*; are they in another unit"),
        (9.80665, "most have (1|0.99)[0-9.]*; they seem to be in g where those of the result are in m/s"),
        (1e-3, "most have .*; they seem to be in a unit a thousand times as small"),
    ],
)
@pytest.mark.parametrize("u", [poses.turns(), poses.faces()[:2]], ids=["turns", "two poses"])
def test_readings_in_another_unit_are_refused(factor, told, u):
    """A sensor without bias, so that readings too small determine nothing at all."""
    plain = ErrorModel(1670.0 * np.eye(3), np.zeros(3))
    old = calibrate(readings(TURNS, model=plain, sigma=SIGMA, seed=1), FAST)
    other = Readings.from_array(new(u, model=plain).output() / factor)
    with pytest.raises(DataError, match=rf"no pose is near g = 9.8 m/s\^2, {told}"):
        verify(old, other)


def test_an_axis_that_died_is_a_matter_of_the_sensor():
    output = new().output().copy()
    output[:, 2] = MEMS.D[2]
    found = verify(result(), Readings.from_array(output))
    assert found.verdict != "unchanged"
    assert found.rms > 0.2 * G


def test_readings_that_determine_nothing_are_never_unchanged(monkeypatch):
    monkeypatch.setattr("accelcal_cli.verification.verify.check_unit", lambda *_: None)
    monkeypatch.setattr("accelcal_cli.verification.verify.limitations_of", lambda *_: ())
    plain = ErrorModel(1670.0 * np.eye(3), np.zeros(3))
    old = calibrate(readings(TURNS, model=plain, sigma=SIGMA, seed=1), FAST)
    found = verify(old, Readings.from_array(new(poses.faces()[:2], model=plain).output() / 1e4))
    assert found.directions == 0
    assert found.verdict == "inconclusive"
    assert "determine 0 of 9 directions" in " ".join(found.reasons)


def test_copies_are_no_new_readings_and_are_not_called_a_log():
    """Six poses, each four times to the last digit: the reason speaks of what the warnings say, not of a log."""
    output = np.repeat(new(poses.edges()[:6]).output(), 4, axis=0)
    found = verify(result(), Readings.from_array(output))
    assert found.verdict == "inconclusive"
    assert any("themselves are doubtful, as the warnings say" in reason for reason in found.reasons)
    assert any("repeat another to the last digit" in notice.text for notice in found.warnings)
    output = np.repeat(new(poses.edges()[:6], moved(bias=(0.5, 0.5, 0))).output(), 4, axis=0)
    changed = verify(result(), Readings.from_array(output))
    assert changed.chance < 1e-9
    assert changed.verdict == "inconclusive"


def test_a_suspect_result_is_said_and_is_no_reason_against_the_readings():
    """One pose of the result is wrong by two thousandths: what the others say still holds to their noise."""
    output = readings(TURNS, model=MEMS, sigma=SIGMA, seed=1).output().copy()
    output[3] *= 1.002
    old = calibrate(Readings.from_array(output), FAST)
    assert old.verdict == "suspect"
    found = verify(old, new())
    assert found.verdict == "unchanged"
    assert [(n.key, n.severity) for n in found.warnings] == [("suspect-result", "note")]
    assert found.warnings[0].text.startswith("The result is suspect itself (outliers)")


def test_the_freedom_of_sigma_counts_not_the_rows():
    """Rows of 24 attitudes that follow each other: sigma has few degrees of freedom, however many rows there are."""
    shared = np.repeat(noise(24, SIGMA, 5), 20, axis=0)
    rows = np.repeat(TURNS, 20, axis=0)
    output = MEMS.output(G * rows + shared + noise(480, 0.1 * SIGMA, 6))
    found = verify(result(), Readings.from_array(output))
    assert found.freedom < 24
    assert any(notice.key == "correlated" for notice in found.warnings)
