"""Adaptive differential evolution, individual by individual as its paper has it [depf2015]."""

from __future__ import annotations

import numpy as np
import pytest
from known_problems import ShiftedSphere

from accelcal_cli.optimization.algorithms.ade import AdaptiveEvolution
from accelcal_cli.rng import Streams

P, D = 20, 4


def _generation(problem, x, fx, u, mutation):
    """Return population and costs after equations 3 to 7, with F from 0.3 to 0.9 and CR from 0.1 to 0.8."""
    best, worst = int(np.argmin(fx)), int(np.argmax(fx))
    new, new_cost, counts = x.copy(), fx.copy(), []

    def cost(point):
        return float(problem.cost(point[None, None])[0, 0])

    for i in range(P):
        others = [(i + 1 + k) % P for k in range(P - 1)]
        first = others[int(u[i, 0] * (P - 1))]
        others.remove(first)
        second = others[int(u[i, 1] * (P - 2))]
        F = 0.3 + 0.6 * (fx[i] - fx[best]) / (fx[worst] - fx[best])
        if mutation == "best-r":
            mutant = x[i] + F * (x[best] - x[first])
        else:
            mutant = x[i] + F * (x[best] - x[i]) + F * (x[first] - x[second])
        mutant = np.minimum(np.maximum(mutant, problem.lower), problem.upper)
        behind = (cost(mutant) - fx[best]) / (fx[worst] - fx[best])
        CR = 0.8 - 0.7 * min(max(behind, 0.0), 1.0)
        forced = int(u[i, 2] * D)
        trial = np.array([mutant[j] if u[i, 3 + j] <= CR or j == forced else x[i, j] for j in range(D)])
        counts.append((trial != x[i]).sum())
        if cost(trial) < fx[i]:
            new[i], new_cost[i] = trial, cost(trial)
    assert len(set(counts)) > 2
    return new, new_cost


@pytest.mark.parametrize("mutation", ["current-to-best", "best-r"])
def test_generations_are_equations_3_to_7(mutation):
    problem = ShiftedSphere(D)
    optimizer = AdaptiveEvolution(
        population=P, weight_min=0.3, weight_max=0.9, crossover_min=0.1, crossover_max=0.8, mutation=mutation
    )
    rng, twin = Streams(7, [0]), Streams(7, [0])
    x = problem.lower + (problem.upper - problem.lower) * Streams(1, [0]).uniform(P, D)
    state = optimizer.init(problem, x, rng)
    expected, cost = x[0], state.fx[0]
    for _ in range(4):
        state = optimizer.step(problem, state, rng)
        expected, cost = _generation(problem, expected, cost, twin.uniform(P, D + 3)[0], mutation)
        np.testing.assert_allclose(state.x[0], expected, atol=1e-10)
        np.testing.assert_allclose(state.fx[0], cost, rtol=1e-10)
    assert (expected != x[0]).any(axis=1).sum() > 5
