"""`accelcal calibrate` on readings that are as they should be."""

import csv
import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

from accelcal_cli.calibration.result import SCHEMA, Calibration
from accelcal_cli.config import load_mapping

NUMBER = (int, float)
CONTRACT = {
    "K_a": (3, 3),
    "D_a": (3,),
    "K_A": (3, 3),
    "f_0": (3,),
    "gauge": str,
    "sigma": dict,
    "interval": dict,
    "coverage_factor": (*NUMBER, type(None)),
    "dop": dict,
    "verdict": str,
    "reasons": list,
    "suggestions": list,
    "warnings": list,
    "cost_search": NUMBER,
    "cost": NUMBER,
    "rms": NUMBER,
    "rms_before": NUMBER,
    "before": str,
    "s": NUMBER,
    "freedom": int,
    "residual_noise_ratio": (*NUMBER, type(None)),
    "residual_noise_p": (*NUMBER, type(None)),
    "covariance": (9, 9),
    "nominal_scale": (3,),
    "nominal_bias": (3,),
    "poses": int,
    "attitudes": (int, type(None)),
    "evaluations": int,
    "runs": int,
    "runs_agreeing": int,
    "poses_fit": list,
    "outliers": list,
    "convergence": list,
    "optimizer": str,
    "settings": dict,
    "g": NUMBER,
    "data": dict,
    "notes": list,
    "version": str,
    "schema": str,
    "temperature": (dict, type(None)),
}
"""Names and types (or shapes) that programs rely on. A name that goes or changes needs a new schema."""


def record(run, *arguments, **more):
    outcome = run("calibrate", *arguments, "--format", "json", **more)
    assert outcome.code in (0, 1)
    return json.loads(outcome.out)


def truth(run, *arguments):
    assert run("simulate", *arguments, "-o", "data.csv", "--truth", "truth.yaml").code == 0
    return yaml.safe_load(Path("truth.yaml").read_text(encoding="utf-8"))


def test_json_keeps_its_contract(run, good):
    result = record(run, good)
    assert result["schema"] == SCHEMA == "accelcal/calibration/3"
    assert set(CONTRACT) <= set(result)
    for name, expected in CONTRACT.items():
        if isinstance(expected, tuple) and isinstance(expected[0], int):
            assert np.shape(result[name]) == expected, name
        else:
            assert isinstance(result[name], expected), name
            assert not isinstance(result[name], bool), name
    assert set(result["sigma"]) == {"K_a", "D_a"}
    assert set(result["dop"]) == {"misalignment", "scale", "bias", "worst", "parameters"}
    assert len(result["dop"]["parameters"]) == 9
    pose = {"pose", "where", "residual", "residual_before", "direction"}
    assert set(result["poses_fit"][0]) == {*pose, "studentised", "leverage", "left_out"}
    assert {"source", "sha256", "columns"} <= set(result["data"])


@pytest.mark.parametrize("sensor", ["dpso", "mems", "navigation"])
def test_a_noise_free_sensor_is_found(run, sensor):
    true = truth(run, "--sensor", sensor, "--positions", "24", "--noise", "0")
    result = record(run, "data.csv")
    K = np.array(true["K_a_lower"])
    np.testing.assert_allclose(result["K_a"], K, atol=1e-8 * K.max())
    np.testing.assert_allclose(result["D_a"], true["D_a"], atol=1e-7 * K.max())
    np.testing.assert_allclose(np.array(result["K_A"]) @ result["K_a"], np.eye(3), atol=1e-12)
    np.testing.assert_allclose(np.array(result["K_A"]) @ result["D_a"], result["f_0"], rtol=1e-9)
    assert result["verdict"] == "good"
    assert result["rms"] < 1e-8 < result["rms_before"]


def test_the_stated_gravity_sets_the_scale(run, good):
    metres, units = record(run, good, "--g", "9.8"), record(run, good, "--g", "1")
    K = np.array(metres["K_a"])
    np.testing.assert_allclose(units["K_a"], 9.8 * K, atol=1e-6 * K.max())
    np.testing.assert_allclose(units["D_a"], metres["D_a"], rtol=1e-6)
    assert record(run, good, "--latitude", "45", "--height", "100")["g"] == pytest.approx(9.80589, abs=1e-5)


