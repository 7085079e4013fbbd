"""Pose schemes and the words for a pose."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from accelcal_cli.calibration.observability import Observability, design
from accelcal_cli.errors import UsageError
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses


def _rank(u):
    return Observability.of(design(u).T @ design(u), len(u)).rank


def _distinct(u):
    return len(np.unique(u.round(9), axis=0))


@pytest.mark.parametrize(
    ("scheme", "count", "distinct", "rank"),
    [
        (poses.faces, 6, 6, 6),
        (poses.edges, 12, 12, 9),
        (poses.corners, 8, 8, 7),
        (poses.faces_edges, 12, 12, 9),
        (poses.icosahedron, 12, 12, 9),
        (poses.turns, 24, 18, 9),
    ],
)
def test_schemes(scheme, count, distinct, rank):
    u = scheme()
    assert u.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-14)
    assert _distinct(u) == distinct
    assert _rank(u) == rank


def test_faces_are_the_six_axes():
    assert sorted(map(tuple, poses.faces().tolist())) == sorted(
        tuple(side if k == axis else 0.0 for k in range(3)) for axis in range(3) for side in (1.0, -1.0)
    )


def test_edges_have_two_equal_parts_and_a_zero():
    u = np.abs(poses.edges())
    assert ((u == 0).sum(axis=1) == 1).all()
    np.testing.assert_allclose(u[u > 0], np.sqrt(0.5))


def test_the_icosahedron_has_equal_neighbours():
    """Every vertex has five neighbours at the same angle, and its opposite."""
    cosine = poses.icosahedron() @ poses.icosahedron().T
    for row in cosine:
        values = np.sort(row)
        np.testing.assert_allclose(values[:1], -1.0, atol=1e-12)
        np.testing.assert_allclose(values[1:6], -1 / np.sqrt(5), atol=1e-12)
        np.testing.assert_allclose(values[6:11], 1 / np.sqrt(5), atol=1e-12)


def test_the_24_turns_are_three_circles_of_eight():
    u = poses.turns().reshape(3, 8, 3)
    for circle, still in zip(u, (1, 0, 2), strict=True):
        assert (circle[:, still] == 0).all()
        np.testing.assert_allclose(
            (circle * np.roll(circle, 1, axis=0)).sum(axis=1), np.sqrt(0.5), atol=1e-14
        )
    counts = np.unique(poses.turns().round(9), axis=0, return_counts=True)[1]
    assert sorted(counts) == [1] * 12 + [2] * 6


@given(st.integers(1, 300))
def test_fibonacci_is_even(count):
    u = poses.fibonacci(count)
    assert u.shape == (count, 3)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-12)
    assert np.linalg.norm(u.sum(axis=0)) <= 2.0
    if count > 1:
        cosine = u @ u.T - 2 * np.eye(count)
        nearest = np.degrees(np.arccos(np.clip(cosine.max(axis=1), -1, 1)))
        assert nearest.min() > 0.5 * np.degrees(np.sqrt(4 * np.pi / count))
    if count >= 9:
        assert _rank(u) == 9


@pytest.mark.parametrize(
    ("count", "scheme"),
    [(6, "faces"), (12, "edges"), (24, "turns"), (7, "fibonacci"), (100, "fibonacci")],
)
def test_the_default_scheme_of_a_number(count, scheme):
    random = Streams(0, [0]).normal(count, 3)[0]
    np.testing.assert_array_equal(
        poses.directions(count, None, random), poses.directions(count, scheme, random)
    )


def test_random_directions_are_uniform():
    random = Streams(0, [0]).normal(4000, 3)[0]
    u = poses.directions(4000, "random", random)
    np.testing.assert_allclose(np.linalg.norm(u, axis=1), 1.0, rtol=1e-12)
    assert np.linalg.norm(u.mean(axis=0)) < 0.05
    np.testing.assert_allclose((u.T @ u) / 4000, np.eye(3) / 3, atol=0.02)


def test_a_scheme_has_its_number_of_poses():
    for name, make in poses.FIXED.items():
        assert len(poses.directions(len(make()), name, np.zeros((0, 3)))) == len(make())
        with pytest.raises(UsageError, match=rf'"{name}" has {len(make())} poses, not 5'):
            poses.directions(5, name, np.zeros((5, 3)))


def test_an_unknown_scheme_is_answered():
    with pytest.raises(UsageError, match=r'"icosaedron": unknown \(did you mean "icosahedron"\?\)') as error:
        poses.directions(12, "icosaedron", np.zeros((12, 3)))
    for name in poses.SCHEMES:
        assert name in str(error.value)


@pytest.mark.parametrize(
    ("direction", "words"),
    [
        ((1, 0, 0), "+x up"),
        ((0, -1, 0), "-y up"),
        ((0, 0, 3.0), "+z up"),
        ((1, 0.005, 0), "+x up"),
        ((1, -1, 0), "+x up, tilted 45 degrees towards -y"),
        ((0, 0.5, np.sqrt(0.75)), "+z up, tilted 30 degrees towards +y"),
        ((-np.sqrt(0.75), 0, -0.5), "-x up, tilted 30 degrees towards -z"),
        ((1, 1, 1), "corner between +x, +y and +z up"),
        ((-1, 1, -1), "corner between -x, +y and -z up"),
        ((0.2, 0.1, 0.97), "+z up, tilted 13 degrees towards +x turned 27 degrees to +y"),
    ],
)
def test_words_for_a_pose(direction, words):
    assert poses.describe(np.array(direction, dtype=float)) == words


def _read(words):
    """The direction that the words of `describe` mean: what a person would hold."""
    axis = {
        f"{sign}{name}": s * row
        for sign, s in (("+", 1), ("-", -1))
        for name, row in zip("xyz", np.eye(3), strict=True)
    }
    if words.startswith("corner"):
        return sum(axis[word.strip(",")] for word in words.split()[2:6] if word != "and") / np.sqrt(3)
    parts = words.replace(",", "").split()
    up = axis[parts[0]]
    if len(parts) == 2:
        return up
    tilt, towards = np.radians(float(parts[3])), axis[parts[6]]
    if len(parts) > 7:
        turn = np.radians(float(parts[8]))
        towards = np.cos(turn) * towards + np.sin(turn) * axis[parts[11]]
    return np.cos(tilt) * up + np.sin(tilt) * towards


@given(st.integers(0, 10**6))
def test_the_words_lead_back_to_the_pose(seed):
    u = Streams(seed, [0]).normal(1, 3)[0, 0]
    u /= np.linalg.norm(u)
    meant = _read(poses.describe(u))
    assert np.degrees(np.arccos(np.clip(u @ meant, -1, 1))) < 1.5
