"""Pictures of commands: axes have units, logs with dates have clock times, convergence is on logarithmic axes."""

from __future__ import annotations

import re

import numpy as np
import polars as pl
import pytest

import accelcal_cli as accelcal
from accelcal_cli.output.plot import plot_convergence, plot_log

pytest.importorskip("matplotlib")


def texts(path) -> str:
    """What an SVG file says: matplotlib writes each text as a comment beside its outlines."""
    return "\n".join(re.findall(r"<!-- (.*?) -->", path.read_text()))


@pytest.fixture(scope="module")
def log():
    return accelcal.simulate("mems", positions=13, raw=True, rate=50.0, hold=3.0, move=1.0, seed=2)


def drawn(frame, tmp_path, **keys) -> str:
    path = tmp_path / "log.svg"
    plot_log(accelcal.detect(frame, picture=True, **keys), str(path))
    return texts(path)


def test_a_log_has_seconds_and_output_units(log, tmp_path):
    said = drawn(log, tmp_path)
    assert "time [s]" in said
    assert "output [output units]" in said
    assert all(f"\n{pose}\n" in said for pose in range(1, 14))


def test_a_longer_log_has_minutes_in_the_unit_of_its_clock(log, tmp_path):
    slow = log.with_columns(pl.col("t") * 10_000).rename({"t": "t (ms)"})
    assert "time [min]" in drawn(slow, tmp_path, window="20rows", min_length="20rows")


def test_a_log_without_time_has_rows(log, tmp_path):
    assert "\nrow\n" in drawn(log.drop("t"), tmp_path, window="50rows", min_length="50rows")


def test_a_log_with_dates_has_clock_times(log, tmp_path):
    start = np.datetime64("2026-03-01T09:58:30.000", "ms")
    stamps = start + (log["t"].to_numpy() * 10_000).astype("timedelta64[ms]")
    path = tmp_path / "dated.csv"
    rows = zip(stamps.astype(str), *log.select("ax", "ay", "az").to_numpy().T, strict=True)
    path.write_text("time,ax,ay,az\n" + "".join(f"{t},{x},{y},{z}\n" for t, x, y, z in rows))
    detection = accelcal.detect(path, picture=True, window="20rows", min_length="20rows")
    assert detection.began == start
    plot_log(detection, str(tmp_path / "dated.svg"))
    said = texts(tmp_path / "dated.svg")
    assert "time of day" in said
    assert "10:00" in said
    assert "2026-Mar-01" in said


def test_seconds_since_1970_are_clock_times(log, tmp_path):
    unix = log.with_columns(pl.col("t") + 1_772_358_000.0)
    assert "time of day" in drawn(unix, tmp_path)


def test_convergence_is_drawn_on_logarithmic_axes(tmp_path):
    curve = np.geomspace(100, 50_000, 20), np.geomspace(1e3, 1e-9, 20)
    plot_convergence("A study", {"sphere": {"pso": curve}}, 1e-8, str(tmp_path / "curve.svg"))
    said = texts(tmp_path / "curve.svg")
    assert "$\\mathdefault{10^{4}}$" in said  # evaluations
    assert "tolerance" in said
