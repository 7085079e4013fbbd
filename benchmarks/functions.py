"""The four test functions of the DPSO paper, section 3.2, each as a problem over its box [dpso2014].

Every cost is written for a population-contiguous array (see `accelcal_cli.streams`): sums run over the
coordinates, the slow axis, and temporaries are reused in place.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.problem import Problem
from accelcal_cli.streams import Float


class TestFunction(Problem):
    """A function of D coordinates over the box [-half, half]^D, least cost 0."""

    half: float
    minimum = 0.0

    def __init__(self, dimensions: int = 12) -> None:
        """Set the box."""
        self.lower = np.full(dimensions, -self.half)
        self.upper = np.full(dimensions, self.half)


class Sphere(TestFunction):
    """sum_i x_i^2, least at 0."""

    name, half = "sphere", 100.0

    def cost(self, x: Float) -> Float:
        """Return the cost, shape (R, P), at x, shape (R, P, D)."""
        return total(x * x)


class Rosenbrock(TestFunction):
    """sum_i 100 (x_{i+1} - x_i^2)^2 + (x_i - 1)^2, least at (1, ..., 1)."""

    name, half = "rosenbrock", 30.0

    def cost(self, x: Float) -> Float:
        """Return the cost, shape (R, P), at x, shape (R, P, D)."""
        this = x[..., :-1]
        valley = this * this
        np.subtract(x[..., 1:], valley, out=valley)
        valley *= valley
        valley *= 100.0
        slope = this - 1.0
        slope *= slope
        valley += slope
        return total(valley)


class Rastrigin(TestFunction):
    """sum_i x_i^2 - 10 cos(2 pi x_i) + 10, least at 0."""

    name, half = "rastrigin", 5.12

    def cost(self, x: Float) -> Float:
        """Return the cost, shape (R, P), at x, shape (R, P, D)."""
        ripple = (2.0 * np.pi) * x
        np.cos(ripple, out=ripple)
        np.subtract(1.0, ripple, out=ripple)
        ripple *= 10.0
        ripple += x * x
        return total(ripple)


class Griewank(TestFunction):
    """1 + sum_i x_i^2 / 4000 - prod_i cos(x_i / sqrt(i)), least at 0."""

    name, half = "griewank", 600.0

    def __init__(self, dimensions: int = 12) -> None:
        """Keep 1 / sqrt(i), i from 1."""
        super().__init__(dimensions)
        self._scale = 1.0 / np.sqrt(np.arange(1.0, dimensions + 1.0))

    def cost(self, x: Float) -> Float:
        """Return the cost, shape (R, P), at x, shape (R, P, D)."""
        ripple = self._scale * x
        np.cos(ripple, out=ripple)
        bowl = total(x * x)
        bowl /= 4000.0
        bowl += 1.0
        bowl -= np.multiply.reduce(ripple, axis=-1)
        return bowl


def total(terms: Float) -> Float:
    """Return the sum over the coordinates: shape (R, P) of (R, P, D)."""
    result: Float = np.add.reduce(terms, axis=-1)
    return result


FUNCTIONS: dict[str, type[TestFunction]] = {f.name: f for f in (Sphere, Rosenbrock, Rastrigin, Griewank)}
