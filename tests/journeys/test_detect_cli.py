"""`accelcal detect`, `calibrate --raw` and `simulate --raw` from the command line."""

from __future__ import annotations

import csv
import hashlib
import io
import json
from pathlib import Path

import numpy as np
import pytest
import yaml

HEADER = ["pose", "start", "end", "n", "Nx", "Ny", "Nz", "sx", "sy", "sz", "t_start", "t_end"]


@pytest.fixture
def log(run) -> str:
    """The name of a raw log of 14 poses with a gyroscope."""
    outcome = run(
        *("simulate", "--raw", "--sensor", "mems", "--positions", "14", "--gyro", "--tremor", "0.02"),
        *("--hold", "3", "--move", "1", "--seed", "3", "-o", "raw.csv", "--truth", "truth.yaml"),
    )
    assert outcome.code == 0
    return "raw.csv"


def rows(text):
    return list(csv.reader(io.StringIO(text)))


def test_the_poses_of_a_simulated_log(run, log):
    outcome = run("detect", log, "-o", "poses.csv", "--verbose")
    assert outcome.code == 0
    assert "14 still intervals found" in outcome.out.replace("\n", " ")
    assert "kept" in outcome.out
    assert outcome.err == "accelcal: wrote poses.csv\n"
    header, *poses = rows(Path("poses.csv").read_text(encoding="utf-8"))
    assert header == HEADER
    holds = yaml.safe_load(Path("truth.yaml").read_text(encoding="utf-8"))["holds"]
    assert len(poses) == len(holds) == 14
    assert [number for number, *_ in poses] == [str(k) for k in range(1, 15)]
    for (_, *pose), (start, end) in zip(poses, holds, strict=True):
        assert start <= int(pose[0]) <= start + 100
        assert end - 100 <= int(pose[1]) <= end
        assert int(pose[2]) == int(pose[1]) - int(pose[0]) + 1
        assert float(pose[9]) == pytest.approx((int(pose[0]) - 1) / 100)


def test_raw_is_detect_and_calibrate_in_one(run, log):
    assert run("detect", log, "-q", "-o", "poses.csv").code == 0
    two = json.loads(run("calibrate", "poses.csv", "--weights", "auto", "--format", "json").out)
    one = json.loads(run("calibrate", log, "--raw", "--format", "json").out)
    np.testing.assert_allclose(one["K_a"], two["K_a"], rtol=1e-9, atol=1e-6)
    np.testing.assert_allclose(one["sigma"]["D_a"], two["sigma"]["D_a"], rtol=1e-6)
    assert one["verdict"] == "good"
    assert one["data"]["sha256"] == hashlib.sha256(Path(log).read_bytes()).hexdigest()
    assert one["data"]["columns"] == ["ax", "ay", "az"]
    assert one["poses_fit"][0]["where"].startswith("time ")
    assert "14 still intervals found" in one["notes"][-1]
    assert one["settings"]["weights"] == "auto"
    truth = yaml.safe_load(Path("truth.yaml").read_text(encoding="utf-8"))
    away = np.array(one["K_a"]) - truth["K_a_lower"]
    lower = np.tril_indices(3)
    assert np.abs(away[lower] / np.array(one["sigma"]["K_a"])[lower]).max() < 4


def test_a_log_is_verified_as_it_is_calibrated(run, log):
    assert run("calibrate", log, "--raw", "-o", "result.yaml").code == 0
    assert run("detect", log, "-q", "-o", "poses.csv").code == 0
    one = json.loads(run("verify", "result.yaml", log, "--raw", "--format", "json").out)
    two = json.loads(run("verify", "result.yaml", "poses.csv", "--format", "json").out)
    assert one["verdict"] == two["verdict"] == "unchanged"
    assert one["chance"] == pytest.approx(two["chance"], rel=1e-6)
    assert one["data"]["sha256"] == hashlib.sha256(Path(log).read_bytes()).hexdigest()
    assert "--min-poses needs --raw" in run("verify", "result.yaml", "poses.csv", "--min-poses", "3").err


