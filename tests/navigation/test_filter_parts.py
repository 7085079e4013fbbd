"""The parts of the filters that scores alone do not show, against Kalman filters by hand and closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from accelcal_cli.navigation.filters.reference import Bank, Reference, _inflate
from accelcal_cli.navigation.gravity_map import PRESETS, generate
from accelcal_cli.navigation.ins import InsGrade, metres_per_radian
from accelcal_cli.navigation.marginal import Gaussian, MarginalFilter, TrackWindow, de_mc_generation
from accelcal_cli.navigation.particle_filter import FILTERS, Cloud, PositionEstimates, normalise
from accelcal_cli.navigation.scenario import simulate
from accelcal_cli.navigation.scores import bound, score
from accelcal_cli.navigation.voyage import PlannedVoyage
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.schema import from_mapping

WINDOW = 5


def step_noise(grade, period):
    """Q by hand: white noise of velocity, tilt and azimuth over a step, none of position and biases."""
    return np.diag(np.r_[0.0, 0.0, grade.white() ** 2 * period, np.zeros(5)])


@pytest.fixture(scope="module")
def flat():
    """Two runs where the map tells nothing, a measurement every 30 s."""
    field = generate(PRESETS["constant"], 0)
    return simulate(field, PlannedVoyage(hours=2.5), InsGrade(), runs=range(2), seed=1, period=30.0)


# The bound


def test_the_bound_is_the_covariance_of_a_kalman_filter_on_the_true_track(voyage):
    """In the information form, with the slope of the map from differences of its values, 1 cm to either side."""
    true, values = voyage.true, voyage.gravity_map.at
    scale = np.stack(metres_per_radian(true.latitude), axis=1)
    north, east = (0.01 / scale).T
    slope = (
        np.stack(
            [
                values(true.latitude + north, true.longitude) - values(true.latitude - north, true.longitude),
                values(true.latitude, true.longitude + east) - values(true.latitude, true.longitude - east),
            ],
            axis=1,
        )
        / 0.02
    )
    F = dataclasses.replace(voyage, ins=true).transitions(0, voyage.epochs)
    Q, P = step_noise(voyage.grade, voyage.period), voyage.prior
    expected = np.empty((voyage.epochs, 2))
    for k in range(voyage.epochs):
        h = np.r_[-slope[k], np.zeros(10)]
        scaling = np.sqrt(np.diagonal(P))  # states differ by ten powers of ten
        information = np.linalg.inv(P / np.outer(scaling, scaling))
        seen = information + np.outer(h * scaling, h * scaling) / voyage.noise**2
        P = np.linalg.inv(seen) * np.outer(scaling, scaling)
        expected[k] = P[0, 0], P[1, 1]
        P = F[k] @ P @ F[k].T + Q
    found = bound(voyage)
    np.testing.assert_allclose(found, expected, rtol=1e-6)


# The marginalised filter


def carried_on(scenario, form, state, measured=None, first=1):
    """Return the covariance at the next window's start, the particles at its first, and the filter's scenario."""
    if measured is not None:
        scenario = dataclasses.replace(scenario, measured=measured)
    u = Streams(4, range(2)).normal(form.particles, 2)
    window = TrackWindow.predict(scenario, state, first, first + WINDOW)
    found, _ = form.step(window, u, PositionEstimates.empty(scenario), Streams(5, range(2)))
    return found.root @ found.root.swapaxes(1, 2), u


def predicted(scenario, root, covariance, first=1):
    """Return the covariance after a window of Kalman predictions from root diag(covariance, I) root^T."""
    F, Q = scenario.transitions(first, first + WINDOW), step_noise(scenario.grade, scenario.period)
    S = np.eye(12)
    out = []
    for r in range(scenario.runs):
        S[:2, :2] = covariance[r]
        P = root[r] @ S @ root[r].T
        for w in range(WINDOW):
            P = F[r, w] @ P @ F[r, w].T + Q
        out.append(P)
    return np.array(out)


def start(scenario, part):
    """A Gaussian without mean, `part` of the initial sigma wide."""
    root = part * np.tile(np.linalg.cholesky(scenario.prior), (scenario.runs, 1, 1))
    return Gaussian(np.zeros((scenario.runs, 12)), root)


def close(found, expected):
    sigma = np.sqrt(np.einsum("rii->ri", expected))
    size = sigma[:, :, None] * sigma[:, None, :]
    return np.abs(found - expected) <= 1e-6 * size


@pytest.mark.parametrize("inflation", [1.0, 1.3])
def test_a_window_that_shows_nothing_is_a_kalman_prediction_inflated(flat, inflation):
    """All weights are equal: the particles are kept, and their moments are those of the start."""
    form = MarginalFilter(50, 0, WINDOW, 1.0, inflation, 4.0)
    state = start(flat, 0.5)
    found, u = carried_on(flat, form, state)
    moments = np.array([np.cov(cloud.T, bias=True) for cloud in u])
    assert close(found, predicted(flat, state.root, inflation * moments)).all()


@pytest.mark.parametrize(
    ("part", "first", "off", "grows"),
    [
        (0.5, 1, 10.0, True),  # ten sigma off at every place
        (0.5, 1, 0.0, False),
        (0.5, 0, 10.0, False),  # the first window covers all there is
        (2.0, 1, 10.0, False),  # as wide as the initial square already
    ],
)
def test_a_window_that_nothing_explains_widens_the_whole_covariance(flat, part, first, off, grows):
    form = MarginalFilter(50, 0, WINDOW, 1.0, 1.0, 4.0)
    state = start(flat, part)
    found, u = carried_on(flat, form, state, flat.measured + off, first)
    moments = np.array([np.cov(cloud.T, bias=True) for cloud in u])
    expected = predicted(flat, state.root, moments, first) * (4.0 if grows else 1.0)
    assert close(found, expected).all()


# The reference


def test_a_component_that_does_not_fit_grows_to_the_initial_error_at_most():
    P = np.tile(np.diag(np.r_[200.0**2, 200.0**2, np.ones(10)]), (3, 1, 1))
    P[2, 0, 0] = 2100.0**2
    bank = Bank(np.zeros(3, int), np.zeros((3, 12)), P, np.zeros(3), np.array([3.9, 4.1, 4.1]))
    found = _inflate(bank, 2000.0, 2.5)
    np.testing.assert_array_equal(found.P, P * np.array([1.0, 2.5, 1.0])[:, None, None])
    np.testing.assert_array_equal(found.misfit, [3.9, 1.0, 4.1])


def test_a_track_that_does_not_fit_widens_the_reference(voyage):
    """Fifty mGal off from an epoch on: no place of the map fits."""
    measured = voyage.measured.copy()
    measured[:, 120:] += 50.0
    spoiled = dataclasses.replace(voyage, measured=measured)
    size = {
        growth: np.einsum(
            "rkii->rk", Reference(recovery_inflation=growth).run(spoiled, Streams(0, range(6))).covariance
        )
        for growth in (1.0, 4.0)
    }
    np.testing.assert_array_equal(size[4.0][:, :120], size[1.0][:, :120])
    assert np.median(size[4.0][:, 160:]) > 4 * np.median(size[1.0][:, 160:])


def test_estimates_that_are_no_numbers_have_diverged(voyage):
    nowhere = PositionEstimates.empty(voyage)
    nowhere.mean[:2] = np.nan
    found = score(voyage, nowhere)
    assert found.diverged[:2].all()
    assert found.lost[:2].all()


# The evolution


def test_a_metropolis_move_leaves_the_line_of_the_cloud_by_a_thousandth_of_sigma():
    x = np.zeros((1, 2000, 2))
    x[0, :, 0] = 50.0 * Streams(2, [0]).normal(2000, 1)[0, :, 0]
    moved, _ = de_mc_generation(
        x, np.zeros((1, 2000)), lambda v: np.zeros(v.shape[:2]), Streams(3, [0]), 50.0
    )
    first = moved[0, :1000, 1]  # the other half takes its differences from these
    assert np.std(first) == pytest.approx(0.05, rel=0.07)
    assert abs(np.mean(first)) < 0.006


@pytest.mark.parametrize("name", ["de-pf", "pso-pf", "apo-pf"])
def test_particles_that_move_keep_the_weight_that_they_had_together(flat, name):
    """Where the map shows nothing an evolution must not make a place more likely."""
    settings = {"particles": 50, "strategy": "safe"} if name == "de-pf" else {"particles": 50}
    form = from_mapping(FILTERS.get(name), settings, "test")
    streams = Streams(6, range(2), Purpose.FILTER)
    logs = 3.0 * Streams(7, range(2)).normal(50, 1)[..., 0]
    logs -= logs.max(axis=1, keepdims=True)  # as the filter carries them on
    before = np.exp(logs) / np.exp(logs).sum(axis=1, keepdims=True)
    x = 300.0 * streams.normal(50, 2)
    cloud, *_ = form.update(flat, Cloud(x.copy(), logs), 0, streams)
    after = normalise(cloud.log_weights)
    order = np.argsort(before, axis=1)
    sorted_before = np.take_along_axis(before, order, axis=1)
    assert (cloud.x != np.take_along_axis(x, order[..., None], axis=1)).any(axis=2)[:, :10].sum() > 10
    np.testing.assert_allclose(after[:, 10:], sorted_before[:, 10:], rtol=1e-9)
    np.testing.assert_allclose(after[:, :10].sum(axis=1), sorted_before[:, :10].sum(axis=1), rtol=1e-9)
