"""`accelcal plan`: from nothing, from readings, from a result; bad input."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest


@pytest.fixture
def faces(run):
    assert run("simulate", "--sensor", "mems", "--positions", "6", "--seed", "4", "-o", "six.csv").code == 0
    return "six.csv"


def test_twelve_poses_from_nothing(run):
    done = run("plan", "--format", "json")
    assert (done.code, done.err) == (0, "")
    record = json.loads(done.out)
    assert record["verdict"] == "good"
    assert record["noise"] is None
    assert [row["pose"] for row in record["poses"]] == list(range(13))
    assert max(row["dop_after"] for row in record["parameters"]) < 1.05
    assert "sigma_scale" not in record["poses"][-1]


def test_six_poses_more_than_the_faces(run, faces):
    done = run("plan", faces, "--noise", "0.01", "--format", "json")
    assert done.code == 0
    assert done.err.startswith("accelcal: six.csv: warning: The readings have 6 different attitudes")
    assert done.err.count("\n") == 1
    record = json.loads(done.out)
    assert [row["pose"] for row in record["poses"]] == list(range(6, 13))
    assert record["poses"][0]["dop_misalignment"] is None
    assert max(row["dop_after"] for row in record["parameters"]) < 1.45
    assert record["poses"][-1]["sigma_misalignment"] == pytest.approx(
        record["poses"][-1]["dop_misalignment"] * 0.01 / 9.80665 * 1e3
    )


def test_readings_and_their_result_give_the_same_plan(run, good):
    options = ("--g", "9.81")
    assert run("calibrate", good, *options, "-o", "r.yaml", "-q").code == 0
    from_readings = json.loads(run("plan", good, *options, "--add", "3", "--format", "json").out)
    from_result = json.loads(run("plan", "r.yaml", "--add", "3", "--format", "json").out)
    assert [row["hold"] for row in from_readings["poses"]] == [row["hold"] for row in from_result["poses"]]
    assert from_result["noise"] == pytest.approx(from_readings["noise"], rel=1e-6)
    stated = json.loads(run("plan", "r.yaml", "--add", "3", "--noise", "0.5", "--format", "json").out)
    assert stated["noise"] == pytest.approx(0.5 / 9.81)


def test_poses_counts_those_so_far(run, faces):
    rows = list(csv.DictReader(io.StringIO(run("plan", faces, "--poses", "10", "--format", "csv").out)))
    assert [row["pose"] for row in rows] == ["6", "7", "8", "9", "10"]
    assert rows[0]["hold"] == "so far"


def test_readings_may_come_through_a_pipe(run, faces, tmp_path):
    piped = run("plan", "-", "--format", "csv", stdin=(tmp_path / faces).read_bytes())
    assert piped.code == 0
    assert piped.out == run("plan", faces, "--format", "csv").out


@pytest.mark.parametrize("name", ["r.yaml", "r.json"])
def test_a_result_may_come_through_a_pipe(run, good, tmp_path, name):
    assert run("calibrate", good, "-o", name, "-q").code == 0
    text = (tmp_path / name).read_bytes()
    for form in (
        text,
        b"\xef\xbb\xbf\n" + text,
        b"# mine\n---\n" + text if name == "r.yaml" else b"\n" + text,
    ):
        piped = run("plan", "-", "--add", "2", "--format", "json", stdin=form)
        assert (piped.code, piped.err) == (0, "")
        assert piped.out == run("plan", name, "--add", "2", "--format", "json").out
    refused = run("plan", "-", "--g", "9.81", stdin=text)
    assert refused.code == 2
    assert "a result file has its own columns and g" in refused.err


def test_what_calibrate_says_of_the_poses_so_far_is_carried_on(run, tmp_path):
    """Random numbers: their directions are many, but no sensor reads so."""
    rows = np.random.default_rng(1).normal(size=(30, 3))
    np.savetxt(tmp_path / "r.csv", rows, delimiter=",")
    said = json.loads(run("calibrate", "r.csv", "--optimizer", "levenberg-marquardt", "--format", "json").out)
    done = run("plan", "r.csv", "--add", "2", "--format", "json")
    record = json.loads(done.out)
    assert (done.code, record["verdict"]) == (1, "undetermined")
    assert record["so_far"] == {key: said[key] for key in ("verdict", "reasons", "warnings")}
    assert "r.csv: warning: Residuals are too large" in done.err
    assert run("plan", "r.csv", "--add", "2", "--format", "json", "-q").err == ""
    shown = run("plan", "r.csv", "--add", "2")
    assert (shown.code, shown.err) == (1, "")
    assert shown.out.startswith("Verdict so far: undetermined\n  The least cost lies outside the search box")
    assert "Warning: Residuals are too large" in shown.out
    assert "More poses do not change the verdict on those so far" in shown.out


def test_poses_that_only_lack_others_are_mended_by_them(run, faces):
    record = json.loads(run("plan", faces, "--format", "json").out)
    assert record["so_far"]["verdict"] == "undetermined"
    assert record["verdict"] == "good"
    assert json.loads(run("plan", "--format", "json").out)["so_far"] is None


def test_a_record_through_a_pipe_that_is_none_of_a_calibration_is_refused(run):
    done = run("plan", "-", stdin=b'{"schema": "accelcal/verification/1"}')
    assert done.code == 2
    assert done.err.startswith("accelcal: <stdin>: schema is 'accelcal/verification/1'; expected")


def test_the_poses_so_far_may_come_from_a_raw_log(run, tmp_path):
    """Those that detect finds; without --min-poses also fewer than a calibration needs."""
    raw = ("--raw", "--sensor", "mems", "--rate", "50", "--hold", "3", "--move", "1", "--noise", "0.02")
    for positions in ("14", "6"):
        made = run("simulate", *raw, "--positions", positions, "-o", f"{positions}.csv")
        assert made.code == 0
    assert run("detect", "14.csv", "-o", "poses.csv").code == 0
    plain = json.loads(run("plan", "poses.csv", "--format", "json").out)
    many = run("plan", "14.csv", "--raw", "--format", "json")
    found = json.loads(many.out)
    assert (many.code, found["so_far"]["verdict"]) == (0, "good")
    assert found["poses"][0]["pose"] == plain["poses"][0]["pose"] == 14
    for name, value in plain["poses"][0].items():
        assert (
            value is None
            or isinstance(value, str)
            or found["poses"][0][name] == pytest.approx(value, rel=0.1)
        )
    few = run("plan", "6.csv", "--raw", "--add", "6", "--format", "json")
    record = json.loads(few.out)
    assert (few.code, record["so_far"]["verdict"], record["verdict"]) == (0, "undetermined", "good")
    assert [pose["pose"] for pose in record["poses"]] == list(range(6, 13))
    piped = run(
        "plan", "-", "--raw", "--add", "6", "--format", "json", stdin=(tmp_path / "6.csv").read_bytes()
    )
    assert json.loads(piped.out)["poses"] == record["poses"]
    refused = run("plan", "6.csv", "--raw", "--min-poses", "7")
    assert (refused.code, "6 still poses in 6 attitudes, fewer than 7" in refused.err) == (2, True)


def test_the_table_says_how_to_hold_the_sensor(run):
    done = run("plan", "--poses", "12", "--fixture", "edges", "--noise", "0.01", "--verbose")
    assert done.code == 0
    assert "+x up, tilted 45 degrees towards" in done.out
    assert "Expected after all 12 poses" in done.out
    assert "[ppm]" in done.out


def test_faces_alone_exit_with_1(run):
    done = run("plan", "--fixture", "faces")
    assert done.code == 1
    assert "Still not determined after these poses: misalignment xy" in done.out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--fixture", "edge"), '--fixture "edge": unknown (did you mean "edges"?); expected one of faces'),
        (("--poses", "0"), "--poses"),
        (("--add", "201"), "--add"),
        (("--poses", "5000"), "--poses 5000: 5000 poses to plan; expected at most 200"),
        (("--poses", "12", "--add", "3"), "--poses and --add: expected one of them"),
        (("--noise", "-1"), "--noise -1: expected a positive number"),
        (("--noise", "nan"), "--noise nan: expected a positive number"),
        (("six.csv", "--poses", "6"), "--poses 6: 6 poses exist already"),
        (("nowhere.csv",), "nowhere.csv"),
        (("nowhere.yaml",), "nowhere.yaml"),
        (("six.csv", "--columns", "a,b,c"), "six.csv"),
        (("r.yaml", "--g", "9.8"), "leave out --columns, --where, --g and --latitude"),
        (("bad.yaml",), "bad.yaml"),
        (("r.yaml", "--raw"), "r.yaml: a result file is no log; leave out --raw"),
        (("--raw",), "--raw needs the name of a log"),
        (("six.csv", "--rate", "50"), "--rate needs --raw"),
        (("six.csv", "--raw"), "six.csv"),
        (("--format", "xml"), '--format "xml": unknown'),
    ],
)
def test_bad_input_is_one_message(run, faces, tmp_path, arguments, message):
    (tmp_path / "bad.yaml").write_text("K_a: 3\n", encoding="utf-8")
    done = run("plan", *arguments)
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert done.err.count("\n") == 1


def test_poses_that_determine_nothing_have_no_table_of_expectations(run):
    outcome = run("plan", "--poses", "3")
    assert outcome.code == 1
    assert "Still not determined after these poses: all nine parameters" in outcome.out.replace("\n", " ")
    assert "Expected" not in outcome.out