def test_gauges_agree_on_what_is_observable(run, good):
    results = {
        gauge: record(run, good, "--gauge", gauge) for gauge in ("lower", "upper", "symmetric", "full")
    }
    products = {g: np.array(r["K_a"]) @ np.transpose(r["K_a"]) for g, r in results.items()}
    for gauge, result in results.items():
        assert result["gauge"] == gauge
        np.testing.assert_allclose(products[gauge], products["lower"], rtol=1e-6, atol=1e-3)
        np.testing.assert_allclose(result["D_a"], results["lower"]["D_a"], rtol=1e-6)
        assert result["cost"] == pytest.approx(results["lower"]["cost"], rel=1e-9)


def test_all_optimizers_end_in_the_same_minimum(run, good):
    costs = [
        record(run, good, "--optimizer", name)["cost"]
        for name in ("de-pso", "de", "pso", "levenberg-marquardt", "ellipsoid")
    ]
    np.testing.assert_allclose(costs, costs[0], rtol=1e-9)


def test_same_seed_same_bytes(run, good):
    first = run("calibrate", good, "--seed", "7", "--format", "json").out
    assert run("calibrate", good, "--seed", "7", "--format", "json").out == first
    assert run("calibrate", good, "--seed", "8", "--format", "json").out != first


def test_csv_has_a_row_a_parameter(run, good):
    result = record(run, good)
    rows = list(csv.DictReader(io.StringIO(run("calibrate", good, "--format", "csv").out)))
    value = {row["parameter"]: row["value"] for row in rows}
    assert float(value["K_21"]) == result["K_a"][1][0]
    assert float(value["D_3"]) == result["D_a"][2]
    assert float(rows[0]["sigma"]) == result["sigma"]["K_a"][0][0]
    assert value["verdict"] == "good"
    engineering = [row for row in rows if row["parameter"].startswith(("scale_", "misalignment_", "bias_"))]
    assert (len(rows), len(engineering)) == (26, 9)


def test_the_table_says_it_all(run, good):
    outcome, whole = run("calibrate", good), run("calibrate", good, "--verbose")
    for part in ("Verdict: good", "Calibration", "Engineering view", "Fit"):
        assert part in outcome.out
    for part in (
        "Verdict: good",
        "Calibration",
        "Engineering view",
        "Fit",
        "Observability",
        "Poses",
        "Convergence",
    ):
        assert part in whole.out
    assert "gauge lower" in outcome.out
    assert "g = 9.80665 assumed" in outcome.err


@pytest.mark.parametrize("name", ["result.yaml", "result.yml", "result.json"])
def test_the_result_file_reads_back(run, good, name):
    outcome = run("calibrate", good, "-o", name, "--format", "json")
    assert outcome.code == 0
    assert f"wrote {name}" in outcome.err
    written = load_mapping(Path(name))
    assert written == json.loads(outcome.out)
    assert Calibration.from_record(written, name).record() == written


def test_a_dash_writes_the_result_file_to_standard_output(run, good):
    outcome = run("calibrate", good, "-o", "-", "--quiet")
    assert outcome.err == ""
    assert yaml.safe_load(outcome.out)["schema"] == SCHEMA


def test_quiet_leaves_standard_error_empty(run, good):
    outcome = run("calibrate", good, "--quiet", "-o", "result.yaml")
    assert (outcome.code, outcome.err) == (0, "")
    assert "Verdict" in outcome.out


def test_a_missed_tolerance_is_exit_1_with_the_result(run, good):
    assert run("calibrate", good, "--tolerance", "0.1").code == 0
    outcome = run("calibrate", good, "--tolerance", "1e-6", "-o", "result.json")
    assert outcome.code == 1
    assert "Verdict: good" in outcome.out
    assert "above the tolerance 1e-06" in outcome.err
    assert load_mapping(Path("result.json"))["rms"] > 1e-6


def test_undetermined_is_exit_1_and_names_what_is_missing(run):
    truth(run, "--sensor", "mems", "--positions", "6")
    outcome = run("calibrate", "data.csv")
    assert outcome.code == 1
    assert "Verdict: undetermined" in outcome.out
    assert "misalignment" in outcome.out
    assert "Add these poses" in outcome.out


def test_repeated_readings_are_averaged_and_judged(run):
    truth(run, "--sensor", "mems", "--positions", "24", "--samples", "50")
    result = record(run, "data.csv", "--weights", "sd")
    assert result["poses"] == 24
    assert 0.5 < result["residual_noise_ratio"] < 1.6  # 15 degrees of freedom
    assert run("calibrate", "data.csv", "--weights", "sd", "-o", "result.yaml").code == 0
    assert load_mapping(Path("result.yaml")) == result


