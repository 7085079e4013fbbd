"""Every filter on a short voyage: it beats the INS, not the bound, and says how good it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accelcal_cli.errors import ConfigError
from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.navigation.filters.apo_pf import forces, masses
from accelcal_cli.navigation.filters.de_pf import IDLE, DePf
from accelcal_cli.navigation.gravity_map import PRESETS, GravityMap, generate
from accelcal_cli.navigation.ins import InsGrade
from accelcal_cli.navigation.marginal import de_mc_generation
from accelcal_cli.navigation.particle_filter import SCHEMES, Cloud, effective_size, normalise
from accelcal_cli.navigation.scenario import simulate
from accelcal_cli.navigation.scores import bound, counted, score
from accelcal_cli.navigation.voyage import PlannedVoyage
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import from_mapping

NAMES = ["apo-pf", "de-pf", "mpf", "pf", "point-mass", "pso-pf", "reference", "sitan"]
EVOLVING = ("apo-pf", "de-pf", "pso-pf")


def run(scenario, name, seed=1, runs=range(6), **settings):
    with np.errstate(all="ignore"):
        track = from_mapping(FILTERS.get(name), settings, "test").run(
            scenario, Streams(seed, runs, Purpose.FILTER)
        )
        return track, score(scenario, track)


def rmse(scores) -> float:
    return float(np.sqrt((scores.north + scores.east).mean()))


def test_these_are_all():
    assert FILTERS.names() == NAMES


# Resampling


weights = st.lists(st.floats(0.0, 1.0), min_size=2, max_size=30).filter(lambda w: sum(w) > 1e-6)


@given(weights, st.floats(0.0, 0.999))
@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_particle_is_copied_as_often_as_it_should_be(scheme, w, u):
    w = np.array([w]) / sum(w)
    chosen = SCHEMES[scheme](w, np.array([u]))
    copies = np.bincount(chosen[0], minlength=w.shape[1])
    assert copies.sum() == w.shape[1]
    assert (np.abs(copies - w.shape[1] * w[0]) < 1 + 1e-6).all()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_resampling_is_unbiased(scheme):
    w = normalise(np.random.default_rng(0).normal(size=(1, 9)) * 2)
    u = (np.arange(4000) + 0.5) / 4000
    chosen = SCHEMES[scheme](np.repeat(w, 4000, axis=0), u)
    copies = np.stack([(chosen == i).sum(axis=1) for i in range(9)]).mean(axis=1)
    np.testing.assert_allclose(copies, 9 * w[0], atol=0.01)


@given(st.lists(st.floats(-1e6, 0.0), min_size=2, max_size=30))
def test_weights_sum_to_one_however_small_they_are(logs):
    w = normalise(np.array([logs]) - 1e6)
    assert w.sum() == pytest.approx(1.0)
    assert 1.0 - 1e-9 <= effective_size(w)[0] <= w.shape[1] + 1e-9


# Operators


def test_the_forces_are_the_double_sum():
    rng = np.random.default_rng(3)
    x, f = rng.normal(size=(2, 12, 2)), rng.normal(size=(2, 12))
    m = masses(f)
    expected = np.zeros_like(x)
    for r in range(2):
        for i in range(12):
            for j in range(12):
                if f[r, i] < f[r].max():
                    sign = np.sign(f[r, j] - f[r, i])
                    expected[r, i] += sign * m[r, j] * (x[r, j] - x[r, i]) / m[r].sum()
    np.testing.assert_allclose(forces(x, f), expected, atol=1e-12)


def hill(v):
    """Return the log fitness of a round hill at (1, -1)."""
    return -0.5 * np.square(v - np.array([1.0, -1.0])).sum(axis=2)


def test_a_generation_of_de_is_equations_3_to_7():
    streams, twin = Streams(5, [0], 9), Streams(5, [0], 9)
    x = 2.0 * np.random.default_rng(1).normal(size=(1, 20, 2))
    f = np.exp(hill(x)[0])
    best, worst = f.argmax(), f.argmin()
    draws = twin.uniform(20, 5)[0]
    expected = x.copy()
    for i, (r, _, forced, *chances) in enumerate(draws):
        other = (i + 1 + int(19 * r)) % 20
        F = 0.4 + 0.6 * (f[best] - f[i]) / (f[best] - f[worst])
        u = x[0, i] + F * (x[0, best] - x[0, other])
        short = max(f[best] - np.exp(hill(u[None, None]))[0, 0], 0.0) / (f[best] - f[worst])
        CR = 1.0 - min(short, 1.0)
        v = [u[j] if chances[j] <= CR or j == int(2 * forced) else x[0, i, j] for j in (0, 1)]
        if np.exp(hill(np.array([[v]])))[0, 0] > f[i]:
            expected[0, i] = v
    moved = DePf(generations=1).evolve(x, hill(x), 20, hill, streams)
    assert 5 < (expected != x).any(axis=2).sum() < 20
    np.testing.assert_allclose(moved, expected, atol=1e-9)


def test_a_step_of_pso_is_towards_the_best():
    """At first every particle is its own best: v = |n2| (gbest - x)."""
    x = Streams(0, [0], 9).normal(10, 2)
    swarm = from_mapping(FILTERS.get("pso-pf"), {"generations": 1}, "test")
    moved = swarm.evolve(x, hill(x), 10, hill, Streams(1, [0], 9))
    pull = np.abs(Streams(1, [0], 9).normal(10, 4))[..., 2:]
    np.testing.assert_allclose(moved, x + pull * (x[:, hill(x)[0].argmax()] - x))


@pytest.mark.parametrize("name", ["de-pf", "pso-pf", "apo-pf"])
def test_evolution_climbs_and_leaves_the_others_alone(name):
    x = 1.5 * Streams(0, range(3), 9).normal(40, 2) + np.array([1.0, -1.0])
    moved = from_mapping(FILTERS.get(name), {}, "test").evolve(x, hill(x), 15, hill, Streams(1, range(3), 9))
    assert (moved[:, 15:] == x[:, 15:]).all()
    assert hill(moved)[:, :15].mean() > 0.7 * hill(x)[:, :15].mean()


@pytest.mark.parametrize("name", ["de-pf", "pso-pf", "apo-pf"])
def test_look_ups_are_counted(name, rough, monkeypatch):
    scenario = simulate(rough, PlannedVoyage(hours=2.05), InsGrade(), runs=range(2), seed=1)
    points = 0

    def at(self, latitude, longitude):
        nonlocal points
        points += np.broadcast(latitude, longitude).size
        return plain(self, latitude, longitude)

    plain = GravityMap.at
    monkeypatch.setattr(GravityMap, "at", at)
    for settings in ({"mode": "literal"}, {}):
        points = 0
        track, _ = run(scenario, name, runs=range(2), generations=3, **settings)
        assert points == round(track.lookups * scenario.runs * scenario.epochs)


def test_de_mc_leaves_a_gaussian_as_it_is():
    streams = Streams(0, [0], 99)
    x = streams.normal(400, 2)

    def rate(v):
        return -0.5 * np.square(v).sum(axis=2)

    level, total = rate(x), []
    for _ in range(60):
        x, level = de_mc_generation(x, level, rate, streams)
        total.append(x[0])
    pool = np.concatenate(total[10:])
    np.testing.assert_allclose(np.cov(pool.T), np.eye(2), atol=0.15)
    np.testing.assert_allclose(level, rate(x))


# Filters


WALKING = ("apo-pf", "pf", "pso-pf")
"""Filters whose position is a random walk: they hold errors like the paper's, and no velocity of a metre a second."""


