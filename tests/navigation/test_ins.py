"""The Earth, the error model, the field and the bound against independent truths."""

from __future__ import annotations

import dataclasses

import boule
import numpy as np
import pytest
import scipy.linalg

from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.navigation import ins as earth
from accelcal_cli.navigation.gravity_map import PRESETS, GravityMap, generate
from accelcal_cli.navigation.ins import InsGrade, Motion, discretise, dynamics, to_metric
from accelcal_cli.navigation.scenario import simulate
from accelcal_cli.navigation.scores import bound, counted
from accelcal_cli.navigation.voyage import PlannedVoyage, aligned_covariance


def at_rest(latitude: float) -> Motion:
    return Motion(np.array(np.radians(latitude)), *[np.array(0.0)] * 4)


def test_normal_gravity_is_that_of_wgs84():
    for latitude in (0.0, 20.2, 45.0, 90.0):
        expected = boule.WGS84.normal_gravity((0.0, latitude, 0.0)) * 1e-5
        assert earth.somigliana_gravity(np.array(np.radians(latitude))) == pytest.approx(expected, rel=1e-9)


def test_radii_at_equator_and_pole():
    a, e2 = earth.EQUATORIAL_RADIUS, earth.ECCENTRICITY_SQUARED
    meridian, prime = earth.radii(np.array([0.0, np.pi / 2]))
    np.testing.assert_allclose(meridian, [a * (1 - e2), a / np.sqrt(1 - e2)])
    np.testing.assert_allclose(prime, [a, a / np.sqrt(1 - e2)])


@pytest.mark.parametrize("latitude", [20.2, 45.0, 60.0])
def test_the_eigen_periods_are_earth_rate_and_schuler_split_by_foucault(latitude):
    rates = np.linalg.eigvals(dynamics(at_rest(latitude))[:7, :7]).imag
    day, slow, fast = 2 * np.pi / np.sort(rates[rates > 1e-8])
    assert day == pytest.approx(2 * np.pi / earth.EARTH_RATE, rel=0.002)  # 23.93 h
    radius, gravity = earth.EQUATORIAL_RADIUS, 9.79
    schuler = np.sqrt(gravity / radius)
    foucault = earth.EARTH_RATE * np.sin(np.radians(latitude))
    assert 2 * np.pi / slow == pytest.approx(schuler - foucault, rel=0.005)
    assert 2 * np.pi / fast == pytest.approx(schuler + foucault, rel=0.005)
    assert 0.5 * (slow + fast) / 60 == pytest.approx(84.4, abs=0.8)


@pytest.mark.parametrize("step", [1.0, 10.0, 60.0, 600.0])
def test_the_discretisation_is_the_matrix_exponential(step):
    motion = Motion(*(np.array([v]) for v in (0.4, 7.5, -2.7, 0.1, -0.1)))
    A = dynamics(motion)
    np.testing.assert_allclose(discretise(A, step)[0], scipy.linalg.expm(A[0] * step), atol=1e-9, rtol=1e-9)


def test_metric_states_are_metres():
    motion = Motion(*(np.array([v]) for v in (0.4, 7.5, -2.7, 0.0, 0.0)))
    F = discretise(dynamics(motion), 10.0)
    latitude = np.array([0.4])
    M = to_metric(F, latitude, latitude)[0]
    scale = np.array([v[0] for v in earth.metres_per_radian(latitude)] + [1.0] * 10)
    np.testing.assert_allclose(M, F[0] * scale[:, None] / scale[None, :], atol=1e-15)
    assert M[0, 3] == pytest.approx(10.0, rel=1e-3)  # a metre a second north for ten seconds


def test_the_interpolation_is_exact_at_nodes_and_for_bilinear_fields():
    rows, columns = np.mgrid[0:5, 0:7].astype(float)
    grid = GravityMap(0.3, 1.9, 0.01, 0.02, 3.0 + 2.0 * rows - columns + 0.5 * rows * columns)
    latitude, longitude = 0.3 + 0.01 * rows, 1.9 + 0.02 * columns
    inner = np.s_[:-1, :-1]
    np.testing.assert_allclose(grid.at(latitude, longitude)[inner], grid.values[inner], atol=1e-12)
    i, j = np.random.default_rng(0).uniform(0, 4, 50), np.random.default_rng(1).uniform(0, 6, 50)
    place = 0.3 + 0.01 * i, 1.9 + 0.02 * j
    np.testing.assert_allclose(grid.at(*place), 3.0 + 2.0 * i - j + 0.5 * i * j)
    north, east = grid.slope(*place)
    np.testing.assert_allclose(north, (2.0 + 0.5 * j) / 0.01)
    np.testing.assert_allclose(east, (-1.0 + 0.5 * i) / 0.02)


def test_outside_and_beside_a_hole_there_is_no_value():
    values = np.ones((4, 4))
    values[0, 0] = np.nan
    grid = GravityMap(0.0, 0.0, 1.0, 1.0, values)
    found = grid.at(
        np.array([-0.1, 3.1, 1.5, 1.5, 0.5, 1.5, np.nan]), np.array([1.5, 1.5, -9, 99, 0.5, 1.5, 1.0])
    )
    assert np.isnan(found).tolist() == [True, True, True, True, True, False, True]


