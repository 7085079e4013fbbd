"""The table of `accelcal benchmark` against its own raw file; its pictures and LaTeX."""

from __future__ import annotations

import csv
import io
import json

import numpy as np
import pytest
from scipy import stats

from accelcal_cli.studies.functions import TestFunction


def test_the_statistics_of_a_table_are_those_of_its_raw_file(run, tmp_path):
    line = "benchmark --func sphere,ackley --optimizer pso,de --dim 2,4 --instances 3 --runs 7 --evaluations 1500"
    done = run(*line.split(), "--target", "1e-1,1e-3", "--raw", "raw.csv", "--format", "json", "--quiet")
    rows = json.loads(done.out)
    assert (done.code, len(rows)) == (0, 2 * 2 * 2 * 2)
    raw = list(csv.DictReader(io.StringIO((tmp_path / "raw.csv").read_text())))
    for row in rows:
        own = [
            r
            for r in raw
            if (r["function"], r["optimizer"], int(r["dimension"]))
            == (row["function"], row["optimizer"], row["dimension"])
        ]
        cost = np.array([float(r["cost"]) for r in own])
        described = stats.describe(cost)
        assert (row["runs"], row["min"], row["max"]) == (described.nobs, *described.minmax)
        assert row["mean"] == pytest.approx(described.mean, rel=1e-12)
        assert row["variance"] == pytest.approx(described.variance, rel=1e-12)
        quartiles = stats.mstats.mquantiles(cost, alphap=1, betap=1)
        assert [row["lower_quartile"], row["median"], row["upper_quartile"]] == pytest.approx(
            list(quartiles), rel=1e-12
        )
        hits = [int(r[f"hit_{row['target']:g}"]) for r in own if r[f"hit_{row['target']:g}"]]
        assert row["success_rate"] == sum(cost <= row["target"]) / 7 == len(hits) / 7
        spent = sum(int(r[f"hit_{row['target']:g}"] or r["evaluations"]) for r in own)
        assert row["ert"] == (spent / len(hits) if hits else None)
        assert row["evaluations_to_tolerance"] == (int(np.median(hits)) if hits else None)
        for r in own:
            trace = [float(value) for value in r["trace_cost"].split()]
            assert trace == sorted(trace, reverse=True)
            assert trace[-1] == float(r["cost"])
            assert int(r["trace_evaluations"].split()[-1]) == int(r["evaluations"])
            problem = TestFunction(
                row["function"], row["dimension"], shift=True, rotate=True, instances=[int(r["instance"])]
            )
            x = np.array([float(r[f"x_{i + 1}"]) for i in range(row["dimension"])])
            assert problem.cost(x[None, None])[0, 0] == pytest.approx(float(r["cost"]), rel=1e-9)
        assert sorted(int(r["instance"]) for r in own) == [1, 1, 1, 2, 2, 3, 3]


def test_pictures_and_latex_are_written(run, tmp_path):
    line = "benchmark --func sphere,ackley --optimizer pso,de --dim 2,4 --runs 3 --evaluations 600 --target 1000,10"
    done = run(*line.split(), "--profile", "p.svg", "--plot", "c.svg", "--format", "latex", "--quiet")
    assert done.code == 0
    assert done.out.startswith("\\begin{tabular}{lrlr")
    assert done.out.count("\\\\\n") == 1 + 2 * 2 * 2 * 2
    for name, words in (
        ("p.svg", ("ECDF", "data profile", "ERT to 10", "best cost")),
        ("c.svg", ("sphere, D = 2",)),
    ):
        text = (tmp_path / name).read_text()
        assert all(f"<!-- {word}" in text or word in text for word in words), name


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--dim", "2,one"], '--dim "2,one": expected whole numbers from 2 to 1000'),
        (["--dim", "1"], "from 2 to 1000"),
        (["--target", "small"], '--target "small": expected numbers from 0'),
        (["--profile", "p.pdf"], "expected a name that ends in .png or .svg"),
        (["--format", "tex"], 'unknown (did you mean "latex"?)'),
    ],
)
def test_wrong_options_are_explained(run, more, message):
    done = run("benchmark", "--func", "sphere", "--runs", "1", *more)
    assert (done.code, message in done.err.replace("\n", " ")) == (2, True), done.err
