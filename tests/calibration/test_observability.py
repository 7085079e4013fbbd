"""Information, dilution of precision, verdict, and what they become in each gauge."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from simulated import DPSO, MEMS, dpso_box, loetters, rotation

from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.fit import firm
from accelcal_cli.calibration.observability import PARAMETERS, Observability, design, propagate
from accelcal_cli.calibration.problem import Box, pack
from accelcal_cli.sensor import poses
from accelcal_cli.sensor.model import ErrorModel, to_gauge

G = 9.8
NINE = ((0, 0), (1, 1), (2, 2), (1, 0), (2, 0), (2, 1))


def _of(u):
    return Observability.of(design(u).T @ design(u), len(u))


def _ring(count):
    angle = 2 * np.pi * np.arange(count) / count
    return np.stack([np.zeros(count), np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize(
    ("u", "misalignment", "scale", "bias"),
    [
        (poses.turns(), (0.995, 1.005), (0.4175, 0.4185), (0.3535, 0.3545)),
        (poses.faces_edges(), (1.655, 1.735), (0.605, 0.645), (0.555, 0.715)),
        (poses.edges(), (0.995, 1.005), (0.8655, 0.8665), (0.4995, 0.5005)),
        (poses.icosahedron(), (1.1175, 1.1185), (0.7065, 0.7075), (0.4995, 0.5005)),
    ],
    ids=["24 turns", "faces and edges", "edges", "icosahedron"],
)
def test_reference_dilutions(u, misalignment, scale, bias):
    seen = _of(u)
    assert seen.rank == 9
    assert seen.verdict == "good"
    for part, (low, high) in (
        (quality.MISALIGNMENT, misalignment),
        (quality.SCALE, scale),
        (quality.BIAS, bias),
    ):
        assert seen.dop[part].min() >= low
        assert seen.dop[part].max() <= high
    assert seen.worst == pytest.approx(seen.dop.max())


def _force_residual(E, bias, N, model):
    """e of a sensor whose K_A is (I + E) K_A0 and whose bias has moved by `bias`, m/s^2, along its axes."""
    K_A = (np.eye(3) + E) @ model.K_A
    D = model.D + np.diagonal(model.K) * bias
    f = (N - D) @ K_A.T
    return (G**2 - (f**2).sum(axis=1)) / (2 * G)


def _numeric_rows(model, u):
    """d e / d (g E, bias) by differences of the direct formula."""
    N, h, columns = model.output(G * u), 1e-6, []
    for p in range(9):
        E, bias = np.zeros((3, 3)), np.zeros(3)
        if p < 6:
            E[NINE[p]] = h / G
        else:
            bias[p - 6] = h
        change = _force_residual(E, bias, N, model) - _force_residual(-E, -bias, N, model)
        columns.append(change / (2 * h))
    return np.stack(columns, axis=1)


@given(st.integers(0, 10**6))
def test_information_from_compressed_readings_is_that_of_the_poses(seed):
    """J^T J of the compressed residuals against differences of the direct formula, for a poor sensor."""
    model = ErrorModel(MEMS.in_gauge("lower").K, MEMS.D)
    u = poses.fibonacci(17) @ rotation(seed)
    problem = loetters(model.output(G * u), G, Box(np.zeros((1, 9)), np.ones((1, 9))))
    got = problem.information(problem.coordinates(model.K[None], model.D[None]))[0]
    rows = _numeric_rows(model, u)
    np.testing.assert_allclose(got, rows.T @ rows, atol=1e-6 * np.abs(got).max())


def test_design_is_the_information_of_an_ideal_sensor():
    u = poses.fibonacci(20)
    rows = _numeric_rows(ErrorModel(3.0 * np.eye(3), np.zeros(3)), u)
    np.testing.assert_allclose(design(u), rows, atol=1e-8)


def test_dilution_depends_on_the_poses_alone():
    """Half the scale, another unit, another g: the same dilution of precision."""
    values = []
    for factor, g in ((1.0, 9.8), (100.0, 9.8), (1.0, 1.0)):
        model = ErrorModel(factor * np.eye(3), np.full(3, 0.1 * factor))
        problem = loetters(model.output(g * poses.turns()), g, Box(np.zeros((1, 9)), np.ones((1, 9))))
        x = problem.coordinates(model.K[None], model.D[None])
        values.append(Observability.of(problem.information(x)[0], 24).dop)
    np.testing.assert_allclose(values[1], values[0], rtol=1e-9)
    np.testing.assert_allclose(values[2], values[0], rtol=1e-9)
    np.testing.assert_allclose(values[0], _of(poses.turns()).dop, rtol=1e-9)


def test_more_poses_never_raise_a_dilution():
    u = np.concatenate([poses.icosahedron(), poses.fibonacci(10)])
    worse = _of(u[:12]).dop
    for count in range(13, 23):
        better = _of(u[:count]).dop
        assert (better <= worse + 1e-12).all()
        worse = better
    doubled = _of(np.concatenate([u, u])).dop
    np.testing.assert_allclose(doubled, _of(u).dop / np.sqrt(2), rtol=1e-9)


@pytest.mark.parametrize(
    ("worst", "verdict"),
    [
        (1.0, "good"),
        (9.99, "good"),
        (10.01, "weak"),
        (24.99, "weak"),
        (25.01, "undetermined"),
        (1000.0, "undetermined"),
    ],
)
def test_verdict_thresholds(worst, verdict):
    information = np.eye(9)
    information[4, 4] = worst**-2
    seen = Observability.of(information, 20)
    assert seen.rank == 9
    assert seen.worst == pytest.approx(worst)
    assert seen.verdict == verdict
    assert seen.above(10.0) == (["misalignment xz"] if worst > 10 else [])


def test_a_missing_rank_is_undetermined_and_named():
    information = np.eye(9)
    information[7, 7] = 0.0
    seen = Observability.of(information, 20)
    assert seen.rank == 8
    assert seen.verdict == "undetermined"
    assert seen.above(25.0) == ["bias y"]
    assert np.isinf(seen.dop[7])
    assert np.isfinite(np.delete(seen.dop, 7)).all()
    assert seen.in_words("The poses", ()) == ("The poses do not determine: bias y.",)
    assert seen.in_words("The poses", ("+x up", "-y up"))[-1] == "Add these poses: +x up; -y up."


def test_a_combination_that_is_missing_makes_its_parts_undetermined():
    """The sum of two parameters is known and their difference is not: neither has a dilution of precision."""
    information = np.eye(9)
    information[1, 1] = information[2, 2] = information[1, 2] = information[2, 1] = 1.0
    seen = Observability.of(information, 20)
    assert np.isinf(seen.dop[[1, 2]]).all()
    assert np.isfinite(np.delete(seen.dop, [1, 2])).all()


def test_words_for_a_weak_set():
    information = np.eye(9)
    information[4, 4], information[8, 8] = 1 / 12**2, 1 / 30**2
    lines = Observability.of(information, 20).in_words("The poses", ("+z up",))
    assert lines[0] == "The poses do not determine: bias z."
    assert lines[1] == "Weakly determined: misalignment xz."
    assert "+z up" in lines[2]
    assert Observability.of(np.eye(9), 20).in_words("The poses", ()) == ()


@pytest.mark.parametrize(
    ("u", "rank"),
    [(poses.faces(), 6), (np.repeat(poses.faces(), 2, axis=0), 6), (poses.fibonacci(8), 8), (_ring(24), 5)],
    ids=["faces", "faces twice", "eight", "ring"],
)
def test_poor_pose_sets_lack_rank(u, rank):
    seen = _of(u)
    assert seen.rank == rank
    assert seen.verdict == "undetermined"
    assert np.isinf(seen.worst)


def test_faces_alone_hide_the_misalignments():
    assert _of(poses.faces()).above(25.0) == list(PARAMETERS[3:6])


def test_no_poses_and_no_rank():
    seen = Observability.of(np.zeros((9, 9)), 0)
    assert seen.verdict == "undetermined"
    assert seen.rank == 0


def _covariance(seed):
    a = np.random.Generator(np.random.SFC64(seed)).normal(size=(9, 9))
    return 1e-6 * (a @ a.T + np.eye(9))


def _numeric_sigma(model, covariance, gauge):
    """One-sigma of K by differences: move K_A in gauge lower, convert to the gauge, propagate."""
    low, h, columns = model.in_gauge("lower"), 1e-6, []
    for p in range(6):
        ends = []
        for side in (1, -1):
            E = np.zeros((3, 3))
            E[NINE[p]] = side * h / G
            ends.append(to_gauge(low.K @ np.linalg.inv(np.eye(3) + E), gauge))
        columns.append(((ends[0] - ends[1]) / (2 * h)).ravel())
    chain = np.stack(columns, axis=1)
    sigma_D = np.diagonal(low.K) * np.sqrt(np.diagonal(covariance)[6:])
    return np.sqrt(np.einsum("ip,pq,iq->i", chain, covariance[:6, :6], chain)).reshape(3, 3), sigma_D


@pytest.mark.parametrize("gauge", ["lower", "upper", "symmetric"])
@given(seed=st.integers(0, 10**6))
def test_propagated_sigma_against_differences(gauge, seed):
    model, covariance = ErrorModel(MEMS.K @ rotation(seed), MEMS.D), _covariance(seed)
    shown, low = model.in_gauge(gauge), model.in_gauge("lower")
    sigma_K, sigma_D = propagate(shown.K, low.K, covariance, gauge, G)
    expected_K, expected_D = _numeric_sigma(model, covariance, gauge)
    np.testing.assert_allclose(sigma_K, expected_K, rtol=1e-5, atol=1e-8 * expected_K.max())
    np.testing.assert_allclose(sigma_D, expected_D, rtol=1e-12)


def test_sigma_in_gauge_full_is_given_for_what_is_observable():
    """The free rotation moves every entry of the matrix; only the bias does not know of it."""
    covariance = _covariance(1)
    low = DPSO.in_gauge("lower")
    sigma_K, sigma_D = propagate(DPSO.K, low.K, covariance, "full", G)
    assert np.isnan(sigma_K).all()
    _, expected_D = _numeric_sigma(DPSO, covariance, "symmetric")
    np.testing.assert_allclose(sigma_D, expected_D, rtol=1e-12)


def test_sigma_is_missing_where_the_covariance_is():
    """A parameter without variance leaves NaN on every entry it moves, and only there."""
    covariance = _covariance(2)
    covariance[3, :] = covariance[:, 3] = np.nan
    covariance[8, :] = covariance[:, 8] = np.nan
    K = np.diag([1.0, 1.1, 0.9])
    sigma_K, sigma_D = propagate(K, K, covariance, "lower", G)
    missing = np.isnan(sigma_K)
    assert missing[1, 0]
    assert missing.sum() == 1
    assert np.isnan(sigma_D).tolist() == [False, False, True]


def test_sigma_of_a_real_fit_is_what_repeated_noise_gives():
    """Propagated sigma against the spread of 400 fits with fresh noise, in every gauge."""
    from accelcal_cli.calibration.problem import Loetters, compress_each
    from accelcal_cli.optimization.algorithms.levenberg_marquardt import LevenbergMarquardt
    from accelcal_cli.optimization.minimize import minimize
    from accelcal_cli.rng import Streams

    runs, sigma, truth = 400, 1e-3, MEMS.in_gauge("lower")
    force = G * poses.icosahedron() @ rotation(4)
    outputs = MEMS.output(force + sigma * Streams(8, range(runs)).normal(12, 3))
    centre = np.repeat(pack(truth.K, truth.D, 9)[None], runs, axis=0)
    problem = Loetters(compress_each(outputs), G, Box(centre, np.full((runs, 9), 0.2)))
    x = minimize(problem, LevenbergMarquardt(), runs=runs, start=np.zeros((runs, 1, 9)), trace=False).x
    K, D = problem.parameters(x)
    one = problem.take(np.array([0]))
    information = one.information(one.coordinates(truth.K[None], truth.D[None]))[0]
    covariance = sigma**2 * np.linalg.inv(information)
    for gauge in ("lower", "upper", "symmetric"):
        sigma_K, sigma_D = propagate(to_gauge(truth.K, gauge), truth.K, covariance, gauge, G)
        np.testing.assert_allclose(to_gauge(K, gauge).std(axis=0), sigma_K, rtol=0.15, atol=1e-12)
        np.testing.assert_allclose(D.std(axis=0), sigma_D, rtol=0.15)


def test_the_papers_box_has_its_units():
    problem = loetters(DPSO.output(G * poses.turns()), G, dpso_box(9))
    assert problem.units[0].tolist() == [1e4] * 3 + [1e3] * 3 + [2e4] * 3


def test_a_sigma_holds_where_it_is_more_than_the_bend_of_the_valley():
    """An error of 0.1 x 30 m/s^2 along it bends by 3^2 / 20 = 0.45 m/s^2: firm from 4.5 times the noise on."""
    dop = np.array([30.0, 4.6, 4.4, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0])
    held = firm(np.array([dop, dop]), ["undetermined", "weak"], np.array([0.1, 0.1]), 10.0)
    assert held.tolist() == [[True, True] + [False] * 7, [True] * 9]


def test_no_sigma_is_firm_beside_a_direction_without_bound():
    dop = np.full((3, 9), 2.0)
    dop[:, 3] = np.inf
    assert not firm(dop, ["undetermined"] * 3, np.array([0.0, 0.1, np.nan]), 9.8).any()