@pytest.fixture(scope="module")
def scenarios(voyage, rough):
    plan = PlannedVoyage(drift=(1000.0, 1700.0))
    drifting = simulate(rough, plan, InsGrade(), runs=range(6), seed=1, period=30.0, prior="tied")
    return {name: drifting if name in WALKING else voyage for name in NAMES}


@pytest.fixture(scope="module")
def results(scenarios):
    return {
        name: run(scenarios[name], name, generations=5) if name in EVOLVING else run(scenarios[name], name)
        for name in NAMES
    }


@pytest.mark.parametrize("name", NAMES)
def test_a_filter_beats_the_ins_and_not_the_bound(results, scenarios, name):
    _, scores = results[name]
    late = counted(scenarios[name])
    least = np.sqrt(bound(scenarios[name])[late].sum(axis=1).mean())
    alone = np.sqrt(scores.ins.mean())
    assert 0.8 * least < rmse(scores) < 0.5 * alone


def test_strapped_down_biases_turn_with_the_heading_and_the_filter_knows(rough):
    """By the course of the indicated velocity, which errs by degrees, the normalised error squared is above 10."""
    ins = InsGrade(mounting="strapdown")
    scenario = simulate(rough, PlannedVoyage(), ins, runs=range(6), seed=1, period=60.0)
    _, scores = run(scenario, "reference")
    assert scores.nees.mean() < 4.0


