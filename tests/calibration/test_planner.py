"""Which poses to take next: each choice is the best one, and the set is mended by them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import rotation

from accelcal_cli.calibration.planner import PRIOR, dop_after, fixture_directions, next_poses
from accelcal_cli.calibration.quality import Observability, design
from accelcal_cli.sensor import poses


def _information(u):
    return design(u).T @ design(u)


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
