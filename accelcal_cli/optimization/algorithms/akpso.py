"""AKPSO: particle swarm whose positions pass a fading-memory Kalman filter [akpso2015].

Dai Shaowu, Wang Kehong, Qian Jianxue, "Rapid calibration method for accelerometer based on AKPSO algorithm", 2015.
The state of a particle and coordinate is (x, v, p, g); the swarm's own update, written as a matrix with its random
numbers, predicts it (eq. 11), a second swarm update with fresh random numbers observes it (eq. 12, 13), and the
filter forgets by e^alpha (eq. 19). Most of the printed formulas are lost; docs/explanation/reproduction.md says
which reading is used and why it works: the gain averages two random steps, which halves their variance. Every other
reading that the surviving text admits is a setting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, cast

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.algorithms.pso import SwarmState
from accelcal_cli.optimization.operators import best_of, better_of
from accelcal_cli.optimization.optimizer import OPTIMIZERS, RANDOMS, Optimizer, Randoms
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

Pulls = tuple[Float, Float]
"""Two arrays that go together: phi1 and phi2, or a position and a velocity."""

LARGEST_FADING = math.exp(5.0)
"""Most by which the adaptive memory inflates a covariance: as the largest alpha does."""


@dataclass(frozen=True, eq=False)
class KalmanState(SwarmState):
    """A swarm with its filters: x and velocity are filtered, memory is the paper's p, leader its g."""

    covariance: Float  # of (x, v, p, g) or (x, v), (R, k, k, P, D)
    estimate: Float | None = (
        None  # (x, v, p, g) of the filters where they are not the swarm's own, (R, 4, P, D)
    )


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
    randoms: Randoms = setting("coordinate", RANDOMS)
    observation: Literal["state", "step"] = setting(
        "state", "state: H = [I 0], Z a fresh step; step: H is the fresh step, Z = H X"
    )
    first_state: Literal["swarm", "zero"] = setting(
        "swarm", "X_0: the swarm's own x and v, or 0, the middle of the box"
    )
    position: Literal["estimate", "sampled"] = setting(
        "estimate", "new position: the filter's estimate, or drawn from its distribution"
    )
    memory: Literal["fixed", "adaptive"] = setting(
        "fixed", "fading memory: by e^alpha, or by what the innovation exceeds its expectation"
    )
    bests: Literal["reset", "filtered"] = setting(
        "reset", "p and g of the filter: set to the swarm's in every iteration, or left to the filter"
    )

    def __post_init__(self) -> None:
        """Refuse to filter p and g that are no part of the state."""
        super().__post_init__()
        if self.bests == "filtered" and self.kalman_dim == 2:
            raise ConfigError("bests: filtered needs kalman_dim: 4; with 2 they are known inputs")

    def init(self, problem: Problem, x: Float, rng: Streams) -> KalmanState:
        """Scatter positions and velocities; every filter starts with the same covariance."""
        runs, population, dimensions = x.shape
        v = self.speed * problem.half_width * (2.0 * rng.uniform(population, dimensions) - 1.0)
        fx, k = problem.cost(x), self.kalman_dim
        P = np.zeros((runs, k, k, dimensions, population)).swapaxes(-1, -2)
        P[:, range(k), range(k)] = self.noise
        state = KalmanState(x, fx, v, x, fx, best_of(x, fx), P)
        if self.first_state == "zero":
            middle = np.broadcast_to(0.5 * (problem.lower + problem.upper), x.shape)
            return replace(state, estimate=self._estimate(state, middle, 0.0 * x, middle, middle))
        first = self._estimate(state, x, v, x, state.leader[:, None]) if self._apart else None
        return replace(state, estimate=first)

    def step(self, problem: Problem, state: KalmanState, rng: Streams) -> KalmanState:
        """Predict with one set of random numbers, observe with another, filter."""
        x, v, (population, dimensions) = state.x, state.velocity, state.x.shape[1:]
        width = dimensions if self.randoms == "coordinate" else 1
        u = rng.uniform(population, 4 * width)
        r1, r2, r1_fresh, r2_fresh = (u[..., k * width : (k + 1) * width] for k in range(4))
        phi = self.social * r1, self.cognitive * r2
        fresh = self.social * r1_fresh, self.cognitive * r2_fresh
        limit = self.speed * problem.half_width
        pulls = state.leader[:, None] - x, state.memory - x
        start, own = x, cast("tuple[Float, Float, Float]", (v, *pulls))
        if state.estimate is not None:
            start, own = state.estimate[:, 0], _with_pulls(*np.moveaxis(state.estimate, 1, 0))
        v_predicted = self._velocity(*own, phi)  # eq. 16: X = Phi X
        x_predicted = start + v_predicted
        zv = self._velocity(v, *pulls, fresh)
        zv = np.minimum(np.maximum(zv, -limit), limit)  # eq. 12
        expected = x_predicted, v_predicted
        if self.observation == "step":
            ahead = _with_pulls(x_predicted, v_predicted, start + own[2], start + own[1])
            v_ahead = self._velocity(*ahead, fresh)
            expected = x_predicted + v_ahead, v_ahead
        ex, ev = x + zv - expected[0], zv - expected[1]  # innovation, eq. 13
        excess = None if self.memory == "fixed" else (ex**2 + ev**2) / (2.0 * problem.half_width**2)
        P, gain = self._filter(state.covariance, phi, fresh, excess)
        x = x_predicted + gain[:, 0, 0] * ex + gain[:, 0, 1] * ev  # eq. 17
        v = v_predicted + gain[:, 1, 0] * ex + gain[:, 1, 1] * ev
        x = np.minimum(np.maximum(x, problem.lower), problem.upper)  # eq. 20
        v = np.minimum(np.maximum(v, -limit), limit)
        after = self._evaluated(problem, state, x, v, P, rng)
        if not self._apart:
            return after
        p, g = start + own[2], start + own[1]
        if self.bests == "filtered":
            p = p + gain[:, 2, 0] * ex + gain[:, 2, 1] * ev
            g = g + gain[:, 3, 0] * ex + gain[:, 3, 1] * ev
        return replace(after, estimate=self._estimate(after, x, v, p, g))

    @property
    def _apart(self) -> bool:
        """Whether the filters' states differ from the swarm's beyond the first step."""
        return self.position == "sampled" or self.bests == "filtered"

    def _estimate(self, state: KalmanState, x: Float, v: Float, p: Float, g: Float) -> Float:
        """Return the filters' states, shape (R, 4, P, D), with p and g of the swarm unless they are filtered."""
        if self.bests == "reset":
            p, g = state.memory, state.leader[:, None]
        return np.stack(np.broadcast_arrays(x, v, p, g), axis=1)

    def _velocity(self, v: Float, to_leader: Float, to_memory: Float, phi: Pulls) -> Float:
        """Return w v + phi1 (g - x) + phi2 (p - x)."""
        return self.inertia * v + phi[0] * to_leader + phi[1] * to_memory

    def _evaluated(
        self, problem: Problem, state: KalmanState, x: Float, v: Float, P: Float, rng: Streams
    ) -> KalmanState:
        """Return the swarm at its new positions, which are x or drawn around it; see `position`."""
        if self.position == "sampled":  # P is in parts of the range, twice the half-width of the box
            spread = np.sqrt(2.0 * np.maximum(P[:, 0, 0], 0.0)) * rng.normal(*x.shape[1:])
            x = np.clip(x + problem.half_width * spread, problem.lower, problem.upper)
        fx = problem.cost(x)
        memory, memory_cost = better_of(state.memory, state.memory_cost, x, fx)
        return KalmanState(x, fx, v, memory, memory_cost, best_of(memory, memory_cost), P)

    def _filter(self, P: Float, phi: Pulls, fresh: Pulls, excess: Float | None) -> tuple[Float, Float]:
        """Return the covariance after the observation, shape (R, k, k, P, D), and the gain, (R, k, 2, P, D)."""
        P = self._predict(P, phi, excess)
        if self.observation == "state":
            PH, HPH = (P[:, :, 0], P[:, :, 1]), (P[:, 0, 0], P[:, 0, 1], P[:, 1, 1])
        else:
            row = self._row(fresh)
            x = np.add.reduce([c[:, None] * P[:, :, k] for k, c in enumerate(row)])
            PH, turned = (x, x - P[:, :, 0]), np.stack((x, x - P[:, :, 0]), axis=2)
            y = np.add.reduce([c[:, None] * turned[:, k] for k, c in enumerate(row)])
            HPH = y[:, 0], y[:, 1], y[:, 1] - turned[:, 0, 1]
        gain = self._gain(PH, HPH)  # eq. 15
        HP = P[:, :2] if self.observation == "state" else np.stack(PH, axis=1)
        P = P - np.einsum("riapd,rajpd->rijpd", gain, HP)  # eq. 18
        return 0.5 * (P + P.swapaxes(1, 2)), gain

    def _row(self, phi: Pulls) -> list[Float]:
        """Return the first row of Phi, (1 - phi, w, phi2, phi1), as far as the state goes."""
        return [1.0 - phi[0] - phi[1], np.full((1, 1, 1), self.inertia), phi[1], phi[0]][: self.kalman_dim]

    def _predict(self, P: Float, phi: Pulls, excess: Float | None) -> Float:
        """Return e^alpha (Phi P Phi^T + Q), eq. 14 and 19, shape (R, k, k, P, D).

        Phi's second row is the first less (1, 0, 0, 0), the others are of the identity. The adaptive memory inflates
        Phi P Phi^T alone, until the squared innovation `excess`, in units of P, is what the filter expects.
        """
        row = self._row(phi)
        A = P.copy(order="K")  # Phi P
        A[:, 0] = np.add.reduce([c[:, None] * P[:, k] for k, c in enumerate(row)])
        A[:, 1] = A[:, 0] - P[:, 0]
        B = A.copy(order="K")  # (Phi P) Phi^T
        B[:, :, 0] = np.add.reduce([c[:, None] * A[:, :, k] for k, c in enumerate(row)])
        B[:, :, 1] = B[:, :, 0] - A[:, :, 0]
        if excess is not None:
            beyond = excess - 4.0 * self.noise  # e^T e - tr R - tr Q
            B *= np.clip(beyond / (B[:, 0, 0] + B[:, 1, 1]), 1.0, LARGEST_FADING)[:, None, None]
        diagonal = range(self.kalman_dim)
        B[:, diagonal, diagonal] += self.noise
        if excess is None:
            B *= math.exp(self.fading)
        return B

    def _gain(self, PH: Pulls, HPH: tuple[Float, Float, Float]) -> Float:
        """Return K = P H^T (H P H^T + R)^-1 by the 2 x 2 inverse, shape (R, k, 2, P, D)."""
        a, b, d = HPH[0] + self.noise, HPH[1], HPH[2] + self.noise
        determinant = a * d - b * b
        x, v = PH
        a, b, d = a[:, None], b[:, None], d[:, None]
        return np.stack((x * d - v * b, v * a - x * b), axis=2) / determinant[:, None, None]


def _with_pulls(x: Float, v: Float, p: Float, g: Float) -> tuple[Float, Float, Float]:
    """Return v, g - x and p - x of a filter's state."""
    return v, g - x, p - x
