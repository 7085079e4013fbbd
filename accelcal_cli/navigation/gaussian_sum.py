"""Banks of extended Kalman filters of all fourteen errors, each linearised at its own mean [alspach1972].

Their weights follow from their innovations. Components of negligible weight are dropped, those that have come together
are merged, and one over whose width the map curves is split [faubel2009].
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.navigation.filter import OUTLIER, PositionEstimates
from accelcal_cli.navigation.ins import cholesky, metres_per_radian
from accelcal_cli.navigation.noise import EXTRA
from accelcal_cli.navigation.particle_filter import CHUNK
from accelcal_cli.navigation.scenario import Scenario

NEGLIGIBLE = 1e-6
"""Weight below which a component is dropped."""

COINCIDENT = 0.01
"""Squared Mahalanobis distance of the positions below which a lighter component is merged into the heaviest."""

REACH, WIDTH = 2.2, 0.35
"""Of the initial components: the outermost centres, in sigma of the prior, and the part of its variance in each."""

MEMORY, MISFIT = 30.0, 4.0
"""A component whose mean normalised innovation squared over MEMORY measurements, 1 when all is well, exceeds MISFIT
is wrong: part of the prior is added to its covariance."""

RECOVERY_COST = 20.0
"""What that takes from the logarithm of its weight: with a noise model that is right it hardly happens."""

PATIENCE = 1200.0
"""Outliers count as misfits that slowly, s: ten minutes of them are an outage, half an hour a wrong position."""

CURVED, LIMIT, OFTEN = 1.0, 150, 10
"""A component is split when at one sigma of its position the map is off its tangent by CURVED sigma of the gravimeter,
as long as a run has fewer than LIMIT components. That is looked at every OFTEN epochs, and at each of the first."""

SIDE, SHIFT = 0.25, 1.1
"""Of the outer two of three components that replace one: weight, and centre in sigma; the variance is kept."""


@dataclass(frozen=True)
class Bank:
    """All components of all runs, M in all.

    Attributes:
        run: which run each belongs to, shape (M,), ascending.
        mean: all errors, shape (M, 14); P: covariances, shape (M, 14, 14).
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

    @classmethod
    def start(cls, scenario: Scenario, count: int) -> Bank:
        """Return count x count components whose sum is the prior: their centres lie on a square of the position."""
        runs, P = scenario.runs, scenario.full_prior()
        middle = np.linspace(-REACH, REACH, count) if count > 1 else np.zeros(1)
        own = WIDTH if count > 1 else 1.0
        axes = np.stack([np.repeat(middle, count), np.tile(middle, count)])
        regression = np.linalg.solve(P[:2, :2], P[:2]).T
        variance = P - (1.0 - own) * regression @ P[:2]
        log_weight = -0.5 * np.square(axes).sum(axis=0) / (1.0 - WIDTH)
        return cls(
            np.repeat(np.arange(runs), count * count),
            np.tile(axes.T @ cholesky(P[:2, :2]).T @ regression.T, (runs, 1)),
            np.tile(variance, (runs * count * count, 1, 1)),
            np.tile(log_weight, runs),
            np.ones(runs * count * count),
        )


def run_bank(
    scenario: Scenario, components: int, recovery: float, split: bool, stochastic: bool = False
) -> PositionEstimates:
    """Return the estimates of a bank.

    Args:
        scenario: under one noise model.
        components: on either axis of the initial position error.
        recovery: part of the prior that is added to a component whose innovations do not fit.
        split: whether components over which the map curves are split.
        stochastic: whether the slope of the map is fitted over the width of a component instead of taken at its mean.
    """
    estimates = PositionEstimates.empty(scenario)
    bank = Bank.start(scenario, components)
    used, F = 0, scenario.steps(0, 0)
    for k in range(scenario.epochs):
        if split and (k < OFTEN or k % OFTEN == 0):
            used += 3 * len(bank.run)
            bank = split_curved(scenario, bank, k)
        used += len(bank.run) * (FIT if stochastic else 1)
        bank, known = update(scenario, bank, k, estimates, stochastic)
        estimates.blind[:] += np.bincount(bank.run, known, scenario.runs) == 0
        estimates.mean[:, k], estimates.covariance[:, k] = moments(bank, scenario.runs)
        bank = inflate(prune(bank, scenario.runs), scenario, recovery, estimates.evidence[:, k])
        if k % CHUNK == 0:
            F = scenario.steps(k, min(k + CHUNK, scenario.epochs))
            bank = merge(bank)
        step = F[bank.run, k % CHUNK]
        mean = (step @ bank.mean[:, :, None])[:, :, 0]
        P = step @ bank.P @ step.swapaxes(1, 2)
        diagonal = range(P.shape[1])
        P[:, diagonal, diagonal] += scenario.step_noise(k)[bank.run]
        bank = replace(bank, mean=mean, P=P)
    return replace(estimates, lookups=used / (scenario.runs * scenario.epochs))