def test_columns_by_name_or_number(run, tmp_path):
    truth(run, "--sensor", "mems", "--positions", "24")
    rows = [line.split(",") for line in (tmp_path / "data.csv").read_text().splitlines()]
    (tmp_path / "turned.csv").write_text("".join(f"x,{z},{y},{x}\n" for x, y, z in rows))
    by_name, by_number = (
        record(run, "turned.csv", "--columns", "Nx,Ny,Nz"),
        record(run, "turned.csv", "--columns", "4,3,2"),
    )
    assert by_name["K_a"] == by_number["K_a"] == record(run, "data.csv")["K_a"]


def test_the_command_line_wins_over_the_file(run, good, tmp_path):
    (tmp_path / "mine.yaml").write_text(
        "optimizer: de\nseed: 3\ngauge: upper\nparameters: {population: 40}\n"
    )
    result = record(run, good, "--config", "mine.yaml", "--gauge", "symmetric")
    assert (result["optimizer"], result["gauge"], result["settings"]["seed"]) == ("de", "symmetric", 3)
    assert result["settings"]["parameters"]["population"] == 40
    other = record(run, good, "--config", "mine.yaml", "--optimizer", "pso")
    assert other["settings"]["parameters"]["population"] == 100  # de's 40 is not pso's


def test_no_polish_leaves_the_search_alone(run, good):
    result = record(run, good, "--no-polish", "--iterations", "20")
    assert result["cost"] == result["cost_search"] > record(run, good)["cost"]
    assert result["evaluations"] == 100 * 21


@pytest.mark.parametrize("loss", ["huber", "soft-l1"])
def test_a_robust_loss_stands_a_bad_pose(run, good, tmp_path, loss):
    clean = np.array(record(run, good)["K_a"])
    lines = (tmp_path / good).read_text().splitlines()
    lines[5] = ",".join(str(float(cell) * 1.02) for cell in lines[5].split(","))
    (tmp_path / "bad.csv").write_text("\n".join(lines) + "\n")
    plain = np.abs(record(run, "bad.csv")["K_a"] - clean).max()
    robust = np.abs(record(run, "bad.csv", "--robust", loss)["K_a"] - clean).max()
    assert robust < 0.5 * plain


def test_readings_in_g_that_are_compared_with_metres_are_told(run, good):
    rows = [line.split(",") for line in Path(good).read_text().splitlines()]
    parts = [",".join(repr(float(cell) / 16384) for cell in row) for row in rows[1:]]
    Path("g.csv").write_text("\n".join([",".join(rows[0]), *parts]))
    fast = ("--optimizer", "ellipsoid")
    assert "add --g 1" in run("calibrate", "g.csv", *fast).err
    assert run("calibrate", "g.csv", "--g", "1", *fast).err == ""
    assert "--g 1" not in run("calibrate", good, *fast).err


def test_warnings_stand_under_the_verdict_and_go_with_the_result(run):
    run("simulate", "--positions", "24", "--noise", "0.1", "--seed", "1", "-o", "noisy.csv")
    shown = run("calibrate", "noisy.csv", "--optimizer", "ellipsoid", "-o", "noisy.yaml", "--quiet")
    first, second, *_ = shown.out.splitlines()
    assert (first, shown.code, shown.err) == ("Verdict: suspect", 1, "")
    assert second.startswith("Warning: Residuals are too large")
    said = "accelcal: noisy.csv: warning: Residuals are too large"
    for form in ("csv", "json"):
        assert said in run("calibrate", "noisy.csv", "--optimizer", "ellipsoid", "--format", form).err
    said = "accelcal: noisy.yaml: warning: Residuals are too large"
    assert run("export", "noisy.yaml", "--to", "imucal").err.startswith(said)
    assert run("apply", "noisy.yaml", "noisy.csv", "-o", "forces.csv").err.startswith(said)
    assert run("export", "noisy.yaml", "--to", "imucal", "--quiet").err == ""


def test_a_search_that_ends_where_nothing_has_a_slope_is_no_fault(run, tmp_path):
    (tmp_path / "four.csv").write_text("-2,3,1\n0,-2,1\n-1,-2,0\n1,-1,2\n")
    options = ("--robust", "huber", "--optimizer", "ifoa", "--iterations", "50", "--g", "9.80665")
    outcome = run("calibrate", "four.csv", *options, "--format", "csv")
    assert outcome.code == 1
    assert "verdict,undetermined" in outcome.out
