"""The parts of L-SHADE that its results alone do not show: ties, and the memory's last value."""

from __future__ import annotations

import dataclasses

import numpy as np
from known_problems import ShiftedSphere, Watched

from accelcal_cli.optimization.algorithms.shade_cma import ShadeCma
from accelcal_cli.rng import Streams

SETTINGS = ShadeCma(population=20, evaluations=5000, memory=3)


class Plateau(ShiftedSphere):
    """The same cost everywhere."""

    def cost(self, x):
        return np.ones(x.shape[:2])


def _one_step(problem):
    watched, rng = Watched(problem), Streams(3, [0])
    x = problem.lower + (problem.upper - problem.lower) * rng.uniform(20, 4)
    state = SETTINGS.init(watched, x, rng)
    watched.seen.points.clear()
    return state, SETTINGS.step(watched, state, rng), watched.seen.all()


def test_a_tie_moves_the_individual_and_teaches_nothing():
    before, after, trials = _one_step(Plateau())
    np.testing.assert_array_equal(after.x[0], trials)
    assert (trials != before.x[0]).any(axis=1).all()
    np.testing.assert_array_equal(after.weights, before.weights)
    np.testing.assert_array_equal(after.rates, before.rates)
    assert after.archived[0] == after.position[0] == 0


def test_a_gain_moves_teaches_and_fills_the_archive():
    problem = ShiftedSphere()
    before, after, trials = _one_step(problem)
    better = problem.cost(trials[None])[0] < before.fx[0]
    assert 0 < better.sum() < 20
    np.testing.assert_array_equal(after.x[0], np.where(better[:, None], trials, before.x[0]))
    assert after.archived[0] == better.sum()
    np.testing.assert_array_equal(after.archive[0, : better.sum()], before.x[0][better])
    assert after.position[0] == 1
    assert after.rates[0, 0] != 0.5


def test_a_memory_of_crossovers_that_are_all_zero_is_never_left():
    """[tanabe2014] algorithm 1: while other rates go on learning."""
    state, _, _ = _one_step(ShiftedSphere())
    state = dataclasses.replace(state, position=np.array([1]))
    F, CR = np.full((1, 20), 0.7), np.r_[np.zeros(10), np.full(10, 0.9)][None]
    gain = np.r_[np.ones(10), np.zeros(10)][None]  # of those at zero alone
    ended = SETTINGS._learn(state, F, CR, gain)
    np.testing.assert_allclose(ended.weights, [[0.5, 0.7, 0.5]])
    np.testing.assert_array_equal(ended.rates, [[0.5, np.nan, 0.5]])

    again = SETTINGS._learn(dataclasses.replace(ended, position=np.array([1])), F, CR, 1.0 - gain)
    assert np.isnan(again.rates[0, 1])
    other = SETTINGS._learn(ended, F, CR, 1.0 - gain)
    np.testing.assert_allclose(other.rates[0, 2], 0.9)

    entry = np.where(np.arange(20) < 10, 0.4, 0.9)[None]  # M_CR no. 1 for half of them, no. 2 for the others
    _, drawn = SETTINGS._draw(again, entry, np.full((1, 20), 0.5), Streams(1, [0]))
    assert (drawn[0, :10] == 0.0).all()
    assert (drawn[0, 10:] > 0.0).all()