FIT = 9
"""Look-ups of a stochastic linearisation: a square of three by three places, SHIFT sigma apart."""


def _linearise(scenario: Scenario, bank: Bank, k: int, stochastic: bool) -> tuple[Float, Float, Float]:
    """Return anomaly (M,), its slope by the position error, (M, 2), and variance that the plane leaves, (M,)."""
    latitude, longitude = scenario.ins.latitude[bank.run, k], scenario.ins.longitude[bank.run, k]
    meridian, parallel = metres_per_radian(latitude)
    grid = scenario.gravity_map
    if not stochastic:
        place = latitude - bank.mean[:, 0] / meridian, longitude - bank.mean[:, 1] / parallel
        north, east = grid.slope(*place)
        return (
            grid.at(*place),
            np.stack([-north / meridian, -east / parallel], axis=1),
            np.zeros(len(latitude)),
        )
    nodes = SHIFT * np.stack([np.repeat([-1.0, 0.0, 1.0], 3), np.tile([-1.0, 0.0, 1.0], 3)])
    root = cholesky(bank.P[:, :2, :2])
    away = (root @ nodes) + bank.mean[:, :2, None]
    values = grid.at(
        latitude[:, None] - away[:, 0] / meridian[:, None],
        longitude[:, None] - away[:, 1] / parallel[:, None],
    )
    middle = values.mean(axis=1)
    by = (values[:, None] * nodes).sum(axis=2) / np.square(nodes).sum(
        axis=1
    )  # the nodes are orthogonal: a least-squares plane
    left = values - middle[:, None] - (by[:, :, None] * nodes).sum(axis=1)
    slope = np.linalg.solve(root.swapaxes(1, 2), by[:, :, None])[:, :, 0]
    return middle, slope, np.square(left).mean(axis=1)


def update(
    scenario: Scenario, bank: Bank, k: int, estimates: PositionEstimates, stochastic: bool = False
) -> tuple[Bank, Bool]:
    """Return the bank after the measurement of epoch k, and which components are on the map; note the innovations."""
    anomaly, by_position, left = _linearise(scenario, bank, k, stochastic)
    slope = np.zeros(bank.mean.shape)
    slope[:, :2], slope[:, 2:4], slope[:, -EXTRA:] = by_position, scenario.coupling[bank.run, k], 1.0
    beside = (slope[:, 2:] * bank.mean[:, 2:]).sum(axis=1)
    misfit = scenario.measured[bank.run, k] - anomaly - beside
    known: Bool = np.isfinite(anomaly) & np.isfinite(by_position).all(axis=1)
    measured = known & np.isfinite(misfit)
    slope[~measured] = 0.0
    misfit = np.where(measured, misfit, 0.0)
    gain = (bank.P @ slope[:, :, None])[:, :, 0]
    variance = (gain * slope).sum(axis=1) + scenario.noise**2 + np.where(measured, left, 0.0)
    nis = misfit**2 / variance
    gate = scenario.model.gate
    outlier = measured & (nis > gate**2) & (gate > 0.0)
    used = measured & ~outlier
    density = np.where(used, -0.5 * (nis + np.log(2.0 * np.pi * variance)), OUTLIER * outlier)
    _note(bank, k, misfit, variance, density, measured, outlier, estimates)
    gain = np.where(used[:, None], gain, 0.0)
    mean = bank.mean + gain * (misfit / variance)[:, None]
    P = bank.P - gain[:, :, None] * gain[:, None, :] / variance[:, None, None]
    patient = min(1.0, scenario.period / PATIENCE)
    running = bank.misfit + np.where(used, (nis - bank.misfit) / MEMORY, 0.0)
    running += np.where(outlier, (1.5 * MISFIT - bank.misfit) * patient, 0.0)
    return Bank(bank.run, mean, 0.5 * (P + P.swapaxes(1, 2)), bank.log_weight + density, running), known


def _note(
    bank: Bank,
    k: int,
    misfit: Float,
    variance: Float,
    density: Float,
    measured: Bool,
    outlier: Bool,
    estimates: PositionEstimates,
) -> None:
    """Fill in what the innovations of epoch k say of each run."""
    runs = len(estimates.mean)
    weight = weights(bank, runs) * measured
    total = np.bincount(bank.run, weight, runs)

    def average(values: Float) -> Float:
        return np.asarray(np.bincount(bank.run, weight * values, runs) / total)

    mean = average(misfit)
    spread = average(variance + np.square(misfit - mean[bank.run]))
    estimates.nis[:, k] = mean**2 / spread
    estimates.rejected[:, k] = np.nan_to_num(average(outlier.astype(float)) > 0.5)
    likelihood = np.bincount(bank.run, weights(bank, runs) * np.exp(density), runs)
    estimates.evidence[:, k] = np.where(total > 0.0, np.log(np.maximum(likelihood, 1e-300)), 0.0)


