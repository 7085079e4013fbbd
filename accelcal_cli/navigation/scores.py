"""Scores of a filter's estimates: errors, consistency and lock of every run, against the true position.

Also the posterior Cramer-Rao bound of a scenario, below which no filter's mean square error can be [tichavsky1998]. The
system is linear except for the map, and the noise is Gaussian: the recursion is that of a Kalman filter whose
measurement matrix is the slope of the map at the true position.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.navigation.filter import PositionEstimates
from accelcal_cli.navigation.ins import metres_per_radian, process_noise
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.notices import Notice

SETTLED = 3600.0
"""Time from the filter's start from which errors count, s: hour 3 of a voyage whose filter starts at hour 2
[depf2015] section 4."""

ASTRAY = 0.1
"""A run whose error exceeds the initial one for more than this part of the time has lost lock."""

DIVERGED = 5.0
"""A run whose last error exceeds the initial one by more than this factor has diverged."""


@dataclass(frozen=True)
class Scores:
    """Scores of R runs over the epochs from an hour after the filter's start; NaN where the true position is not known.

    Attributes:
        error: estimated - true position error of the INS, m north and east, shape (R, K, 2).
        north, east, ins: mean squares of the error and of the INS alone, m^2, shape (R,).
        nees: mean normalised error squared, 2 when the covariance is right, shape (R,).
        sigma: root of the mean claimed variance, m, shape (R,).
        nis: mean normalised innovation squared of all epochs, 1 when innovations are as predicted, shape (R,).
        rejected: part of the measurements that were left out as outliers; disturbed: mean probability of the disturbed
            noise models; shape (R,).
        lost: error above the initial one at the end, or for a tenth of the time; diverged: far above it at the end.
    """

    error: Float
    north: Float
    east: Float
    ins: Float
    nees: Float
    sigma: Float
    nis: Float
    rejected: Float
    disturbed: Float
    lost: Bool
    diverged: Bool


def counted(scenario: Scenario) -> Bool:
    """Return which epochs count, shape (K,): from an hour after the first on, or all if the voyage ends before."""
    late: Bool = scenario.seconds - scenario.seconds[0] >= SETTLED
    return late if late.any() else np.ones_like(late)


def score(scenario: Scenario, estimates: PositionEstimates) -> Scores:
    """Return the scores of a filter's estimates."""
    late = counted(scenario)
    truth = np.full(estimates.mean.shape, np.nan) if scenario.error is None else scenario.error
    error = estimates.mean - truth
    square = np.square(error[:, late])
    ins = np.square(truth[:, late]).sum(axis=2).mean(axis=1)
    variance = np.einsum("rkii->rk", estimates.covariance[:, late]).mean(axis=1)
    blind = estimates.blind > 0.5 * scenario.epochs
    lost = diverged = ~np.isfinite(estimates.mean).all(axis=(1, 2)) | blind
    if scenario.error is not None:
        astray = ~(square.sum(axis=2) <= scenario.initial**2)
        lost = lost | astray[:, -1] | (astray.mean(axis=1) > ASTRAY)
        far = np.square(error[:, -1]).sum(axis=1)
        diverged = lost & ~(far <= (DIVERGED * scenario.initial) ** 2)
    measured = np.isfinite(estimates.nis)
    count = np.maximum(measured.sum(axis=1), 1)
    return Scores(
        error,
        square[..., 0].mean(axis=1),
        square[..., 1].mean(axis=1),
        ins,
        _nees(error[:, late], estimates.covariance[:, late]),
        np.sqrt(variance),
        np.where(measured, estimates.nis, 0.0).sum(axis=1) / count,
        estimates.rejected.sum(axis=1) / count,
        estimates.disturbed[:, late].mean(axis=1),
        lost,
        diverged,
    )


def _nees(error: Float, covariance: Float) -> Float:
    """Return the mean of e^T P^-1 e, shape (R,); a standard deviation below 1 mm counts as 1 mm."""
    a, b, c = covariance[..., 0, 0] + 1e-6, covariance[..., 0, 1], covariance[..., 1, 1] + 1e-6
    north, east = error[..., 0], error[..., 1]
    value: Float = ((c * north - 2.0 * b * east) * north + a * east**2) / (a * c - b * b)
    return np.asarray(value.mean(axis=1))


def bound(scenario: Scenario) -> Float:
    """Return the least variances of the position error north and east at every epoch, m^2, shape (K, 2).

    A measurement that is missing, or taken where the map has no value, gives no information.
    """
    true = scenario.true
    slope = np.stack(scenario.gravity_map.slope(true.latitude, true.longitude), axis=-1)
    slope /= np.stack(metres_per_radian(true.latitude), axis=-1)
    slope[np.isnan(slope).any(axis=1) | np.isnan(scenario.measured[0])] = 0.0
    F = replace(scenario, ins=true).transitions(0, scenario.epochs)
    Q = np.diag(process_noise(scenario.grade, scenario.period))
    P = scenario.prior
    out = np.empty((scenario.epochs, 2))
    for k, h in enumerate(-slope):
        gain = P[:, :2] @ h
        P = P - np.outer(gain, gain) / (h @ gain[:2] + scenario.noise**2)
        out[k] = P[0, 0], P[1, 1]
        P = F[k] @ P @ F[k].T + Q
    return out


CONFIDENCE, SLACK = 3.0, 0.1
"""Of the band of the mean NIS: sigma of chance, and what the approximations of a filter add to it."""

OUTLIERS, DOUBT = 0.01, 0.9
"""Parts of the measurements that may be left out, and of the time that a disturbed noise model may be the likelier."""


def nis_band(count: int) -> tuple[float, float]:
    """Return the band of the mean of `count` normalised innovations squared of a filter that is right."""
    half = SLACK + CONFIDENCE * (2.0 / max(count, 1)) ** 0.5
    return max(0.0, 1.0 - half), 1.0 + half


def judge(
    nis: float, rejected: float, disturbed: float, claimed: float, initial: float, count: int
) -> list[Notice]:
    """Return what innovations say against a filter's estimates, of a voyage whose true track nobody needs to know.

    Args:
        nis, rejected, disturbed: see `Scores`; claimed: sigma, m; initial: m; count: of the measurements.
    """
    band = nis_band(count)
    found = []
    check = "Check the map, the clock of the gravimeter and its unit."
    if not nis <= band[1]:
        text = f"Innovations do not fit: NIS is {nis:.3g}, expected {band[0]:.2f} to {band[1]:.2f}."
        found.append(Notice("nis", "warning", text, check))
    if rejected > OUTLIERS:
        text = f"{100.0 * rejected:.2g} % of the measurements were left out as outliers."
        found.append(Notice("outliers", "warning", text, check))
    if disturbed > DOUBT:
        text = "Gravity fits the map only with a bias of the gravimeter or an error of the map."
        found.append(Notice("disturbed", "note", text))
    if not claimed <= initial:
        text = f"The position is not fixed: claimed sigma is {claimed:.0f} m, initial error {initial:.0f} m."
        found.append(Notice("fix", "warning", text, "Use a map with more relief, or a longer voyage."))
    return found