def test_a_raw_log_that_is_taken_for_poses_is_told(run, log):
    said = "Each row is taken for a pose at rest. If these"
    plain = run("calibrate", log, "--optimizer", "ellipsoid", "-o", "wrong.yaml")
    assert said in plain.out.replace("\n", " ")
    assert said not in run("calibrate", log, "--raw", "--optimizer", "ellipsoid").out.replace("\n", " ")
    verified = run("verify", "wrong.yaml", log)
    assert verified.err.startswith(f"accelcal: wrong.yaml: warning: {said}")
    for outcome in (verified, run("plan", log)):
        assert f"\nWarning: {said}" in outcome.out
        assert "accelcal: raw.csv" not in outcome.err
    assert run("plan", log, "--format", "csv").err.startswith(f"accelcal: raw.csv: warning: {said}")
    assert run("detect", log, "-o", "poses.csv").code == 0
    assert said not in run("calibrate", "poses.csv", "--optimizer", "ellipsoid").out.replace("\n", " ")
    assert run("plan", "poses.csv", "--format", "csv").err == ""


def test_a_raw_log_without_names_is_told_too_and_many_poses_are_not(run, log):
    bare = "".join(line.partition(",")[2] for line in Path(log).read_text().splitlines(keepends=True)[1:])
    said = "Each row is taken for a pose at rest. If these"
    Path("bare.csv").write_text(bare)
    assert run("plan", "bare.csv", "--columns", "1,2,3", "--format", "csv").err.startswith(
        f"accelcal: bare.csv: warning: {said}"
    )
    run("simulate", "--sensor", "mems", "--positions", "600", "-o", "poses.csv")
    assert run("plan", "poses.csv", "--format", "csv").err == ""


def test_weights_of_a_raw_log_can_be_stated(run, log):
    Path("plain.yaml").write_text("weights: none\n")
    for arguments in (["--weights", "none"], ["--config", "plain.yaml"]):
        result = json.loads(run("calibrate", log, "--raw", "--format", "json", *arguments).out)
        assert result["settings"]["weights"] == "none"


def test_formats_agree(run, log):
    table = run("detect", log, "-q", "--format", "csv")
    assert table.err == ""
    assert run("detect", log, "-q", "-o", "-").out == table.out
    record = json.loads(run("detect", log, "--format", "json").out)
    assert record["schema"] == "accelcal/detection/1"
    assert list(record["poses"][0]) == HEADER
    assert [pose["n"] for pose in record["poses"]] == [int(row[3]) for row in rows(table.out)[1:]]
    assert record["rate"] == pytest.approx(100)
    assert record["threshold"] == pytest.approx(record["multiplier"] * record["variance"])
    kept = [c for c in record["candidates"] if c["multiplier"] == record["multiplier"]]
    assert kept[0]["poses"] == 14


def test_standard_input_and_stated_columns(run, log):
    data = Path(log).read_bytes()
    by_name = run("detect", "-", "--format", "csv", stdin=data)
    nameless = data.split(b"\n", 1)[1]
    by_number = run("detect", "-", "--columns", "2,3,4", "--gyro", "5,6,7", "--format", "csv", stdin=nameless)
    guessed = run("detect", "-", "--format", "csv", stdin=nameless)
    assert by_name.out == by_number.out == guessed.out
    assert by_name.code == 0
    without = run("detect", log, "--gyro", "none", "--time", "none", "--format", "csv")
    assert rows(without.out)[0] == HEADER[:-2]
    assert len(rows(without.out)) == 15


