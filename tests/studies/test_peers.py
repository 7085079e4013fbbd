"""Other libraries and somebody's own code on our problems: budgets, counts, and where code may come from."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from accelcal_cli.calibration.settings import load_settings
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.optimization.algorithms.de import DifferentialEvolution
from accelcal_cli.optimization.minimize import Stopping, minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Status
from accelcal_cli.optimization.problem import FunctionProblem
from accelcal_cli.studies import peers
from accelcal_cli.studies.functions import TestFunction
from accelcal_cli.studies.study import Budget, Entry, choose

INSTALLED = {
    "scipy:differential_evolution": "scipy",
    "scipy:dual_annealing": "scipy",
    "scipy:minimize": "scipy",
    "pymoo:de": "pymoo",
    "pygmo:pso_gen": "pygmo",
    "pygmo:cmaes": "pygmo",
    "fcmaes:de": "fcmaes",
    "pyswarms:pso": "pyswarms",
    "scikit-opt:pso": "sko",
}


@pytest.mark.parametrize("name", INSTALLED)
@pytest.mark.filterwarnings("ignore")
def test_a_peer_has_our_budget_and_its_best_is_a_point_of_the_box(name):
    pytest.importorskip(INSTALLED[name], reason="pip install 'accelcal[bench]'")
    problem = TestFunction("sphere", 3, shift=True, instances=[1, 2])
    run = peers.run_search(problem, peers.peer(name), [0, 5], 3, 2000)
    assert (run.evaluations <= 2000).all()
    assert (run.evaluations == 2000).all() or name == "scipy:minimize"
    expected = Status.CONVERGED if name == "scipy:minimize" else Status.EVALUATIONS
    assert set(run.status) == {expected}
    for row in range(2):
        own = problem.take(np.array([row]))
        assert own.cost(run.x[row][None, None])[0, 0] == pytest.approx(run.cost[row], rel=1e-9, abs=1e-300)
        assert run.cost[row] < 100.0  # of thousands at the start
        assert (np.diff(run.trace[row]) <= 0).all()
        assert run.trace[row, -1] == run.cost[row]
        assert run.trace_evaluations[row, -1] <= 2000
    again = peers.run_search(problem.take(np.array([1])), peers.peer(name), [5], 3, 2000)
    assert again.cost[0] == run.cost[1]


def test_an_objective_stops_a_search_that_goes_on():
    problem = TestFunction("sphere", 2)

    def greedy(f, seed):
        while True:
            f(np.random.default_rng(seed).uniform(f.lower, f.upper))

    run = peers.run_search(problem, greedy, [0], 1, 25)
    assert (run.evaluations.tolist(), run.status) == ([25], (Status.EVALUATIONS,))

    def in_rows(f, seed):
        while True:
            f.rows(np.random.default_rng(seed).uniform(f.lower, f.upper, (10, 2)))

    assert peers.run_search(problem, in_rows, [0], 1, 25).evaluations.tolist() == [25]

    def broken(f, seed):
        f(np.zeros(2))
        raise RuntimeError("of its own")

    with pytest.raises(RuntimeError, match="of its own"):
        peers.run_search(problem, broken, [0], 1, 25)


def test_points_outside_the_box_count_as_at_its_wall_and_nan_as_infinite():
    f = peers.Objective(TestFunction("sphere", 2), 10)
    assert f([1e6, 0.0]) == f([100.0, 0.0]) == 1e4
    odd = peers.Objective(
        FunctionProblem(lambda x: np.where(x[..., 0] > 0, np.nan, 1.0), [-1, -1], [1, 1]), 10
    )
    assert (odd([0.5, 0.0]), odd([-0.5, 0.0])) == (np.inf, 1.0)
    assert odd.best.tolist() == [-0.5, 0.0]


def test_unknown_peers_are_explained(monkeypatch):
    with pytest.raises(ConfigError, match=r'did you mean "scipy".*scipy:NAME'):
        peers.peer("scypi:differential_evolution")
    with pytest.raises(ConfigError, match=r'did you mean "differential_evolution"'):
        peers.peer("scipy:diferential_evolution")
    monkeypatch.setitem(sys.modules, "pyswarms.single", None)
    with pytest.raises(DataError, match=r"pip install 'accelcal\[bench\]'"):
        peers.peer("pyswarms:pso")


def test_any_function_is_a_problem():
    bowl = FunctionProblem(lambda x: ((x - 1.0) ** 2).sum(axis=-1), [-5, -5], [5, 5])
    run = minimize(bowl, DifferentialEvolution(), runs=2)
    np.testing.assert_allclose(run.x, 1.0, atol=1e-6)


# Code of somebody else


OWN = '''
import numpy as np
from dataclasses import dataclass
from accelcal_cli.optimization.optimizer import Optimizer, PopulationAlone, State
from accelcal_cli.optimization.operators import better_of
from accelcal_cli.schema import setting


@dataclass(frozen=True)
class Shrinking(PopulationAlone, Optimizer[State]):
    """Random steps about every point."""

    family = "random search"
    paper = "none"
    reach: float = setting(0.1, "length of a step, part of the box", above=0, high=1)

    def step(self, problem, state, rng):
        u = 2.0 * rng.uniform(*state.x.shape[1:]) - 1.0
        x = np.clip(state.x + self.reach * problem.half_width * u, problem.lower, problem.upper)
        return State(*better_of(state.x, state.fx, x, problem.cost(x)))


def walk(function, bounds, rng):
    low, high = np.array(bounds).T
    generator, best, least = np.random.default_rng(rng), 0.5 * (low + high), np.inf
    while True:
        x = np.clip(best + 0.1 * (high - low) * generator.standard_normal(len(low)), low, high)
        cost = function(x)
        if cost < least:
            best, least = x, cost


class Nothing:
    pass
'''


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module in the current folder, which is not on the path."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [entry for entry in sys.path if entry not in ("", str(tmp_path))])
    name = f"own_{abs(hash(str(tmp_path)))}"
    Path(f"{name}.py").write_text(OWN)
    yield name
    sys.modules.pop(name, None)


def test_a_class_on_the_command_line_is_an_optimizer(own):
    (entry,) = choose([f"{own}:Shrinking"], None, (), Budget(population=20, iterations=50))
    optimizer = entry.build()
    assert (optimizer.population, optimizer.reach, type(optimizer).__name__) == (20, 0.1, "Shrinking")
    run = minimize(TestFunction("sphere", 3), optimizer)
    assert run.cost[0] < run.trace[0, 0]
    assert f"{own}:Shrinking" not in OPTIMIZERS.names()  # no file and no list may call it


def test_a_function_on_the_command_line_is_a_search(own):
    (entry,) = choose([f"{own}:walk"], None, (), Budget(evaluations=300))
    assert entry == Entry(f"{own}:walk", f"{own}:walk", peer=True)
    run = entry.run(TestFunction("sphere", 3), [0, 1], seed=0, stopping=Stopping(evaluations=300))
    assert run.evaluations.tolist() == [300, 300]
    assert run.cost[0] != run.cost[1]
    scipy = peers.callable_at("scipy.optimize:differential_evolution")
    assert peers.run_search(TestFunction("sphere", 3), scipy, [0], 0, 3000).cost[0] < 1e-3


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("no_such_module:Thing", "cannot be imported .ModuleNotFoundError: No module named 'no_such_module'"),
        ("{own}:Missing", "cannot be imported .AttributeError"),
        ("{own}:Nothing", "not a complete subclass of Optimizer"),
        ("{own}:np", "not a complete subclass of Optimizer"),
    ],
)
def test_what_is_no_optimizer_is_explained(own, place, message):
    with pytest.raises(ConfigError, match=message):
        choose([place.format(own=own)], None, (), Budget())


@pytest.mark.parametrize("text", ["optimizer: {own}:Shrinking", "optimizer: de\npeer: true"])
def test_a_file_never_imports_code(own, tmp_path, text):
    Path(f"{own}.py").write_text("raise SystemExit('imported')")
    file = tmp_path / "mine.yaml"
    file.write_text(text.format(own=own))
    with pytest.raises(ConfigError, match="a file imports no code"):
        choose([], file, (), Budget())
    if "peer" not in text:
        with pytest.raises(ConfigError, match="a file imports no code"):
            load_settings(file, {})
    assert own not in sys.modules


def test_calibrate_takes_a_class_by_its_place(own):
    settings = load_settings(None, {"optimizer": f"{own}:Shrinking", "parameters": {"iterations": 7}})
    assert (settings.optimizer, settings.build_optimizer().iterations) == (f"{own}:Shrinking", 7)


def test_workers_import_it_again(own, tmp_path):
    """In processes of their own, with the same result."""
    import subprocess

    line = f"benchmark --func sphere --optimizer {own}:Shrinking,{own}:walk --runs 6 --evaluations 400 --dim 3 -q"
    root = str(Path(__file__).parents[2])
    outputs = []
    for jobs in ("1", "2"):
        command = [
            sys.executable,
            "-m",
            "accelcal_cli",
            *line.split(),
            "--jobs",
            jobs,
            "--raw",
            f"{jobs}.csv",
        ]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={"PYTHONPATH": root, "PATH": ""}
        )
        assert done.returncode == 0, done.stderr
        outputs.append((tmp_path / f"{jobs}.csv").read_text())
    assert outputs[0] == outputs[1]
    assert len(outputs[0].splitlines()) == 13


def test_compare_gives_peers_the_same_budget(tmp_path):
    import subprocess

    line = "compare --optimizer de --peer scipy:differential_evolution --runs 2 --evaluations 900 --format json -q"
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-m", "accelcal_cli", *line.split()],
        capture_output=True, text=True, check=False, cwd=tmp_path, env={"PYTHONPATH": root, "PATH": ""},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)
    assert [(row["optimizer"], row["evaluations"]) for row in rows] == [
        ("de", 900),
        ("scipy:differential_evolution", 900),
    ]