def test_the_order_that_is_told(results):
    found = {name: rmse(scores) for name, (_, scores) in results.items()}
    assert found["reference"] < 0.7 * found["pf"]
    assert found["de-pf"] < 0.8 * found["pf"]


@pytest.mark.parametrize("name", ["pf", "de-pf", "reference"])
def test_the_claimed_spread_fits_the_error(results, name):
    assert 0.7 < results[name][1].nees.mean() < 6.0
    assert not results[name][1].lost.any()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_plain_filter_is_far_better_than_the_ins(seed):
    """On errors like the paper's; of velocities of a metre a second its random walk loses lock."""
    scenario = simulate(
        generate(PRESETS["rough"], seed),
        PlannedVoyage(drift=(1000.0, 1700.0)),
        InsGrade(),
        runs=range(6),
        seed=seed,
        prior="tied",
    )
    _, scores = run(scenario, "pf", seed=seed, particles=300)
    assert rmse(scores) < 600
    assert rmse(scores) < 0.25 * np.sqrt(scores.ins.mean())


def test_without_evolution_the_marginal_filter_loses_lock(voyage):
    _, scores = run(voyage, "de-pf", generations=0)
    assert rmse(scores) > 1000


def test_without_measurements_every_filter_drifts(voyage):
    deaf = replace(voyage, measured=np.full_like(voyage.measured, np.nan))
    for name in ("pf", "de-pf", "reference"):
        _, scores = run(deaf, name, **({"generations": 2} if name == "de-pf" else {}))
        assert rmse(scores) > 1500, name


@pytest.mark.parametrize("name", NAMES)
def test_a_run_alone_is_the_same_as_in_a_batch(voyage, rough, name):
    settings = {"generations": 2} if name in EVOLVING else {}
    plan = PlannedVoyage(hours=2.5)
    batch = simulate(rough, plan, InsGrade(), runs=range(4), seed=1)
    alone = simulate(rough, plan, InsGrade(), runs=range(2, 3), seed=1)
    assert (alone.measured[0] == batch.measured[2]).all()
    together, _ = run(batch, name, runs=range(4), **settings)
    single, _ = run(alone, name, runs=range(2, 3), **settings)
    assert (together.mean[2] == single.mean[0]).all()
    assert (together.covariance[2] == single.covariance[0]).all()


@pytest.mark.parametrize("name", ["de-pf", "pso-pf", "apo-pf"])
def test_the_literal_mode_is_told_to_lose_lock(rough, name):
    scenario = simulate(rough, PlannedVoyage(), InsGrade(), runs=range(3), seed=1, period=60.0)
    _, scores = run(scenario, name, runs=range(3), mode="literal", generations=10)
    assert scores.lost.any()