def test_spans_in_seconds_are_spans_in_rows(run, log):
    seconds = ["--window", "0.5", "--min-length", "0.8s", "--trim", "0.2", "--still", "2"]
    counted = ["--window", "50rows", "--min-length", "80rows", "--trim", "20rows", "--still", "200rows"]
    assert (
        run("detect", log, *seconds, "--format", "csv").out
        == run("detect", log, *counted, "--format", "csv").out
    )
    stated = run("detect", log, "--time", "none", "--rate", "100", *seconds, "--format", "json")
    assert json.loads(stated.out)["window"] == 50


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_a_picture_of_the_log(run, log, suffix):
    pytest.importorskip("matplotlib")
    assert run("detect", log, "-q", "--plot", f"log.{suffix}").code == 0
    first = Path(f"log.{suffix}").read_bytes()
    assert first.startswith(b"\x89PNG" if suffix == "png" else b"<?xml")
    assert run("detect", log, "-q", "--plot", f"log.{suffix}").code == 0
    assert Path(f"log.{suffix}").read_bytes() == first
    if suffix == "svg":
        assert b"static pose" in first


def test_a_picture_shows_why_detection_failed(run, log):
    pytest.importorskip("matplotlib")
    failed = run("detect", log, "--min-poses", "15", "--plot", "log.svg", "-o", "out.csv")
    assert failed.code == 2
    assert failed.err.startswith("accelcal: wrote log.svg\naccelcal: raw.csv: 14 still poses")
    assert "14 static poses" in Path("log.svg").read_text()
    assert not Path("out.csv").exists()
    assert run("detect", log, "--min-length", "60", "--plot", "none.svg", "-q").err.count("\n") == 1
    assert "0 static poses" in Path("none.svg").read_text()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--multiplier", "0.5"], '--multiplier "0.5": expected numbers above 1'),
        (["--multiplier", "2,x"], '--multiplier "2,x": expected numbers'),
        (["--window", "0"], "--window: 0 rows are too few"),
        (["--window", "wide"], '--window "wide": expected seconds'),
        (["--window", "1000"], "fewer than one window"),
        (["--rate", "0"], "--rate 0: expected more than 0"),
        (["--rate", "nan"], "--rate nan: expected more than 0"),
        (["--time", "none", "--window", "1"], "state --rate"),
        (["--still", "1000"], "fewer than the still period"),
        (["--still", "5"], "the first 500 rows are not still"),
        (["--still", "0.1"], "fewer than the 100 of a window"),
        (["--min-length", "60"], "14 stretches"),
        (["--min-poses", "15"], "14 still poses in 14 attitudes, fewer than 15"),
        (["--merge", "9"], "--merge 9: expected more than 0 and at most 5 degrees"),
        (["--merge", "1", "--thin", "1"], "expected one of them, not both"),
        (["--gyro", "wx,wy"], "--gyro: three columns were expected"),
        (["--columns", "a,b,c"], '--columns: no column "a"'),
        (["--g", "0"], "--g 0: expected gravity"),
        (["--plot", "log.gif"], '--plot "log.gif"'),
        (["--plot", "no/log.png"], "no such folder"),
        (["--plot", "out.csv"], '--plot "out.csv": expected another file'),
    ],
)
def test_wrong_options_leave_one_line_and_no_file(run, log, arguments, said):
    outcome = run("detect", log, "-o", "out.csv", *arguments)
    assert outcome.code == 2
    assert said in outcome.err
    assert outcome.err.startswith("accelcal: ")
    assert outcome.err.count("\n") == 1
    assert outcome.out == ""
    assert not Path("out.csv").exists()


