"""Every registered optimizer keeps the contract, and an optimizer that does nothing breaks it."""

from __future__ import annotations

import dataclasses
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np
import optimizer_contract as contract
import pytest

from accelcal_cli.config import load_mapping
from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.optimizer import OPTIMIZERS, PRESETS, State, optimizer_file, preset_parameters
from accelcal_cli.schema import from_mapping

NAMES = OPTIMIZERS.names()
PAIRS = [(name, case) for name in NAMES for case in contract.cases(OPTIMIZERS.get(name))]


def test_the_registry_holds_the_methods_of_the_papers():
    """The names are a contract."""
    evolving = {"de-pso", "pso", "de", "ade", "shade-cma", "kpso", "akpso", "foa", "full-foa", "ifoa"}
    assert evolving | {"levenberg-marquardt", "newton", "ellipsoid"} <= set(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_every_optimizer_has_a_problem_to_prove_itself_on(name):
    assert contract.cases(OPTIMIZERS.get(name))


@pytest.mark.parametrize(("name", "case"), PAIRS)
@pytest.mark.parametrize("check", contract.CONTRACT, ids=lambda check: check.__name__)
def test_contract(check, name, case):
    if check is contract.reaches_the_minimum and case in contract.BEYOND.get(name, ()):
        with pytest.raises(AssertionError, match="best costs"):
            check(OPTIMIZERS.get(name), case)
    else:
        check(OPTIMIZERS.get(name), case)


def _unchanged(self, problem, state, rng):
    return state


def _same_point_again(self, problem, state, rng):
    problem.cost(state.x)
    return state


def _random_search(self, problem, state, rng):
    u = rng.uniform(*state.x.shape[1:])
    problem.cost(problem.lower + (problem.upper - problem.lower) * u)
    return state


def _start_only(self, problem, x, rng):
    return State(x, problem.cost(x))


def _disable(monkeypatch, cls, step):
    monkeypatch.setattr(cls, "step", step)
    if not contract.searches(cls):
        monkeypatch.setattr(cls, "init", _start_only)


@pytest.mark.parametrize("step", [_unchanged, _same_point_again, _random_search])
@pytest.mark.parametrize(
    ("name", "case"), [(name, case) for name, case in PAIRS if case not in contract.BEYOND.get(name, ())]
)
def test_an_optimizer_without_its_update_does_not_reach_the_minimum(monkeypatch, name, case, step):
    cls = OPTIMIZERS.get(name)
    _disable(monkeypatch, cls, step)
    with pytest.raises(AssertionError, match="best costs"):
        contract.reaches_the_minimum(cls, case)
    with pytest.raises(AssertionError):
        contract.survives_nan(cls, case)


SEARCHING = [(name, case) for name, case in PAIRS if contract.searches(OPTIMIZERS.get(name))]


@pytest.mark.parametrize(("name", "case"), SEARCHING)
def test_an_optimizer_without_its_update_is_seen_to_stand_still(monkeypatch, name, case):
    cls = OPTIMIZERS.get(name)
    _disable(monkeypatch, cls, _unchanged)
    with pytest.raises(AssertionError, match="not one improvement"):
        contract.never_worsens(cls, case)
    with pytest.raises(AssertionError):
        contract.stops_at_the_tolerance(cls, case)
    with pytest.raises(AssertionError):
        contract.stops_at_the_budget(cls, case)


def test_the_contract_sees_points_outside_the_box(monkeypatch):
    cls = OPTIMIZERS.get("pso")
    honest = cls.step

    def straying(self, problem, state, rng):
        problem.cost(problem.upper * (1.0 + 1e-15) + 0.0 * state.x)
        return honest(self, problem, state, rng)

    monkeypatch.setattr(cls, "step", straying)
    with pytest.raises(AssertionError):
        contract.keeps_to_the_box(cls, "sphere")


def test_the_contract_sees_runs_that_share_their_random_numbers(monkeypatch):
    """A step that mixes the runs of a batch does not give the same bits alone."""
    cls = OPTIMIZERS.get("de")
    honest = cls.step

    def mixing(self, problem, state, rng):
        state = honest(self, problem, state, rng)
        return dataclasses.replace(state, x=state.x + 1e-9 * (state.x.mean() - state.x[:1].mean()))

    monkeypatch.setattr(cls, "step", mixing)
    with pytest.raises(AssertionError):
        contract.alone_equals_batch(cls, "sphere")


@pytest.mark.parametrize("name", NAMES)
def test_every_optimizer_ships_its_settings(name):
    """One YAML file an algorithm: it names its source and states every setting, of a built-in one the default."""
    record = load_mapping(optimizer_file(name))
    cls = OPTIMIZERS.get(name)
    assert record["optimizer"] == name
    assert record["source"]
    assert set(record["parameters"]) == {field.name for field in dataclasses.fields(cls)}
    built = from_mapping(OPTIMIZERS.get(name), record["parameters"], name)
    for key, stated in record["parameters"].items():
        value = getattr(built, key)
        assert (list(value) if isinstance(value, tuple) else value) == stated
    assert built == cls() or not OPTIMIZERS.is_built_in(cls)
    assert set(record) - {"presets"} == {"optimizer", "source", "parameters"}


BUILT_IN = [name for name in NAMES if OPTIMIZERS.is_built_in(OPTIMIZERS.get(name))]


@pytest.mark.parametrize("name", BUILT_IN)
def test_every_optimizer_ships_both_presets(name):
    """What they state differs from the default, and one of them is the default where there is no third."""
    cls = OPTIMIZERS.get(name)
    stated = {preset: preset_parameters(name, preset) for preset in PRESETS}
    assert list(load_mapping(optimizer_file(name))["presets"]) == list(PRESETS)
    for preset, parameters in stated.items():
        from_mapping(cls, parameters, f"{name}: {preset}")
        default = {key: getattr(cls(), key) for key in parameters}
        same = [
            key
            for key, value in from_mapping(cls, parameters, name).__dict__.items()
            if key in parameters and value == default[key]
        ]
        assert same == [], f"{preset} states the default of {same}"
    assert stated["printed"] != stated["tuned"] or not stated["printed"]


VARIANTS = [
    ("pso", {"randoms": "particle"}),
    ("pso", {"randoms": "particle", "draws": 2}),
    ("de-pso", {"randoms": "particle"}),
    ("kpso", {"randoms": "coordinate"}),
    ("akpso", {"randoms": "particle"}),
    ("akpso", {"kalman_dim": 4}),
    ("akpso", {"kalman_dim": 4, "observation": "step"}),
    ("akpso", {"kalman_dim": 2, "observation": "step"}),
    ("akpso", {"kalman_dim": 4, "first_state": "zero"}),
    ("akpso", {"position": "sampled"}),
    ("akpso", {"memory": "adaptive"}),
    ("akpso", {"kalman_dim": 4, "bests": "filtered", "first_state": "zero"}),
    ("foa", {"start": "plane"}),
    ("foa", {"outside": "swarm"}),
    ("ifoa", {"rounding": "round"}),
    ("ifoa", {"rounding": "ceil"}),
    ("ifoa", {"rounding": "1+floor"}),
    ("shade-cma", {"smallest": 4, "greed": 0.11, "archive": 2.6, "samples": 11}),
]
"""Every other reading of a paper: settings that the contract, which builds the defaults, does not see."""


@pytest.mark.parametrize(("name", "reading"), VARIANTS, ids=str)
def test_every_reading_keeps_the_box_counts_and_repeats(name, reading):
    """It differs from the default, stays in the box, and run 3 alone has the bits of run 3 in a batch."""
    cls, case = OPTIMIZERS.get(name), contract.CASES["sphere"]
    default = contract.short(cls)
    changed = dataclasses.replace(default, **reading)
    problem = contract.watched(case.make())
    batch = minimize(problem, changed, runs=5, seed=9)
    points = problem.seen.all()
    assert ((points >= problem.lower) & (points <= problem.upper)).all()
    assert problem.seen.evaluations == batch.evaluations.sum()
    assert (np.diff(batch.trace, axis=1) <= 0).all()
    assert (batch.trace[:, -1] < batch.trace[:, 0]).any()
    contract.same_run(minimize(case.make(), changed, runs=[3], seed=9), 0, batch, 3)
    assert not np.array_equal(batch.trace[:, -1], minimize(case.make(), default, runs=5, seed=9).trace[:, -1])


@pytest.mark.parametrize("name", NAMES)
def test_every_optimizer_says_what_it_is(name):
    cls = OPTIMIZERS.get(name)
    assert cls.name == name
    assert cls.family
    assert cls.paper
    assert cls.__doc__
    for field in dataclasses.fields(cls):
        assert field.metadata["doc"], f"{name}: {field.name} has no description"


def _run_13(name):
    cls = OPTIMIZERS.get(name)
    return minimize(contract.CASES[contract.cases(cls)[0]].make(), contract.short(cls), runs=[13], seed=9)


def test_another_worker_gives_the_same_bits():
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        for name, elsewhere in zip(NAMES, pool.map(_run_13, NAMES), strict=True):
            contract.same_run(elsewhere, 0, _run_13(name), 0)


def test_a_problem_that_lacks_what_an_optimizer_needs_does_not_suit():
    sphere = contract.CASES["sphere"].make()
    assert not OPTIMIZERS.get("levenberg-marquardt")().suits(sphere)
    assert not OPTIMIZERS.get("ellipsoid")().suits(sphere)
    assert OPTIMIZERS.get("de-pso")().suits(sphere)


def test_more_runs_than_a_block_are_the_same_runs():
    """Blocks of runs are an economy of memory; they do not show."""
    problem, optimizer = contract.CASES["sphere"].make(), OPTIMIZERS.get("de")(iterations=20)
    many = minimize(problem, optimizer, runs=40, seed=3)
    assert many.x.shape == (40, 4)
    assert many.trace.shape == (40, 21)
    for number in (0, 17, 39):
        alone = minimize(problem, optimizer, runs=[number], seed=3)
        assert alone.x[0].tobytes() == many.x[number].tobytes()
        assert many.runs[number] == number
