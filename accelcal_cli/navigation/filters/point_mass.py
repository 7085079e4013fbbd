"""The point-mass filter: the posterior of the position on a grid, all other errors Gaussian given it [bergman1999].

It integrates the marginalised model of `marginal` over a square grid instead of over particles, and draws no random
number. The grid is laid twice: over five sigma of the prior of a window, and again over the nodes that weigh anything.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.filter import FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.ins import cholesky
from accelcal_cli.navigation.marginal import (
    ALL,
    RECOVERY_COST,
    Gaussian,
    TrackWindow,
    estimate_epochs,
    note_window,
    rate_tracks,
)
from accelcal_cli.navigation.particle_filter import moments, normalise
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

EXTENT, NOTHING = 5.0, 1e-9
"""Of the first grid, in sigma; weight of a node, over that of the best, that the second grid need not cover."""

QUANTILES = 10
"""On either axis, of the lattice that stands for the prior when innovations are predicted."""


@FILTERS.register("point-mass")
@dataclass(frozen=True)
class PointMass(Filter):
    """Point-mass filter, marginalised [bergman1999]."""

    nodes: int = setting(31, "on either axis of the grid", low=5, high=501)
    window: float = setting(600.0, "W, of measurements that count at once, s", above=0.0, high=36000.0)
    recovery: float = setting(
        0.1, "part of the prior that is added when no track explains a window; 0: none", low=0.0, high=10.0
    )

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the filter's estimates; see `Filter`."""
        estimates = PositionEstimates.empty(scenario)
        runs, size, variance = scenario.runs, scenario.epochs_in(self.window), scenario.noise**2
        start = Gaussian(np.zeros((runs, ALL)), np.tile(cholesky(scenario.full_prior()), (runs, 1, 1)))
        middle = [NormalDist().inv_cdf((i + 0.5) / QUANTILES) for i in range(QUANTILES)]
        lattice = np.stack(np.meshgrid(middle, middle), axis=-1).reshape(-1, 2) / np.std(middle)
        for first in range(0, scenario.epochs, size):
            window = TrackWindow.predict(scenario, start, first, min(first + size, scenario.epochs))
            note_window(window, np.tile(lattice, (runs, 1, 1)), variance, estimates)
            rate, reach = rate_tracks(window, variance)
            coarse = grid(np.full((runs, 2), -EXTENT), np.full((runs, 2), EXTENT), self.nodes)
            u = grid(*around(coarse, rate(coarse)[0], self.nodes), self.nodes)
            level, white = rate(u)
            estimate_epochs(window, u, white, level, reach, estimates, -0.5 * np.square(u).sum(axis=2))
            together = np.concatenate([u, white], axis=2)
            mean, covariance = moments(normalise(level), together)
            used = np.isfinite(window.measured).sum(axis=1)
            unexplained = np.square(white).sum(axis=2).min(axis=1) > 4.0 * used
            added = np.where(unexplained & (used > 0) & (first > 0), self.recovery, 0.0)
            estimates.evidence[:, window.last - 1] -= RECOVERY_COST * (added > 0.0)
            start, _ = window.end(u[:, :1], white[:, :1], reach, mean, covariance, added, streams)
        return replace(estimates, lookups=2.0 * self.nodes**2 + lattice.shape[0])


def grid(low: Float, high: Float, nodes: int) -> Float:
    """Return the centres of the cells between two corners, shape (R, 2), as (R, nodes^2, 2)."""
    part = (np.arange(nodes) + 0.5) / nodes
    square = np.stack(np.meshgrid(part, part, indexing="ij"), axis=-1).reshape(-1, 2)
    return np.asarray(low[:, None] + (high - low)[:, None] * square)


def around(u: Float, level: Float, nodes: int) -> tuple[Float, Float]:
    """Return the corners of the cells that weigh anything, and of those beside them, each of shape (R, 2)."""
    matter = level > level.max(axis=1, keepdims=True) + np.log(NOTHING)
    cell = 2.0 * EXTENT / nodes
    low = np.where(matter[:, :, None], u, np.inf).min(axis=1) - 1.5 * cell
    high = np.where(matter[:, :, None], u, -np.inf).max(axis=1) + 1.5 * cell
    return low, high
