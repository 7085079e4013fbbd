"""AKPSO: particle swarm whose positions pass a fading-memory Kalman filter [akpso2015].

Dai Shaowu, Wang Kehong, Qian Jianxue, "Rapid calibration method for accelerometer based on AKPSO algorithm", 2015.
The state of a particle and coordinate is (x, v, p, g); the swarm's own update, written as a matrix with its random
numbers, predicts it (eq. 11), a second swarm update with fresh random numbers observes it (eq. 12, 13), and the
filter forgets by e^alpha (eq. 19). Most of the printed formulas are lost; docs/explanation/reproduction.md says
which reading is used and why it works: the gain averages two random steps, which halves their variance.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.optimization.algorithms.pso import SwarmState
from accelcal_cli.optimization.operators import best_of, better_of
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@dataclass(frozen=True, eq=False)
class KalmanState(SwarmState):
    """A swarm with its filters: x and velocity are filtered, memory is the paper's p, leader its g."""

    covariance: Float  # of (x, v, p, g) or (x, v), (R, k, k, P, D)


@OPTIMIZERS.register("akpso")
@dataclass(frozen=True)
class AdaptiveKalmanSwarm(Optimizer[KalmanState]):
    """AKPSO with the constants of the paper, its filter in two states; `kalman_dim: 4` is the printed one."""

    family = "swarm"
    paper = "akpso2015"

    population: int = setting(500, "particles (N)", low=4, high=1_000_000)
    inertia: float = setting(0.7289, "inertia weight (w)", low=0, high=2)
    social: float = setting(2.0, "pull towards the global best (c1)", low=0, high=10)
    cognitive: float = setting(2.0, "pull towards the own best (c2)", low=0, high=10)
    fading: float = setting(0.1, "exponent of the fading memory (alpha)", low=0, high=5)
    noise: float = setting(
        0.01, "adjustment constant of P_0, Q and R (epsilon); it cancels", above=0, high=1e6
    )
    kalman_dim: Literal[2, 4] = setting(2, "4: (x, v, p, g) as printed; 2: p and g as known inputs")
    speed: float = setting(0.2, "velocity limit as a part of the half box (v_max)", above=0, high=100)

    def init(self, problem: Problem, x: Float, rng: Streams) -> KalmanState:
        """Scatter positions and velocities; every filter starts with the same covariance."""
        runs, population, dimensions = x.shape
        v = self.speed * problem.half_width * (2.0 * rng.uniform(population, dimensions) - 1.0)
        fx, k = problem.cost(x), self.kalman_dim
        P = np.zeros((runs, k, k, dimensions, population)).swapaxes(-1, -2)
        P[:, range(k), range(k)] = self.noise
        return KalmanState(x, fx, v, x, fx, best_of(x, fx), P)

    def step(self, problem: Problem, state: KalmanState, rng: Streams) -> KalmanState:
        """Predict with one set of random numbers, observe with another, filter."""
        x, v = state.x, state.velocity
        population, dimensions = x.shape[1:]
        u = rng.uniform(population, 4 * dimensions)
        r1, r2, r1_fresh, r2_fresh = (u[..., k * dimensions : (k + 1) * dimensions] for k in range(4))
        phi1, phi2 = self.social * r1, self.cognitive * r2
        limit = self.speed * problem.half_width
        to_leader, to_memory = state.leader[:, None] - x, state.memory - x
        v_predicted = self.inertia * v + phi1 * to_leader + phi2 * to_memory  # eq. 16: X = Phi X
        x_predicted = x + v_predicted
        zv = self.inertia * v + self.social * r1_fresh * to_leader + self.cognitive * r2_fresh * to_memory
        zv = np.minimum(np.maximum(zv, -limit), limit)  # eq. 12
        ex, ev = x + zv - x_predicted, zv - v_predicted  # innovation, eq. 13
        P = self._predict(state.covariance, phi1, phi2)
        gain = self._gain(P)  # eq. 15
        x = x_predicted + gain[:, 0, 0] * ex + gain[:, 0, 1] * ev  # eq. 17
        v = v_predicted + gain[:, 1, 0] * ex + gain[:, 1, 1] * ev
        P = P - np.einsum("riapd,rajpd->rijpd", gain, P[:, :2])  # eq. 18
        P = 0.5 * (P + P.swapaxes(1, 2))
        x = np.minimum(np.maximum(x, problem.lower), problem.upper)  # eq. 20
        v = np.minimum(np.maximum(v, -limit), limit)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)
        return KalmanState(x, fx, v, memory, memory_cost, best_of(memory, memory_cost), P)

    def _predict(self, P: Float, phi1: Float, phi2: Float) -> Float:
        """Return e^alpha (Phi P Phi^T + Q), eq. 14 and 19, shape (R, k, k, P, D).

        Phi's first row is (1 - phi, w, phi2, phi1), its second the first less (1, 0, 0, 0), the others identity.
        """
        row = [1.0 - phi1 - phi2, np.full((1, 1, 1), self.inertia), phi2, phi1][: self.kalman_dim]
        A = P.copy(order="K")  # Phi P
        A[:, 0] = np.add.reduce([c[:, None] * P[:, k] for k, c in enumerate(row)])
        A[:, 1] = A[:, 0] - P[:, 0]
        B = A.copy(order="K")  # (Phi P) Phi^T
        B[:, :, 0] = np.add.reduce([c[:, None] * A[:, :, k] for k, c in enumerate(row)])
        B[:, :, 1] = B[:, :, 0] - A[:, :, 0]
        diagonal = range(self.kalman_dim)
        B[:, diagonal, diagonal] += self.noise
        B *= math.exp(self.fading)
        return B

    def _gain(self, P: Float) -> Float:
        """Return K = P H^T (H P H^T + R)^-1 by the 2 x 2 inverse, shape (R, k, 2, P, D)."""
        a, b, d = P[:, 0, 0] + self.noise, P[:, 0, 1], P[:, 1, 1] + self.noise
        determinant = a * d - b * b
        x, v = P[:, :, 0], P[:, :, 1]
        a, b, d = a[:, None], b[:, None], d[:, None]
        return np.stack((x * d - v * b, v * a - x * b), axis=2) / determinant[:, None, None]
