"""`accelcal compare` and `accelcal reproduce`: what they print, write and refuse."""

from __future__ import annotations

import csv
import io
import json
import os
from math import cos, sin

import pytest
from refusals import refused

QUICK = ("compare", "--runs", "6", "--optimizer", "pso,levenberg-marquardt", "--iterations", "60", "--quiet")
SMALL = ("reproduce", "dpso-figure2", "--runs", "1", "--quiet")
NAMES = {
    "optimizer", "runs", "success_rate", "seconds", "evaluations", "cost", "bias_error", "scale_error",
    "misalignment_error", "efficiency",
}  # fmt: skip


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def compared(run, *arguments):
    done = run(*QUICK, "--format", "json", *arguments)
    assert (done.code, done.err) == (0, "")
    return json.loads(done.out)


def test_json_is_a_list_of_rows_with_the_names_of_the_contract(run):
    rows = compared(run)
    assert [row["optimizer"] for row in rows] == ["pso", "levenberg-marquardt"]
    assert all(set(row) >= NAMES and row["runs"] == 6 for row in rows)
    assert rows[0]["evaluations"] == 6100
    assert rows[1]["success_rate"] == 1


def test_csv_has_the_same_numbers(run):
    rows = compared(run)
    table = list(csv.DictReader(io.StringIO(run(*QUICK, "--format", "csv").out)))
    assert list(table[0]) == list(rows[0])
    assert [float(row["bias_error"]) for row in table] == [row["bias_error"] for row in rows]


def test_without_noise_the_efficiency_is_null(run):
    assert [row["efficiency"] for row in compared(run, "--noise", "0")] == [None, None]


def test_a_seed_repeats_and_another_differs(run):
    one, same, other = (without_time(compared(run, "--seed", seed)) for seed in "112")
    assert one == same
    assert one != other


def test_the_sensor_poses_and_gauge_are_those_asked_for(run):
    asked = (
        "--sensor",
        "dpso",
        "--fixed",
        "--positions",
        "24",
        "--noise",
        "0",
        "--gauge",
        "full",
        "--g",
        "9.8",
    )
    rows = compared(run, *asked)
    assert rows[1]["cost"] < 1e-20
    assert rows[1]["bias_error"] < 1e-6
    shown = run(*QUICK, *asked).out
    assert "24 poses, noise 0 m/s^2, g = 9.8, 12 unknowns, 6 runs, seed 0" in shown


def test_the_polish_is_asked_for(run):
    searched, polished = compared(run), compared(run, "--polish")
    assert searched[0]["excess"] > polished[0]["excess"]
    assert polished[0]["evaluations"] > searched[0]["evaluations"]


def test_the_table_draws_convergence_and_says_who_failed(run):
    done = run("compare", "--optimizer", "foa,pso", "--runs", "2", "--quiet")
    assert done.code == 0
    assert "Sensors drawn from low-cost MEMS accelerometer" in done.out
    assert "a foa   b pso" in done.out
    assert "foa came within 1 % of the least cost in 0% of its runs" in done.out
    assert "Cramer-Rao" in done.out


def test_a_recording_is_compared_with_its_own_least_squares(run, good):
    rows = compared(run, good, "--optimizer", "foa")
    assert [row["optimizer"] for row in rows] == ["pso", "levenberg-marquardt", "foa"]
    assert rows[1]["excess"] == 0
    assert rows[1]["bias_error"] < 1e-3
    assert rows[2]["success_rate"] == 0
    assert f"{good}\n24 poses" in run(*QUICK, good).out


def test_readings_may_come_from_a_pipe(run, good, tmp_path):
    piped = run(*QUICK, "-", "--format", "json", stdin=(tmp_path / good).read_bytes())
    assert without_time(json.loads(piped.out)) == without_time(compared(run, good))


def test_raw_results_do_not_depend_on_the_workers(run, tmp_path):
    files = []
    for number, jobs in enumerate(("1", "2")):
        name = f"raw{number}.csv"
        assert run(*QUICK, "--runs", "12", "--raw", name, "--jobs", jobs).code == 0
        files.append((tmp_path / name).read_bytes())
    assert files[0] == files[1]
    rows = list(csv.DictReader(io.StringIO(files[0].decode())))
    assert len(rows) == 24
    assert {"optimizer", "run", "cost", "least_cost", "bias_error", "efficiency", "K_11", "D_3"} <= set(
        rows[0]
    )
    assert not list(tmp_path.glob("*.journal"))


@pytest.mark.parametrize("suffix", ["png", "svg"])
def test_a_plot_is_written(run, tmp_path, suffix):
    pytest.importorskip("matplotlib")
    assert run(*QUICK, "--plot", f"c.{suffix}").code == 0
    assert (tmp_path / f"c.{suffix}").stat().st_size > 5000


# reproduce


def test_reproduce_alone_lists_the_experiments(run):
    done = run("reproduce", "--format", "json")
    rows = json.loads(done.out)
    assert done.code == 0
    assert {"dpso-table2", "ifoa-calibration", "akpso-calibration", "depf-rmse"} <= {
        row["name"] for row in rows
    }
    assert set(rows[0]) == {"name", "title", "source"}
    listed = run("reproduce").out
    assert all(row["name"] in listed for row in rows)


