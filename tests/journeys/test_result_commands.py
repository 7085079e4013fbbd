"""`accelcal verify`, `apply` and `export`: what they print, what they write, and what they refuse."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from refusals import refused

from accelcal_cli.calibration.result import load_result

G = "9.80665"


@pytest.fixture
def result(run, good) -> str:
    """The name of a result file, of the readings `good`."""
    assert run("calibrate", good, "--g", G, "-o", "result.yaml", "-q").code == 0
    return "result.yaml"


@pytest.fixture
def other(run) -> str:
    """New readings of the same sensor."""
    options = ("--sensor", "mems", "--positions", "24", "--seed", "8")
    assert run("simulate", *options, "-o", "other.csv").code == 0
    return "other.csv"


@pytest.fixture
def log(tmp_path) -> str:
    """A log with a time and a remark."""
    rows = [f"{k / 100:.2f},{1690 + k},{-380 - k},{17000.5},r{k}" for k in range(50)]
    (tmp_path / "log.csv").write_text("\n".join(["t,ax,ay,az,remark", *rows]) + "\n")
    return "log.csv"


# verify


def test_the_same_sensor_passes(run, result, other):
    outcome = run("verify", result, other)
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.startswith("Verdict: unchanged")
    assert "bias z" in outcome.out


def test_readings_in_another_unit_are_told(run, result, other):
    assert "another unit" not in run("verify", result, other).out
    rows = [line.split(",") for line in Path(other).read_text().splitlines()]
    parts = [",".join(repr(float(cell) / 16384) for cell in row) for row in rows[1:]]
    Path("g.csv").write_text("\n".join([",".join(rows[0]), *parts]))
    outcome = run("verify", result, "g.csv")
    assert (outcome.code, outcome.out) == (2, "")
    assert outcome.err == (
        "accelcal: g.csv: under the result no pose is near g = 9.80665 m/s^2, most have 0.685; are they in another "
        "unit than its readings, or from another sensor?\n"
    )


def test_another_sensor_fails(run, result, other, tmp_path):
    rows = [line.split(",") for line in Path(other).read_text().splitlines()]
    moved = [",".join([x, y, repr(float(z) + 40)]) for x, y, z in rows[1:]]
    Path("moved.csv").write_text("\n".join(["Nx,Ny,Nz", *moved]) + "\n")
    outcome = run("verify", result, "moved.csv", "--format", "json")
    record = json.loads(outcome.out)
    assert outcome.code == 1
    assert record["verdict"] == "changed"
    assert [d["name"] for d in record["differences"] if d["changed"]] == ["bias z"]


def test_a_missed_tolerance_fails_too(run, result, other):
    assert run("verify", result, other, "--tolerance", "0.1").code == 0
    outcome = run("verify", result, other, "--tolerance", "1e-6")
    assert outcome.code == 1
    assert "above the tolerance 1e-06" in outcome.err
    assert run("verify", result, other, "--tolerance", "1e-6", "--quiet").err == ""


def test_readings_that_cannot_tell_fail(run, result, other):
    rows = np.loadtxt(other, delimiter=",", skiprows=1)
    rows[3] *= 1.1
    np.savetxt("wrong.csv", rows, delimiter=",", header="Nx,Ny,Nz", comments="")
    shown = run("verify", result, "wrong.csv")
    assert (shown.code, shown.err) == (1, "")
    assert shown.out.startswith("Verdict: inconclusive\n")
    assert (
        "Warning: Outlier: line 5 does not fit the other poses (p < 0.002). Measure it again.\n" in shown.out
    )
    plain = run("verify", result, "wrong.csv", "--format", "json")
    record = json.loads(plain.out)
    assert (plain.code, record["verdict"]) == (1, "inconclusive")
    assert plain.err == "".join(
        f"accelcal: wrong.csv: {notice['severity']}: {notice['text']} {notice['remedy']}".rstrip() + "\n"
        for notice in record["warnings"]
    )
    assert run("calibrate", "wrong.csv", "--g", G, "-o", "wrong.yaml", "-q").code == 1
    back = run("verify", "wrong.yaml", other)
    assert back.code == 1
    assert "accelcal: wrong.yaml: warning: Residuals are too large" in back.err
    assert run("verify", "wrong.yaml", other, "-q").err == ""


def test_the_level_decides(run, result, other):
    chance = json.loads(run("verify", result, other, "--format", "json").out)["chance"]
    assert run("verify", result, other, "--level", str(min(0.999, chance + 0.001))).code == 1
    assert run("verify", result, other, "--level", str(chance / 2)).code == 0


def test_differences_as_csv(run, result, other):
    rows = list(csv.DictReader(io.StringIO(run("verify", result, other, "--format", "csv").out)))
    assert [row["parameter"] for row in rows][6] == "bias x"
    assert {row["unit"] for row in rows} == {"ppm", "micro-rad", "micro-g"}


def test_readings_from_a_pipe_and_a_json_result(run, good, other):
    assert run("calibrate", good, "--g", G, "-o", "result.json", "-q").code == 0
    assert run("verify", "result.json", "-", "--g", G, stdin=Path(other).read_bytes()).code == 0


# apply


def force(name, columns=("fx", "fy", "fz")):
    return pl.read_csv(name).select(columns).to_numpy()


def test_the_force_is_added(run, result, log):
    outcome = run("apply", result, log, "-o", "out.csv")
    assert (outcome.code, outcome.out, outcome.err) == (0, "", "accelcal: wrote out.csv\n")
    old, new = Path(log).read_text().splitlines(), Path("out.csv").read_text().splitlines()
    assert new[0] == old[0] + ",fx,fy,fz"
    assert all(b.startswith(a + ",") for a, b in zip(old, new, strict=True))
    expected = load_result(result).model.specific_force(force(log, ("ax", "ay", "az")).astype(float))
    np.testing.assert_array_equal(force("out.csv"), expected)


def test_in_place_in_another_unit_under_another_name(run, result, log):
    plain = run("apply", result, log, "--quiet").out
    metres = pl.read_csv(io.StringIO(plain)).select("fx", "fy", "fz").to_numpy()
    outcome = run("apply", result, log, "--replace", "--unit", "mg", "--prefix", "acc_")
    made = pl.read_csv(io.StringIO(outcome.out))
    assert made.columns == ["t", "acc_x", "acc_y", "acc_z", "remark"]
    np.testing.assert_allclose(
        made.select("acc_x", "acc_y", "acc_z").to_numpy(), metres * 1000 / 9.80665, rtol=1e-14
    )


def test_a_result_in_g_gives_g_unless_told(run, good, log):
    assert run("calibrate", good, "--g", "1", "-o", "g.yaml", "-q").code == 0
    own = pl.read_csv(io.StringIO(run("apply", "g.yaml", log, "-q").out))["fz"]
    metres = pl.read_csv(io.StringIO(run("apply", "g.yaml", log, "-q", "--unit", "m/s^2").out))["fz"]
    np.testing.assert_allclose(metres, own * 9.80665, rtol=1e-14)


def test_a_log_in_another_unit_is_told(run, result, log):
    """The result is of counts; the log is in g."""
    rows = [line.split(",") for line in Path(log).read_text().splitlines()]
    in_g = [[row[0], *(f"{float(cell) / 4000:.6f}" for cell in row[1:4]), *row[4:]] for row in rows[1:]]
    Path("in_g.csv").write_text("\n".join(",".join(row) for row in [rows[0], *in_g]) + "\n")
    told = run("apply", result, "in_g.csv", "-o", "out.csv").err
    assert told.startswith("accelcal: in_g.csv: warning: The first readings come out as ")
    assert run("apply", result, "in_g.csv", "-o", "out.csv", "-q").err == ""


def test_through_a_pipe(run, result, log):
    direct = run("apply", result, log, "-q").out
    assert run("apply", result, "-", "-q", stdin=Path(log).read_bytes()).out == direct


def test_parquet_stays_parquet(run, result, log):
    pl.read_csv(log).write_parquet("log.parquet")
    assert run("apply", result, "log.parquet", "-o", "out.parquet").code == 0
    assert run("apply", result, log, "-o", "out.csv").code == 0
    assert pl.read_parquet("out.parquet").equals(pl.read_csv("out.csv"))
    with open("open.parquet", "wb") as file:
        os.symlink(f"/dev/fd/{file.fileno()}", "link.parquet")
        assert run("apply", result, "log.parquet", "-o", "link.parquet").code == 0
    assert pl.read_parquet("open.parquet").equals(pl.read_csv("out.csv"))
    assert run("apply", result, "log.parquet", "-o", "again.csv").code == 0
    assert pl.read_csv("again.csv").equals(pl.read_csv("out.csv"))


def test_text_becomes_parquet(run, result, log):
    """Of the same columns as the text, from a file and from a pipe, and with the options of text."""
    assert run("apply", result, log, "--tilt", "-o", "out.csv").code == 0
    outcome = run("apply", result, log, "--tilt", "-o", "out.parquet")
    assert (outcome.code, outcome.err) == (0, "accelcal: wrote out.parquet\n")
    made = pl.read_parquet("out.parquet")
    assert made.equals(pl.read_csv("out.csv"))
    assert run("apply", result, "-", "--tilt", "-o", "pipe.pq", stdin=Path(log).read_bytes()).code == 0
    assert pl.read_parquet("pipe.pq").equals(made)
    lines = Path(log).read_text().splitlines(keepends=True)
    Path("bad.csv").write_text("".join(["no table\n", *lines[:9], "1,x,2,3,y\n", *lines[9:]]))
    outcome = run("apply", result, "bad.csv", "-o", "bad.parquet")
    assert (outcome.code, "bad.csv, line 11" in outcome.err, Path("bad.parquet").exists()) == (2, True, False)
    options = ("--skip-bad", "--skip-rows", "1", "--count", "none", "--tilt")
    outcome = run("apply", result, "bad.csv", *options, "-o", "bad.parquet")
    assert (outcome.code, "1 broken row left out (--skip-bad): line 11" in outcome.err) == (0, True)
    assert pl.read_parquet("bad.parquet").equals(made)
    assert "line 11" in run("apply", result, "bad.csv", *options, "-o", "bad.csv").err


def test_a_slower_temperature_is_carried_on(run, tmp_path):
    """An empty cell has the last temperature above it; before the first there is none to take."""
    assert run("simulate", "--sensor", "mems", "--positions", "24", "-o", "u.csv", "-q").code == 0
    degrees = np.tile([10.0, 40.0], 24)
    rows = np.repeat(np.loadtxt("u.csv", delimiter=",", skiprows=1), 2, axis=0) + 0.5 * degrees[:, None]
    cells = [",".join(map(repr, row)) for row in rows.tolist()]
    header = "Nx,Ny,Nz,temperature\n"
    full = [f"{row},{t}\n" for row, t in zip(cells, degrees.tolist(), strict=True)]
    Path("warm.csv").write_text(header + "".join(full))
    assert run("calibrate", "warm.csv", "--g", G, "-o", "warm.yaml", "-q").code == 0
    Path("same.csv").write_text(
        header + "".join(f"{row},{10.0 + 30.0 * (k // 4 % 2)}\n" for k, row in enumerate(cells))
    )
    slow = [f"{row},{10.0 + 30.0 * (k // 4 % 2) if k % 4 == 0 else ''}\n" for k, row in enumerate(cells)]
    Path("slow.csv").write_text(header + "".join(slow))
    force_of = {name: run("apply", "warm.yaml", name).out for name in ("same.csv", "slow.csv")}
    same, sparse = (
        np.genfromtxt(io.StringIO(text), delimiter=",", skip_header=1) for text in force_of.values()
    )
    np.testing.assert_array_equal(same[:, 4:], sparse[:, 4:])
    Path("late.csv").write_text(header + "".join(slow[1:]))
    assert 'line 2, column "temperature"' in run("apply", "warm.yaml", "late.csv").err


def test_a_log_may_be_replaced_by_its_result(run, result, log):
    before = Path(log).read_text()
    assert run("apply", result, log, "-o", log, "-q").code == 0
    assert Path(log).read_text().startswith(before.splitlines()[0] + ",fx")


def test_an_undetermined_result_needs_force(run, log):
    assert run("simulate", "--sensor", "mems", "--positions", "6", "-o", "six.csv").code == 0
    assert run("calibrate", "six.csv", "--g", G, "-o", "six.yaml", "-q").code == 1
    for command in (("apply", "six.yaml", log), ("export", "six.yaml", "--to", "ros")):
        outcome = run(*command, "-o", "out")
        assert outcome.code == 2
        assert "verdict is undetermined (6 poses are fewer than the nine parameters" in outcome.err
        assert "--force" in outcome.err
        assert not Path("out").exists()
        assert run(*command, "-o", "out", "--force").code == 0
        Path("out").unlink()
    tilted = pl.read_csv(io.StringIO(run("apply", "six.yaml", log, "--force", "--tilt", "-q").out))
    assert tilted["sigma_roll"].is_nan().all()


def test_tilt_and_its_sigma(run, result, log):
    made = pl.read_csv(io.StringIO(run("apply", result, log, "--tilt", "-q").out))
    x, y, z = made.select("fx", "fy", "fz").to_numpy().T
    np.testing.assert_allclose(made["roll"], np.degrees(np.arctan2(y, z)), rtol=1e-12)
    np.testing.assert_allclose(made["pitch"], np.degrees(np.arctan2(-x, np.hypot(y, z))), rtol=1e-12)
    noisy = pl.read_csv(io.StringIO(run("apply", result, log, "--tilt", "--noise", "0.05", "-q").out))
    extra = np.sqrt(noisy["sigma_pitch"].to_numpy() ** 2 - made["sigma_pitch"].to_numpy() ** 2)
    np.testing.assert_allclose(extra, np.degrees(0.05 / np.sqrt(x**2 + y**2 + z**2)), rtol=1e-6)


def test_a_temperature_column_is_used(run, tmp_path):
    text = run("simulate", "--sensor", "mems", "--positions", "24").out
    u = np.repeat(np.genfromtxt(io.StringIO(text), delimiter=",", skip_header=1), 2, axis=0)
    degrees = np.tile([10.0, 40.0], 24)
    rows = u + 0.5 * (degrees - 25.0)[:, None]
    np.savetxt(
        "warm.csv",
        np.column_stack([rows, degrees]),
        delimiter=",",
        header="Nx,Ny,Nz,temperature",
        comments="",
    )
    assert run("calibrate", "warm.csv", "--g", G, "-o", "warm.yaml", "-q").code == 0
    outcome = run("apply", "warm.yaml", "warm.csv")
    f = pl.read_csv(io.StringIO(outcome.out)).select("fx", "fy", "fz").to_numpy().reshape(24, 2, 3)
    np.testing.assert_allclose(f[:, 0], f[:, 1], atol=0.01)
    assert outcome.err == ""
    np.savetxt("cold.csv", rows, delimiter=",", header="Nx,Ny,Nz", comments="")
    assert "no temperature column" in run("apply", "warm.yaml", "cold.csv").err
    whole = run("export", "warm.yaml", "--to", "c-header")
    assert ("accelcal_apply_at" in whole.out, whole.err) == (True, "")
    warned = run("export", "warm.yaml", "--to", "ros")
    assert "no temperature slopes" in warned.err
    assert "no temperature slopes" in warned.out


def test_known_attitudes_on_the_command_line(run):
    options = ("--sensor", "mems", "--attitude", "--noise", "0.001")
    assert run("simulate", *options, "-o", "known.csv").code == 0
    record = json.loads(
        run("calibrate", "known.csv", "--g", G, "--attitudes", "known", "--format", "json").out
    )
    assert record["gauge"] == "full"
    assert None not in np.ravel(record["sigma"]["K_a"])
    shown = run("calibrate", "known.csv", "--g", G, "--attitudes", "known", "--verbose").out
    assert "linear least squares" in shown
    assert "a rotation of the body frame is free" not in shown


# export


def test_every_format_is_written(run, result):
    for name in ("px4", "ardupilot", "kalibr", "imucal", "ros", "c-header", "numpy"):
        more = ("--driver-scale", "1670") if name in ("px4", "ardupilot") else ()
        outcome = run("export", result, "--to", name, "-o", f"out.{name}", *more)
        assert outcome.code == 0
        assert f"wrote out.{name}" in outcome.err
        assert Path(f"out.{name}").stat().st_size > 100
        assert run("export", result, "--to", name, "-o", f"out.{name}", "-q", *more).err == ""
    assert run("export", result, "--to", "ros", "-q").out == Path("out.ros").read_text()


def test_the_warning_goes_to_standard_error(run, result):
    outcome = run("export", result, "--to", "px4", "--driver-scale", "1670")
    assert "accelcal: warning: this format has no misalignments" in outcome.err
    assert "CAL_ACC0_XOFF" in outcome.out


# Refusals

FILES = {
    "syntax.yaml": "K_a: [1, 2\nD_a: 3\n",
    "list.yaml": "- 1\n- 2\n",
    "empty.yaml": "",
    "other.json": '{"schema": "accelcal/verification/1"}',
    "broken.json": '{"schema": "accelcal/calibration/3", ',
    "nothing.yaml": "schema: accelcal/calibration/3\n",
    "latin.yaml": b"schema: \xe9\n",
    "nan.csv": "t,ax,ay,az\n0,1,2,3\n1,2,nan,4\n",
    "word.csv": "t,ax,ay,az\n0,1,2,3\n1,2,x,4\n",
    "names.csv": "a,b,c,d\n0,1,2,3\n",
    "taken.csv": "ax,ay,az,fy\n0,1,2,3\n",
    "wide.csv": "1,2,3,4\n5,6,7,8\n",
    "empty.csv": "",
}

BAD_RESULTS = {
    "missing": ("god.yaml", ["god.yaml", "no such file"]),
    "a folder": ("folder", ["folder", "is a directory"]),
    "truncated YAML": ("syntax.yaml", ["syntax.yaml, line 2"]),
    "a list": ("list.yaml", ["list.yaml", "expected keys and values"]),
    "empty": ("empty.yaml", ["empty.yaml", "expected keys and values"]),
    "another record": ("other.json", ["other.json", "verification", "accelcal/calibration/3"]),
    "truncated JSON": ("broken.json", ["broken.json, line 2, column 1"]),
    "no content": ("nothing.yaml", ["nothing.yaml", "missing: K_a"]),
    "not UTF-8": ("latin.yaml", ["latin.yaml", "UTF-8"]),
    "readings": ("good.csv", ["good.csv"]),
    "a wrong part": ("wrong.yaml", ["wrong.yaml", "K_a: expected 3 x 3 numbers"]),
    "a singular matrix": ("singular.yaml", ["singular.yaml", "K_a: is singular"]),
}

APPLY = {
    "no log": (["result.yaml"], ["missing argument"]),
    "missing log": (["result.yaml", "lgo.csv"], ["lgo.csv", "no such file", 'did you mean "log.csv"']),
    "empty log": (["result.yaml", "empty.csv"], ["empty.csv", "empty"]),
    "nan": (["result.yaml", "nan.csv"], ["nan.csv, line 3", '"ay"', "not a finite number"]),
    "word": (["result.yaml", "word.csv"], ["word.csv, line 3", '"ay"', '"x" is not a number']),
    "no columns": (["result.yaml", "names.csv"], ["names.csv", "--columns"]),
    "no header": (["result.yaml", "wide.csv"], ["wide.csv", "--columns"]),
    "no such column": (
        ["result.yaml", "log.csv", "--columns", "ax,ay,aq"],
        ["--columns", '"aq"', "did you mean"],
    ),
    "name taken": (["result.yaml", "taken.csv"], ["taken.csv", 'column "fy" already', "--prefix"]),
    "prefix": (["result.yaml", "log.csv", "--prefix", "f,"], ['--prefix "f,"', "letters"]),
    "unit": (["result.yaml", "log.csv", "--unit", "gs"], ['--unit "gs"', 'did you mean "g"', "m/s^2"]),
    "noise": (["result.yaml", "log.csv", "--noise", "nan"], ["--noise nan", "zero or more"]),
    "no folder": (["result.yaml", "log.csv", "-o", "no/out.csv"], ["no/out.csv", "no such folder"]),
    "a folder": (["result.yaml", "log.csv", "-o", "folder"], ["folder", "is a directory"]),
    "tilt in gauge full": (["full.yaml", "log.csv", "--tilt"], ["--tilt", "gauge full"]),
}

VERIFY = {
    "no readings": (["result.yaml"], ["missing argument"]),
    "missing readings": (["result.yaml", "god.csv"], ["god.csv", "no such file"]),
    "nan": (["result.yaml", "nan.csv"], ["nan.csv, line 3", "not a finite number"]),
    "another gravity": (["result.yaml", "good.csv", "--g", "1"], ["--g 1", "result.yaml", "g = 9.80665"]),
    "impossible gravity": (["result.yaml", "good.csv", "--g", "-1"], ["--g -1", "expected"]),
    "level": (["result.yaml", "good.csv", "--level", "5"], ["--level 5", "between 0 and 1"]),
    "tolerance": (["result.yaml", "good.csv", "--tolerance", "-1"], ["--tolerance -1", "positive"]),
    "format": (["result.yaml", "good.csv", "--format", "jsn"], ["--format", 'did you mean "json"']),
    "undetermined": (["six.yaml", "good.csv"], ["no uncertainty", "undetermined"]),
}

EXPORT = {
    "no format": (["result.yaml"], ["--to"]),
    "unknown format": (
        ["result.yaml", "--to", "px44"],
        ['export format "px44"', 'did you mean "px4"', "c-header"],
    ),
    "counts": (["result.yaml", "--to", "px4"], ["--to px4", "output units", "--driver-scale"]),
    "driver scale": (
        ["result.yaml", "--to", "px4", "--driver-scale", "0"],
        ["--to px4: driver_scale: 0", "more than 0"],
    ),
    "instance": (
        ["result.yaml", "--to", "px4", "--instance", "9", "--driver-scale", "1"],
        ["--to px4: instance: 9", "at most 3"],
    ),
    "driver scale of ros": (
        ["result.yaml", "--to", "ros", "--driver-scale", "2"],
        ["--driver-scale does not apply to --to ros", "ardupilot, kalibr, px4"],
    ),
    "instance of numpy": (
        ["result.yaml", "--to", "numpy", "--instance", "0", "-o", "a.npz"],
        ["--instance does not apply to --to numpy"],
    ),
    "negative instance": (
        ["result.yaml", "--to", "px4", "--instance", "-1"],
        ["--to px4: instance: -1", "at least 0"],
    ),
    "no folder": (["result.yaml", "--to", "ros", "-o", "no/out.yaml"], ["no/out.yaml", "no such folder"]),
}

ATTITUDES = {
    "no reference": (["good.csv", "--attitudes", "known"], ["good.csv", "fx, fy, fz"]),
    "unknown word": (["good.csv", "--attitudes", "knwn"], ["attitudes", "knwn", 'did you mean "known"']),
    "another unit": (["known.csv", "--attitudes", "known", "--g", "1"], ["known.csv", "mean length", "--g"]),
    "robust": (["known.csv", "--attitudes", "known", "--robust", "huber"], ["robust: huber", "known"]),
}


@pytest.fixture
def folder(run, result, log, tmp_path):
    """A folder with every kind of wrong file."""
    for name, content in FILES.items():
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    (tmp_path / "folder").mkdir()
    text = Path(result).read_text()
    lines = text.splitlines(keepends=True)
    start = next(k for k, line in enumerate(lines) if line.startswith("K_a:"))
    end = next(k for k, line in enumerate(lines) if line.startswith("D_a:"))
    for name, matrix in (("wrong.yaml", "[1, 2]"), ("singular.yaml", "[[1, 0, 0], [0, 1, 0], [1, 1, 0]]")):
        Path(name).write_text("".join([*lines[:start], f"K_a: {matrix}\n", *lines[end:]]))
    assert run("simulate", "--sensor", "mems", "--positions", "6", "-o", "six.csv").code == 0
    assert run("calibrate", "six.csv", "--g", G, "-o", "six.yaml", "-q").code == 1
    assert run("calibrate", "good.csv", "--g", G, "--gauge", "full", "-o", "full.yaml", "-q").code == 0
    assert run("simulate", "--sensor", "mems", "--attitude", "-o", "known.csv").code == 0
    return tmp_path


def test_every_command_refuses_a_bad_result(run, folder):
    before = sorted(os.listdir(folder))
    for what, (name, parts) in BAD_RESULTS.items():
        for command in (
            ("verify", name, "good.csv"),
            ("apply", name, "log.csv", "-o", "out.csv"),
            ("export", name, "--to", "ros", "-o", "out.yaml"),
        ):
            refused(run(*command), parts)
            assert sorted(os.listdir(folder)) == before, what


def test_a_matrix_that_is_all_but_singular_is_no_fault(run, folder):
    text = Path("result.yaml").read_text()
    matrix = load_result("result.yaml").K_a
    flat = matrix.copy()
    flat[2] = matrix[1] + 1e-6 * matrix[2] / 1e3
    lines = text.splitlines(keepends=True)
    start, end = (next(k for k, line in enumerate(lines) if line.startswith(key)) for key in ("K_a:", "D_a:"))
    Path("flat.yaml").write_text("".join([*lines[:start], f"K_a: {flat.tolist()}\n", *lines[end:]]))
    for arguments in (("report", "flat.yaml", "-o", "flat.html"), ("export", "flat.yaml", "--to", "kalibr")):
        outcome = run(*arguments)
        assert outcome.code == 0, outcome.err


@pytest.mark.parametrize(
    ("command", "cases"),
    [("apply", APPLY), ("verify", VERIFY), ("export", EXPORT), ("calibrate", ATTITUDES)],
    ids=["apply", "verify", "export", "calibrate"],
)
def test_what_is_wrong_is_refused(run, folder, command, cases):
    before = sorted(os.listdir(folder))
    for what, (arguments, parts) in cases.items():
        output = () if command == "verify" or "-o" in arguments else ("-o", "out.yaml")
        refused(run(command, *arguments, *output), parts)
        assert sorted(os.listdir(folder)) == before, what


# Interrupts, full disks, readers that leave


@pytest.fixture
def long_log(tmp_path) -> str:
    """A log of several blocks."""
    t = np.arange(400_000) / 100
    columns = {"t": t, "ax": 1690 + np.sin(t), "ay": -380 + t / 7, "az": 17000.5 - t}
    pl.DataFrame(columns).write_csv(tmp_path / "long.csv")
    return "long.csv"


def test_a_full_disk_is_one_message_and_no_file(run, result, long_log, log, tmp_path):
    Path("out.csv").write_text("the old one")
    for name, most in ((long_log, 5_000_000), (log, 1000)):
        before = sorted(os.listdir(tmp_path))
        limit = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (most, limit[1]))
        try:
            outcome = run("apply", result, name, "-o", "out.csv")
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limit)
        refused(outcome, ["out.csv", "cannot be written", os.strerror(errno.EFBIG).lower()])
        assert sorted(os.listdir(tmp_path)) == before
        assert Path("out.csv").read_text() == "the old one"


def test_no_room_for_the_copy_of_a_text_is_one_message(run, result, long_log, tmp_path):
    before, limit = sorted(os.listdir(tmp_path)), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, limit[1]))
    try:
        outcome = run("apply", result, long_log, "-o", "out.parquet")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limit)
    refused(outcome, ["long.csv", "no room for a working copy"])
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize("name", ["long.csv", "log.csv", "long.parquet"])
def test_a_full_device_is_one_message(shell, run, result, log, long_log, name):
    if name.endswith("parquet"):
        pl.read_csv(long_log).write_parquet(name)
    for line in (
        f"accelcal apply {result} {name} -o /dev/full",
        f"accelcal apply {result} {name} >/dev/full",
    ):
        outcome = shell(line)
        refused(outcome, [os.strerror(errno.ENOSPC).lower()])
    assert Path("/dev/full").is_char_device()
    for line in ("export result.yaml --to ros", "verify result.yaml good.csv"):
        refused(shell(f"accelcal {line} >/dev/full"), ["cannot write", os.strerror(errno.ENOSPC).lower()])


def test_a_reader_that_leaves_is_no_error(shell, result, long_log):
    outcome = shell(f"accelcal apply {result} {long_log} | head -2; exit ${{PIPESTATUS[0]}}")
    assert (outcome.code, outcome.err) == (0, "")
    assert outcome.out.splitlines()[0] == "t,ax,ay,az,fx,fy,fz"


@pytest.mark.parametrize(
    ("number", "code", "said"),
    [
        (signal.SIGINT, 130, b"interrupted"),
        (signal.SIGHUP, 129, b"ended by SIGHUP"),
        (signal.SIGTERM, 143, b"ended by SIGTERM"),
    ],
)
def test_an_interrupt_is_one_line_and_leaves_no_file(
    environment, result, long_log, tmp_path, number, code, said
):
    before = sorted(os.listdir(tmp_path))
    program = _busy(environment, result, long_log, tmp_path)
    program.send_signal(number)
    out, error = program.communicate()
    assert (program.returncode, out, error) == (code, b"", b"accelcal: %s\n" % said)
    assert sorted(os.listdir(tmp_path)) == before


def test_a_hangup_that_is_ignored_as_nohup_has_it_ends_nothing(environment, result, long_log, tmp_path):
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        program = _busy(environment, result, long_log, tmp_path)
    finally:
        signal.signal(signal.SIGHUP, before)
    program.send_signal(signal.SIGHUP)
    program.communicate()
    assert program.returncode == 0
    assert (tmp_path / "out.csv").is_file()


def _busy(environment, result, long_log, folder):
    """Start `apply` and return it at work: when the pipe has taken the log, it is."""
    program = subprocess.Popen(
        [sys.executable, "-m", "accelcal_cli", "apply", result, "-", "-o", "out.csv"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=folder,
        env=environment,
    )
    program.stdin.write((folder / long_log).read_bytes())
    program.stdin.flush()
    return program


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="no /proc to read the peak memory from")
def test_memory_does_not_grow_with_the_log(environment, result, long_log, tmp_path):
    """Peak memory of logs of 2.4 and 4.8 million rows, both of many blocks: twice the rows are no more at a time."""
    header, _, rows = (tmp_path / long_log).read_text().partition("\n")
    for name, times in (("longer.csv", 6), ("longest.csv", 12)):
        with (tmp_path / name).open("w") as file:
            file.write(f"{header}\n")
            for _ in range(times):
                file.write(rows)
    script = (  # ru_maxrss would count what the process that started this one had
        "from accelcal_cli.cli.main import main\n"
        "try: main()\nexcept SystemExit: pass\n"
        "print(next(line for line in open('/proc/self/status') if line.startswith('VmHWM')).split()[1])"
    )

    def peak(name):
        arguments = [sys.executable, "-c", script, "apply", result, name, "-o", "out.csv", "-q"]
        done = subprocess.run(
            arguments, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
        )
        return int(done.stdout.split()[-1]) / 1024

    assert peak("longest.csv") < 1.5 * peak("longer.csv") < 700
