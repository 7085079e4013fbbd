"""The record of a calibration goes out and comes back, and nothing else comes in."""

from __future__ import annotations

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from simulated import MEMS, noise, readings

from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.result import SCHEMA, Calibration, Dop, PoseFit, Sigma, Temperature
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.config import dump, load_mapping
from accelcal_cli.errors import DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor import poses

G = 9.8


def _ring():
    angle = np.linspace(0, 3, 12)
    return np.stack([np.zeros(12), np.cos(angle), np.sin(angle)], axis=1)


def _result(kind):
    settings = {"optimizer": "levenberg-marquardt", "g": G}
    if kind == "good":
        return calibrate(readings(poses.turns(), sigma=1e-3), Settings(**settings))
    if kind == "full":
        return calibrate(readings(poses.turns(), sigma=1e-3), Settings(**settings, gauge="full", runs=2))
    if kind == "undetermined":
        return calibrate(readings(_ring(), sigma=1e-3), Settings(**settings))
    if kind == "too few":
        return calibrate(readings(poses.faces()), Settings(**settings))
    output = MEMS.output(poses.turns() + noise(24, 1e-4, 1))
    data = Readings.from_array(
        output, labels=[f"pose {j}" for j in range(24)], count=np.full(24, 9), scatter=np.full((24, 3), 3e-4)
    )
    return calibrate(data, Settings(**{**settings, "g": 1.0}, weights="n", robust="huber"))


KINDS = ("good", "full", "undetermined", "too few", "labelled, robust, in g")


@pytest.fixture(scope="module", params=KINDS)
def result(request):
    return _result(request.param)


@pytest.mark.parametrize("cls", [Calibration, PoseFit, Dop, Sigma, Temperature])
def test_the_docstring_names_every_part_and_no_other(cls):
    parts = {field.name for field in dataclasses.fields(cls)}
    text = cls.__doc__.partition("Attributes:")[2]
    heads = re.findall(r"^ {8}(\w[\w, ]*):", text, re.MULTILINE)
    assert {name for head in heads for name in head.split(", ")} <= parts
    assert parts <= set(re.findall(r"\w+", text))


def test_a_record_is_plain(result):
    """Mappings with text keys, lists, numbers, text, truth values and None; no NaN, no numpy."""

    def walk(value):
        if isinstance(value, dict):
            assert all(type(key) is str for key in value)
            return all(walk(v) for v in value.values())
        if isinstance(value, list):
            return all(walk(v) for v in value)
        assert type(value) in (int, float, str, bool, type(None)), type(value)
        return type(value) is not float or math.isfinite(value)

    assert walk(result.record())


def test_a_record_comes_back_the_same(result):
    record = result.record()
    again = Calibration.from_record(record, "r.json")
    assert again.record() == record
    for field in dataclasses.fields(Calibration):
        one, two = getattr(result, field.name), getattr(again, field.name)
        if isinstance(one, np.ndarray):
            assert two.dtype == one.dtype
            np.testing.assert_array_equal(two, one)
        elif field.name not in ("settings", "sigma", "interval", "dop", "poses_fit", "data"):
            assert two == one or (one != one and two != two), field.name
    np.testing.assert_array_equal(again.sigma.K_a, result.sigma.K_a)
    np.testing.assert_array_equal(again.sigma.D_a, result.sigma.D_a)
    assert again.dop == result.dop
    assert repr(again.poses_fit) == repr(result.poses_fit)


def test_by_way_of_json_and_yaml(result, tmp_path):
    record = result.record()
    assert Calibration.from_record(json.loads(json.dumps(record, allow_nan=False)), "r").record() == record
    file = tmp_path / "result.yaml"
    file.write_text(dump(record), encoding="utf-8")
    assert Calibration.from_record(load_mapping(file), str(file)).record() == record