def weights(bank: Bank, runs: int) -> Float:
    """Return weights that sum to 1 in each run, shape (M,)."""
    highest = np.full(runs, -np.inf)
    np.maximum.at(highest, bank.run, bank.log_weight)
    weight = np.exp(bank.log_weight - highest[bank.run])
    return np.asarray(weight / np.bincount(bank.run, weight, runs)[bank.run])


def moments(bank: Bank, runs: int) -> tuple[Float, Float]:
    """Return mean (R, 2) and covariance (R, 2, 2) of the position error."""
    weight = weights(bank, runs)
    mean: Float = np.stack(
        [np.bincount(bank.run, weight * bank.mean[:, axis], runs) for axis in (0, 1)], axis=1
    )
    away = bank.mean[:, :2] - mean[bank.run]
    spread = bank.P[:, :2, :2] + away[:, :, None] * away[:, None, :]
    parts = [np.bincount(bank.run, weight * spread[:, i, j], runs) for i in (0, 1) for j in (0, 1)]
    return mean, np.stack(parts, axis=1).reshape(runs, 2, 2).astype(float)


def prune(bank: Bank, runs: int) -> Bank:
    """Return the bank without components of negligible weight."""
    keep = ~(weights(bank, runs) <= NEGLIGIBLE)  # a diverged run has NaN weights, and stays so
    return bank if keep.all() else bank.at(keep)


def inflate(bank: Bank, scenario: Scenario, recovery: float, evidence: Float) -> Bank:
    """Return the bank with wider components where innovations do not fit, unless as wide as the initial error.

    It costs them weight, and their runs evidence, shape (R,).
    """
    wide = bank.P[:, 0, 0] + bank.P[:, 1, 1] >= scenario.initial**2
    wrong = (bank.misfit > MISFIT) & ~wide
    if not wrong.any() or not recovery:
        return bank
    wider = bank.P + recovery * scenario.full_prior()
    cost = RECOVERY_COST * wrong
    kept = np.bincount(bank.run, weights(bank, scenario.runs) * np.exp(-cost), scenario.runs)
    evidence += np.log(np.maximum(kept, 1e-300))
    return replace(
        bank,
        P=np.where(wrong[:, None, None], wider, bank.P),
        misfit=np.where(wrong, 1.0, bank.misfit),
        log_weight=bank.log_weight - cost,
    )


def merge(bank: Bank) -> Bank:
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


def split_curved(scenario: Scenario, bank: Bank, k: int) -> Bank:
    """Return the bank in which three components stand for each one over whose width the map curves."""
    if not np.isfinite(bank.P).all():
        return bank
    sizes, directions = np.linalg.eigh(bank.P[:, :2, :2])
    axis = directions[:, :, 1] * np.sqrt(np.maximum(sizes[:, 1], 0.0))[:, None]  # m, one sigma of the widest
    latitude, longitude = scenario.ins.latitude[bank.run, k], scenario.ins.longitude[bank.run, k]
    meridian, parallel = metres_per_radian(latitude)
    values = []
    for side in (-1.0, 0.0, 1.0):
        north, east = (bank.mean[:, :2] + side * axis).T
        values.append(scenario.gravity_map.at(latitude - north / meridian, longitude - east / parallel))
    off = 0.5 * np.abs(values[0] - 2.0 * values[1] + values[2])
    crowded = np.bincount(bank.run, minlength=scenario.runs)[bank.run] >= LIMIT
    curved = (off > CURVED * scenario.noise) & ~crowded
    if not curved.any():
        return bank
    one = bank.at(curved)
    # Along the regression of all errors on that coordinate of the position.
    unit = axis[curved] / np.square(axis[curved]).sum(axis=1, keepdims=True)
    along = (one.P[:, :, :2] @ unit[:, :, None])[:, :, 0]
    kept = 2.0 * SIDE * SHIFT**2
    P = one.P - kept * along[:, :, None] * along[:, None, :]
    parts = [bank.at(~curved)]
    for side, weight in ((-SHIFT, SIDE), (0.0, 1.0 - 2.0 * SIDE), (SHIFT, SIDE)):
        parts.append(
            replace(one, mean=one.mean + side * along, P=P, log_weight=one.log_weight + np.log(weight))
        )
    whole = Bank(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Bank)))
    return whole.at(np.argsort(whole.run, kind="stable"))
