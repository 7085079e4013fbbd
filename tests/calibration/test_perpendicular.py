"""Six unknowns: scale factors and biases of a sensor whose axes are taken as perpendicular."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from simulated import DPSO, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import ConfigError
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.planning import plan_from
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.verification.verify import verify
from accelcal_cli.views.calibration import engineering, observability
from accelcal_cli.views.plan import pose_table

G = 9.8
ALIGNED = ErrorModel(np.diag(np.diagonal(DPSO.K)), DPSO.D)
SIX = Settings(optimizer="levenberg-marquardt", g=G, misalignment=False)


def read(u, sigma=0.0, seed=1, sensor=ALIGNED):
    return Readings.from_array(sensor.output(G * u + noise(len(u), sigma, seed)))


@pytest.mark.parametrize("optimizer", [name for name in OPTIMIZERS.names() if OPTIMIZERS.get(name).converges])
def test_six_faces_determine_scale_factors_and_biases(optimizer):
    """Exactly, from readings without noise; six poses leave no degree of freedom, so the verdict is weak."""
    result = calibrate(read(poses.faces()), replace(SIX, optimizer=optimizer))
    np.testing.assert_allclose(result.K_a, ALIGNED.K, atol=1e-9 * ALIGNED.K[0, 0])
    np.testing.assert_allclose(result.D_a, ALIGNED.D, atol=1e-8 * ALIGNED.K[0, 0])
    assert (result.verdict, result.freedom) == ("weak", 0)
    assert result.reasons == (
        "Six poses leave no degrees of freedom, so no uncertainty can be given. Take at least 12.",
    )
    assert result.dop.scale == pytest.approx(np.sqrt(0.5), rel=1e-2)
    assert result.dop.misalignment == 0
    assert any("taken as perpendicular" in notice.text for notice in result.warnings)
    assert Calibration.from_record(result.record(), "r").held.sum() == 3


def test_the_fit_is_that_of_scipy():
    data = read(poses.turns(), sigma=1e-2)
    result = calibrate(data, SIX)

    def residuals(x):
        f = (data.output() - x[3:] * 1e6) / (x[:3] * 1e6)
        return G * G - np.sum(f * f, axis=1)

    start = np.append(np.diagonal(ALIGNED.K), ALIGNED.D) / 1e6
    found = least_squares(residuals, start, xtol=1e-15, ftol=1e-15, gtol=1e-15).x * 1e6
    np.testing.assert_allclose(np.append(np.diagonal(result.K_a), result.D_a), found, rtol=1e-6)
    assert (result.verdict, result.freedom) == ("good", 18)


def test_sigma_is_the_scatter_of_the_estimates():
    """300 calibrations from twelve edges, six degrees of freedom each."""
    found, stated = [], []
    for seed in range(300):
        result = calibrate(read(poses.edges(), sigma=1e-2, seed=seed), SIX)
        found.append(np.append(np.diagonal(result.K_a), result.D_a))
        stated.append(np.append(np.diagonal(result.sigma.K_a), result.sigma.D_a))
    ratio = np.sqrt(np.mean(np.square(stated), axis=0)) / np.std(found, axis=0)
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert result.sigma.K_a[1, 0] == 0


def test_a_wrong_pose_is_named():
    data = ALIGNED.output(G * poses.edges() + noise(12, 1e-3, 3))
    data[4] *= 1.05
    assert 4 in calibrate(Readings.from_array(data), SIX).outliers


def test_too_few_poses_are_told():
    result = calibrate(read(poses.faces()[:5]), SIX)
    assert result.verdict == "undetermined"
    assert result.reasons[0] == "5 poses are fewer than the six parameters; take at least 12."
    assert any("do not determine" in reason for reason in result.reasons)


def test_a_table_says_what_was_assumed():
    result = calibrate(read(poses.turns(), sigma=1e-2), SIX)
    assert ["taken as 0" in row for row in engineering(result).rows[3:6]] == [True] * 3
    assert [row[1:] for row in observability(result).rows[3:6]] == [("-", "taken as 0")] * 3


@pytest.mark.parametrize(
    "other", [{"gauge": "full"}, {"robust": "huber"}, {"weights": "auto"}, {"attitudes": "known"}]
)
def test_what_does_not_go_with_it_is_refused(other):
    (key,) = other
    with pytest.raises(ConfigError, match=f"{key}: {other[key]} does not go with misalignment: false"):
        replace(SIX, **other)


def test_verify_does_without_misalignments():
    found = verify(calibrate(read(poses.turns(), sigma=1e-2), SIX), read(poses.turns(), sigma=1e-2, seed=2))
    assert (found.verdict, found.directions) == ("unchanged", 6)


def test_more_faces_are_suggested_and_planned():
    """Nothing but faces is needed; and a plan goes on with the model of the result."""
    first = calibrate(read(poses.faces()[:3]), SIX)
    assert first.suggestions
    assert all(len(suggestion.split()) == 2 for suggestion in first.suggestions)
    assert len(set(first.suggestions)) == len(first.suggestions)
    result = calibrate(read(np.repeat(poses.faces(), 2, axis=0), sigma=1e-2), SIX)
    found = plan_from(result.information, result.poses, 6, "faces", 1e-3, result)
    assert found.verdict == "good"
    last = pose_table(found).records()[-1]
    assert last["dop_scale"] == pytest.approx(np.sqrt(1 / 6), rel=0.02)
    assert "dop_misalignment" not in last
    assert any("scale factors and biases alone" in note for note in pose_table(found).notes)


def test_a_temperature_column_is_said_to_be_left():
    rows = ALIGNED.output(G * poses.turns() + noise(24, 1e-2, 1))
    data = Readings.from_array(rows, temperature=np.linspace(10.0, 40.0, 24))
    assert any("Temperature column not used" in note for note in calibrate(data, SIX).notes)


def test_nothing_is_dropped_that_was_not_estimated():
    result = calibrate(read(poses.turns(), sigma=1e-2), SIX)
    scale = float(np.diagonal(result.K_a).mean())
    for name in ("px4", "ardupilot"):
        made = EXPORTERS.get(name)(driver_scale=scale).export(result)
        assert not any("misalignments" in warning for warning in made.warnings)