def test_what_has_no_value_is_none_and_comes_back_as_nan_or_infinite():
    result = _result("too few")
    record = result.record()
    assert record["s"] is None
    assert record["dop"]["worst"] is None
    assert record["sigma"]["K_a"][1][0] is None
    again = Calibration.from_record(record, "r")
    assert math.isnan(again.s)
    assert math.isinf(again.dop.worst)
    assert np.isnan(again.sigma.K_a[1, 0])
    assert all(math.isnan(pose.studentised) for pose in again.poses_fit)


def test_a_record_carries_its_units_and_origin():
    result = _result("good")
    record = result.record()
    assert record["schema"] == SCHEMA
    assert record["gauge"] == "lower"
    assert record["g"] == G
    form = {"source_format", "rows", "rows_skipped", "rate_hz", "unit"}
    assert set(record["data"]) == {"source", "sha256", "columns"} | form
    assert record["settings"]["optimizer"] == "levenberg-marquardt"
    assert record["version"]
    assert len(record["poses_fit"]) == 24
    assert result.unit == "m/s^2"
    assert _result("labelled, robust, in g").unit == "g"
    assert _result("labelled, robust, in g").poses_fit[3].where == 'position "pose 3"'


@pytest.mark.parametrize("schema", [None, "accelcal/calibration/4", "other", 1])
def test_another_schema_is_refused(schema):
    record = {**_result("good").record(), "schema": schema}
    with pytest.raises(DataError, match=r"old.yaml: schema is .*expected \"accelcal/calibration/3\""):
        Calibration.from_record(record, "old.yaml")


def test_an_incomplete_record_is_refused():
    record = _result("good").record()
    del record["K_a"], record["sigma"]
    with pytest.raises(DataError, match=r"r.yaml: not a calibration result: missing: K_a, sigma"):
        Calibration.from_record(record, "r.yaml")
    with pytest.raises(DataError, match="schema is None"):
        Calibration.from_record({}, "r.yaml")


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("K_a", "text"),
        ("K_a", 3),
        ("K_a", [[1, 2], [3]]),
        ("K_a", [1.0, 2.0]),
        ("D_a", [[1.0], [2.0], [3.0]]),
        ("D_a", {"x": 1}),
        ("sigma", None),
        ("sigma", {"K_a": [[1, 2, 3]] * 3}),
        ("dop", {"worst": 1}),
        ("dop", []),
        ("poses_fit", [{"pose": 1}]),
        ("poses_fit", 7),
        ("convergence", [[1]]),
        ("cost", "low"),
        ("s", [1]),
        ("g", "9.8"),
        ("g", None),
        ("g", -9.8),
        ("K_a", [[1, 0, 0], [0, None, 0], [0, 0, 1]]),
        ("K_a", [[1e200, 0, 0], [0, 1, 0], [0, 0, 1]]),
        ("K_a", [[1e-40, 0, 0], [0, 1e-40, 0], [0, 0, 1e-40]]),
        ("g", 10**400),
        ("cost", 10**400),
        ("poses", 10**400),
        ("poses", 10**200),
        ("D_a", [10**400, 0, 0]),
        ("settings", {"box": {"scale": 10**400}}),
        ("verdict", "excellent"),
        ("gauge", "diagonal"),
    ],
)
def test_a_record_with_a_wrong_part_is_refused(key, value):
    record = {**_result("good").record(), key: value}
    with pytest.raises(DataError, match=r"r.yaml"):
        Calibration.from_record(record, "r.yaml")


def test_what_comes_back_can_be_used():
    result = _result("good")
    again = Calibration.from_record(json.loads(json.dumps(result.record())), "r")
    f = again.model.specific_force(readings(poses.turns(), sigma=1e-3).output())
    assert np.sqrt(np.mean((np.linalg.norm(f, axis=1) - G) ** 2)) == pytest.approx(result.rms, rel=1e-12)


@pytest.mark.parametrize("name", ["reasons", "suggestions", "notes"])
@pytest.mark.parametrize("entry", [1, None, ["a"]])
def test_sentences_are_text(name, entry):
    record = _result("good").record()
    record[name] = ["One.", entry]
    with pytest.raises(DataError, match=rf"r: not a calibration result: {name}\[1\]: expected text, not"):
        Calibration.from_record(record, "r")
