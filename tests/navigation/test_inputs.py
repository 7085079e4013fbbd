"""Maps and voyages from files, and `accelcal navigate` on good and on bad ones."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import re
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

import accelcal_cli
from accelcal_cli.errors import AccelcalError, DataError
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.navigation.gravity_map import PRESETS, GravityMap, RandomField, generate
from accelcal_cli.navigation.ins import InsGrade
from accelcal_cli.navigation.map_files import load_map
from accelcal_cli.navigation.recording import from_recording, read_voyage
from accelcal_cli.navigation.scenario import simulate
from accelcal_cli.navigation.study import FilterEntry, Navigation, NavigationSettings, load_study
from accelcal_cli.navigation.voyage import PlannedVoyage
from accelcal_cli.studies.study import Task
from accelcal_cli.views.blocks import Table
from accelcal_cli.views.navigation import COLUMNS, chart_of, curves, with_paper

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
        ("0 0 1\n0 1 -9999\n1 0 1\n1 1 1\n", "-9999 mGal at 1 N 0 E is no gravity anomaly"),
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
    with pytest.raises(
        DataError, match=r"one variable on a grid, not 2 .anomaly, error.; state it by --variable NAME"
    ):
        load_map(str(path))
    np.testing.assert_allclose(load_map(str(path), "error").values, grid.values, atol=1e-9)
    with pytest.raises(DataError, match=r'no variable "anomly" on a grid .did you mean "anomaly"'):
        load_map(str(path), "anomly")


@maps
def test_the_unit_of_a_netcdf_map_is_read(tmp_path):
    grid = generate(SMALL, 0)
    path = tmp_path / "map.nc"
    for unit, factor in (("m/s^2", 1e-5), ("m s-2", 1e-5), ("mGal", 1.0), ("milligals", 1.0)):
        array = as_array(grid) * factor
        array.attrs["units"] = unit
        array.to_dataset(name="anomaly").to_netcdf(path)
        np.testing.assert_allclose(load_map(str(path)).values, grid.values, atol=1e-9)
    array.attrs["units"] = "metres"
    array.to_dataset(name="height").to_netcdf(path)
    with pytest.raises(
        DataError, match="the values are in 'metres'; expected a gravity anomaly in mGal or m/s"
    ):
        load_map(str(path))


ICGEM = """product_type                gravity_field
modelname                   EIGEN-6C4
functional                  gravity_anomaly_cl
unit                        {unit}
gapvalue                    9999.0000
     longitude      latitude   gravity_anomaly_cl
       [deg.]        [deg.]         [{unit}]