def test_reproduce_prints_its_tables(run):
    shown = run(*SMALL).out
    assert shown.startswith("DE-PSO, Figure 2")
    assert "median cost after so many evaluations" in shown
    assert "e PSO c=1.496" in shown
    record = json.loads(run(*SMALL, "--format", "json").out)
    assert record["name"] == "dpso-figure2"
    # Costs, their spread, and costs on the way of four optimizers by both readings; evaluations to the tolerance.
    assert [len(table["rows"]) for table in record["tables"]] == [8, 8, 8, 28]
    blocks = run(*SMALL, "--format", "csv").out.split("\n\n")
    assert len(blocks) == len(record["tables"])
    firsts = [block.split("\n")[0].split(",")[0] for block in blocks]
    assert firsts == [*["optimizer"] * 3, "varies"]


def test_reproduce_writes_raw_results_and_plots(run, tmp_path):
    pytest.importorskip("matplotlib")
    assert run(*SMALL, "--raw", "r.parquet", "--plot", "f.svg", "--seed", "3").code == 0
    assert (tmp_path / "r.parquet").stat().st_size > 1000
    assert b"PSO" in (tmp_path / "f.svg").read_bytes() or (tmp_path / "f.svg").stat().st_size > 5000


# Wrong input

COMPARE = {
    "too few positions": (["--positions", "3"], ["--positions 3", "at least 9 poses"]),
    "negative noise": (["--noise", "-1"], ["--noise -1", "expected 0 to 100"]),
    "too much noise": (["--noise", "1e9"], ["--noise 1e+09", "expected 0 to 100"]),
    "noise that is none": (["--noise", "nan"], ["--noise nan"]),
    "no runs": (["--runs", "0"], ["--runs", "0 is not in the range"]),
    "unknown sensor": (["--sensor", "mem"], ['"mem"', 'did you mean "mems"']),
    "unknown optimizer": (["--optimizer", "psoo"], ['"psoo"', 'did you mean "pso"']),
    "unknown scheme": (["--scheme", "edgs"], ['"edgs"', 'did you mean "edges"']),
    "scheme of other size": (["--scheme", "turns"], ["has 24 poses, not 12"]),
    "gauge": (["--gauge", "upper"], ['"upper"', "lower or full"]),
    "g": (["--g", "0"], ["--g 0", "expected"]),
    "tolerance": (["--tolerance", "-1"], ["--tolerance -1", "zero or more"]),
    "population": (["--optimizer", "pso", "--population", "1"], ["population: 1 is too small"]),
    "format": (["--format", "jsn"], ['"jsn"', 'did you mean "json"']),
    "plot": (["--plot", "a.gif"], ['"a.gif"', ".png or .svg"]),
    "raw": (["--raw", "a.txt"], ['"a.txt"', ".csv or .parquet"]),
    "resume without a file": (["--resume"], ["--resume", "--raw"]),
    "jobs": (["--jobs", "0"], ["--jobs"]),
    "no such file": (["god.csv"], ["god.csv", "no such file"]),
    "file and simulation": (["good.csv", "--noise", "1", "--fixed"], ["--fixed, --noise", "not with a file"]),
    "columns without file": (["--columns", "1,2,3"], ["--columns", "needs a file"]),
    "poses that determine no sensor": (
        ["flat.csv"],
        ["flat.csv: there is no unique least cost", "undetermined (The"],
    ),
    "too few poses": (["few.csv"], ["few.csv", "3 poses", "at least 9"]),
    "word in a cell": (["word.csv"], ["word.csv, line 3", '"oops" is not a number']),
}

REPRODUCE = {
    "unknown study": (["dpso-table"], ['"dpso-table"', 'did you mean "dpso-table3"', "ifoa-rosenbrock"]),
    "a file": (["mine.yaml"], ['unknown study "mine.yaml"']),
    "no runs": (["dpso-table2", "--runs", "0"], ["--runs", "0 is not in the range"]),
    "options without a name": (["--runs", "3"], ["name of an experiment"]),
    "raw": (["dpso-table2", "--raw", "x.png"], ["x.png", ".csv or .parquet"]),
    "seed": (["dpso-table2", "--seed", "-1"], ["--seed"]),
}


@pytest.fixture
def folder(good, tmp_path):
    (tmp_path / "few.csv").write_text("Nx,Ny,Nz\n1,0,0\n0,1,0\n0,0,1\n")
    turns = [f"{cos(k)},{sin(k)},{0.001 * (k % 3)}" for k in range(15)]
    (tmp_path / "flat.csv").write_text("\n".join(["Nx,Ny,Nz", *turns]))
    (tmp_path / "word.csv").write_text("Nx,Ny,Nz\n1,2,3\n4,oops,6\n")
    return tmp_path


@pytest.mark.parametrize("what", COMPARE)
def test_compare_refuses(run, folder, what):
    arguments, parts = COMPARE[what]
    before = sorted(os.listdir(folder))
    refused(run("compare", *arguments), parts)
    assert sorted(os.listdir(folder)) == before


@pytest.mark.parametrize("what", REPRODUCE)
def test_reproduce_refuses(run, tmp_path, what):
    arguments, parts = REPRODUCE[what]
    refused(run("reproduce", *arguments), parts)
