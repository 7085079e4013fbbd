"""`accelcal report`: the file, the exit code, bad input."""

from __future__ import annotations

import importlib.util
import re

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


def test_a_certificate_is_written(run, result, tmp_path):
    words = ("--certificate", "--meta", "serial=A17", "operator=Jo", "--paper", "letter")
    done = run("report", result, *words, "-o", "c.html")
    assert (done.code, done.out, done.err) == (0, "", "accelcal: wrote c.html\n")
    text = (tmp_path / "c.html").read_text("utf-8")
    assert "size: letter" in text
    assert "<dt>serial</dt><dd>A17</dd>" in text
    assert "<dt>operator</dt><dd>Jo</dd>" in text


def test_a_suspect_result_has_a_certificate_that_says_so(run, result, tmp_path):
    lines = (tmp_path / "good.csv").read_text().splitlines()
    lines[5] = ",".join(str(1.05 * float(cell)) for cell in lines[5].split(","))
    (tmp_path / "off.csv").write_text("\n".join(lines))
    assert run("calibrate", "off.csv", "-o", "off.yaml", "-q").code == 1
    assert run("report", "off.yaml", "--certificate", "-o", "c.html").code == 1
    assert "Verdict: suspect." in (tmp_path / "c.html").read_text("utf-8")


def test_an_undetermined_result_has_no_certificate(run, tmp_path):
    assert run("simulate", "--positions", "6", "-o", "six.csv").code == 0
    assert run("calibrate", "six.csv", "-o", "r.yaml", "-q").code == 1
    done = run("report", "r.yaml", "--certificate", "-o", "c.html")
    assert (done.code, done.out, done.err.count("\n")) == (2, "", 1)
    assert "r.yaml: its verdict is undetermined (" in done.err
    assert not (tmp_path / "c.html").exists()


def test_what_a_result_keeps_stands_and_more_may_be_added(run, good, tmp_path):
    assert (
        run("calibrate", good, "--optimizer", "ellipsoid", "--meta", "serial=7", "-o", "r.yaml", "-q").code
        == 0
    )
    assert run("report", "r.yaml", "--meta", "serial=7", "place=Lab 2", "-o", "p.html").code == 0
    text = (tmp_path / "p.html").read_text("utf-8")
    assert text.count("<dt>serial</dt><dd>7</dd>") == text.count("<dt>place</dt><dd>Lab 2</dd>") == 1
    done = run("report", "r.yaml", "--meta", "serial=8", "-o", "p.html")
    assert (done.code, done.err.count("\n")) == (2, 1)
    assert 'the result has serial "7"' in done.err


def test_several_results_stand_side_by_side(run, result, tmp_path):
    assert (
        run("calibrate", "good.csv", "--optimizer", "ellipsoid", "--g", "9.81", "-o", "after.json", "-q").code
        == 0
    )
    assert run("report", "r.yaml", "after.json", "-o", "two.html").code == 0
    text = (tmp_path / "two.html").read_text("utf-8")
    assert "<h1>Calibrations r, after</h1>" in text
    assert "after less r" in text


def test_a_folder_is_a_fleet(run, tmp_path):
    assert (
        run("simulate", "--sensors", "12", "--positions", "24", "--noise", "0.003", "-o", "fleet.csv").code
        == 0
    )
    assert run("fleet", "fleet.csv", "--g", "9.80665", "-o", "out/", "-q").code == 0
    done = run("report", "out", "-o", "fleet.html")
    assert (done.code, done.err) == (0, "accelcal: wrote fleet.html\n")
    text = (tmp_path / "fleet.html").read_text("utf-8")
    assert "12 sensors: 12 good" in text
    for number in range(1, 13):
        assert f"S{number:02}" in text
    shown = run("fleet", "fleet.csv", "--g", "9.80665", "-q", "--verbose").out
    median = next(line.split()[-3] for line in shown.splitlines() if "scale factor x" in line)
    assert re.search(rf"> *{median}<", text)  # the same numbers as the command that made the folder


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
        (("r.yaml", "-o", "p.html", "--paper", "a4"), "--paper is of a certificate: add --certificate"),
        (
            ("r.yaml", "-o", "p.html", "--paper", "a5", "--certificate"),
            '--paper "a5": unknown (did you mean "a4"?)',
        ),
        (("r.yaml", "r.yaml", "-o", "p.html"), "r.yaml: is stated twice"),
        (("r.yaml", "-", "-o", "p.html"), "-: standard input is one result"),
        ((".", "-o", "p.html", "--certificate"), "--certificate is of one result: 2 are stated"),
        (("empty", "-o", "p.html"), "empty: holds no result file"),
        (("r.yaml", "-o", "p.html", "--meta", "serial"), "expected KEY=VALUE"),
    ],
)
def test_bad_input_is_one_message_and_no_file(run, result, tmp_path, arguments, message):
    (tmp_path / "bad.yaml").write_text("schema: accelcal/calibration/1\n", encoding="utf-8")
    (tmp_path / "empty").mkdir()
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
