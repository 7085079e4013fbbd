"""The parts of the filters that scores alone do not show, against Kalman filters by hand and closed forms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from accelcal_cli.navigation.filter import FILTERS, PositionEstimates
from accelcal_cli.navigation.filters.reference import Reference
from accelcal_cli.navigation.filters.sitan import Sitan
from accelcal_cli.navigation.gaussian_sum import Bank, inflate, split_curved
from accelcal_cli.navigation.gravity_map import PRESETS, generate
from accelcal_cli.navigation.ins import InsGrade, cholesky, metres_per_radian
from accelcal_cli.navigation.marginal import Gaussian, MarginalFilter, TrackWindow, de_mc_generation
from accelcal_cli.navigation.noise import NoiseModel, eotvos, eotvos_slope, noise_models
from accelcal_cli.navigation.particle_filter import Cloud, normalise
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
    nobody = np.zeros(2, dtype=bool)
    found, _ = form.step(window, u, nobody, PositionEstimates.empty(scenario), Streams(5, range(2)))
    return found.root @ found.root.swapaxes(1, 2), u


def predicted(scenario, root, covariance, first=1):
    """Return the covariance after a window of Kalman predictions from root diag(covariance, I) root^T."""
    F, Q = scenario.steps(first, first + WINDOW), np.zeros((14, 14))
    Q[:12, :12] = step_noise(scenario.grade, scenario.period)
    S = np.eye(14)
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
    root = part * np.tile(cholesky(scenario.full_prior()), (scenario.runs, 1, 1))
    return Gaussian(np.zeros((scenario.runs, 14)), root)


def close(found, expected):
    found, expected = found[:, :12, :12], expected[:, :12, :12]  # bias and map error are not believed in
    sigma = np.sqrt(np.einsum("rii->ri", expected))
    size = sigma[:, :, None] * sigma[:, None, :]
    return np.abs(found - expected) <= 1e-6 * size


@pytest.mark.parametrize("inflation", [1.0, 1.3])
def test_a_window_that_shows_nothing_is_a_kalman_prediction_inflated(flat, inflation):
    """All weights are equal: the particles are kept, and their moments are those of the start."""
    form = MarginalFilter(50, 0, WINDOW, 1.0, inflation, 0.1)
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
    form = MarginalFilter(50, 0, WINDOW, 1.0, 1.0, 0.1)
    state = start(flat, part)
    found, u = carried_on(flat, form, state, flat.measured + off, first)
    moments = np.array([np.cov(cloud.T, bias=True) for cloud in u])
    expected = predicted(flat, state.root, moments, first) + (0.1 * flat.full_prior() if grows else 0.0)
    assert close(found, expected).all()


# The reference


def test_a_component_that_does_not_fit_grows_to_the_initial_error_at_most(flat):
    P = np.tile(np.diag(np.r_[200.0**2, 200.0**2, np.ones(12)]), (3, 1, 1))
    P[2, 0, 0] = 2100.0**2
    bank = Bank(np.array([0, 1, 1]), np.zeros((3, 14)), P, np.zeros(3), np.array([3.9, 4.1, 4.1]))
    evidence = np.zeros(2)
    found = inflate(bank, flat, 0.2, evidence)
    grown = 0.2 * flat.full_prior()
    np.testing.assert_allclose(found.P, P + np.array([0.0, 1.0, 0.0])[:, None, None] * grown, rtol=1e-12)
    np.testing.assert_array_equal(found.misfit, [3.9, 1.0, 4.1])
    np.testing.assert_allclose(evidence, [0.0, np.log(0.5 + 0.5 * np.exp(-20.0))])  # half of run 1 paid


def test_three_components_that_replace_one_have_its_mean_and_covariance(voyage):
    bank = Bank.start(voyage, 1)
    parts = split_curved(dataclasses.replace(voyage, noise=1e-3), bank, 0)
    assert len(parts.run) == 3 * voyage.runs
    for run in range(voyage.runs):
        own = parts.at(parts.run == run)
        weight = np.exp(own.log_weight)
        away = own.mean - bank.mean[run]
        assert weight.sum() == pytest.approx(1.0)
        np.testing.assert_allclose(weight @ away, 0.0, atol=1e-9)
        P = np.einsum("m,mij->ij", weight, own.P) + np.einsum("m,mi,mj->ij", weight, away, away)
        np.testing.assert_allclose(P, bank.P[run], rtol=1e-9, atol=1e-12)


def test_a_track_that_does_not_fit_widens_the_reference(voyage):
    """Fifty mGal off from an epoch on: no place of the map fits."""
    measured = voyage.measured.copy()
    measured[:, 120:] += 50.0
    spoiled = dataclasses.replace(voyage, measured=measured)
    size = {
        part: np.einsum("rkii->rk", Reference(recovery=part).run(spoiled, Streams(0, range(6))).covariance)
        for part in (0.0, 0.1)
    }
    np.testing.assert_array_equal(size[0.1][:, :120], size[0.0][:, :120])
    assert np.median(size[0.1][:, 160:]) > 4 * np.median(size[0.0][:, 160:])


# Baselines on textbook cases: a map that is a plane, where a Kalman filter of all errors is exact


@pytest.fixture(scope="module")
def plane():
    """Two runs over an even slope of 8 mGal/km to north and 3 to east, with a bias that is believed in."""
    field = generate(PRESETS["constant"], 0)
    rows, columns = np.mgrid[0 : field.values.shape[0], 0 : field.values.shape[1]].astype(float)
    tilted = dataclasses.replace(field, values=7.4 * rows + 2.6 * columns - 1500.0)
    scenario = simulate(tilted, PlannedVoyage(hours=2.4), InsGrade(), runs=range(2), seed=1, period=60.0)
    return scenario.under(NoiseModel(bias=5.0, map_error=2.0))


def kalman(scenario):
    """Return mean (R, K, 2) and covariance (R, K, 2, 2) of a Kalman filter by hand, on a map that is a plane."""
    means, covariances = [], []
    for r in range(scenario.runs):
        P, x = scenario.full_prior(), np.zeros(14)
        F = scenario.steps(0, scenario.epochs)[r]
        mean, covariance = [], []
        for k in range(scenario.epochs):
            latitude, longitude = scenario.ins.latitude[r, k], scenario.ins.longitude[r, k]
            metres = np.array(metres_per_radian(latitude))
            place = np.array([latitude, longitude]) - x[:2] / metres
            slope = np.array([v[0] for v in scenario.gravity_map.slope(*place)]) / metres
            h = np.r_[-slope, np.zeros(10), 1.0, 1.0]
            misfit = scenario.measured[r, k] - scenario.gravity_map.at(*place)[0] - x[12] - x[13]
            gain = P @ h / (h @ P @ h + scenario.noise**2)
            x, P = x + gain * misfit, P - np.outer(gain, h @ P)
            mean.append(x[:2])
            covariance.append(P[:2, :2])
            x, P = F[k] @ x, F[k] @ P @ F[k].T + np.diag(scenario.step_noise(k)[r])
        means.append(mean)
        covariances.append(covariance)
    return np.array(means), np.array(covariances)


@pytest.mark.parametrize(
    ("name", "settings", "part"),
    [
        ("sitan", {"recovery": 0.0}, 1e-3),
        ("reference", {"recovery": 0.0, "components": 1}, 1e-3),
        ("point-mass", {"nodes": 151, "recovery": 0.0}, 0.05),
        ("de-pf", {"particles": 1000, "inflation": 1.0}, 0.15),
        ("mpf", {"particles": 4000, "roughening": 0.5}, 0.25),
    ],
)
def test_where_the_map_is_a_plane_a_filter_is_the_kalman_filter(plane, name, settings, part):
    """At the last epoch: mean within a part of the sigma, sigma within that part."""
    mean, covariance = kalman(plane)
    form = from_mapping(FILTERS.get(name), settings, "test")
    found = form.track(plane.under(plane.model), Streams(1, range(2), Purpose.FILTER))
    sigma = np.sqrt(np.einsum("rii->ri", covariance[:, -1]))
    assert (np.abs(found.mean[:, -1] - mean[:, -1]) < part * sigma).all()
    np.testing.assert_allclose(np.sqrt(np.einsum("rii->ri", found.covariance[:, -1])), sigma, rtol=part)


# Noise


def test_the_filter_that_is_told_the_bias_explains_it(voyage):
    """Ten milligal: the nominal noise is given up for the bias, and the claims fit."""
    biased = dataclasses.replace(voyage, measured=voyage.measured + 10.0)
    models = noise_models(voyage.gravity_map, 10.0, 0.0, None, 5.0)
    told = Sitan().run(dataclasses.replace(biased, models=models), Streams(0, range(6)))
    deaf = Sitan(robust=False).run(biased, Streams(0, range(6)))
    assert np.median(told.disturbed[:, -1]) > 0.9
    assert score(voyage, told).nees.mean() < 9.0 < score(voyage, deaf).nees.mean()


def test_outliers_are_left_out(voyage):
    measured = voyage.measured.copy()
    measured[:, 200:220] += 60.0
    models = noise_models(voyage.gravity_map, 10.0, None, None, 5.0)
    spoiled, clean = (
        dataclasses.replace(voyage, measured=values, models=models) for values in (measured, voyage.measured)
    )
    there, here = (Sitan().run(each, Streams(0, range(6))) for each in (spoiled, clean))
    assert there.rejected[:, 200:220].mean() > 0.9
    assert here.rejected.mean() < 0.01
    assert score(voyage, there).north.mean() < 1.5 * score(voyage, here).north.mean()


def test_the_eotvos_effect_is_half_a_gal_per_hundred_metres_a_second_at_the_equator():
    """2 w v = 14.58 mGal per m/s eastward, less cos L elsewhere; over the pole v^2 / R alone."""
    zero = np.array(0.0)
    assert eotvos(zero, np.array(1.0), zero) == pytest.approx(14.58, abs=0.02)
    assert eotvos(np.array(np.pi / 3), np.array(1.0), zero) == pytest.approx(7.29, abs=0.03)
    slope = eotvos_slope(np.array(0.3), np.array(8.0), np.array(2.0))
    steps = [
        eotvos(np.array(0.3), np.array(8.0 + d), np.array(2.0 + e))
        - eotvos(np.array(0.3), np.array(8.0), np.array(2.0))
        for d, e in ((1e-3, 0.0), (0.0, 1e-3))
    ]
    np.testing.assert_allclose(slope * 1e-3, steps, rtol=1e-3)


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
    cloud, *_ = form.update(flat, Cloud.of(x.copy(), logs), 0, streams)
    after = normalise(cloud.log_weights)
    order = np.argsort(before, axis=1)
    sorted_before = np.take_along_axis(before, order, axis=1)
    assert (cloud.x != np.take_along_axis(x, order[..., None], axis=1)).any(axis=2)[:, :10].sum() > 10
    np.testing.assert_allclose(after[:, 10:], sorted_before[:, 10:], rtol=1e-9)
    np.testing.assert_allclose(after[:, :10].sum(axis=1), sorted_before[:, :10].sum(axis=1), rtol=1e-9)
