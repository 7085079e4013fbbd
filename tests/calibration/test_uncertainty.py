"""Two thousand calibrations of simulated readings: the stated intervals cover the truth as often as they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, t
from simulated import DPSO, MEMS, noise

from accelcal_cli.calibration import observability as quality
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.observability import propagate
from accelcal_cli.calibration.problem import Box, Loetters, compress_each, pack
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.algorithms.levenberg_marquardt import LevenbergMarquardt
from accelcal_cli.optimization.minimize import minimize
from accelcal_cli.optimization.optimizer import Status
from accelcal_cli.rng import Streams
from accelcal_cli.sensor import poses

G, RUNS, SIGMA = 9.8, 2000, 1e-3
TRUTH = DPSO.in_gauge("lower")


class Fits:
    """All fits at once: parameters, covariance, and the errors of the nine parameters in m/s^2."""

    def __init__(self, u):
        noise = Streams(11, range(RUNS)).normal(len(u), 3)
        outputs = DPSO.output(G * u + SIGMA * noise)
        centre = pack(TRUTH.K, TRUTH.D, 9) + 3000.0
        box = Box(np.repeat(centre[None], RUNS, axis=0), np.full((RUNS, 9), 3e4))
        problem = Loetters(compress_each(outputs), G, box)
        solver = LevenbergMarquardt()
        self.run = minimize(problem, solver, runs=RUNS, start=np.zeros((RUNS, 1, 9)), trace=False)
        self.K, self.D = problem.parameters(self.run.x)
        self.freedom = len(u) - 9
        self.s2 = self.run.cost / (4 * G**2) / self.freedom
        self.cofactor = np.linalg.inv(problem.information(self.run.x))
        self.errors = self._errors()

    def _errors(self):
        """What the truth is off the fit, in the fit's own nine parameters."""
        E = np.linalg.solve(TRUTH.K, self.K) - np.eye(3)  # K_A truth = (I + E) K_A fit
        bias = (TRUTH.D - self.D) / np.diagonal(self.K, axis1=1, axis2=2)
        return np.concatenate([G * E[:, [0, 1, 2, 1, 2, 2], [0, 1, 2, 0, 0, 1]], bias], axis=1)

    def sigma(self):
        return np.sqrt(self.s2[:, None] * np.diagonal(self.cofactor, axis1=1, axis2=2))


@pytest.fixture(scope="module")
def fits():
    return Fits(poses.turns())


def test_every_fit_converges(fits):
    assert set(fits.run.status) == {Status.CONVERGED}
    assert len(np.unique(fits.run.cost)) == RUNS


def test_intervals_of_95_percent_cover_the_truth(fits):
    half = t.ppf(0.975, fits.freedom) * fits.sigma()
    covered = (np.abs(fits.errors) <= half).mean(axis=0)
    assert covered.shape == (9,)
    assert (covered >= 0.93).all(), covered
    assert (covered <= 0.97).all(), covered


def test_intervals_of_other_levels_cover_as_often_too(fits):
    for level in (0.5, 0.8, 0.99):
        half = t.ppf(0.5 + level / 2, fits.freedom) * fits.sigma()
        covered = (np.abs(fits.errors) <= half).mean()
        assert covered == pytest.approx(level, abs=0.015)


def test_intervals_of_the_printed_parameters_cover_the_truth(fits):
    """K_a and D_a in gauge lower with the propagated sigma, which is what a user reads."""
    quantile, covered, below = t.ppf(0.975, fits.freedom), [], np.tril_indices(3)
    for K, D, s2, cofactor in zip(fits.K, fits.D, fits.s2, fits.cofactor, strict=True):
        sigma_K, sigma_D = propagate(K, K, s2 * cofactor, "lower", G)
        covered.append(
            np.concatenate(
                [
                    np.abs(K - TRUTH.K)[below] <= quantile * sigma_K[below],
                    np.abs(D - TRUTH.D) <= quantile * sigma_D,
                ]
            )
        )
    share = np.mean(covered, axis=0)
    assert (share >= 0.93).all(), share
    assert (share <= 0.97).all(), share


def test_parameter_variances_are_at_the_cramer_rao_bound(fits):
    rows = quality.design(poses.turns())
    bound = SIGMA**2 * np.diagonal(np.linalg.inv(rows.T @ rows))
    ratio = fits.errors.var(axis=0) / bound
    assert (np.abs(ratio - 1) <= 0.10).all(), ratio
    assert (np.abs(fits.errors.mean(axis=0)) <= 4 * np.sqrt(bound / RUNS)).all()


def test_covariances_are_those_of_the_bound(fits):
    rows = quality.design(poses.turns())
    bound = SIGMA**2 * np.linalg.inv(rows.T @ rows)
    got = np.cov(fits.errors.T)
    size = np.sqrt(np.outer(np.diagonal(bound), np.diagonal(bound)))
    assert (np.abs(got - bound) <= 0.12 * size).all()


def test_the_noise_is_estimated_without_bias(fits):
    assert fits.s2.mean() == pytest.approx(SIGMA**2, rel=0.03)
    scaled = fits.freedom * fits.s2 / SIGMA**2
    share = (scaled > chi2.ppf(0.95, fits.freedom)).mean()
    assert share == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize("robust", ["huber", "soft-l1"])
def test_sigma_of_a_robust_loss_is_the_scatter_of_its_estimates(robust):
    """200 calibrations from 60 poses; the dilution of precision stays that of the poses."""
    u, settings = poses.fibonacci(60), Settings(optimizer="levenberg-marquardt", g=G, robust=robust)
    lower, found, stated = np.tril_indices(3), [], []
    for seed in range(200):
        data = Readings.from_array(MEMS.output(G * u + noise(60, 1e-2, seed)))
        result = calibrate(data, settings)
        found.append(np.append(result.K_a[lower], result.D_a))
        stated.append(np.append(result.sigma.K_a[lower], result.sigma.D_a))
    ratio = np.sqrt(np.mean(np.square(stated), axis=0)) / np.std(found, axis=0)
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    plain = calibrate(data, replace(settings, robust="none"))
    assert result.dop.worst == pytest.approx(plain.dop.worst, rel=1e-3)


@pytest.mark.parametrize(("count", "verdict"), [(9, "weak"), (10, "good"), (11, "good")])
def test_the_scatter_gives_the_intervals_that_few_poses_cannot(count, verdict):
    """With one degree of freedom, too: rounding puts that at 0.9999."""
    u = np.concatenate([np.eye(3), -np.eye(3), [[1, 1, 0], [1, 0, 1], [0, 1, 1], [-1, 1, 0], [-1, 0, 1]]])
    u = (u / np.linalg.norm(u, axis=1, keepdims=True))[:count]
    noise = np.random.default_rng(1).normal(0, 1e-3, u.shape)
    output = 9.80665 * u * [1.01, 1.02, 0.99] + [0.1, 0.2, -0.1] + noise
    scatter = np.tile([0.01, 0.0103, 0.0098], (count, 1))
    result = calibrate(Readings.from_array(output, count=np.full(count, 100), scatter=scatter))
    assert result.verdict == verdict
    assert (result.interval.D_a < 2e-2).all()
    assert np.isfinite(result.interval.K_a).all()
    assert not any("no uncertainty" in reason for reason in result.reasons)
