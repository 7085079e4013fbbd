"""Known attitudes: twelve parameters by linear least squares."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import scipy.stats
from simulated import MEMS, noise, rotation

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.residuals import OUTLIER_LEVEL
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.io.readings import Readings
from accelcal_cli.navigation.ins import InsGrade
from accelcal_cli.navigation.study import grade_of
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.views.calibration import engineering

G, SIGMA = 9.8, 2e-3
KNOWN = Settings(g=G, attitudes="known")
TWELVE = poses.faces_edges()


def known(u=TWELVE, sigma=SIGMA, seed=1, g=G, **more):
    return Readings.from_array(MEMS.output(g * u + noise(len(u), sigma, seed)), reference=g * u, **more)


def test_all_twelve_parameters_are_found():
    result = calibrate(known(sigma=0.0), KNOWN)
    np.testing.assert_allclose(result.K_a, MEMS.K, atol=1e-13)
    np.testing.assert_allclose(result.D_a, MEMS.D, atol=1e-13)
    assert result.gauge == "full"
    assert result.verdict == "good"


def test_sigma_is_what_repeated_noise_gives():
    runs = [calibrate(known(seed=k), KNOWN) for k in range(600)]
    K, D = np.array([r.K_a for r in runs]), np.array([r.D_a for r in runs])
    s = np.mean([r.s**2 for r in runs]) ** 0.5
    assert s == pytest.approx(SIGMA, rel=0.05)
    sigma_K, sigma_D = (
        np.sqrt(np.mean([part(r.sigma) ** 2 for r in runs], axis=0))
        for part in (lambda sigma: sigma.K_a, lambda sigma: sigma.D_a)
    )
    np.testing.assert_allclose(K.std(axis=0), sigma_K, rtol=0.15)
    np.testing.assert_allclose(D.std(axis=0), sigma_D, rtol=0.15)
    assert runs[0].freedom == 3 * 12 - 12


def test_the_covariance_of_the_nine_is_what_repeated_noise_gives():
    """In gauge lower: differences of K_A relative to the truth, as force."""
    low = to_gauge(MEMS.K, "lower")
    runs = [calibrate(known(seed=k), KNOWN) for k in range(600)]
    values = []
    for r in runs:
        E = np.linalg.solve(to_gauge(r.K_a, "lower"), low) - np.eye(3)
        values.append(
            [*(G * E[[0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]]), *((r.D_a - MEMS.D) / np.diagonal(low))]
        )
    expected = np.sqrt(np.mean([np.diagonal(r.covariance) for r in runs], axis=0))
    np.testing.assert_allclose(np.std(values, axis=0), expected, rtol=0.15)


def test_the_record_goes_round():
    result = calibrate(known(), KNOWN)
    assert Calibration.from_record(result.record(), "r").record() == result.record()
    assert result.settings["attitudes"] == "known"
    assert any("attitudes are known" in note for note in result.notes)


def test_a_wrong_attitude_is_named():
    u = poses.turns()
    reference = G * u
    reference[7] = (
        G * np.array([0.0, np.sin(0.02), np.cos(0.02)]) if abs(u[7, 2]) > 0.9 else reference[7][[1, 2, 0]]
    )
    data = Readings.from_array(MEMS.output(G * u + noise(24, SIGMA, 1)), reference=reference)
    assert 7 in calibrate(data, KNOWN).outliers


def test_weights_count():
    count = np.array([1.0] * 6 + [100.0] * 6)
    plain = calibrate(known(count=count), KNOWN)
    heavy = calibrate(known(count=count), dataclasses.replace(KNOWN, weights="n"))
    assert np.abs(plain.K_a - heavy.K_a).max() > 0


@pytest.mark.parametrize(
    ("u", "verdict"), [(poses.faces(), "good"), (np.eye(3)[[0, 1, 2, 0]] * [[1], [1], [1], [-1]], "weak")]
)
def test_verdicts(u, verdict):
    result = calibrate(known(u), KNOWN)
    assert result.verdict == verdict
    assert bool(result.reasons) == (verdict == "weak")


def test_attitudes_near_one_another_do_not_determine():
    u = np.array([0.0, 0.0, 1.0]) + 0.01 * poses.fibonacci(12)
    result = calibrate(known(u / np.linalg.norm(u, axis=1, keepdims=True)), KNOWN)
    assert result.verdict == "undetermined"
    assert "do not determine" in result.reasons[0]


@pytest.mark.parametrize(
    ("data", "settings", "message"),
    [
        (Readings.from_array(poses.turns()), KNOWN, "fx, fy, fz"),
        (known(), dataclasses.replace(KNOWN, g=1.0), "mean length of 9.8"),
        (known(poses.turns()[:8:4]), KNOWN, "2 of 4 dimensions"),
    ],
)
def test_what_cannot_be_used_is_refused(data, settings, message):
    with pytest.raises(DataError, match=message):
        calibrate(data, settings)


@pytest.mark.parametrize("changes", [{"robust": "huber"}, {"weights": "auto"}])
def test_settings_that_do_not_apply_are_refused(changes):
    with pytest.raises(ConfigError, match="does not go with --attitudes known"):
        calibrate(known(), dataclasses.replace(KNOWN, **changes))


TURNED = {
    "axes exchanged": np.eye(3)[[1, 2, 0]],
    "two axes turned round": np.diag([-1.0, -1.0, 1.0]),
    "a mean of zero": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    @ np.diag([1.0, 1.0, -1.0]),
    "anyhow": rotation(5),
}


@pytest.mark.parametrize("turn", TURNED.values(), ids=TURNED)
def test_how_the_sensor_lies_in_the_body_does_not_matter(turn):
    """The same sensor in the same attitudes; only what the body frame is called differs."""
    plain = known()
    straight = calibrate(plain, KNOWN)
    found = calibrate(Readings.from_array(plain.output(), reference=G * TWELVE @ turn), KNOWN)
    np.testing.assert_allclose(found.K_a @ turn.T, straight.K_a, atol=1e-12)
    np.testing.assert_array_equal(found.nominal_scale, straight.nominal_scale)
    assert found.warnings == straight.warnings == ()
    assert found.rms_before == pytest.approx(straight.rms_before)
    for row, other in zip(engineering(found).rows, engineering(straight).rows, strict=True):
        np.testing.assert_allclose([row[1], row[2]], [other[1], other[2]], rtol=1e-6)
    assert grade_of(found, InsGrade(), "r").accelerometer == pytest.approx(
        grade_of(straight, InsGrade(), "r").accelerometer
    )
    record = json.loads(EXPORTERS.get("imucal")().export(found).content)
    np.testing.assert_allclose(np.diagonal(record["K_a"]), np.linalg.norm(MEMS.K, axis=1), rtol=1e-3)


def test_a_reference_that_points_down_is_noted():
    plain = known()
    found = calibrate(Readings.from_array(plain.output(), reference=-G * TWELVE), KNOWN)
    assert "counts gravity instead of specific force" in found.warnings[0].text


@pytest.mark.parametrize("value", [0.1, 3.0])
def test_an_axis_that_does_not_answer_is_named(value):
    output = known().output().copy()
    output[:, 1] = value
    data = Readings.from_array(output, reference=G * TWELVE)
    with pytest.raises(DataError, match=rf'column "{data.columns[1]}" is {value:g} in every pose'):
        calibrate(data, KNOWN)


def test_axes_that_depend_on_each_other_are_refused():
    output = known().output().copy()
    output[:, 1] = output[:, 0]
    with pytest.raises(DataError, match="depend on each other"):
        calibrate(Readings.from_array(output, reference=G * TWELVE), KNOWN)


def test_a_reference_is_not_used_unasked():
    """It may be what accelcal apply wrote."""
    result = calibrate(known(poses.turns()), Settings(g=G, optimizer="levenberg-marquardt"))
    assert result.gauge == "lower"
    assert any("--attitudes known" in note for note in result.notes)


def _beyond_chance(data):
    """The poses whose leaving out takes more off the squares than chance allows: fits with numpy, pose by pose."""
    F = np.column_stack([data.reference, np.ones(len(data.reference))])
    N, J = data.output(), len(data.reference)
    K_A = np.linalg.inv(np.linalg.lstsq(F, N)[0][:3].T)

    def square(keep):
        rest = N[keep] - F[keep] @ np.linalg.lstsq(F[keep], N[keep])[0]
        return np.sum((rest @ K_A.T) ** 2)

    every, named = square(np.arange(J)), []
    for j in range(J):
        others = square(np.delete(np.arange(J), j))
        ratio = (every - others) / 3 / (others / (3 * J - 15))
        if J * scipy.stats.f.sf(ratio, 3, 3 * J - 15) < OUTLIER_LEVEL:
            named.append(j)
    return tuple(named)


@pytest.mark.parametrize("wrong", [2, 9])
def test_outliers_are_those_whose_leaving_out_tells(wrong):
    """One pose of twelve off by nothing to twelve sigma: the fit follows a third of it."""
    found = []
    for size in np.linspace(0.0, 12.0, 25):
        force = G * TWELVE + noise(12, SIGMA, 1)
        force[wrong] += size * SIGMA
        data = Readings.from_array(MEMS.output(force), reference=G * TWELVE)
        found.append(calibrate(data, KNOWN).outliers)
        assert found[-1] == _beyond_chance(data)
    assert found[0] == ()
    assert found[-1] == (wrong,)


def test_residuals_are_of_the_length_over_the_noise_of_all_poses():
    data = known()
    result = calibrate(data, KNOWN)
    F = np.column_stack([G * TWELVE, np.ones(12)])
    room = 1.0 - np.diagonal(F @ np.linalg.pinv(F))
    length = np.linalg.norm(result.model.specific_force(data.output()), axis=1) - G
    np.testing.assert_allclose([pose.residual for pose in result.poses_fit], length, rtol=1e-9)
    studentised = [pose.studentised for pose in result.poses_fit]
    np.testing.assert_allclose(studentised, length / (result.s * np.sqrt(room)), rtol=1e-9)