def broken(kind):
    numbers = np.column_stack([np.arange(2000) / 100, np.tile([1.0, 2.0, 9.0], (2000, 1))])
    numbers[:, 1:] += 0.01 * np.sin(np.arange(6000.0).reshape(2000, 3) ** 2)
    if kind == "back":
        numbers[1500:, 0] -= 3
    if kind == "equal":
        numbers[:, 1:] = 1.0
    lines = [",".join(f"{cell:.6g}" for cell in row) for row in numbers[: 50 if kind == "short" else None]]
    if kind == "nan":
        lines[41] = "0.41,1,nan,9"
    if kind == "empty":
        return ""
    return "\n".join(["t,ax,ay,az", *([] if kind == "header" else lines)]) + "\n"


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("empty", "bad.csv: is empty"),
        ("header", "bad.csv: has a header but no rows"),
        ("short", "bad.csv: has 50 rows, fewer than one window of 100"),
        ("nan", 'bad.csv, line 43, column "ay": "nan" is not a finite number'),
        ("back", "bad.csv, line 1502: time 12 comes after 14.99"),
        ("equal", "bad.csv: all readings are equal"),
        ("one pose", "bad.csv: the sensor was never turned: all readings show one attitude"),
    ],
)
@pytest.mark.parametrize("command", [("detect",), ("calibrate", "--raw")])
def test_a_log_that_cannot_be_used(run, kind, said, command):
    Path("bad.csv").write_text(broken(kind))
    outcome = run(*command, "bad.csv", "-o", "out.yaml")
    assert outcome.code == 2
    assert said in outcome.err
    assert outcome.err.count("\n") == 1
    assert not Path("out.yaml").exists()


def test_output_that_cannot_be_written(run, log):
    outcome = run("detect", log, "-o", "no/poses.csv")
    assert (outcome.code, outcome.err) == (2, "accelcal: no/poses.csv: no such folder: no\n")
    assert run("detect", log, "-o", "-", "--format", "json").code == 2


def test_a_picture_needs_matplotlib(run, log, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    outcome = run("detect", log, "--plot", "log.png")
    assert outcome.code == 2
    assert "python -m pip install matplotlib" in outcome.err


def test_options_of_a_log_go_with_raw(run, log):
    for arguments in (["--window", "1"], ["--gyro", "none"], ["--min-poses", "3"]):
        outcome = run("calibrate", log, *arguments)
        assert (outcome.code, outcome.err) == (2, f"accelcal: {arguments[0]} needs --raw\n")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--gyro"], "--gyro needs --raw"),
        (["--hold", "3"], "--hold needs --raw"),
        (["--raw", "--samples", "2"], "--samples cannot be used with --raw"),
        (["--raw", "--attitude"], "--attitude cannot be used with --raw"),
        (["--raw", "--rate", "0"], "rate: 0.0 is too small"),
        (["--raw", "--tremor", "nan"], "tremor: nan is not a finite number"),
    ],
)
def test_simulate_refuses_what_makes_no_log(run, arguments, said):
    outcome = run("simulate", *arguments)
    assert outcome.code == 2
    assert said in outcome.err


def test_a_simulated_log_repeats_from_its_seed(run):
    again = [run("simulate", "--raw", "--positions", "3", "--seed", seed).out for seed in ("5", "5", "6")]
    assert again[0] == again[1] != again[2]
    header, *lines = rows(again[0])
    assert header == ["t", "ax", "ay", "az"]
    assert len(lines) > 3 * 400


def test_a_log_of_faces_is_enough_without_misalignments(run):
    """On the command line or by the configuration: six poses will do, weighed by their number of readings."""
    run(
        "simulate",
        "--raw",
        "--positions",
        "6",
        "--scheme",
        "faces",
        "--sensor",
        "mems",
        "--seed",
        "4",
        "-o",
        "faces.csv",
    )
    Path("six.yaml").write_text("misalignment: false\n")
    for stated in (["--no-misalignment"], ["--config", "six.yaml"]):
        done = run(
            "calibrate",
            "faces.csv",
            "--raw",
            "--optimizer",
            "levenberg-marquardt",
            *stated,
            "--format",
            "json",
            "-q",
        )
        one = json.loads(done.out)
        assert (done.code, one["poses"], one["settings"]["weights"]) == (0, 6, "n")


def test_a_log_without_noise_is_good_and_nothing_speaks_against_it(run):
    """What rounding leaves is neither noise nor a coarse step."""
    for seed in ("1", "2"):
        run("simulate", "--raw", "--noise", "0", "--seed", seed, "-o", "still.csv")
        result = run("calibrate", "still.csv", "--raw", "--format", "json", "-q")
        record = json.loads(result.out)
        assert (result.code, record["verdict"], record["warnings"]) == (0, "good", [])
