"""The reference: a Gaussian sum of extended Kalman filters [alspach1972], which shows what is attainable.

The initial position error is covered by components, each a Kalman filter of all twelve errors, linearised at its own
mean. Their weights follow from their innovations; components of negligible weight are dropped, and those that have come
together are merged.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.navigation.ins import cholesky, metres_per_radian, process_noise
from accelcal_cli.navigation.particle_filter import CHUNK, FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

NEGLIGIBLE = 1e-6
"""Weight below which a component is dropped."""

COINCIDENT = 0.01
"""Squared Mahalanobis distance of the positions below which a lighter component is merged into the heaviest."""


REACH, WIDTH = 2.2, 0.35
"""Of the initial components: the outermost centres, in sigma of the prior, and the part of its variance in each."""

MEMORY, MISFIT = 30.0, 4.0
"""A component whose mean normalised innovation squared over MEMORY measurements, 1 when all is well, exceeds MISFIT
is wrong: its covariance is inflated."""


@dataclass(frozen=True)
class Bank:
    """All components of all runs, M in all.

    Attributes:
        run: which run each belongs to, shape (M,), ascending.
        mean: metric states, shape (M, 12); P: covariances, shape (M, 12, 12).
        log_weight: shape (M,).
        misfit: running mean of the normalised innovation squared, shape (M,).
    """

    run: Int
    mean: Float
    P: Float
    log_weight: Float
    misfit: Float

    def at(self, chosen: Int | Bool) -> Bank:
        """Return some of the components."""
        return Bank(*(getattr(self, f.name)[chosen] for f in fields(self)))


@FILTERS.register("reference")
@dataclass(frozen=True)
class Reference(Filter):
    """Gaussian sum of extended Kalman filters [alspach1972]; it draws no random number, and has one mode."""

    components: int = setting(7, "on either axis of the initial position error", low=1, high=50)
    recovery_inflation: float = setting(
        4.0,
        "of the covariance of a component whose innovations do not fit; 1: none",
        low=1.0,
        high=100.0,
    )

    def run(self, scenario: Scenario, streams: Streams) -> PositionEstimates:  # noqa: ARG002
        """Return the filter's estimates; see `Filter`."""
        estimates = PositionEstimates.empty(scenario)
        bank = self._start(scenario)
        Q = np.diag(process_noise(scenario.grade, scenario.period))
        used, F = 0, scenario.transitions(0, 0)
        for k in range(scenario.epochs):
            used += len(bank.run)
            bank, known = _update(scenario, bank, k)
            estimates.blind[:] += np.bincount(bank.run, known, scenario.runs) == 0
            estimates.mean[:, k], estimates.covariance[:, k] = _moments(bank, scenario.runs)
            bank = _inflate(_prune(bank, scenario.runs), scenario.initial, self.recovery_inflation)
            if k % CHUNK == 0:
                F = scenario.transitions(k, min(k + CHUNK, scenario.epochs))
                bank = _merge(bank)
            step = F[bank.run, k % CHUNK]
            mean = (step @ bank.mean[:, :, None])[:, :, 0]
            bank = replace(bank, mean=mean, P=step @ bank.P @ step.swapaxes(1, 2) + Q)
        return replace(estimates, lookups=used / (scenario.runs * scenario.epochs))

    def _start(self, scenario: Scenario) -> Bank:
        """Return components whose sum is the prior: their centres lie on a square of REACH sigma of the position."""
        count, runs, P = self.components, scenario.runs, scenario.prior
        middle = np.linspace(-REACH, REACH, count) if count > 1 else np.zeros(1)
        own = WIDTH if count > 1 else 1.0  # variance of a component over that of the prior
        axes = np.repeat(middle, count), np.tile(middle, count)
        centre = np.stack(axes, axis=1) @ cholesky(P[:2, :2]).T
        regression = np.linalg.solve(P[:2, :2], P[:2]).T
        variance = P - (1.0 - own) * regression @ P[:2]
        log_weight = -0.5 * np.square(axes).sum(axis=0) / (1.0 - WIDTH)
        return Bank(
            np.repeat(np.arange(runs), count * count),
            np.tile(centre @ regression.T, (runs, 1)),
            np.tile(variance, (runs * count * count, 1, 1)),
            np.tile(log_weight, runs),
            np.ones(runs * count * count),
        )


