"""Which poses to take next: each choice is the best one, and the set is mended by them."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from simulated import DPSO, rotation

from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import PARAMETERS, Observability, design, next_poses
from accelcal_cli.calibration.problem import Box, Loetters, compress_each, pack
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.algorithms.levenberg_marquardt import LevenbergMarquardt
from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.planning import FIXTURES, PRIOR, best_poses, candidates, distinct_poses, plan_from
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.poses import fixture_directions
from accelcal_cli.views.plan import parameter_table, pose_table, record


def _information(u):
    return design(u).T @ design(u)


def dop_after(information, directions):
    """Return the observability after taking the poses `directions`, shape (k, 3), too."""
    return Observability.of(information + _information(directions), 9)


def _worst_variance(information, direction):
    row = design(direction[None])
    return np.diagonal(np.linalg.inv(information + PRIOR * np.eye(9) + row.T @ row)).max()


NEAR = 5e-3
"""Choices whose largest variances differ by less than this part are ties, and the smaller sum of variances decides."""

SETS = {
    "none": np.zeros((0, 3)),
    "faces": poses.faces(),
    "six of the edges": poses.edges()[:6],
    "half a ring": np.stack(
        [np.zeros(7), np.cos(np.linspace(0, 3, 7)), np.sin(np.linspace(0, 3, 7))], axis=1
    ),
    "spread": poses.fibonacci(15),
}


@pytest.mark.parametrize("name", SETS)
def test_every_choice_is_the_best_of_all_candidates(name):
    """Against an inverse from scratch for every candidate, four choices in a row."""
    u = SETS[name]
    candidates = np.concatenate([fixture_directions(), poses.fibonacci(30)])
    chosen = next_poses(_information(u), candidates, 4)
    assert len(chosen) == 4
    for k, index in enumerate(chosen):
        before = _information(np.concatenate([u, candidates[chosen[:k]]]))
        worst = [_worst_variance(before, c) for c in candidates]
        assert worst[index] <= min(worst) * (1 + NEAR)


@given(st.integers(0, 10**6), st.integers(0, 15))
def test_the_best_of_any_candidates(seed, count):
    u = poses.fibonacci(count + 1) @ rotation(seed)
    candidates = poses.fibonacci(25) @ rotation(seed + 1)
    (index,) = next_poses(_information(u), candidates, 1)
    worst = [_worst_variance(_information(u), c) for c in candidates]
    assert worst[index] <= min(worst) * (1 + NEAR)


@given(st.integers(0, 10**6))
def test_predicted_dilution_is_that_of_the_enlarged_set(seed):
    u, more = poses.fibonacci(11) @ rotation(seed), poses.fibonacci(5) @ rotation(seed + 3)
    predicted = dop_after(_information(u), more)
    whole = np.concatenate([u, more])
    taken = Observability.of(_information(whole), len(whole))
    np.testing.assert_allclose(predicted.dop, taken.dop, rtol=1e-7)
    np.testing.assert_allclose(
        predicted.cofactor, taken.cofactor, rtol=1e-6, atol=1e-9 * taken.cofactor.max()
    )


@pytest.mark.parametrize("name", SETS)
def test_choosing_stops_when_it_is_enough(name):
    u, candidates = SETS[name], fixture_directions()
    information = _information(u)
    enough = 0.8 * min(2.0, Observability.of(information, 9).worst)
    chosen = next_poses(information, candidates, 60, enough=enough)
    assert 0 < len(chosen) < 60
    assert dop_after(information, candidates[chosen]).worst <= enough * (1 + 1e-6)
    assert dop_after(information, candidates[chosen[:-1]]).worst > enough


def test_a_set_that_is_good_enough_needs_nothing():
    assert next_poses(_information(poses.turns()), fixture_directions(), 8, enough=5.0) == []


@pytest.mark.parametrize("name", ["faces", "six of the edges", "half a ring"])
def test_a_degenerate_set_is_mended(name):
    u = SETS[name]
    information = _information(u)
    assert Observability.of(information, len(u)).verdict == "undetermined"
    chosen = next_poses(information, fixture_directions(), 8, enough=5.0)
    mended = dop_after(information, fixture_directions()[chosen])
    assert mended.verdict == "good"
    assert mended.worst <= 5.0 * (1 + 1e-6)


def test_choosing_from_nothing_ends_in_a_good_set():
    chosen = next_poses(np.zeros((9, 9)), fixture_directions(), 12)
    seen = dop_after(np.zeros((9, 9)), fixture_directions()[chosen])
    assert seen.rank == 9
    assert seen.worst < 2.0


def test_fixture_directions_are_a_cube_with_its_edges_and_corners():
    u = fixture_directions()
    assert u.shape == (26, 3)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-14)
    assert len(np.unique(u.round(9), axis=0)) == 26
    assert len({poses.describe(d) for d in u}) == 26


KINDS = (quality.SCALE, quality.MISALIGNMENT, quality.BIAS)


def _dop(u):
    return np.sqrt(np.diagonal(np.linalg.inv(_information(u) + PRIOR * np.eye(9))))


def _by_kind(dop):
    """Dilutions sorted within their kind: the axes of a sensor are alike."""
    return np.concatenate([np.sort(dop[kind]) for kind in KINDS])


def _exhaustive(taken, allowed, count):
    """The least worst dilution that any `count` of the allowed directions reach, with repetition."""
    rows = design(allowed)
    outer = np.einsum("ci,cj->cij", rows, rows)
    base, best = _information(taken) + PRIOR * np.eye(9), np.inf
    sets = itertools.combinations_with_replacement(range(len(allowed)), count)
    while block := list(itertools.islice(sets, 20000)):
        total = base + outer[np.array(block)].sum(axis=1)
        best = min(best, np.diagonal(np.linalg.inv(total), axis1=1, axis2=2).max(axis=1).min())
    return np.sqrt(best)


@functools.cache
def _long_search(name, count, starts):
    """Dilutions of the best set that a quasi-Newton search over all directions finds from several starts."""
    taken = SETS[name]
    from scipy.optimize import minimize as descend

    def unit(x):
        u = x.reshape(count, 3)
        return u / np.linalg.norm(u, axis=1, keepdims=True)

    def cost(x, power):
        variance = _dop(np.concatenate([taken, unit(x)])) ** 2
        return np.log(np.sum((variance / variance.max()) ** power)) / power + np.log(variance.max())

    found = []
    for x in Streams(5, range(starts)).normal(1, 3 * count)[:, 0]:
        for power in (2.0, 16.0, 64.0):
            x = descend(cost, x, (power,), method="BFGS", options={"maxiter": 40}).x
        found.append(_dop(np.concatenate([taken, unit(x)])))
    return min(found, key=np.max)


@pytest.mark.parametrize(("fixture", "directions"), [("edges", 18), ("corners", 26)])
def test_four_poses_after_the_faces_are_those_of_an_exhaustive_search(fixture, directions):
    allowed = candidates(fixture)
    assert len(allowed) == directions
    chosen = best_poses(_information(poses.faces()), allowed, 4)
    worst = _dop(np.concatenate([poses.faces(), allowed[chosen]])).max()
    assert worst == pytest.approx(_exhaustive(poses.faces(), allowed, 4), rel=1e-6)


@pytest.mark.parametrize("fixture", ["corners", "any"])
@pytest.mark.parametrize(("taken", "count"), [("faces", 6), ("none", 12)])
def test_every_dilution_is_near_that_of_the_best_set_of_a_long_search(taken, count, fixture):
    u = SETS[taken]
    allowed = candidates(fixture)
    chosen = best_poses(_information(u), allowed, count)
    assert len(chosen) == count
    reached = _dop(np.concatenate([u, allowed[chosen]]))
    best = _long_search(taken, count, 6)
    assert reached.max() <= 1.1 * best.max()
    assert (_by_kind(reached) <= 1.1 * _by_kind(best)).all()


@settings(max_examples=8)
@given(st.integers(0, 10**6), st.integers(0, 14), st.integers(1, 9))
def test_an_exchange_is_never_worse_than_the_greedy_choice(seed, taken, count):
    u = poses.fibonacci(taken + 1) @ rotation(seed)
    greedy = next_poses(_information(u), fixture_directions(), count)
    chosen = best_poses(_information(u), fixture_directions(), count)
    worst = [_dop(np.concatenate([u, fixture_directions()[c]])).max() for c in (chosen, greedy)]
    assert worst[0] <= worst[1] * (1 + NEAR)


def test_poses_come_in_the_order_that_helps_most():
    allowed = candidates("corners")
    chosen = best_poses(_information(poses.faces()), allowed, 6)
    for k in range(5):
        so_far = np.concatenate([poses.faces(), allowed[chosen[:k]]])
        worst = [_worst_variance(_information(so_far), allowed[c]) for c in chosen[k:]]
        assert worst[0] <= min(worst) * (1 + NEAR)


def test_fixtures_allow_more_and_more():
    sizes = [len(candidates(fixture)) for fixture in FIXTURES]
    assert sizes == [6, 18, 26, 290]
    for few, many in itertools.pairwise(FIXTURES):
        np.testing.assert_array_equal(candidates(many)[: len(candidates(few))], candidates(few))
    whole = candidates("any")
    np.testing.assert_allclose(np.linalg.norm(whole, axis=1), 1.0, rtol=1e-14)
    assert len(np.unique(whole.round(9), axis=0)) == 290


def _faces_of(u):
    return int((np.abs(u).max(axis=1) > 1 - 1e-9).sum())


def _largest_of_kinds(u):
    return np.array([_dop(u)[kind].max() for kind in KINDS])


@pytest.mark.parametrize("fixture", ["edges", "corners"])
@pytest.mark.parametrize("count", [14, 16, 18, 24, 40])
def test_enough_poses_contain_faces_and_cost_the_nine_little(count, fixture):
    found = plan_from(np.zeros((9, 9)), 0, count, fixture, None)
    assert _faces_of(found.directions) >= 1
    best = candidates(fixture)[best_poses(np.zeros((9, 9)), candidates(fixture), count)]
    assert (_largest_of_kinds(found.directions) <= 1.1 * _largest_of_kinds(best) * (1 + 1e-6)).all()
    if count >= 16:
        assert found.cubic.max() < 4.5


def test_a_cubic_is_seen_as_its_dilution_says():
    """A cubic of 0.5 % on z, fitted beside the nine in simulated readings of the planned poses."""
    found = plan_from(np.zeros((9, 9)), 0, 18, "corners", 1e-4)
    u, cubic, noise = found.directions, 0.005, 1e-4
    rows = np.concatenate([design(u), -(u**4)], axis=1)
    force = u * (1.0 + cubic * u**2 * np.array([0.0, 0.0, 1.0]))
    estimates = []
    for draw in Streams(7, range(400)).normal(len(u), 3):
        e = (1.0 - np.sum((force + noise * draw) ** 2, axis=1)) / 2.0
        estimates.append(np.linalg.lstsq(rows, e)[0][9:])
    mean, scatter = np.mean(estimates, axis=0), np.std(estimates, axis=0)
    np.testing.assert_allclose(mean, [0.0, 0.0, cubic], atol=2e-4)
    np.testing.assert_allclose(scatter, noise * found.cubic, rtol=0.15)


def test_twelve_edges_stay_the_default_and_are_blind_to_a_cubic():
    found = plan_from(np.zeros((9, 9)), 0, 12, "corners", None)
    assert _faces_of(found.directions) == 0
    assert np.isinf(found.cubic).all()
    assert "Cubic nonlinearity of any axis does not show" in pose_table(found).notes[-1]
    assert record(found)["dop_cubic"] == [None] * 3


def test_noise_that_hides_a_cubic_leaves_the_poses_to_the_nine():
    quiet = plan_from(np.zeros((9, 9)), 0, 18, "edges", 1e-4)
    noisy = plan_from(np.zeros((9, 9)), 0, 18, "edges", 0.01)
    assert _faces_of(quiet.directions) > 0
    best = candidates("edges")[best_poses(np.zeros((9, 9)), candidates("edges"), 18)]
    assert _dop(noisy.directions).max() == pytest.approx(_dop(best).max(), rel=1e-9)
    assert "shows in these poses" in pose_table(quiet).notes[-1]


def test_faces_are_added_to_twelve_edges():
    g = 9.8
    readings = Readings.from_array(DPSO.output(g * poses.edges() + Streams(1, [0]).normal(12, 3)[0] * 1e-3))
    result = calibrate(readings, Settings(g=g, optimizer="levenberg-marquardt"))
    found = plan_from(result.information, 12, 6, "corners", 1e-4, result)
    assert _faces_of(found.directions) >= 3
    assert np.isfinite(found.cubic).all()


def test_predicted_sigma_is_the_scatter_of_simulated_calibrations():
    """Two thousand sensors in the six faces and the six poses that were planned."""
    g, runs, sigma = 9.8, 2000, 1e-3
    found = plan_from(_information(poses.faces()), 6, 6, "corners", sigma / g)
    u = np.concatenate([poses.faces(), found.directions])
    truth = DPSO.in_gauge("lower")
    outputs = truth.output(g * u + sigma * Streams(3, range(runs)).normal(len(u), 3))
    box = Box(np.repeat((pack(truth.K, truth.D, 9) + 3000.0)[None], runs, axis=0), np.full((runs, 9), 3e4))
    problem = Loetters(compress_each(outputs), g, box)
    run = minimize(problem, LevenbergMarquardt(), runs=runs, start=np.zeros((runs, 1, 9)), trace=False)
    K, D = problem.parameters(run.x)
    E = np.linalg.solve(truth.K, K) - np.eye(3)
    bias = (truth.D - D) / np.diagonal(K, axis1=1, axis2=2)
    scatter = np.concatenate([E[:, [0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]], bias / g], axis=1).std(axis=0)
    units = np.repeat([1e6, 1e3, 1e6], 3)  # ppm, mrad, micro-g
    predicted = np.array([row["sigma_after"] for row in parameter_table(found).records()])
    np.testing.assert_allclose(predicted, scatter * units, rtol=0.1)


def test_a_plan_tells_what_is_expected_after_each_pose():
    found = plan_from(_information(poses.faces()), 6, 6, "corners", 1e-4)
    rows = pose_table(found).records()
    assert [row["pose"] for row in rows] == list(range(6, 13))
    assert rows[0]["hold"] == "so far"
    assert rows[0]["dop_misalignment"] is None
    for k, row in enumerate(rows[1:], 1):
        np.testing.assert_array_equal([row["x"], row["y"], row["z"]], found.directions[k - 1])
        assert row["hold"] == poses.describe(found.directions[k - 1])
        dop = dop_after(_information(poses.faces()), found.directions[:k]).dop
        if np.isfinite(dop).all():
            assert row["dop_misalignment"] == pytest.approx(dop[quality.MISALIGNMENT].max())
            assert row["sigma_scale"] == pytest.approx(dop[quality.SCALE].max() * 100)
    assert found.verdict == "good"
    assert [row["parameter"] for row in parameter_table(found).records()] == list(PARAMETERS)
    assert record(found)["verdict"] == "good"


def test_without_a_noise_there_is_no_sigma():
    found = plan_from(np.zeros((9, 9)), 0, 12, "edges", None)
    assert not [key for row in pose_table(found).records() for key in row if key.startswith("sigma")]
    assert not [key for row in parameter_table(found).records() for key in row if key.startswith("sigma")]


def test_poses_that_cannot_be_enough_are_named_as_such():
    found = plan_from(np.zeros((9, 9)), 0, 12, "faces", None)
    assert found.verdict == "undetermined"
    assert "misalignment xy, misalignment xz, misalignment yz" in pose_table(found).notes[-1]
    assert "all nine parameters" in pose_table(plan_from(np.zeros((9, 9)), 0, 1, "any", None)).notes[-1]


@pytest.mark.parametrize("count", [1, 12, 20, 26])
def test_distinct_poses_are_distinct(count):
    allowed = candidates("corners")
    chosen = distinct_poses(allowed, count)
    assert len(chosen) == len(set(chosen)) == count
    if count == 12:
        assert _dop(allowed[chosen]).max() < 1.05


def test_where_the_worst_variance_cannot_fall_the_sum_decides():
    """z is worst and neither pose turns to it; x is known already, y is not: y, though it comes second."""
    variance = dict.fromkeys(PARAMETERS, 1e-2)
    variance.update({"scale factor z": 1.0, "bias z": 1.0, "scale factor y": 0.5, "bias y": 0.5})
    information = np.diag([1.0 / variance[name] for name in PARAMETERS])
    assert next_poses(information, np.eye(3)[:2], 1) == [1]
    assert next_poses(information, np.eye(3)[[1, 0]], 1) == [0]
