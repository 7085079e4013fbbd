"""`accelcal benchmark` and `accelcal optimizers`: what they print, write and refuse."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import sys

import pytest

from accelcal_cli.optimization.optimizer import OPTIMIZERS

QUICK = ("benchmark", "--dim", "3", "--runs", "4", "--population", "10", "--iterations", "15", "--quiet")
PAIR = ("--func", "sphere,rastrigin", "--optimizer", "pso", "--optimizer", "de")
NAMES = {
    "function", "optimizer", "runs", "evaluations", "min", "max", "mean", "variance", "median", "success_rate",
    "seconds",
}  # fmt: skip


def without_time(rows):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in rows]


def test_json_is_a_list_of_rows_with_the_names_of_the_contract(run):
    done = run(*QUICK, *PAIR, "--format", "json")
    rows = json.loads(done.out)
    assert (done.code, done.err) == (0, "")
    assert [(r["function"], r["optimizer"]) for r in rows] == [
        ("sphere", "pso"), ("sphere", "de"), ("rastrigin", "pso"), ("rastrigin", "de"),
    ]  # fmt: skip
    assert all(set(row) >= NAMES for row in rows)
    assert all(row["evaluations"] == 160 and row["runs"] == 4 for row in rows)


def test_csv_has_the_same_numbers(run):
    rows = json.loads(run(*QUICK, *PAIR, "--format", "json").out)
    table = list(csv.DictReader(io.StringIO(run(*QUICK, *PAIR, "--format", "csv").out)))
    assert [float(row["median"]) for row in table] == [row["median"] for row in rows]
    assert list(table[0]) == list(rows[0])


def test_a_seed_repeats_and_another_differs(run):
    one, same, other = (
        without_time(json.loads(run(*QUICK, *PAIR, "--format", "json", "--seed", seed).out))
        for seed in ("1", "1", "2")
    )
    assert one == same
    assert one != other


@pytest.mark.parametrize("columns", ["60", "80", "200"])
def test_the_table_fits_the_terminal(run, monkeypatch, columns):
    monkeypatch.setenv("COLUMNS", columns)
    done = run(*QUICK, *PAIR)
    assert done.code == 0
    assert max(map(len, done.out.splitlines())) <= int(columns)
    assert "…" not in done.out
    for word in ("sphere", "rastrigin", "median", "success", "a pso   b de", "Nemenyi", "evaluations"):
        assert word in done.out


def test_one_run_has_no_variance(run):
    (row,) = json.loads(
        run(*QUICK, "--runs", "1", "--func", "sphere", "--optimizer", "pso", "--format", "json").out
    )
    assert row["variance"] is None
    assert "Friedman" not in run(*QUICK, "--runs", "1", "--func", "sphere").out


def test_shift_rotate_and_stop_change_the_runs(run):
    plain, *others = (
        json.loads(run(*QUICK, *PAIR, "--format", "json", *more).out)
        for more in ([], ["--shift"], ["--rotate"], ["--stop", "--tolerance", "100"])
    )
    assert all(without_time(other) != without_time(plain) for other in others)
    assert others[-1][0]["evaluations"] < plain[0]["evaluations"]


def test_all_leaves_out_what_does_not_suit_and_says_so(run):
    loud = [word for word in QUICK if word != "--quiet"]
    done = run(
        *loud, "--func", "sphere,ackley", "--optimizer", "all", "--format", "json", "--evaluations", "600"
    )
    pairs = {(row["function"], row["optimizer"]) for row in json.loads(done.out)}
    assert done.code == 0
    assert ("sphere", "levenberg-marquardt") in pairs
    assert ("ackley", "levenberg-marquardt") not in pairs
    assert (
        "accelcal: levenberg-marquardt needs residuals (a sum of squares), which ackley does not" in done.err
    )
    assert "accelcal: ellipsoid needs a closed form, which sphere and ackley do not have" in done.err
    assert {name for _, name in pairs} == {*OPTIMIZERS.names()} - {"ellipsoid"}


def test_a_config_states_optimizers(run, tmp_path):
    (tmp_path / "two.yaml").write_text(
        "optimizers:\n- optimizer: pso\n- {label: slow, optimizer: pso, parameters: {speed: 0.01}}\n"
    )
    rows = json.loads(run(*QUICK, "--func", "sphere", "--config", "two.yaml", "--format", "json").out)
    assert [row["optimizer"] for row in rows] == ["pso", "slow"]
    assert rows[0]["median"] != rows[1]["median"]


@pytest.mark.parametrize("name", ["raw.csv", "raw.parquet"])
def test_raw_results_have_a_row_for_every_run(run, tmp_path, name):
    import polars

    done = run(*QUICK, *PAIR, "--raw", name)
    assert done.code == 0
    read = polars.read_csv if name.endswith(".csv") else polars.read_parquet
    frame = read(tmp_path / name)
    assert frame.shape == (16, 15)
    assert frame["run"].to_list() == [0, 1, 2, 3] * 4
    assert {path.name for path in tmp_path.iterdir()} == {name}


def test_a_full_disk_at_the_end_keeps_the_runs(run, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "replace", full)
        done = run(*QUICK, *PAIR, "--raw", "raw.csv")
    assert done.code == 2
    assert "no space left on device; 16 finished runs are kept in raw.csv.journal" in done.err
    assert {path.name for path in tmp_path.iterdir()} == {"raw.csv.journal"}
    assert run(*QUICK, *PAIR, "--raw", "raw.csv", "--resume").code == 0
    assert {path.name for path in tmp_path.iterdir()} == {"raw.csv"}


@pytest.mark.parametrize("name", ["plot.png", "plot.svg"])
def test_the_plot_is_a_picture_and_repeats(run, tmp_path, name):
    pytest.importorskip("matplotlib")
    pictures = []
    for _ in range(2):
        done = run(*QUICK, *PAIR, "--plot", name)
        assert done.code == 0
        pictures.append((tmp_path / name).read_bytes())
    assert pictures[0].startswith(b"\x89PNG" if name.endswith("png") else b"<?xml")
    assert pictures[0] == pictures[1]


def test_a_plot_of_costs_that_are_all_zero(run, tmp_path):
    pytest.importorskip("matplotlib")
    line = ("benchmark", "--quiet", "--dim", "2", "--runs", "2", "--func", "sphere", "--optimizer", "newton")
    assert run(*line, "--tolerance", "0", "--plot", "a.png").code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--func", "rosenbrok"], 'unknown function "rosenbrok" (did you mean "rosenbrock"?)'),
        (["--optimizer", "pso,psoo"], 'unknown optimizer "psoo" (did you mean "pso"?)'),
        (["--optimizer", "all,psoo"], 'unknown optimizer "psoo" (did you mean "pso"?)'),
        (["--dim", "1"], "--dim"),
        (["--runs", "0"], "--runs"),
        (["--population", "1"], "pso: population: 1 is too small; expected at least 4"),
        (["--evaluations", "0"], "--evaluations"),
        (["--iterations", "0"], "--iterations"),
        (["--jobs", "0"], "--jobs"),
        (["--seed", "-1"], "--seed"),
        (["--tolerance", "nan"], "--tolerance nan: expected zero or more"),
        (["--tolerance", "-1"], "--tolerance -1: expected zero or more"),
        (["--format", "jsn"], 'did you mean "json"'),
        (["--raw", "missing/raw.csv"], "missing/raw.csv: no such folder: missing"),
        (["--raw", "raw.txt"], "expected a name that ends in .csv or .parquet"),
        (["--plot", "plot.gif"], "expected a name that ends in .png or .svg"),
        (["--plot", "missing/plot.png"], "no such folder"),
        (["--resume"], "--resume needs the --raw FILE"),
        (["--jobs", "2", "--cluster", "tcp://127.0.0.1:9"], "expected one of them, not both"),
        (["--optimizer", "levenberg-marquardt", "--func", "ackley"], "needs residuals"),
        (["--optimizer", "ellipsoid"], "needs a closed form"),
        (["--config", "none.yaml"], "none.yaml: no such file"),
    ],
)
def test_bad_input_is_one_message(run, tmp_path, arguments, message):
    done = run("benchmark", "--runs", "1", *arguments)
    assert (done.code, done.out) == (2, "")
    assert message in done.err
    assert done.err.startswith("accelcal: ")
    assert len(done.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_cluster_that_does_not_answer_leaves_nothing(run, tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    from accelcal_cli import pools

    monkeypatch.setattr(pools, "ANSWER_TIME", 0.3)
    done = run(*QUICK, *PAIR, "--raw", "raw.csv", "--cluster", "tcp://127.0.0.1:9")
    assert done.code == 2
    assert "no Dask scheduler answers there" in done.err
    assert len(done.err.splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


def test_a_plot_without_matplotlib(run, monkeypatch):
    import importlib.util

    known = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "matplotlib" else known(name, *rest)
    )
    done = run(*QUICK, "--plot", "a.png")
    assert done.code == 2
    assert done.err == "accelcal: --plot needs matplotlib: python -m pip install matplotlib\n"


def test_progress_is_for_terminals_only(run):
    loud = [word for word in QUICK if word != "--quiet"]
    assert run(*loud, "--func", "sphere", "--optimizer", "pso").err == ""


# accelcal optimizers


def test_every_optimizer_is_listed_with_its_source_and_defaults(run):
    done = run("optimizers")
    assert done.code == 0
    for name in OPTIMIZERS.names():
        cls = OPTIMIZERS.get(name)
        assert f"{name} - {cls.family}, [{cls.paper}]\n" in done.out
    assert "population=100 iterations=500 inertia=0.7298 social=1.49618" in re.sub(r"\s+", " ", done.out)


def test_the_list_for_programs(run):
    rows = json.loads(run("optimizers", "--format", "json").out)
    assert [row["name"] for row in rows] == OPTIMIZERS.names()
    assert set(rows[0]) == {"name", "family", "needs", "paper", "summary", "parameters"}
    de = next(row for row in rows if row["name"] == "de")
    assert de["parameters"]["strategy"] == "rand/1"
    table = list(csv.DictReader(io.StringIO(run("optimizers", "--format", "csv").out)))
    assert [row["name"] for row in table] == OPTIMIZERS.names()
    assert "radius=null" in next(row for row in table if row["name"] == "ifoa")["parameters"]


def test_one_optimizer_tells_what_its_settings_mean(run):
    done = run("optimizers", "ifoa")
    assert "shrink = 0.25  (> 0, <= 1)\n  radius factor for a decade of cost (alpha)\n" in done.out
    (first, *_) = json.loads(run("optimizers", "ifoa", "--format", "json").out)
    assert set(first) == {"parameter", "default", "range", "meaning"}


def test_an_unknown_optimizer_is_bad_input(run):
    done = run("optimizers", "ifo")
    assert (done.code, done.out) == (2, "")
    assert 'did you mean "ifoa"' in done.err


def test_help_does_not_load_numpy(shell):
    done = shell(f"{sys.executable} -X importtime -m accelcal_cli benchmark --help")
    assert done.code == 0
    assert "numpy" not in done.err
