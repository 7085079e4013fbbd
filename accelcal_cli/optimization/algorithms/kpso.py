"""KPSO: particle swarm with a Kalman filter for each particle, "The Kalman Swarm" [monson2004].

Monson and Seppi replace the velocity by a filter: the observation is a random point towards the global best, the
new position is drawn from the filter's predicted distribution. No inertia, no personal best. The noise levels are
fixed parts of the range of each coordinate, so the sampling never narrows and the cost stays on a floor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.operators import best_of, moved_to_best
from accelcal_cli.optimization.optimizer import OPTIMIZERS, RANDOMS, Optimizer, Randoms, State
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

F = np.array([[1.0, 1.0], [0.0, 1.0]])
"""Transition of (position, velocity)."""


@dataclass(frozen=True, eq=False)
class FilterState(State):
    """Filters of position and velocity, in half-widths of the box; x and fx are the sampled positions."""

    mean: Float  # filtered position, (R, P, D)
    rate: Float  # filtered velocity, (R, P, D)
    covariance: Float  # of (position, velocity), the same for all particles and coordinates, (R, 2, 2)
    leader: Float  # gbest, (R, 1, D)
    leader_cost: Float  # (R,)


@OPTIMIZERS.register("kpso")
@dataclass(frozen=True)
class KalmanSwarm(Optimizer[FilterState]):
    """Kalman swarm of Monson and Seppi."""

    family = "swarm"
    paper = "monson2004"
    converges = False

    noise: float = setting(
        0.01, "variance of start, process and observation as part of the range (epsilon)", above=0
    )
    randoms: Randoms = setting("particle", RANDOMS)

    def init(self, problem: Problem, x: Float, rng: Streams) -> FilterState:
        """Start at rest."""
        fx = problem.cost(x)
        covariance = np.broadcast_to(self._q() * np.eye(2), (len(x), 2, 2))
        mean = (x - problem.lower) / problem.half_width - 1.0
        return FilterState(
            x, fx, mean, np.zeros_like(mean), covariance, best_of(x, fx)[:, None], fx.min(axis=1)
        )

    def step(self, problem: Problem, state: FilterState, rng: Streams) -> FilterState:
        """Observe, filter, predict, and sample the next positions."""
        population, dimensions = state.x.shape[1:]
        half = problem.half_width
        pull = 2.0 * rng.uniform(population, dimensions if self.randoms == "coordinate" else 1)
        z = (state.x + pull * (state.leader - state.x) - problem.lower) / half - 1.0
        Pm = F @ state.covariance @ F.T + self._q() * np.eye(2)
        gain = Pm[:, :, 0] / (Pm[:, 0, 0] + self._q())[:, None]
        innovation = z - (state.mean + state.rate)
        mean = state.mean + state.rate + gain[:, 0, None, None] * innovation
        rate = state.rate + gain[:, 1, None, None] * innovation
        P = Pm - gain[:, :, None] * Pm[:, None, 0, :]
        # Sample the predicted position: mean F m, variance of the filtered P.
        spread = np.sqrt(P[:, 0, 0])[:, None, None] * rng.normal(population, dimensions)
        x = problem.lower + half * (mean + rate + spread + 1.0)
        np.clip(x, problem.lower, problem.upper, out=x)
        fx = problem.cost(x)
        return FilterState(x, fx, mean, rate, P, *moved_to_best(state.leader, state.leader_cost, x, fx))

    def _q(self) -> float:
        """Return the variance epsilon times the range, which is 2 in half-widths of the box."""
        return 2.0 * self.noise
