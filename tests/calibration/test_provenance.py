"""What a result keeps of the user's words, when it was made, and where g comes from."""

from __future__ import annotations

import json

import numpy as np
import pytest

from accelcal_cli.calibration.calibrate import calibrate, moment
from accelcal_cli.calibration.provenance import MOST, check_meta, parse_meta, settings_sha256
from accelcal_cli.calibration.result import Calibration, load_result
from accelcal_cli.errors import AccelcalError, ConfigError, DataError, UsageError
from accelcal_cli.io.readings import Readings
from accelcal_cli.sensor.simulation import simulate

OUTPUT = simulate("mems", positions=24, seed=3).output
FAST = {"optimizer": "ellipsoid"}


@pytest.mark.parametrize(
    ("pairs", "words"),
    [
        (["serial"], "expected KEY=VALUE"),
        (["=7"], "expected a key"),
        (["7a=x"], "begins with a letter"),
        (["a b=x"], "expected a key"),
        ([f"{'k' * 41}=x"], "up to 40 characters"),
        (["serial="], "has 0 characters"),
        ([f"note={'x' * 201}"], "has 201 characters"),
        (["note=a\nb"], "U+000A"),
        (["note=\x1b[31mred"], "U+001B"),
        (["note=\u202egnp"], "U+202E"),
        (["note=\udcff"], "U+DCFF"),
        (["serial=1", "serial=1"], "stated before"),
        ([f"k{i}=x" for i in range(MOST + 1)], f"at most {MOST}"),
    ],
)
def test_what_is_not_allowed_is_refused(pairs, words):
    with pytest.raises(UsageError, match=r"^--meta ") as error:
        parse_meta(pairs)
    assert words in str(error.value)


def test_values_are_kept_as_they_are_but_for_blanks():
    meta = parse_meta(["équipe=Jörg = 北京", "t= 21\u00a0degrees ", f"note={'x' * 200}"])
    assert meta == {"équipe": "Jörg = 北京", "t": "21 degrees", "note": "x" * 200}
    assert parse_meta([]) == {}


@pytest.mark.parametrize("suffix", [".yaml", ".json"])
def test_a_result_file_keeps_meta_date_and_origin_of_g(tmp_path, suffix):
    meta = {"serial": "007", "date": "2026-01-01", "on": "yes", "note": "a: b # c"}
    result = calibrate(OUTPUT, meta=meta, latitude=48.1, height=500, **FAST)
    result.save(tmp_path / f"r{suffix}")
    again = load_result(tmp_path / f"r{suffix}")
    assert again.meta == meta
    assert again.date == result.date == "2025-12-01T00:00:00Z"  # SOURCE_DATE_EPOCH of the tests
    assert again.g_source == "WGS84 normal gravity at latitude 48.1 degrees, height 500 m"


def test_the_clock_is_read_without_a_stated_date(monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "soon")
    assert moment() > "2026"
    monkeypatch.delenv("SOURCE_DATE_EPOCH")
    assert moment() > "2026"


def test_a_record_of_before_has_neither():
    record = calibrate(OUTPUT, **FAST).record()
    for key in ("meta", "date", "g_source"):
        del record[key]
    old = Calibration.from_record(record, "r")
    assert (old.meta, old.date, old.g_source) == ({}, None, "")


@pytest.mark.parametrize(
    "meta", [{"serial": 7}, {"a b": "x"}, {"a": "x\ny"}, {"a": ""}, "serial=7", {3: "x"}]
)
def test_a_record_with_a_meta_that_is_not_allowed_is_refused(meta):
    record = {**calibrate(OUTPUT, **FAST).record(), "meta": meta}
    with pytest.raises(DataError, match=r"^r: not a calibration result: meta: "):
        Calibration.from_record(record, "r")


def test_the_library_refuses_it_too():
    with pytest.raises(AccelcalError, match=r"meta: serial: has 0 characters"):
        calibrate(OUTPUT, meta={"serial": ""}, **FAST)
    with pytest.raises(ConfigError, match=r"at most"):
        check_meta({f"k{i}": "x" for i in range(MOST + 1)})


def test_g_is_said_to_come_from_where_it_does():
    assert calibrate(OUTPUT, **FAST).g_source == "standard gravity, assumed: no local value was stated"
    assert calibrate(OUTPUT, g=9.81, **FAST).g_source == "stated by the user"


def test_temperatures_of_the_poses_are_kept_with_the_data():
    warm = np.linspace(20.0, 26.0, 24)
    readings = Readings.from_array(OUTPUT, temperature=warm)
    result = calibrate(readings, temperature=False, **FAST)
    assert result.temperature is None
    np.testing.assert_allclose(result.data["temperature"], [20.0, 23.0, 26.0])
    assert "temperature" not in calibrate(OUTPUT, **FAST).data


def test_the_hash_of_settings_is_of_their_json():
    settings = calibrate(OUTPUT, **FAST).record()["settings"]
    assert settings_sha256(settings) == settings_sha256(json.loads(json.dumps(settings)))
    assert settings_sha256(settings) == settings_sha256(dict(reversed(settings.items())))
    assert settings_sha256(settings) != settings_sha256({**settings, "seed": 1})
