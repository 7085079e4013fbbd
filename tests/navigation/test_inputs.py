"""Maps and voyages from files, and `accelcal navigate` on good and on bad ones."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import accelcal_cli
from accelcal_cli.errors import AccelcalError, DataError
from accelcal_cli.navigation.gravity_map import PRESETS, RandomField, generate, load_map
from accelcal_cli.navigation.ins import InsGrade
from accelcal_cli.navigation.particle_filter import FILTERS
from accelcal_cli.navigation.scenario import from_recording, read_voyage
from accelcal_cli.navigation.study import NavigationSettings, load_study
from accelcal_cli.navigation.voyage import PlannedVoyage
from accelcal_cli.views.blocks import Table
from accelcal_cli.views.navigation import COLUMNS, with_paper

ROOT = Path(accelcal_cli.__file__).parents[1]
SMALL = RandomField(60.0, 8.0, 20.0, 20.7, 115.0, 116.4, 60.0)
QUICK = """
plan: {hours: 2.6, turn: 0, speed: 8}
period: 30
"""


def write_xyz(path, grid, skip=()):
    rows, columns = grid.values.shape
    south, west = np.degrees(grid.south), np.degrees(grid.west)
    step = np.degrees(grid.step_north)
    lines = ["longitude latitude anomaly"]
    for i in range(rows):
        for j in range(columns):
            value = "nan" if (i, j) in skip else f"{grid.values[i, j]:.6f}"
            lines.append(f"{west + j * step:.9f} {south + i * step:.9f} {value}")
    path.write_text("\n".join(lines))
    return path


def navigate(*arguments, code=0):
    done = subprocess.run(
        [sys.executable, "-m", "accelcal_cli", "navigate", *map(str, arguments)],
        capture_output=True, text=True, cwd=ROOT, stdin=subprocess.DEVNULL, check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    assert "Traceback" not in done.stderr
    if code == 2:
        assert len(done.stderr.strip().splitlines()) == 1
    return done.stdout if code == 0 else done.stderr


@pytest.fixture
def quick(tmp_path):
    path = tmp_path / "quick.yaml"
    path.write_text(QUICK)
    return path


def test_xyz_text_is_read_back(tmp_path):
    grid = generate(SMALL, 0)
    read = load_map(str(write_xyz(tmp_path / "map.xyz", grid)))
    np.testing.assert_allclose(read.values, grid.values, atol=1e-6)
    assert read.south == pytest.approx(grid.south, abs=1e-9)
    assert read.step_east == pytest.approx(grid.step_east, rel=1e-6)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "no rows"),
        ("1 2 3\n1 2\n", "line 2"),
        ("1 2 3\n1 x 3\n", "line 2"),
        ("0 0 1\n1 1 2\n2 2 3\n3 3 4\n4 4 5\n5 5 6\n6 6 1\n", "not the nodes of a grid"),
        ("0 0 1\n0 1 1\n1 0 1\n1 1 1\n3 0 1\n3 1 1\n", "not evenly spaced"),
        ("0 0 1\n1 0 1\n", "two nodes in latitude"),
        ("0 0 1\n0 5000 1\n1 0 1\n1 5000 1\n", "degrees"),
    ],
)
def test_a_bad_map_is_refused(tmp_path, text, told):
    path = tmp_path / "map.txt"
    path.write_text(text)
    with pytest.raises(DataError, match=told):
        load_map(str(path))


inside_affine = pytest.mark.filterwarnings(
    "ignore:Use `@` matmul:PendingDeprecationWarning"
)  # of rioxarray's code
maps = pytest.mark.skipif(importlib.util.find_spec("rioxarray") is None, reason="needs the extra maps")


def as_array(grid, names=("lat", "lon")):
    """Return a map as an xarray from north to south, as most files have it."""
    import xarray

    rows, columns = grid.values.shape
    latitude = np.degrees(grid.south) + np.arange(rows) / 60
    longitude = np.degrees(grid.west) + np.arange(columns) / 60
    coordinates = {names[0]: latitude[::-1], names[1]: longitude}
    return xarray.DataArray(grid.values[::-1], coords=coordinates, dims=names)


@maps
def test_netcdf_is_read(tmp_path):
    grid = generate(SMALL, 0)
    path = tmp_path / "map.nc"
    as_array(grid).to_dataset(name="anomaly").to_netcdf(path)
    read = load_map(str(path))
    np.testing.assert_allclose(read.values, grid.values, atol=1e-9)
    assert (read.south, read.west) == pytest.approx((grid.south, grid.west), abs=1e-12)
    both = as_array(grid).to_dataset(name="anomaly")
    both.assign(error=both.anomaly).to_netcdf(path)
    with pytest.raises(DataError, match="one variable on a grid, not 2"):
        load_map(str(path))


@maps
@inside_affine
def test_geotiff_is_read_and_its_missing_value_is_no_value(tmp_path):
    import rioxarray  # noqa: F401  # gives arrays .rio

    grid = generate(SMALL, 0)
    path = tmp_path / "map.tif"
    holed = as_array(grid, ("y", "x"))
    holed[3, 5] = np.nan
    holed.rio.write_crs(4326).rio.write_nodata(-9999.0, encoded=True).rio.to_raster(path)
    read = load_map(str(path))
    rows = grid.values.shape[0]
    assert np.argwhere(np.isnan(read.values)).tolist() == [[rows - 4, 5]]
    np.testing.assert_allclose(
        np.where(np.isnan(read.values), grid.values, read.values), grid.values, atol=1e-9
    )
    assert (read.south, read.west) == pytest.approx((grid.south, grid.west), abs=1e-9)


@maps
@inside_affine
def test_a_map_in_metres_is_refused(tmp_path):
    grid = as_array(generate(SMALL, 0), ("y", "x"))
    path = tmp_path / "map.tif"
    grid.assign_coords(x=grid.x * 1e5, y=grid.y * 1e5).rio.write_crs(32650).rio.to_raster(path)
    with pytest.raises(DataError, match="expected degrees, not metres"):
        load_map(str(path))


@pytest.mark.parametrize("name", ["map.nc", "map.grd", "map.tif"])
def test_a_file_that_is_no_map_gives_one_message(tmp_path, name):
    """Without the extra the message says what to install."""
    (tmp_path / name).write_bytes(b"not a map")
    told = "cannot be read" if importlib.util.find_spec("rioxarray") else "python -m pip install"
    with pytest.raises(DataError, match=told) as caught:
        load_map(str(tmp_path / name))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("name", "package"), [("map.nc", "xarray"), ("map.tif", "rioxarray")])
def test_without_its_package_a_map_says_what_to_install(tmp_path, monkeypatch, name, package):
    monkeypatch.setitem(sys.modules, package, None)
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(DataError, match=f"needs {package}: python -m pip install xarray rioxarray"):
        load_map(str(tmp_path / name))


def voyage_rows(rows=240, period=30.0, gravity=True):
    seconds = 7200 + period * np.arange(rows)
    longitude = 115.3 + 8.0 * (seconds - 7200) / 104e3
    lines = ["time,latitude,longitude,true_latitude,true_longitude" + (",gravity" if gravity else "")]
    for t, e in zip(seconds, longitude, strict=True):
        lines.append(f"{t},20.31,{e + 0.004:.8f},20.30,{e:.8f}" + (",3.5" if gravity else ""))
    return lines


def test_a_recorded_voyage_with_a_gap_is_refused(tmp_path):
    lines = voyage_rows()
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines[:50] + lines[60:]))
    with pytest.raises(DataError, match="line 51: a gap of 330 s"):
        read_voyage(str(path), 30.0)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda s: s.replace("latitude", "latitud", 1), 'no column "latitude" \\(did you mean "latitud"'),
        (lambda s: s.replace("20.31", "north", 1), 'line 2, column "latitude"'),
        (lambda s: s.replace(",3.5", ",3.5,9", 1), "line 2: expected 6 cells"),
        (lambda s: s.replace(",3.5", ",inf", 1), "line 2, column \"gravity\": 'inf' is not a finite number"),
        (lambda s: s.replace("20.30", "nan", 1), "line 2, column \"true_latitude\": 'nan' is not a finite"),
        (lambda s: s.split("\n")[0], "no rows"),
    ],
)
def test_a_bad_voyage_is_refused(tmp_path, change, told):
    path = tmp_path / "log.csv"
    path.write_text(change("\n".join(voyage_rows())))
    with pytest.raises(AccelcalError, match=told):
        read_voyage(str(path), 30.0)


def test_a_recorded_voyage_is_navigated(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(voyage_rows(gravity=False)))
    rows = json.loads(
        navigate(
            "--voyage",
            path,
            "--filter",
            "reference,pf",
            "--period",
            30,
            "--runs",
            2,
            "--format",
            "json",
            "-q",
        )
    )
    assert [row["filter"] for row in rows] == ["reference", "pf"]
    assert all(row["rmse_position_m"] < row["ins_m"] for row in rows)


def test_a_recorded_heading_turns_the_biases(tmp_path):
    lines = voyage_rows(rows=4)
    path = tmp_path / "log.csv"
    degrees = ("heading", "350", "10", "10", "40")
    path.write_text("\n".join(f"{line},{cell}" for line, cell in zip(lines, degrees, strict=True)))
    flat = generate(PRESETS["constant"], 0)
    found = from_recording(
        read_voyage(str(path), 30.0), flat, InsGrade(), runs=range(1), seed=0, noise=1.0, initial=2000.0
    )
    np.testing.assert_allclose(np.degrees(found.turns), [20.0, 0.0, 30.0], atol=1e-9)


def test_the_rows_have_their_names(quick, tmp_path):
    out, raw = tmp_path / "curves.csv", tmp_path / "runs.csv"
    rows = json.loads(
        navigate("--config", quick, "--filter", "all", "--runs", 2, "--generations", 2, "--format", "json", "-q",
                 "-o", out, "--raw", raw)
    )  # fmt: skip
    contract = {
        "filter",
        "mode",
        "runs",
        "rmse_position_m",
        "rmse_latitude_m",
        "rmse_longitude_m",
        "lost",
        "nees",
        "seconds",
    }
    assert [row["filter"] for row in rows] == ["pf", "pso-pf", "apo-pf", "de-pf", "reference"]
    assert all(contract <= set(row) for row in rows)
    header, *curves = out.read_text().splitlines()
    assert header.startswith("filter,mode,accelerometer_ug,seconds,rmse_latitude_m")
    named = {line.split(",")[0] for line in curves}
    assert named == {"pf", "pso-pf", "apo-pf", "de-pf", "reference", "INS alone", "bound"}
    start = next(line.split(",") for line in curves if line.startswith("INS alone"))
    assert 1000 < float(start[6]) < 1700  # the drift at the start of filtering
    assert len(raw.read_text().splitlines()) == 11


def test_jobs_do_not_change_the_result(quick):
    common = ("--config", quick, "--filter", "pf", "--runs", 60, "--format", "json", "-q")
    alone, together = (json.loads(navigate(*common, "--jobs", jobs))[0] for jobs in (1, 2))
    assert alone["rmse_position_m"] == together["rmse_position_m"]


@pytest.mark.parametrize("suffix", ["yaml", "json"])
def test_a_calibration_changes_the_ins(quick, tmp_path, suffix):
    result = tmp_path / f"result.{suffix}"
    subprocess.run(
        f"{sys.executable} -m accelcal_cli simulate --positions 24 --noise 1e-4 | "
        f"{sys.executable} -m accelcal_cli calibrate - --g 9.80665 -q -o {result}",
        shell=True, check=True, capture_output=True, cwd=ROOT,
    )  # fmt: skip
    rows = json.loads(
        navigate(
            "--config",
            quick,
            "--calibration",
            result,
            "--filter",
            "reference",
            "--runs",
            2,
            "--format",
            "json",
            "-q",
        )
    )
    assert rows[0]["accelerometer_ug"] == 50.0
    assert 0 < rows[1]["accelerometer_ug"] < 50.0
    assert rows[1]["bound_m"] < rows[0]["bound_m"]
    piped = subprocess.run(
        f"{sys.executable} -m accelcal_cli navigate --config {quick} --calibration - --filter reference --runs 2 "
        f"--format json -q < {result}",
        shell=True, check=True, capture_output=True, cwd=ROOT,
    )  # fmt: skip
    assert json.loads(piped.stdout)[1]["accelerometer_ug"] == rows[1]["accelerometer_ug"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--filter", "de-fp"), 'unknown filter "de-fp"'),
        (("--map", "ruogh"), 'did you mean "rough"'),
        (("--map", "nothing.xyz"), "no such file"),
        (("--mode", "litteral"), 'did you mean "literal"'),
        (("--period", "0.5"), "period"),
        (("--particles", "1"), "particles"),
        (("--voyage", "nothing.csv"), "nothing.csv"),
        (("--calibration", "nothing.yaml"), "nothing.yaml"),
        (("--resume",), "--raw"),
        (("-o", "/nowhere/x.csv"), "no such folder"),
    ],
)
def test_bad_usage_is_one_message(arguments, told):
    assert told in navigate(*arguments, code=2)


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("runs: 0", "runs: 0 is too small; expected at least 1"),
        ("runs: -3", "runs: -3 is too small; expected at least 1"),
        ("seed: -3", "seed: -3 is too small; expected at least 0"),
        (
            "plan: {hours: 0.0001, filtered: 0}",
            "plan: 0 s from filtered to hours; expected at least one period, 10 s",
        ),
        ("plan: {hours: 2.0025}", "plan: 9 s from filtered to hours"),
        ("noise: 1.0e-300", "noise: 1e-300 is too small; expected at least 0.001"),
    ],
)
def test_a_bad_key_of_the_file_is_one_message(tmp_path, text, told):
    path = tmp_path / "study.yaml"
    path.write_text(f"filters: [{{filter: pf}}]\n{text}\n")
    assert f"{path}: {told}" in navigate("--config", path, code=2)


def test_two_measurements_are_enough_for_every_filter(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text("plan: {hours: 2.0028}\nruns: 1\nnoise: 1.0e-3\n")
    assert len(json.loads(navigate("--config", path, "--format", "json", "-q"))) == len(FILTERS.names())


def test_a_voyage_of_one_measurement_is_refused(tmp_path):
    path = tmp_path / "voyage.csv"
    path.write_text("time,latitude,longitude,gravity\n0,20,115,1\n10,20,115,2\n20,20,115,3\n")
    assert "3 rows, 10 s apart, hold one measurement at --period 30; expected two" in navigate(
        "--voyage", path, "--period", 30, code=2
    )


def test_a_map_that_ends_inside_the_track_is_refused(tmp_path):
    path = write_xyz(tmp_path / "map.xyz", generate(SMALL, 0))
    assert re.search(
        r"the map ends at .* at hour \d", navigate("--map", path, "--filter", "pf", "--runs", 1, code=2)
    )


def test_a_hole_in_the_map_near_the_track_is_refused(tmp_path, quick):
    grid = generate(RandomField(60.0, 8.0, 20.0, 20.7, 115.0, 116.4, 60.0), 0)
    holes = {(i, 60) for i in range(grid.values.shape[0])}
    path = write_xyz(tmp_path / "map.xyz", grid, holes)
    text = "plan: {hours: 4, turn: 0}\nperiod: 30\n"
    quick.write_text(text)
    assert "has a cell without a value" in navigate(
        "--config", quick, "--map", path, "--filter", "pf", "--runs", 1, code=2
    )


def test_every_setting_of_a_filter_is_documented():
    told = set(re.findall(r"`(\w+)`", (ROOT / "docs/reference/navigate.md").read_text("utf-8")))
    for name in FILTERS.names():
        settings = {field.name for field in dataclasses.fields(FILTERS.get(name))}  # type: ignore[arg-type]
        assert settings <= told, name
    for cls in (NavigationSettings, PlannedVoyage, InsGrade):
        assert {field.name for field in dataclasses.fields(cls)} - {
            "digests",
            "title",
            "source",
            "note",
            "paper",
        } <= told
    assert {column.key or column.name for column in COLUMNS} <= told


def test_the_papers_numbers_stand_beside_ours():
    study = load_study("depf-rmse", {})
    table = with_paper(
        Table("", COLUMNS, tuple([(name, *[None] * (len(COLUMNS) - 1)) for name in ("PSO-PF", "de-pf")])),
        study,
    )
    assert [row["paper_m"] for row in table.records()] == [370.7, 101.5]
    assert study.runs == 200
    assert {entry.parameters.get("particles", 100) for entry in study.filters} == {100}
