"""Labels that say which way is up, where the fit has it the other way round."""

from __future__ import annotations

import numpy as np
import pytest
from simulated import MEMS, noise

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.fleet import calibrate_fleet
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.fleet import read_fleet
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses

G = 9.8
FAST = Settings(optimizer="levenberg-marquardt", g=G)


def outputs(mirror=(1, 1, 1), swap=(0, 1, 2)):
    """Readings of the sensor with some columns reversed or exchanged."""
    u = poses.turns()
    output = (MEMS.output(G * u) + noise(24, 1e-3, 1))[:, list(swap)] * mirror
    return u, output


def labels_of(u):
    return [f"{k}: {poses.describe(direction)}" for k, direction in enumerate(u)]


def said(result):
    return [one for one in result.warnings if one.key == "negative-axes"]


@pytest.mark.parametrize("gauge", ["lower", "symmetric", "full"])
def test_a_sensor_that_counts_gravity_is_noted(gauge):
    u, output = outputs((-1, -1, -1))
    result = calibrate(
        Readings.from_array(output, labels=labels_of(u)),
        Settings(optimizer="levenberg-marquardt", g=G, gauge=gauge),
    )
    (note,) = said(result)
    assert note.severity == "note"
    assert "counts gravity" in note.text or "count gravity" in note.text
    assert "all three columns" in note.remedy
    assert result.verdict == "good"


def test_a_reversed_axis_is_named():
    u, output = outputs((1, -1, 1))
    (note,) = said(calibrate(Readings.from_array(output, labels=labels_of(u)), FAST))
    assert "axis y points the other way" in note.text
    assert note.remedy.endswith("turn the sign of column y.")


def test_labels_that_agree_and_labels_that_say_nothing_are_silent():
    u, output = outputs()
    assert said(calibrate(Readings.from_array(output, labels=labels_of(u)), FAST)) == []
    _, turned = outputs((-1, -1, -1))
    assert said(calibrate(Readings.from_array(turned, labels=[f"pose {k}" for k in range(24)]), FAST)) == []
    assert said(calibrate(Readings.from_array(turned), FAST)) == []


def test_one_wrong_label_is_outvoted():
    u, output = outputs()
    labels = labels_of(u)
    labels[0] = "0: -z up"
    assert said(calibrate(Readings.from_array(output, labels=labels), FAST)) == []


def test_words_of_other_spellings():
    u, output = outputs((-1, -1, -1))
    names = np.array([[f"{axis}_up", f"{axis.upper()}-down"] for axis in "xyz"])
    labels = []
    for k, direction in enumerate(u):
        axis = int(np.argmax(np.abs(direction)))
        labels.append(f"{names[axis, int(direction[axis] < 0)]} {k}")
    assert len(said(calibrate(Readings.from_array(output, labels=labels), FAST))) == 1


def test_a_fleet_says_the_same(tmp_path):
    lines = ["sensor,pose,ax,ay,az"]
    alone = []
    for number, mirror in enumerate([(1, 1, 1), (-1, -1, -1), (1, 1, -1)]):
        u, output = outputs(mirror)
        rows = zip(labels_of(u), output.tolist(), strict=True)
        lines += [f'S{number},"{label}",' + ",".join(map(repr, row)) for label, row in rows]
        alone.append(calibrate(Readings.from_array(output, labels=labels_of(u)), FAST))
    (tmp_path / "fleet.csv").write_text("\n".join(lines) + "\n")
    records = {}
    calibrate_fleet(read_fleet([str(tmp_path / "fleet.csv")]), FAST, records.__setitem__)
    assert [said(records[r]) for r in range(3)] == [said(one) for one in alone]
    assert [len(said(one)) for one in alone] == [0, 1, 1]
