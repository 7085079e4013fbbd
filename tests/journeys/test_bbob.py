"""BBOB through COCO: what cocopp reads of our data, and that it says the same. Skipped without the extra `bbob`."""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest

pytest.importorskip("cocoex", reason="pip install 'accelcal[bbob]'")
pytest.importorskip("cocopp", reason="pip install 'accelcal[bbob]'")

from accelcal_cli.studies.bbob import FUNCTIONS, Bbob, BbobFunction
from accelcal_cli.studies.study import Budget, Task, choose

TARGETS = (10.0, 0.1, 1e-8)
POST = """
import glob, json, sys
import matplotlib
matplotlib.use("Agg")
import cocopp
folders = sorted(glob.glob("data/*"))
cocopp.main("-o post " + " ".join(folders))
found = {}
for folder in folders:
    for part in cocopp.load(folder):
        found[f"{folder[5:]} {part.funcId} {part.dim}"] = [
            None if n == float("inf") else float(n) for n in part.detERT([10, 0.1, 1e-8])
        ]
json.dump(found, open("found.json", "w"))
"""


@pytest.fixture
def done(run, tmp_path):
    line = "benchmark --func bbob-f1,bbob-f8 --dim 5 --evaluations 1200 --optimizer pso,de,shade-cma --quiet"
    result = run(*line.split(), "--target", "10,0.1,1e-8", "--coco", "data", "--format", "json")
    assert result.code == 0, result.err
    return json.loads(result.out)


def test_cocopp_takes_the_data_and_its_ert_is_ours(done, tmp_path):
    """Three optimizers on 15 instances in five dimensions, post-processed without a screen."""
    post = subprocess.run(
        [sys.executable, "-c", POST], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert post.returncode == 0, post.stderr[-2000:]
    assert "ALL done" in post.stdout
    assert list((tmp_path / "post").rglob("*.html"))
    found = json.loads((tmp_path / "found.json").read_text())
    assert len(found) == 6
    assert len(done) == 6 * len(TARGETS)
    reached = 0
    for row in done:
        number = row["function"].removeprefix("bbob-f")
        theirs = found[f"{row['optimizer']} {number} {row['dimension']}"][TARGETS.index(row["target"])]
        assert (row["ert"] is None) == (theirs is None)
        if theirs is not None:
            reached += 1
            assert row["ert"] == pytest.approx(theirs, rel=1e-12)
        assert (row["instance"], row["runs"]) == ("1-15", 15)
    assert reached > 6


def test_the_functions_are_those_of_coco():
    """Their least value is at 0 here, every instance has its own, and the box is [-5, 5]."""
    costs = set()
    for number in (1, 8, 24):
        for instance in (1, 2):
            problem = BbobFunction(number, 3, instance)
            assert (problem.lower.tolist(), problem.upper.tolist()) == ([-5.0] * 3, [5.0] * 3)
            x = np.random.default_rng(0).uniform(-5, 5, (1, 50, 3))
            fx = problem.cost(x)
            assert fx.shape == (1, 50)
            assert fx.min() > 0
            costs.add(float(fx[0, 0]))
            problem.close()
    assert len(costs) == 6
    assert len(FUNCTIONS) == 24


def test_a_run_has_its_instance_and_its_budget():
    entries = tuple(choose(["pso"], None, (), Budget()))
    study = Bbob(("bbob-f1",), entries, (2, 3), 4, instances=2, targets=(1.0,))
    assert [study.instance(run) for run in range(4)] == [1, 2, 1, 2]
    assert (study.budget(2), study.budget(3)) == (2000, 3000)
    (record,) = study.execute(Task(1, 3, 4))
    assert (record.instance, record.evaluations, len(record.point)) == (2, 3000, 3)
    assert record.hits[0] < 3000


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--func", "bbob", "--dim", "12"], "--dim 12: BBOB has 2, 3, 5, 10, 20, 40"),
        (["--func", "bbob,sphere"], '"sphere" beside functions of BBOB'),
        (["--func", "bbob", "--shift"], "not with bbob"),
        (["--func", "sphere", "--coco", "x"], "--coco needs --func bbob"),
        (["--func", "bbob-f1", "--coco", "x", "--jobs", "2"], "--coco: not with --jobs"),
        (["--func", "bbob-f1", "--optimizer", "levenberg-marquardt"], "needs residuals"),
    ],
)
def test_what_does_not_go_with_bbob_is_explained(run, more, message):
    done = run("benchmark", *more)
    assert (done.code, message in done.err.replace("\n", " ")) == (2, True), done.err