end_of_head ==========================================
"""


@pytest.mark.parametrize(("unit", "factor"), [("mgal", 1.0), ("m/s**2", 1e-5)])
def test_an_icgem_grid_is_read(tmp_path, unit, factor):
    path = tmp_path / "map.gdf"
    rows = [(x, y, 10.0 * y + x - 359.0) for y in (1.0, 0.5, 0.0) for x in (359.0, 359.5, 360.0)]
    text = "".join(f"{x:12.4f} {y:10.4f} {0.0:8.3f} {v * factor:16.9f}\n" for x, y, v in rows[:-1])
    path.write_text(ICGEM.format(unit=unit) + text + "360.0 0.0 0.0 9999.0000\n")
    found = load_map(str(path))
    assert np.degrees([found.south, found.west]) == pytest.approx([0.0, 359.0])
    np.testing.assert_allclose(found.values[1], [5.0, 5.5, 6.0], atol=1e-3)
    assert np.isnan(found.values[0, 2])
    path.write_text("no header\n")
    with pytest.raises(DataError, match="whose header ends with"):
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


def test_a_gap_is_bridged_and_told(tmp_path):
    lines = voyage_rows()
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines[:50] + lines[60:]))
    found = read_voyage(str(path), 30.0)
    whole = tmp_path / "whole.csv"
    whole.write_text("\n".join(lines))
    expected = read_voyage(str(whole), 30.0)
    np.testing.assert_allclose(found.columns["longitude"], expected.columns["longitude"], atol=1e-9)
    assert np.flatnonzero(np.isnan(found.columns["gravity"])).tolist() == list(range(49, 59))
    assert "1 gap in the record, the longest of 330 s at line 51" in str(found.notices[0])
    assert expected.notices == ()


def test_too_long_a_gap_is_refused(tmp_path):
    lines = voyage_rows()
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines[:50] + lines[180:]))
    with pytest.raises(DataError, match=r"line 51: a gap of 3930 s.*cut the file there"):
        read_voyage(str(path), 30.0)


def columns_of(tmp_path, lines, period=30.0):
    path = tmp_path / "log.csv"
    path.write_text("\n".join(lines))
    return read_voyage(str(path), period).columns


def test_times_count_from_the_first_row_however_they_are_written(tmp_path):
    lines = voyage_rows()
    expected = columns_of(tmp_path, lines)
    assert expected["time"][0] == 0.0
    header, *rows = lines
    cells = [row.split(",", 1) for row in rows]
    later = [f"{float(t) + 1.7e9},{rest}" for t, rest in cells]
    stamps = [
        f"{datetime.fromtimestamp(float(t), UTC).isoformat().replace('+00:00', 'Z')},{rest}"
        for t, rest in cells
    ]
    for written in (later, stamps):
        found = columns_of(tmp_path, [header, *written])
        for name, values in expected.items():
            np.testing.assert_allclose(found[name], values, atol=1e-6)


def test_rows_need_not_be_quite_regular(tmp_path):
    header, *rows = voyage_rows()
    shaken = [
        f"{float(t) + (-1) ** i:.1f},{rest}" for i, (t, rest) in enumerate(row.split(",", 1) for row in rows)
    ]
    found = columns_of(tmp_path, [header, *shaken])
    assert np.isfinite(found["gravity"]).all()
    assert len(found["time"]) == 240


@pytest.mark.parametrize("turn", [0.0, 360.0, -360.0])
def test_longitudes_of_0_to_360_are_those_of_the_map(tmp_path, rough, turn):
    header, *rows = voyage_rows()
    moved = []
    for row in rows:
        cells = row.split(",")
        cells[2], cells[4] = (
            f"{float(cells[i]) + turn * (abs(float(cells[i]) + turn) <= 360):.8f}" for i in (2, 4)
        )
        moved.append(",".join(cells))
    path = tmp_path / "log.csv"
    path.write_text("\n".join([header, *moved]))
    found = recorded(path, rough)
    assert np.isfinite(found.gravity_map.at(found.true.latitude, found.true.longitude)).all()


def recorded(path, grid):
    return from_recording(
        read_voyage(str(path), 30.0), grid, InsGrade(), runs=range(1), seed=0, noise=1.0, initial=2000.0
    )


def test_a_voyage_and_a_map_cross_the_date_line(tmp_path):
    """The map has columns from 179 to 181 degrees, written as 179, ..., 180, -179.9, ...; so has the voyage."""
    longitude = np.arange(1790, 1811) / 10.0
    wrapped = np.where(longitude > 180.0, longitude - 360.0, longitude)
    lines = [
        f"{x} {y} {10 * y + e}"
        for y in (20.0, 20.1, 20.2, 20.3)
        for x, e in zip(wrapped, longitude, strict=True)
    ]
    grid = tmp_path / "map.xyz"
    grid.write_text("\n".join(lines))
    field = load_map(str(grid))
    assert np.degrees([field.west, field.east]) == pytest.approx([179.0, 181.0])
    path = tmp_path / "log.csv"
    rows = [
        f"{30 * i},20.15,{(x if x <= 180 else x - 360):.6f},205.0"
        for i, x in enumerate(np.linspace(179.9, 180.1, 90))
    ]
    path.write_text("time,latitude,longitude,gravity\n" + "\n".join(rows))
    found = recorded(path, field)
    anomaly = found.anomaly(45, np.zeros((1, 1)), np.zeros((1, 1)))
    assert anomaly[0, 0] == pytest.approx(201.5 + np.degrees(found.ins.longitude[0, 45]))
    assert abs(found.ins.east).max() < 20.0


def test_a_map_round_the_earth_has_no_seam(tmp_path):
    rows, columns = 3, 36
    values = np.arange(rows * columns, dtype=float).reshape(rows, columns)
    grid = GravityMap(0.0, 0.0, np.radians(10.0), np.radians(10.0), values)
    turned = grid.facing(0.0)
    assert turned.at(np.zeros(3), np.radians(np.array([-10.0, 0.0, 10.0]))) == pytest.approx([35.0, 0.0, 1.0])
    assert turned.at(np.zeros(1), np.radians(np.array([-5.0]))) == pytest.approx([17.5])
    assert grid.turn_to(np.radians(-100.0)) == pytest.approx(2 * np.pi)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            lambda s: s.replace("20.31", "95", 1),
            'line 2, column "latitude": 95 is out of range; expected -89 to 89',
        ),
        (
            lambda s: re.sub(r"115\.30400000", "1e9", s, count=1),
            "line 2, column .*longitude.*: 1e9.* is out of range",
        ),
        (
            lambda s: s.replace(",3.5", ",-9999", 1),
            'line 2, column "gravity": -9999 is out of range.*leave the cell',
        ),
        (lambda s: s.replace(",3.5", ",1e30", 1), 'line 2, column "gravity": 1e30 is out of range'),
        (lambda s: s.replace("20.31", "25.31", 1), "line 3: latitude and longitude jump by 55"),
        (lambda s: s.replace("7230", "7200", 1), "line 3: time does not ascend"),
        (
            lambda s: s.replace("7230.0", "yesterday", 1),
            "line 3, column \"time\": 'yesterday' is neither seconds nor a date",
        ),
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
    found = recorded(path, flat)
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
        "bound_m",
        "nis",
        "claimed_m",
        "warnings",
    }
    names = ["pf", "pso-pf", "apo-pf", "de-pf", "mpf", "point-mass", "sitan", "reference"]
    assert [row["filter"] for row in rows] == names
    assert all(contract <= set(row) for row in rows)
    header, *curves = out.read_text().splitlines()
    assert header.startswith("filter,mode,accelerometer_ug,seconds,rmse_latitude_m")
    named = {line.split(",")[0] for line in curves}
    assert named == {*names, "INS alone", "bound"}
    start = next(line.split(",") for line in curves if line.startswith("INS alone"))
    assert 200 < float(start[6]) < 5000  # two draws from a sigma of 1155 m on either axis
    assert len(raw.read_text().splitlines()) == 17


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
        (
            ("--calibration", "nothing.yaml", "--voyage", "log.csv"),
            "--calibration does not apply to --voyage",
        ),
        (("--voyage", "log.csv", "--prior", "tied"), "prior: tied needs the hours before the first row"),
        (("--prior", "tide"), 'did you mean "tied"'),
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
    assert len(json.loads(navigate("--config", path, "--filter", "all", "--format", "json", "-q"))) == len(
        FILTERS.names()
    )


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


# Recorded voyages that nobody knows the truth of


def write_record(path, seed=1, shift=0, hours=6.0):
    """Write what an INS and a gravimeter record on map `seed`, the gravity `shift` epochs of a minute late."""
    grid = generate(PRESETS["rough"], seed, "rough")
    plan = PlannedVoyage(hours=2.0 + hours)
    sim = simulate(grid, plan, InsGrade(), runs=range(1), seed=7, period=60.0)
    gravity = np.roll(sim.measured[0], shift)
    ins = sim.ins
    lines = ["time,latitude,longitude,east,north,gravity"]
    for k, t in enumerate(sim.seconds):
        place = np.degrees([ins.latitude[0, k], ins.longitude[0, k]])
        lines.append(
            f"{t},{place[0]:.9f},{place[1]:.9f},{ins.east[0, k]:.5f},{ins.north[0, k]:.5f},{gravity[k]:.3f}"
        )
    path.write_text("\n".join(lines))
    return path


def judged(path, seed, code):
    """Return the rows that filters print of a record over map `seed`."""
    config = path.with_suffix(".yaml")
    config.write_text(f"map: rough\nmap_seed: {seed}\nperiod: 60\nruns: 1\n")
    done = subprocess.run(
        [sys.executable, "-m", "accelcal_cli", "navigate", "--config", config, "--voyage", path,
         "--filter", "sitan,point-mass", "--format", "json", "-q"],
        capture_output=True, text=True, cwd=ROOT, check=False,
    )  # fmt: skip
    assert done.returncode == code, done.stderr + done.stdout
    return json.loads(done.stdout)


def test_a_record_that_fits_has_no_warning_and_no_error_to_print(tmp_path):
    for row in judged(write_record(tmp_path / "log.csv"), 1, 0):
        assert row["warnings"] == ""
        assert row["nis"] == pytest.approx(1.0, abs=0.2)
        assert 50.0 < row["claimed_m"] < 1000.0
        assert row["rmse_position_m"] is row["bound_m"] is row["lost"] is None


@pytest.mark.parametrize(("seed", "shift"), [(2, 0), (1, 60)])
def test_another_map_or_a_clock_an_hour_off_is_told(tmp_path, seed, shift):
    for row in judged(write_record(tmp_path / "log.csv", shift=shift), seed, 1):
        assert "Check the map, the clock of the gravimeter" in row["warnings"]


def test_a_picture_without_a_true_track_shows_none(tmp_path):
    path = write_record(tmp_path / "log.csv", hours=1.0)
    study = Navigation(
        NavigationSettings(map_seed=1, voyage=str(path), period=60.0, runs=1),
        (FilterEntry("sitan"),),
        (InsGrade(),),
    )
    records = study.execute(Task(0, 0, 1))
    table = curves(study, records)
    assert chart_of(study, records, table).truth is None
    assert {row["filter"] for row in table.records()} == {"sitan", "INS alone"}
