"""`calibrate --raw --worn` and `fleet --raw --worn` from the command line, with a simulated Axivity file."""

from __future__ import annotations

import json
import re
import sys
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.calibration.result import load_result
from accelcal_cli.detection.rawlog import open_raw_log
from accelcal_cli.detection.worn import WornSettings, find_wear

sys.path.insert(0, str(Path(__file__).parents[2]))

from benchmarks.worn import deviations
from benchmarks.worn_logs import WornSensor, simulate_worn, write_cwa


@pytest.fixture(scope="module")
def worn_file(tmp_path_factory):
    """Six hours of wear."""
    path = tmp_path_factory.mktemp("worn") / "wrist.cwa"
    write_cwa(path, simulate_worn(WornSensor(), 0.25, 20, 7), 25, actual=20)
    return str(path)


def test_a_worn_log_is_calibrated_with_the_figures_of_ggir(run, worn_file):
    done = run("calibrate", "--raw", "--worn", worn_file, "-o", "wrist.json")
    assert done.code in (0, 1), done.err
    assert "Days of wear" in done.out
    assert re.search(r"sphere filled within \+-0\.3 g +yes", done.out)
    record = json.loads(Path("wrist.json").read_text())
    worn = record["worn"]
    assert worn["filled"]
    assert worn["error_before"] > 20
    assert worn["error_after"] < 1
    assert 5.5 < worn["hours"] < 6.2
    assert worn["rest_hours"] == pytest.approx(worn["windows"] / 360)
    assert (record["data"]["source_format"], record["data"]["unit"], record["g"]) == ("cwa", "g", 1.0)
    result = load_result("wrist.json")
    with closing(open_raw_log(worn_file)) as log:
        poses = find_wear(log, WornSettings(g=1.0)).intervals
    assert np.ptp(poses.temperature) < 2.5  # not enough for slopes
    assert np.abs(deviations(result, poses.n @ poses.temperature / poses.n.sum())).max() < 4.5
    page = run("report", "wrist.json", "-o", "wrist.html")
    assert page.code == 0
    assert "points, windows of 10 s at rest" in Path("wrist.html").read_text()


def test_a_fleet_of_worn_logs(run, worn_file):
    Path("other.cwa").write_bytes(Path(worn_file).read_bytes())
    done = run("fleet", "--raw", "--worn", worn_file, "other.cwa", "--format", "csv")
    assert done.code in (0, 1), done.err
    rows = done.out.strip().splitlines()
    assert len(rows) == 3
    assert rows[1].split(",")[1:] == rows[2].split(",")[1:]


def test_what_does_not_go_with_worn(run, worn_file):
    for arguments, words in (
        (["--worn"], "--worn needs --raw"),
        (["--raw", "--worn", "--multiplier", "3"], "--multiplier does not apply to --worn"),
        (["--raw", "--worn", "--window", "3"], "--window does not apply to --worn"),
    ):
        done = run("calibrate", worn_file, *arguments)
        assert done.code == 2
        assert words in done.err