@pytest.mark.parametrize("name", ["de-pf", "pso-pf", "apo-pf"])
def test_with_the_transition_density_particles_stay_near_where_they_came_from(name):
    """Where the map shows nothing no particle is better off than at its last position, at the step's noise from it."""
    flat = simulate(
        generate(PRESETS["constant"], 0), PlannedVoyage(hours=2.1), InsGrade(), runs=range(2), seed=1
    )
    form = from_mapping(FILTERS.get(name), {"mode": "literal", "fitness": "transition"}, "test")
    x = 300.0 * Streams(1, range(2)).normal(100, 2)
    before = x + form.step_noise(flat) * Streams(2, range(2)).normal(100, 2)
    moved, _, _ = form.update(
        flat, replace(Cloud.of(x, np.zeros((2, 100))), before=before), 5, Streams(3, range(2))
    )
    away = np.square(moved.x - before).sum(axis=2) / form.step_noise(flat) ** 2
    if name == "de-pf":  # its greedy selection takes nothing worse
        assert (away <= np.square(x - before).sum(axis=2) / form.step_noise(flat) ** 2 + 1e-9).all()
    excess = moved.log_weights + 0.5 * away  # the likelihood: the same everywhere
    np.testing.assert_allclose(excess, np.broadcast_to(excess[:, :1], excess.shape), atol=1e-9)


def test_a_fitness_without_effect_is_refused():
    with pytest.raises(ConfigError, match="fitness: has no effect in mode default"):
        from_mapping(FILTERS.get("de-pf"), {"fitness": "transition"}, "de-pf")


@pytest.mark.parametrize("strategy", ["metropolis", "window", "safe"])
def test_the_other_strategies_beat_the_ins(rough, strategy):
    scenario = simulate(rough, PlannedVoyage(hours=4.0), InsGrade(), runs=range(3), seed=1, period=20.0)
    _, scores = run(scenario, "de-pf", runs=range(3), strategy=strategy, generations=2)
    assert rmse(scores) < 0.5 * np.sqrt(scores.ins.mean())


@pytest.mark.parametrize("name", NAMES)
def test_a_constant_map_leaves_the_cloud_wide(name):
    flat = simulate(
        generate(PRESETS["constant"], 0),
        PlannedVoyage(hours=3.5),
        InsGrade(),
        runs=range(3),
        seed=1,
        period=30.0,
    )
    settings = {"generations": 3} if name in EVOLVING else {}
    track, _ = run(flat, name, runs=range(3), **settings)
    claimed = np.sqrt(np.einsum("rkii->rk", track.covariance))[:, -1]
    assert (claimed > 800).all()


@pytest.mark.parametrize("settings", [{"resampling": "residual"}, {"state": 12, "particles": 1000}])
def test_residual_resampling_and_twelve_states_beat_the_ins(rough, settings):
    scenario = simulate(rough, PlannedVoyage(hours=4.0), InsGrade(), runs=range(3), seed=1, period=20.0)
    _, scores = run(scenario, "pf", runs=range(3), **settings)
    assert rmse(scores) < 0.5 * np.sqrt(scores.ins.mean())


@pytest.mark.parametrize(
    ("strategy", "idle"), [(strategy, name) for strategy, names in IDLE.items() for name in names]
)
def test_a_setting_without_effect_on_its_strategy_is_refused(strategy, idle):
    other = {"resampling": "residual", "state": 12, "mutation": "rand-to-best", "window": 7.0}.get(idle, 0.75)
    with pytest.raises(ConfigError, match=f"{idle}: has no effect with strategy {strategy}"):
        from_mapping(
            FILTERS.get("de-pf"), {"strategy": strategy, idle: 1.5 if "inflation" in idle else other}, "de-pf"
        )


def test_settings_with_effect_are_taken():
    from_mapping(FILTERS.get("de-pf"), {"strategy": "safe", "fraction": 0.4, "weight_max": 0.7}, "de-pf")
    from_mapping(FILTERS.get("de-pf"), {"strategy": "window", "window": 40}, "de-pf")
    from_mapping(FILTERS.get("de-pf"), {"mode": "literal", "mutation": "rand-to-best"}, "de-pf")