def statistics(field):
    """Sigma (mGal), rms slope (mGal/km) and mean step over 1' of latitude (mGal) of a map."""
    km = 6371.0
    north = np.diff(field.values, axis=0) / (field.step_north * km)
    east = np.diff(field.values, axis=1) / (field.step_east * km * np.cos(0.5 * (field.south + field.north)))
    stride = max(1, round(np.radians(1.0 / 60.0) / field.step_north))
    return {
        "sigma": np.std(field.values),
        "slope": np.sqrt(0.5 * (np.mean(north**2) + np.mean(east**2))),
        "step": np.mean(np.abs(field.values[stride:] - field.values[:-stride])),
    }


@pytest.mark.parametrize(("name", "step"), [("rough", 6.3), ("moderate", 2.15)])
def test_the_field_has_the_statistics_that_are_told(name, step):
    drawn = [statistics(generate(PRESETS[name], seed)) for seed in range(3)]
    preset = PRESETS[name]
    mean = {key: np.mean([s[key] for s in drawn]) for key in drawn[0]}
    assert mean["sigma"] == pytest.approx(preset.sigma, rel=0.15)
    assert mean["step"] == pytest.approx(step, rel=0.15)
    assert mean["slope"] == pytest.approx(preset.sigma / (np.sqrt(3) * preset.distance), rel=0.15)


PAPERS = PlannedVoyage(drift=(1000.0, 1700.0))
"""The paper's INS is 1260 m and 471 m off when the filter starts."""


def test_a_tied_ins_drifts_as_its_plan_states(rough):
    found = simulate(rough, PAPERS, InsGrade(), runs=range(6), seed=1, period=30.0, prior="tied")
    start = np.hypot(*found.error[:, 0].T)
    assert ((start > 990) & (start < 1710)).all()
    later = np.sqrt(np.square(found.error[:, counted(found)]).sum(axis=2).mean())
    assert 2000 < later < 12000


def test_the_drift_needs_a_fitting_ins(rough):
    with pytest.raises(DataError, match="drifts between"):
        simulate(rough, PAPERS, InsGrade(1e-3, 1e-6), runs=range(1), seed=0, prior="tied")


@pytest.mark.parametrize("prior", ["independent", "tied"])
@pytest.mark.parametrize("ins", [InsGrade(), InsGrade(gyro=0.0, walk=0.01)])
def test_errors_are_drawn_from_the_prior_that_the_filters_are_told(rough, prior, ins):
    """Position at the start: the mean of z' P^-1 z over 300 draws is 2 to within four sigma of that mean."""
    plan = PlannedVoyage(hours=2.1, filtered=2.0)
    found = simulate(rough, plan, ins, runs=range(300), seed=3, period=60.0, prior=prior)
    error, P = found.error[:, 0], found.prior[:2, :2]
    assert np.einsum("ri,ij,rj->r", error, np.linalg.inv(P), error).mean() == pytest.approx(2.0, abs=0.47)
    last = found.error[:, -1]  # six minutes on, where velocities count
    F = dataclasses.replace(found, ins=found.true).transitions(0, found.epochs)
    Q = np.diag(earth.process_noise(ins, found.period))
    P = found.prior
    for k in range(found.epochs - 1):
        P = F[k] @ P @ F[k].T + Q
    square = np.einsum("ri,ij,rj->r", last, np.linalg.inv(P[:2, :2]), last)
    assert square.mean() == pytest.approx(2.0, abs=0.47)


def test_a_tied_prior_ties_tilts_to_biases():
    P = aligned_covariance(PlannedVoyage(hours=2.1, filtered=0.0), InsGrade())
    np.testing.assert_allclose(P[5, 7] / np.sqrt(P[5, 5] * P[7, 7]), 1.0, rtol=1e-6)
    assert np.linalg.matrix_rank(P[4:, 4:] / np.sqrt(np.outer(P.diagonal(), P.diagonal()))[4:, 4:]) == 5


def test_a_random_walk_of_the_gyros_is_white_noise_of_the_attitude():
    white = InsGrade(gyro=0.0, walk=0.01, noise=0.0).white()
    np.testing.assert_allclose(np.degrees(white[2:]) * 60.0, 0.01)  # degrees in an hour: 3600 s, root 60
    assert (white[:2] == 0).all()


def test_the_voyage_turns_and_stays_on_its_speed():
    route = PlannedVoyage().trajectory()
    meridian, parallel = earth.metres_per_radian(route.latitude)
    speed = np.hypot(np.gradient(route.latitude) * meridian, np.gradient(route.longitude) * parallel)
    np.testing.assert_allclose(speed[5:-5], 8.0, rtol=1e-3)
    before, after = (np.degrees(np.arctan2(route.east[k], route.north[k])) for k in (0, -1))
    assert after - before == pytest.approx(-90.0)


def test_a_plan_out_of_range_is_refused():
    with pytest.raises(ConfigError, match="filtered"):
        PlannedVoyage(hours=1.0)
    with pytest.raises(ConfigError, match="accelerometer"):
        InsGrade(accelerometer=-1.0)


def test_the_bound_falls_with_information(voyage, rough):
    least = bound(voyage)
    late = counted(voyage)
    assert 50 < np.sqrt(least[late].sum(axis=1).mean()) < 250
    flat = simulate(
        generate(PRESETS["constant"], 0), PlannedVoyage(), InsGrade(), runs=range(1), seed=1, period=30.0
    )
    assert np.sqrt(bound(flat)[-1].sum()) > 3000  # nothing to see: the bound is the INS itself
    louder = simulate(rough, PlannedVoyage(), InsGrade(), runs=range(1), seed=1, period=30.0, noise=5.0)
    assert (bound(louder)[late].sum(axis=1) > least[late].sum(axis=1)).all()
