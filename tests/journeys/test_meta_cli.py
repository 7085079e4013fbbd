"""`--meta`: what is stated of a sensor, from the command line to every result file."""

from __future__ import annotations

import json

import pytest
import yaml

FAST = ("--optimizer", "ellipsoid", "-q")


@pytest.mark.parametrize(
    "words",
    [
        ("--meta", "serial=A 17", "operator=Jo"),
        ("--meta", "serial=A 17", "--meta", "operator=Jo"),
        ("--meta=serial=A 17", "operator=Jo"),
    ],
)
def test_several_entries_stand_behind_one_option_or_several(run, good, tmp_path, words):
    assert run("calibrate", *words, good, *FAST, "-o", "r.yaml").code == 0
    kept = yaml.safe_load((tmp_path / "r.yaml").read_text())["meta"]
    assert kept == {"serial": "A 17", "operator": "Jo"}


def test_a_file_that_looks_like_an_entry_stays_a_file(run, good, tmp_path):
    (tmp_path / "a=1.csv").write_bytes((tmp_path / good).read_bytes())
    assert run("calibrate", "--meta", "serial=7", "a=1.csv", *FAST, "-o", "r.yaml").code == 0
    assert yaml.safe_load((tmp_path / "r.yaml").read_text())["meta"] == {"serial": "7"}


def test_it_is_shown_and_exported(run, good):
    shown = run("calibrate", good, *FAST, "-o", "r.yaml", "--meta", "serial=A17")
    assert "serial: A17" in shown.out
    assert "serial: A17" in run("export", "r.yaml", "--to", "c-header", "-o", "-").out


def test_what_is_wrong_is_one_line_before_any_work(run, good, tmp_path):
    done = run("calibrate", good, "--meta", "serial", "-o", "r.yaml")
    assert (done.code, done.out) == (2, "")
    assert done.err == 'accelcal: --meta "serial": expected KEY=VALUE, as serial=A17\n'
    assert not (tmp_path / "r.yaml").exists()


def test_a_fleet_keeps_it_in_each_result_file(run, tmp_path):
    assert (
        run("simulate", "--sensors", "3", "--positions", "24", "--noise", "0.003", "-o", "fleet.csv").code
        == 0
    )
    refused = run("fleet", "fleet.csv", "--meta", "lot=9")
    assert (refused.code, refused.err) == (2, "accelcal: --meta is kept in result files: add -o FOLDER/\n")
    run("fleet", "fleet.csv", "--g", "9.81", "--meta", "lot=9", "-o", "out/", "-q")
    files = sorted((tmp_path / "out").iterdir())
    assert len(files) == 3
    for file in files:
        record = json.loads(file.read_text())
        assert (record["meta"], record["g_source"]) == ({"lot": "9"}, "stated by the user")
        assert record["date"] == "2025-12-01T00:00:00Z"


def test_where_a_settings_file_states_g_the_result_says_so(run, good, tmp_path):
    (tmp_path / "own.yaml").write_text("g: 9.8\n")
    assert run("calibrate", good, *FAST, "--config", "own.yaml", "-o", "r.yaml").code == 0
    assert yaml.safe_load((tmp_path / "r.yaml").read_text())["g_source"] == "stated in own.yaml"
    assert run("calibrate", good, *FAST, "--config", "own.yaml", "--g", "9.81", "-o", "r.yaml").code == 0
    assert yaml.safe_load((tmp_path / "r.yaml").read_text())["g_source"] == "stated by the user"
