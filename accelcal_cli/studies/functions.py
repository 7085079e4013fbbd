"""Test functions with known minima: those of the papers and the standard ones a reader expects.

All have the minimum 0 at a known point. The optimum may be moved off the centre of the box and the coordinates
rotated about it: an optimizer that only finds the centre, or only moves along the axes, is exposed.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.problem import Problem
from accelcal_cli.streams import Float, Streams

SHIFT_PURPOSE = 4
MARGIN = 0.1
"""A moved optimum keeps this part of the half box from the walls."""


def sphere(z: Float) -> Float:
    """Return sum z_i^2. [dpso2014] section 3.1."""
    total: Float = np.add.reduce(z * z, axis=-1)
    return total


def rosenbrock(z: Float) -> Float:
    """Return sum 100 (z_{i+1} - z_i^2)^2 + (z_i - 1)^2. [dpso2014] section 3.1."""
    first = z[..., :-1]
    valley = first * first
    np.subtract(z[..., 1:], valley, out=valley)
    valley *= valley
    valley *= 100.0
    slope = first - 1.0
    slope *= slope
    valley += slope
    total: Float = np.add.reduce(valley, axis=-1)
    return total


def modified_rosenbrock(z: Float) -> Float:
    """Return sum 100 (z_{i+1} + z_i^2)^2 + (z_i + 1)^2, minimum at -1. [ifoa2021] section 3.1, reconstructed."""
    return rosenbrock(-z)


def rastrigin(z: Float) -> Float:
    """Return sum z_i^2 - 10 cos(2 pi z_i) + 10. [dpso2014] section 3.1."""
    waves = np.cos(2.0 * math.pi * z)
    waves *= -10.0
    waves += z * z
    waves += 10.0
    total: Float = np.add.reduce(waves, axis=-1)
    return total


def griewank(z: Float) -> Float:
    """Return sum z_i^2 / 4000 - prod cos(z_i / sqrt(i)) + 1. [dpso2014] section 3.1."""
    roots = np.sqrt(np.arange(1.0, z.shape[-1] + 1.0))
    waves = np.multiply.reduce(np.cos(z / roots), axis=-1)
    total: Float = np.add.reduce(z * z, axis=-1) / 4000.0 - waves + 1.0
    return total


def ackley(z: Float) -> Float:
    """Return Ackley's function: 20 + e - 20 exp(-0.2 rms(z)) - exp(mean cos(2 pi z)). [jamil2013] 1."""
    rms = np.sqrt(np.mean(z * z, axis=-1))
    total = 20.0 + math.e - 20.0 * np.exp(-0.2 * rms) - np.exp(np.mean(np.cos(2 * math.pi * z), axis=-1))
    least: Float = np.maximum(total, 0.0)  # rounding would leave -4e-16
    return least


def schwefel(z: Float) -> Float:
    """Return 418.98 D - sum z_i sin(sqrt |z_i|), continued quadratically beyond 500. [jamil2013] 2.26."""
    inside = np.clip(z, -500.0, 500.0)
    waves = inside * np.sin(np.sqrt(np.abs(inside)))
    beyond = z - inside
    total: Float = np.add.reduce(SCHWEFEL_LEVEL - waves + beyond * beyond, axis=-1)
    return total


def levy(z: Float) -> Float:
    """Return Levy's function with w = 1 + (z - 1) / 4. [laguna2005]."""
    w = 1.0 + (z - 1.0) / 4.0
    head = np.sin(math.pi * w[..., 0]) ** 2
    body = (w[..., :-1] - 1.0) ** 2 * (1.0 + 10.0 * np.sin(math.pi * w[..., :-1] + 1.0) ** 2)
    tail = (w[..., -1] - 1.0) ** 2 * (1.0 + np.sin(2.0 * math.pi * w[..., -1]) ** 2)
    total: Float = head + np.add.reduce(body, axis=-1) + tail
    return total


def zakharov(z: Float) -> Float:
    """Return s + t^2 + t^4 with s = sum z_i^2, t = sum i z_i / 2. [jamil2013] 173."""
    t = z @ (0.5 * np.arange(1.0, z.shape[-1] + 1.0))
    total: Float = np.add.reduce(z * z, axis=-1) + t**2 + t**4
    return total


SCHWEFEL_POINT = 420.968746359982
SCHWEFEL_LEVEL = SCHWEFEL_POINT * math.sin(math.sqrt(SCHWEFEL_POINT))


@dataclass(frozen=True)
class Definition:
    """A test function: formula of z, shape (..., D), box of every coordinate, minimiser, start box."""

    formula: Callable[[Float], Float]
    low: float
    high: float
    optimum: float = 0.0
    start: tuple[float, float] | None = None


FUNCTIONS = {
    "sphere": Definition(sphere, -100, 100),
    "rosenbrock": Definition(rosenbrock, -30, 30, 1.0),
    "rastrigin": Definition(rastrigin, -5.12, 5.12),
    "griewank": Definition(griewank, -600, 600),
    "modified-rosenbrock": Definition(modified_rosenbrock, -30, 30, -1.0, (-1.0, 1.0)),
    "ackley": Definition(ackley, -32.768, 32.768),
    "schwefel": Definition(schwefel, -500, 500, SCHWEFEL_POINT),
    "levy": Definition(levy, -10, 10, 1.0),
    "zakharov": Definition(zakharov, -5, 10),
}
"""By name: boxes of the first four from [dpso2014] section 3.1, of the others as usual in the literature."""

PAPER = ("sphere", "rosenbrock", "rastrigin", "griewank")


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
            raise ConfigError(
                f'unknown function "{name}"{did_you_mean(name, FUNCTIONS)}; known: {", ".join(FUNCTIONS)}'
            )
        definition = FUNCTIONS[name]
        self.name, self.definition = name, definition
        self.lower, self.upper = (
            np.full(dimensions, float(definition.low)),
            np.full(dimensions, float(definition.high)),
        )
        if definition.start:
            low, high = definition.start
            self.start = np.full(dimensions, low), np.full(dimensions, high)
        stream = Streams(seed, [0], purpose=SHIFT_PURPOSE)
        centre, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        place = centre + (1.0 - MARGIN) * half * (2.0 * stream.uniform(1, dimensions)[0, 0] - 1.0)
        self.optimum = place if shift else np.full(dimensions, definition.optimum)
        self._offset = self.optimum - definition.optimum if shift else None
        self._turn = np.linalg.qr(stream.normal(dimensions, dimensions)[0])[0] if rotate else None

    def cost(self, x: Float) -> Float:
        """Return the function, shape (R, P), at x, shape (R, P, D)."""
        z = x if self._offset is None else x - self._offset
        if self._turn is not None:
            away = z - self.definition.optimum
            z = (self._turn @ away.swapaxes(1, 2)).swapaxes(1, 2) + self.definition.optimum
        return self.definition.formula(z)
