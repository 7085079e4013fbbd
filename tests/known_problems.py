"""Problems with known minima, none of them at the centre of the box, and wrappers that watch or spoil them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from simulated import DPSO, lower_loetters

from accelcal_cli.optimization.problem import Problem
from accelcal_cli.sensor import poses

G = 9.8


class ShiftedSphere(Problem):
    """sum (x - o)^2 over an uneven box, o well off its centre."""

    name = "shifted sphere"
    minimum = 0.0

    def __init__(self, dimensions=4):
        self.lower = np.linspace(-4.0, -3.0, dimensions)
        self.upper = np.linspace(6.0, 9.0, dimensions)
        self.solution = self.lower + (self.upper - self.lower) * np.linspace(0.6, 0.8, dimensions)

    def cost(self, x):
        return ((x - self.solution) ** 2).sum(axis=2)


class ShiftedRosenbrock(Problem):
    """Rosenbrock's valley in three dimensions, moved; its minimum is 0."""

    name = "shifted rosenbrock"
    minimum = 0.0

    def __init__(self):
        self.solution = np.array([0.9, 1.3, 0.7])
        self.lower, self.upper = np.full(3, -2.0), np.full(3, 3.0)

    def cost(self, x):
        z = x - self.solution + 1.0
        return (100.0 * (z[..., 1:] - z[..., :-1] ** 2) ** 2 + (z[..., :-1] - 1.0) ** 2).sum(axis=2)


class Decay(Problem):
    """Samples of a exp(-b t) + c without noise: residuals with an analytic Jacobian."""

    name = "exponential decay"
    minimum = 0.0
    has_residuals = True

    def __init__(self, noise=0.0):
        self.solution = np.array([2.6, 1.4, -0.3])
        self.lower, self.upper = np.array([0.5, 0.2, -1.0]), np.array([4.0, 3.0, 1.0])
        self.t = np.linspace(0.0, 3.0, 20)
        a, b, c = self.solution
        self.y = a * np.exp(-b * self.t) + c + noise * np.cos(17.0 * np.arange(20))

    def residuals(self, x):
        a, b, c = (x[..., i, None] for i in range(3))
        return a * np.exp(-b * self.t) + c - self.y

    def cost(self, x):
        return (self.residuals(x) ** 2).sum(axis=2)

    def jacobian(self, x):
        a, b, _ = (x[..., i, None] for i in range(3))
        e = np.exp(-b * self.t)
        return np.stack([e, -a * self.t * e, np.ones_like(e)], axis=-1)


def calibration_problem():
    """The Loetters problem of the DPSO sensor, 24 poses without noise, its box off the truth."""
    return lower_loetters(DPSO.output(G * poses.turns()), G)


@dataclass
class Seen:
    """What a Watched problem was asked for."""

    points: list = field(default_factory=list)
    evaluations: int = 0

    def all(self):
        """Every point whose cost, residuals or Jacobian were asked for, shape (n, D), in order."""
        return np.concatenate([p.reshape(-1, p.shape[-1]) for p in self.points])


class Watched(Problem):
    """A problem that records every point it is evaluated at."""

    def __init__(self, problem, seen=None):
        self.problem, self.seen = problem, seen or Seen()
        self.name, self.lower, self.upper, self.minimum = (
            problem.name,
            problem.lower,
            problem.upper,
            problem.minimum,
        )
        self.has_residuals, self.has_closed_form = problem.has_residuals, problem.has_closed_form

    def _note(self, x):
        self.seen.points.append(np.array(x))
        self.seen.evaluations += x.shape[0] * x.shape[1]
        return x

    def cost(self, x):
        return self.problem.cost(self._note(x))

    def residuals(self, x):
        return self.problem.residuals(self._note(x))

    def jacobian(self, x):
        return self.problem.jacobian(self._note(x))

    def closed_form(self):
        return self.problem.closed_form()

    @property
    def units(self):
        return self.problem.units

    @property
    def groups(self):
        return self.problem.groups

    def take(self, index):
        return Watched(self.problem.take(index), self.seen)


class WatchedCurvature(Watched):
    """A Watched problem that knows its own gradient and Hessian."""

    def gradient_hessian(self, x):
        return self.problem.gradient_hessian(self._note(x))

    def take(self, index):
        return WatchedCurvature(self.problem.take(index), self.seen)


def watched(problem):
    """The problem, recording every point that it is evaluated at."""
    own = type(problem).gradient_hessian is not Problem.gradient_hessian
    return (WatchedCurvature if own else Watched)(problem)


class Holed(Watched):
    """A problem whose cost and residuals are NaN in a part of the box along the first coordinate."""

    def __init__(self, problem, share=0.3, seen=None):
        super().__init__(problem, seen)
        self.share = share
        self.edge = self.lower[0] + share * (self.upper[0] - self.lower[0])

    def cost(self, x):
        return np.where(x[..., 0] < self.edge, np.nan, super().cost(x))

    def residuals(self, x):
        return np.where(x[..., :1] < self.edge, np.nan, super().residuals(x))

    def take(self, index):
        return Holed(self.problem.take(index), self.share, self.seen)


@dataclass(frozen=True)
class Case:
    """A problem, and the cost that counts as having reached its minimum.

    Random search with the same number of evaluations stays orders of magnitude above it.
    """

    make: Callable[[], Problem]
    reached: float


CASES = {
    "sphere": Case(ShiftedSphere, 1e-9),
    "rosenbrock": Case(ShiftedRosenbrock, 5e-4),
    "residuals": Case(Decay, 1e-9),
    "calibration": Case(calibration_problem, 1e-4),
}
