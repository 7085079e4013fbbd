"""`accelcal report`: the file, the exit code, bad input."""

from __future__ import annotations

import importlib.util

import pytest


@pytest.fixture
def result(run, good):
    assert run("calibrate", good, "--optimizer", "levenberg-marquardt", "-o", "r.yaml", "-q").code == 0
    return "r.yaml"


def test_a_report_is_written(run, result, tmp_path):
    done = run("report", result, "-o", "report.html")
    assert (done.code, done.out, done.err) == (0, "", "accelcal: wrote report.html\n")
    text = (tmp_path / "report.html").read_text("utf-8")
    assert text.startswith("<!doctype html>")
    assert "Calibration of good.csv" in text
    printed = run("report", result, "-o", "-", "--title", "Sensor 7 & 8")
    assert (printed.code, printed.err) == (0, "")
    assert "<h1>Sensor 7 &amp; 8</h1>" in printed.out
    assert run("report", result, "-o", "report.html", "-q").err == ""


def test_json_does_as_well(run, good, tmp_path):
    options = ("--optimizer", "levenberg-marquardt", "-q")
    assert run("calibrate", good, *options, "-o", "r.json").code == 0
    assert run("calibrate", good, *options, "-o", "r.yaml").code == 0
    pages = [run("report", name, "-o", "-").out for name in ("r.json", "r.yaml")]
    assert pages[0] == pages[1]


def test_an_undetermined_result_exits_with_1_and_is_reported(run, tmp_path):
    assert run("simulate", "--positions", "6", "-o", "six.csv").code == 0
    assert run("calibrate", "six.csv", "-o", "r.yaml", "-q").code == 1
    assert run("report", "r.yaml", "-o", "report.html").code == 1
    assert "Verdict: undetermined" in (tmp_path / "report.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("nowhere.yaml", "-o", "report.html"), "nowhere.yaml"),
        (("bad.yaml", "-o", "report.html"), "bad.yaml"),
        (("good.csv", "-o", "report.html"), "good.csv"),
        (("r.yaml",), "--output"),
        (("r.yaml", "-o", "report.pdf"), '-o "report.pdf": expected a name that ends in .html or .htm'),
        (("r.yaml", "-o", "no/report.html"), "no such folder"),
        (("r.yaml", "-o", "."), "is a directory"),
    ],
)
def test_bad_input_is_one_message_and_no_file(run, result, tmp_path, arguments, message):
    (tmp_path / "bad.yaml").write_text("schema: accelcal/calibration/1\n", encoding="utf-8")
    before = sorted(path.name for path in tmp_path.iterdir())
    done = run("report", *arguments)
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert done.err.count("\n") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_without_the_extra_it_says_what_to_install(run, result, monkeypatch):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "jinja2" else find(name))
    done = run("report", result, "-o", "report.html")
    assert done.code == 2
    assert "python -m pip install jinja2" in done.err
