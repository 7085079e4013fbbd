"""MPF: the marginalised particle filter, particles for position and a Kalman filter for all else [schon2005].

Every particle is a position, and carries the mean of the other twelve errors given its history; their covariance is the
same for all, because the model is linear in them and its matrices do not depend on the particle. [nordlund2001] applied
it to terrain navigation.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.filter import FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.ins import cholesky
from accelcal_cli.navigation.marginal import ALL
from accelcal_cli.navigation.noise import EXTRA
from accelcal_cli.navigation.particle_filter import (
    BLIND,
    CHUNK,
    effective_size,
    moments,
    normalise,
    rate_misfit,
    systematic,
    take_particles,
)
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

POSITION, REST = slice(0, 2), slice(2, ALL)


@FILTERS.register("mpf")
@dataclass(frozen=True)
class Mpf(Filter):
    """Marginalised particle filter [schon2005] [nordlund2001]."""

    particles: int = setting(1000, "N, particles", low=4, high=1_000_000)
    roughening: float = setting(
        15.0, "noise of the position error per step of 10 s, m", low=0.0, high=10_000.0
    )
    threshold: float = setting(2 / 3, "resample when N_eff is below this part of N", low=0.0, high=1.0)

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the filter's estimates; see `Filter`."""
        estimates = PositionEstimates.empty(scenario)
        runs, prior = scenario.runs, scenario.full_prior()
        root = cholesky(prior)
        u: Float = streams.normal(self.particles, 2)
        x: Float = u @ root[POSITION, POSITION].T
        rest: Float = u @ root[REST, POSITION].T
        P: Float = np.tile(root[REST, REST] @ root[REST, REST].T, (runs, 1, 1))
        log_weights: Float = np.zeros((runs, self.particles))
        F = scenario.steps(0, 0)
        for k in range(scenario.epochs):
            log_weights, rest, P = self._measure(scenario, k, estimates, (log_weights, x, rest, P))
            weights = normalise(log_weights)
            estimates.mean[:, k], estimates.covariance[:, k] = moments(weights, x)
            low = effective_size(weights) < self.threshold * self.particles
            chosen = systematic(weights, streams.uniform(1, 1)[:, 0, 0])
            chosen = np.where(low[:, None], chosen, np.arange(self.particles))
            x, rest = take_particles(x, chosen), take_particles(rest, chosen)
            log_weights = np.where(low[:, None], 0.0, log_weights - log_weights.max(axis=1, keepdims=True))
            if k % CHUNK == 0:
                F = scenario.steps(k, min(k + CHUNK, scenario.epochs))
            x, rest, P = self._predict(scenario, k, F[:, k % CHUNK], (x, rest, P), streams)
        return replace(estimates, lookups=float(self.particles))

    def _measure(
        self,
        scenario: Scenario,
        k: int,
        estimates: PositionEstimates,
        state: tuple[Float, Float, Float, Float],
    ) -> tuple[Float, Float, Float]:
        """Return log weights, means and covariance after the measurement of epoch k; [schon2005] step 4(a)."""
        log_weights, x, rest, P = state
        C = np.zeros((scenario.runs, ALL - 2))
        C[:, :2], C[:, -EXTRA:] = scenario.coupling[:, k], 1.0
        misfit = scenario.measured[:, k, None] - scenario.anomaly(k, x[..., 0], x[..., 1])
        misfit = misfit - (rest @ C[:, :, None])[:, :, 0]
        gain = (P @ C[:, :, None])[:, :, 0]
        S = (C * gain).sum(axis=1) + scenario.noise**2
        seen = np.isfinite(misfit)
        weights = np.where(seen, normalise(log_weights), 0.0)
        total, plain = weights.sum(axis=1), np.where(seen, misfit, 0.0)
        mean = (weights * plain).sum(axis=1) / total
        spread = (weights * np.square(plain - mean[:, None])).sum(axis=1) / total
        used = estimates.note(k, mean, spread + S, scenario.model.gate) > 0.0
        K = np.where(used[:, None], gain / S[:, None], 0.0)
        rest = rest + K[:, None] * plain[:, :, None]
        P = P - K[:, :, None] * gain[:, None]
        likelihood = rate_misfit(misfit, used[:, None], S[:, None])
        estimates.blind[:] += likelihood.max(axis=1) < BLIND
        return log_weights + np.where(used[:, None], likelihood, 0.0), rest, np.asarray(P)

    def _predict(
        self, scenario: Scenario, k: int, F: Float, state: tuple[Float, Float, Float], streams: Streams
    ) -> tuple[Float, Float, Float]:
        """Return particles, means and covariance one step on; [schon2005] steps 4(b) and 4(c)."""
        x, rest, P = state
        Q = scenario.step_noise(k)
        Q[:, POSITION] += self.roughening**2 * scenario.period / 10.0
        An, Al = F[:, POSITION, REST], F[:, REST, REST]
        N = An @ P @ An.swapaxes(1, 2) + Q[:, POSITION, None] * np.eye(2)
        expected = x @ F[:, POSITION, POSITION].swapaxes(1, 2) + rest @ An.swapaxes(1, 2)
        moved = expected + streams.normal(self.particles, 2) @ cholesky(N).swapaxes(1, 2)
        gain = np.linalg.solve(N, An @ P @ Al.swapaxes(1, 2)).swapaxes(1, 2)
        rest = rest @ Al.swapaxes(1, 2) + x @ F[:, REST, POSITION].swapaxes(1, 2)
        rest = rest + (moved - expected) @ gain.swapaxes(1, 2)
        P = Al @ P @ Al.swapaxes(1, 2) + Q[:, REST, None] * np.eye(ALL - 2) - gain @ N @ gain.swapaxes(1, 2)
        return moved, rest, 0.5 * (P + P.swapaxes(1, 2))
