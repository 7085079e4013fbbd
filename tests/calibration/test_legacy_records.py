"""Result files of schema 1, written by version 0.1.0: they load, and say what is old about them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy import stats

from accelcal_cli.calibration.result import SCHEMA, Calibration, load_result
from accelcal_cli.errors import DataError

RECORDS = Path(__file__).parent / "records"
KINDS = {"plain": "plain.yaml", "temperature": "temperature.yaml", "undetermined": "undetermined.json"}


def stored(kind):
    return yaml.safe_load((RECORDS / KINDS[kind]).read_text(encoding="utf-8"))


@pytest.mark.parametrize("kind", KINDS)
def test_a_file_of_schema_1_loads(kind):
    record = stored(kind)
    assert record["schema"] == "accelcal/calibration/1"
    result = load_result(RECORDS / KINDS[kind])
    assert result.verdict == record["verdict"]
    assert result.attitudes is None
    assert result.residual_noise_ratio == record["noise_ratio"]
    np.testing.assert_array_equal(result.K_a, record["K_a"])
    assert [notice.text for notice in result.warnings[:-1]] == record["cautions"]
    assert {(notice.key, notice.severity) for notice in result.warnings} == {("legacy", "note")}
    assert "verdict is by the old rule" in result.warnings[-1].text
    again = Calibration.from_record(json.loads(json.dumps(result.record())), "r")
    assert again.record() == result.record()
    assert again.schema == SCHEMA == "accelcal/calibration/3"


@pytest.mark.parametrize("kind", ["plain", "temperature"])
def test_its_intervals_come_from_covariance_and_freedom(kind):
    result = load_result(RECORDS / KINDS[kind])
    k = stats.t.ppf(0.975, result.freedom)
    assert result.coverage_factor == pytest.approx(k, rel=1e-12)
    np.testing.assert_allclose(result.interval.K_a, k * result.sigma.K_a, rtol=1e-12)
    np.testing.assert_allclose(result.interval.D_a, k * result.sigma.D_a, rtol=1e-12)
    if result.temperature is not None:
        slopes = result.temperature
        np.testing.assert_allclose(slopes.interval_scale, k * slopes.sigma_scale, rtol=1e-12)
        np.testing.assert_allclose(slopes.interval_bias, k * slopes.sigma_bias, rtol=1e-12)
    assert (result.temperature is not None) == (kind == "temperature")


def test_an_undetermined_one_has_no_interval_without_freedom():
    result = load_result(RECORDS / KINDS["undetermined"])
    assert result.coverage_factor is None
    assert np.isnan(result.interval.K_a).all()


def test_a_file_without_cautions_loads():
    record = stored("plain")
    del record["cautions"]
    assert len(Calibration.from_record(record, "r").warnings) == 1


@pytest.mark.parametrize("cautions", [1, "One.", ["One.", 2]])
def test_cautions_that_are_no_sentences_are_refused(cautions):
    with pytest.raises(DataError, match="warnings"):
        Calibration.from_record({**stored("plain"), "cautions": cautions}, "r")
