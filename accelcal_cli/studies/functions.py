"""Test functions with known minima: those of the papers and the standard ones a reader expects.

All have the minimum 0 at a known point. The optimum may be moved off the centre of the box and the coordinates
rotated about it: an optimizer that only finds the centre, or only moves along the axes, is exposed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.problem import Problem
from accelcal_cli.streams import Float, Purpose, Streams
from accelcal_cli.studies import formulas, squares

MARGIN = 0.1
"""A moved optimum keeps this part of the half box from the walls."""


@dataclass(frozen=True)
class Definition:
    """A test function: formula of z, shape (..., D), box of every coordinate, minimiser, start box, squares."""

    formula: Callable[[Float], Float]
    low: float
    high: float
    optimum: float = 0.0
    start: tuple[float, float] | None = None
    squares: squares.Squares | None = None


FUNCTIONS = {
    "sphere": Definition(formulas.sphere, -100, 100, squares=squares.SPHERE),
    "rosenbrock": Definition(formulas.rosenbrock, -30, 30, 1.0, squares=squares.ROSENBROCK),
    "rastrigin": Definition(formulas.rastrigin, -5.12, 5.12),
    "griewank": Definition(formulas.griewank, -600, 600),
    "modified-rosenbrock": Definition(
        formulas.modified_rosenbrock, -30, 30, -1.0, (-1.0, 1.0), squares.MODIFIED_ROSENBROCK
    ),
    "ackley": Definition(formulas.ackley, -32.768, 32.768),
    "schwefel": Definition(formulas.schwefel, -500, 500, formulas.SCHWEFEL_POINT),
    "levy": Definition(formulas.levy, -10, 10, 1.0),
    "zakharov": Definition(formulas.zakharov, -5, 10, squares=squares.ZAKHAROV),
    "elliptic": Definition(formulas.elliptic, -100, 100, squares=squares.ELLIPTIC),
    "styblinski-tang": Definition(formulas.styblinski_tang, -5, 5, formulas.STYBLINSKI_POINT),
}
"""By name: boxes of the first four from [dpso2014] section 3.1, of the others as usual in the literature."""

PAPER = ("sphere", "rosenbrock", "rastrigin", "griewank")


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of known test functions; none means those of the paper, "all" means all.

    Raises:
        ConfigError: an unknown name.
    """
    for name in names:
        if name != "all" and name not in FUNCTIONS:
            raise ConfigError(_unknown(name))
    return tuple(FUNCTIONS) if "all" in names else tuple(names) or PAPER


def _unknown(name: str) -> str:
    return f'unknown function "{name}"{did_you_mean(name, FUNCTIONS)}; known: {", ".join(FUNCTIONS)}'


class TestFunction(Problem):
    """A test function over its box, its optimum possibly moved and its coordinates turned.

    Args:
        name: key of FUNCTIONS.
        dimensions: D >= 2.
        shift: move the optimum to a random place in the box.
        rotate: turn the coordinates about the optimum by a random rotation.
        seed: of place and rotation.

    Raises:
        ConfigError: no such function.
    """

    __test__ = False  # not a test case, whatever pytest makes of the name
    minimum = 0.0

    def __init__(
        self, name: str, dimensions: int, *, shift: bool = False, rotate: bool = False, seed: int = 0
    ) -> None:
        """Draw the place of the optimum and the rotation."""
        if name not in FUNCTIONS:
            raise ConfigError(_unknown(name))
        definition = FUNCTIONS[name]
        self.name, self.definition = name, definition
        self.lower, self.upper = (
            np.full(dimensions, float(definition.low)),
            np.full(dimensions, float(definition.high)),
        )
        if definition.start:
            low, high = definition.start
            self.start = np.full(dimensions, low), np.full(dimensions, high)
        stream = Streams(seed, [0], Purpose.SHIFT)
        centre, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        place = centre + (1.0 - MARGIN) * half * (2.0 * stream.uniform(1, dimensions)[0, 0] - 1.0)
        self.optimum = place if shift else np.full(dimensions, definition.optimum)
        self._offset = self.optimum - definition.optimum if shift else None
        self._turn = np.linalg.qr(stream.normal(dimensions, dimensions)[0])[0] if rotate else None

        self.has_residuals = definition.squares is not None

    def cost(self, x: Float) -> Float:
        """Return the function, shape (R, P), at x, shape (R, P, D)."""
        return self.definition.formula(self._inner(x))

    def residuals(self, x: Float) -> Float:
        """Return the residuals whose squares sum to the function; see `Problem.residuals`."""
        return self._squares().residuals(self._inner(x))

    def jacobian(self, x: Float) -> Float:
        """Return the derivatives of the residuals; see `Problem.jacobian`."""
        inner = self._squares().jacobian(self._inner(x))
        return inner if self._turn is None else inner @ self._turn

    def _squares(self) -> squares.Squares:
        if self.definition.squares is None:
            raise NotImplementedError(f"{self.name} is no sum of squares")
        return self.definition.squares

    def _inner(self, x: Float) -> Float:
        """Return z, where the formula has its optimum at its own place and its own axes."""
        z = x if self._offset is None else x - self._offset
        if self._turn is None:
            return z
        away = z - self.definition.optimum
        turned: Float = (self._turn @ away.swapaxes(1, 2)).swapaxes(1, 2) + self.definition.optimum
        return turned