def _update(scenario: Scenario, bank: Bank, k: int) -> tuple[Bank, Bool]:
    """Return the bank after the measurement of epoch k, and which components are on the map."""
    latitude = scenario.ins.latitude[bank.run, k]
    meridian, parallel = metres_per_radian(latitude)
    place = (
        latitude - bank.mean[:, 0] / meridian,
        scenario.ins.longitude[bank.run, k] - bank.mean[:, 1] / parallel,
    )
    north, east = scenario.gravity_map.slope(*place)
    slope = np.stack([-north / meridian, -east / parallel], axis=1)
    misfit = scenario.measured[bank.run, k] - scenario.gravity_map.at(*place)
    known: Bool = ~(np.isnan(slope[:, 0]) | np.isnan(slope[:, 1]))
    slope[~known | np.isnan(misfit)] = 0.0
    misfit = np.nan_to_num(misfit)
    gain = (bank.P[:, :, :2] @ slope[:, :, None])[:, :, 0]
    variance = (gain[:, :2] * slope).sum(axis=1) + scenario.noise**2
    used = slope.any(axis=1)
    log_weight = bank.log_weight - np.where(used, 0.5 * misfit**2 / variance + 0.5 * np.log(variance), 0.0)
    mean = bank.mean + gain * (misfit / variance)[:, None]
    P = bank.P - gain[:, :, None] * gain[:, None, :] / variance[:, None, None]
    running = np.where(used, bank.misfit + (misfit**2 / variance - bank.misfit) / MEMORY, bank.misfit)
    return Bank(bank.run, mean, 0.5 * (P + P.swapaxes(1, 2)), log_weight, running), known


def _weights(bank: Bank, runs: int) -> Float:
    """Return weights that sum to 1 in each run, shape (M,)."""
    highest = np.full(runs, -np.inf)
    np.maximum.at(highest, bank.run, bank.log_weight)
    weight = np.exp(bank.log_weight - highest[bank.run])
    return np.asarray(weight / np.bincount(bank.run, weight, runs)[bank.run])


def _moments(bank: Bank, runs: int) -> tuple[Float, Float]:
    """Return mean (R, 2) and covariance (R, 2, 2) of the position error."""
    weight = _weights(bank, runs)
    mean: Float = np.stack(
        [np.bincount(bank.run, weight * bank.mean[:, axis], runs) for axis in (0, 1)], axis=1
    )
    away = bank.mean[:, :2] - mean[bank.run]
    spread = bank.P[:, :2, :2] + away[:, :, None] * away[:, None, :]
    parts = [np.bincount(bank.run, weight * spread[:, i, j], runs) for i in (0, 1) for j in (0, 1)]
    return mean, np.stack(parts, axis=1).reshape(runs, 2, 2).astype(float)


def _prune(bank: Bank, runs: int) -> Bank:
    """Return the bank without components of negligible weight."""
    keep = ~(_weights(bank, runs) <= NEGLIGIBLE)  # a diverged run has NaN weights, and stays so
    return bank if keep.all() else bank.at(keep)


def _inflate(bank: Bank, initial: float, inflation: float) -> Bank:
    """Return the bank with inflated components where innovations do not fit, unless as wide as the initial error."""
    wrong = (bank.misfit > MISFIT) & (bank.P[:, 0, 0] + bank.P[:, 1, 1] < initial**2)
    if not wrong.any():
        return bank
    return replace(
        bank,
        P=np.where(wrong[:, None, None], inflation * bank.P, bank.P),
        misfit=np.where(wrong, 1.0, bank.misfit),
    )


def _merge(bank: Bank) -> Bank:
    """Return the bank in which the heaviest component of each run has absorbed those that coincide with it."""
    keep = np.ones(len(bank.run), dtype=bool)
    log_weight = bank.log_weight.copy()
    edges = [0, *(np.flatnonzero(np.diff(bank.run)) + 1).tolist(), len(bank.run)]
    for first, last in pairwise(edges):
        own = slice(first, last)
        top = first + int(log_weight[own].argmax())
        away = bank.mean[own, :2] - bank.mean[top, :2]
        inverse = np.linalg.inv(bank.P[top, :2, :2])
        near = ((away @ inverse) * away).sum(axis=1) < COINCIDENT
        log_weight[top] = np.logaddexp.reduce(log_weight[own][near])
        keep[own] = ~near
        keep[top] = True
    return replace(bank, log_weight=log_weight).at(keep)
