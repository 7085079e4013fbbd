"""A sensor's own triad, however it is mounted, and the mounting in words."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated import noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel, to_gauge
from accelcal_cli.sensor.triad import ORIENTATIONS, Triad, angle, roll_pitch_yaw, rotation

G = 9.80665
OWN = to_gauge(np.array([[1.013, 0, 0], [0.004, 0.991, 0], [-0.006, 0.008, 1.021]]), "symmetric")
D = np.array([0.21, -0.13, 0.35])
SCALES = 1.0 / np.linalg.norm(OWN, axis=1)


def mounted(turn, sigma=1e-4):
    """A calibration with known attitudes of the sensor, its axes turned into the body by a matrix."""
    u = G * poses.turns()
    output = ErrorModel(OWN @ turn.T, D).output(u) + noise(24, sigma, 1)
    return calibrate(Readings.from_array(output, reference=u), Settings(g=G, attitudes="known"))


def scales(result, name="px4"):
    made = EXPORTERS.get(name)().export(result)
    lines = [line for line in made.content.decode().splitlines() if not line.startswith("#")]
    return [
        float(line.replace("\t", ",").split(",")[-2 if name == "px4" else -1]) for line in lines[3:]
    ], made


@pytest.mark.parametrize("name", ["px4", "ardupilot"])
@pytest.mark.parametrize("degrees", [0.0, 20.0, 40.0, 130.0])
def test_a_turned_mounting_leaves_the_scales_of_the_sensor(name, degrees):
    found, made = scales(mounted(rotation(0.0, 0.0, degrees)), name)
    np.testing.assert_allclose(found, SCALES, rtol=1e-4)
    text = made.content.decode()
    assert f"yaw {degrees:.2f} degrees" in text or degrees == 0.0 or f"yaw {degrees:.1f}" in text
    assert any("mounting" in warning for warning in made.warnings) == (degrees > 0)


def test_the_angles_are_those_that_turn_the_log_to_the_body():
    turn = Rotation.from_euler("ZYX", [70.0, -25.0, 10.0], degrees=True).as_matrix()
    np.testing.assert_allclose(rotation(10.0, -25.0, 70.0), turn, atol=1e-15)
    np.testing.assert_allclose(roll_pitch_yaw(turn), [10.0, -25.0, 70.0], atol=1e-8)
    result = mounted(turn, sigma=0.0)
    _, made = scales(result)
    assert "roll 10.00, pitch -25.00, yaw 70.00 degrees" in made.content.decode()
    force = (ErrorModel(OWN @ turn.T, D).output(np.array([1.0, 2.0, 9.0])) - D) * Triad.of(result.K_a).scale
    np.testing.assert_allclose(turn @ force, [1.0, 2.0, 9.0], atol=0.07)


@pytest.mark.parametrize("number", range(len(ORIENTATIONS)))
def test_an_orientation_with_a_name_is_named(number):
    turn = rotation(*ORIENTATIONS[number])
    words = Triad.of(OWN @ (rotation(1.0, 0.0, 0.0) @ turn).T).in_words("SENS_BOARD_ROT")
    same = [k for k, other in enumerate(ORIENTATIONS) if angle(turn @ rotation(*other).T) < 0.1]
    assert any(f"SENS_BOARD_ROT {k} (" in words for k in same)
    assert "is 1 degrees from it" in words or "is 1.1 degrees" in words or "is 0.9" in words


def test_exchanged_axes_give_the_scales_and_say_what_is_exchanged():
    exchange = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    found, made = scales(mounted(exchange))
    np.testing.assert_allclose(found, SCALES, rtol=1e-4)
    assert (
        "left-handed in the body frame of fx, fy, fz: x reads +y, y reads +x, z reads +z" in made.warnings[1]
    )
    cycle = exchange[[0, 2, 1]]
    found, made = scales(mounted(cycle))
    np.testing.assert_allclose(found, SCALES, rtol=1e-4)
    assert "SENS_BOARD_ROT" in made.warnings[1]
    assert "left-handed" not in made.warnings[1]


def test_reversed_axes_are_named():
    found, made = scales(mounted(np.diag([1.0, -1.0, 1.0]) @ rotation(2.0, 0.0, 3.0)))
    np.testing.assert_allclose(found, SCALES, rtol=1e-4)
    assert "x reads +x, y reads -y, z reads +z" in made.warnings[1]
    everything = Triad.of(-OWN)
    assert "x reads -x, y reads -y, z reads -z" in everything.in_words("AHRS_ORIENTATION")


def test_angles_at_a_pitch_of_90_degrees():
    for named in ((0, 90, 0), (0, 270, 0), (180, 90, 0)):
        turn = rotation(*named)
        np.testing.assert_allclose(rotation(*roll_pitch_yaw(turn)), turn, atol=1e-12)


def test_without_known_attitudes_nothing_is_said_of_a_mounting():
    u = poses.turns()
    readings = Readings.from_array(ErrorModel(OWN, D).output(G * u) + noise(24, 1e-4, 1))
    result = calibrate(readings, Settings(g=G, optimizer="levenberg-marquardt", gauge="full"))
    _, made = scales(result)
    assert "ounting" not in made.content.decode()
    ros = EXPORTERS.get("ros")().export(result).content.decode()
    assert "wherever the search ended" in ros
    known = EXPORTERS.get("ros")().export(mounted(np.eye(3))).content.decode()
    assert "Axes of the force: those of the reference fx, fy, fz." in known
