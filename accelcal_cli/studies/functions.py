"""Test functions with known minima: those of the papers, and standard ones from the literature.

All have the minimum 0 at a known point. The optimum may be moved off the centre of the box and the coordinates
rotated about it: that exposes an optimizer that only finds the centre, or only moves along the axes.

The formulas take z, shape (..., D), and return costs of shape (...). Functions that are sums of squares also have
residuals, shape (..., M), and Jacobians, shape (..., M, D), for least-squares methods.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float, Int
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Purpose, Streams

SCHWEFEL_POINT = 420.968746359982
SCHWEFEL_LEVEL = SCHWEFEL_POINT * math.sin(math.sqrt(SCHWEFEL_POINT))
STYBLINSKI_POINT = -2.903534027771177
STYBLINSKI_LEVEL = STYBLINSKI_POINT**4 - 16.0 * STYBLINSKI_POINT**2 + 5.0 * STYBLINSKI_POINT


def sphere(z: Float) -> Float:
    """Return sum z_i^2. [dpso2014] section 3.1."""
    return np.asarray(np.add.reduce(z * z, axis=-1))


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
    return np.asarray(np.add.reduce(valley, axis=-1))


def modified_rosenbrock(z: Float) -> Float:
    """Return sum 100 (z_{i+1} + z_i^2)^2 + (z_i + 1)^2, minimum at -1. [ifoa2021] section 3.1, reconstructed."""
    return rosenbrock(-z)


def rastrigin(z: Float) -> Float:
    """Return sum z_i^2 - 10 cos(2 pi z_i) + 10. [dpso2014] section 3.1."""
    waves = np.cos(2.0 * math.pi * z)
    waves *= -10.0
    waves += z * z
    waves += 10.0
    return np.asarray(np.add.reduce(waves, axis=-1))


def griewank(z: Float) -> Float:
    """Return sum z_i^2 / 4000 - prod cos(z_i / sqrt(i)) + 1. [dpso2014] section 3.1."""
    waves = np.multiply.reduce(np.cos(z / np.sqrt(np.arange(1.0, z.shape[-1] + 1.0))), axis=-1)
    return np.asarray(np.add.reduce(z * z, axis=-1) / 4000.0 - waves + 1.0)


def ackley(z: Float) -> Float:
    """Return Ackley's function: 20 + e - 20 exp(-0.2 rms(z)) - exp(mean cos(2 pi z)). [jamil2013] 1."""
    rms = np.sqrt(np.mean(z * z, axis=-1))
    total = 20.0 + math.e - 20.0 * np.exp(-0.2 * rms) - np.exp(np.mean(np.cos(2 * math.pi * z), axis=-1))
    return np.asarray(np.maximum(total, 0.0))  # rounding would leave -4e-16


def schwefel(z: Float) -> Float:
    """Return 418.98 D - sum z_i sin(sqrt |z_i|), continued quadratically beyond 500. [jamil2013] 2.26."""
    inside = np.clip(z, -500.0, 500.0)
    waves = inside * np.sin(np.sqrt(np.abs(inside)))
    beyond = z - inside
    return np.asarray(np.add.reduce(SCHWEFEL_LEVEL - waves + beyond * beyond, axis=-1))


def levy(z: Float) -> Float:
    """Return Levy's function with w = 1 + (z - 1) / 4. [laguna2005]."""
    w = 1.0 + (z - 1.0) / 4.0
    head = np.sin(math.pi * w[..., 0]) ** 2
    body = (w[..., :-1] - 1.0) ** 2 * (1.0 + 10.0 * np.sin(math.pi * w[..., :-1] + 1.0) ** 2)
    tail = (w[..., -1] - 1.0) ** 2 * (1.0 + np.sin(2.0 * math.pi * w[..., -1]) ** 2)
    return np.asarray(head + np.add.reduce(body, axis=-1) + tail)


def zakharov(z: Float) -> Float:
    """Return s + t^2 + t^4 with s = sum z_i^2, t = sum i z_i / 2. [jamil2013] 173."""
    t = z @ _ramp(z)
    return np.asarray(np.add.reduce(z * z, axis=-1) + t**2 + t**4)


def elliptic(z: Float) -> Float:
    """Return sum 10^(6 (i - 1) / (D - 1)) z_i^2: a bowl a thousand times as long as wide. [hansen2016]."""
    return np.asarray(np.add.reduce(elliptic_weights(z.shape[-1]) * (z * z), axis=-1))


def elliptic_weights(dimensions: int) -> Float:
    """Return the D coefficients of `elliptic`."""
    return np.logspace(0.0, 6.0, dimensions)


def styblinski_tang(z: Float) -> Float:
    """Return sum (z_i^4 - 16 z_i^2 + 5 z_i) / 2 above its least value, -39.166 D. [jamil2013] 144."""
    square = z * z
    total = np.add.reduce(square * square - 16.0 * square + 5.0 * z - STYBLINSKI_LEVEL, axis=-1)
    return np.asarray(np.maximum(0.5 * total, 0.0))  # rounding would leave -1e-14


def _diagonal(z: Float, weights: Float) -> Float:
    """Return a constant diagonal Jacobian for every point."""
    return np.broadcast_to(np.diag(weights), (*z.shape, z.shape[-1])).copy()


def _identity(z: Float) -> Float:
    return _diagonal(z, np.ones(z.shape[-1]))


def _elliptic_roots(z: Float) -> Float:
    return np.asarray(np.sqrt(elliptic_weights(z.shape[-1])))


def _valley(z: Float) -> Float:
    """Rosenbrock: r = 10 (z_{i+1} - z_i^2), then z_i - 1."""
    first = z[..., :-1]
    return np.concatenate([10.0 * (z[..., 1:] - first * first), first - 1.0], axis=-1)


def _valley_jacobian(z: Float) -> Float:
    D = z.shape[-1]
    rows = np.arange(D - 1)
    J = np.zeros((*z.shape[:-1], 2 * (D - 1), D))
    J[..., rows, rows] = -20.0 * z[..., :-1]
    J[..., rows, rows + 1] = 10.0
    J[..., D - 1 + rows, rows] = 1.0
    return J


def _zakharov(z: Float) -> Float:
    """Zakharov: r = z_i, then t and t^2 with t = sum i z_i / 2."""
    t = z @ _ramp(z)
    return np.concatenate([z, t[..., None], (t * t)[..., None]], axis=-1)


def _zakharov_jacobian(z: Float) -> Float:
    last = np.broadcast_to(_ramp(z), z.shape)
    t = z @ _ramp(z)
    return np.concatenate(
        [_identity(z), last[..., None, :], (2.0 * t[..., None] * last)[..., None, :]],
        axis=-2,
    )


def _ramp(z: Float) -> Float:
    return 0.5 * np.arange(1.0, z.shape[-1] + 1.0)


MARGIN = 0.1
"""A moved optimum stays away from the walls by this part of the half-width of the box."""


@dataclass(frozen=True)
class Definition:
    """A test function.

    Attributes:
        formula: of z, shape (..., D).
        low, high: box of every coordinate; optimum: each coordinate of the minimiser.
        start: box of the starting points, where it is not the whole box.
        residuals, jacobian: r(z), whose squares sum to the function, and dr/dz, of a sum of squares.
    """

    formula: Callable[[Float], Float]
    low: float
    high: float
    optimum: float = 0.0
    start: tuple[float, float] | None = None
    residuals: Callable[[Float], Float] | None = None
    jacobian: Callable[[Float], Float] | None = None


FUNCTIONS = {
    "sphere": Definition(sphere, -100, 100, residuals=lambda z: z, jacobian=_identity),
    "rosenbrock": Definition(rosenbrock, -30, 30, 1.0, residuals=_valley, jacobian=_valley_jacobian),
    "rastrigin": Definition(rastrigin, -5.12, 5.12),
    "griewank": Definition(griewank, -600, 600),
    "modified-rosenbrock": Definition(
        *(modified_rosenbrock, -30, 30, -1.0, (-1.0, 1.0)),
        residuals=lambda z: _valley(-z),
        jacobian=lambda z: -_valley_jacobian(-z),
    ),
    "ackley": Definition(ackley, -32.768, 32.768),
    "schwefel": Definition(schwefel, -500, 500, SCHWEFEL_POINT),
    "levy": Definition(levy, -10, 10, 1.0),
    "zakharov": Definition(zakharov, -5, 10, residuals=_zakharov, jacobian=_zakharov_jacobian),
    "elliptic": Definition(
        *(elliptic, -100, 100),
        residuals=lambda z: z * _elliptic_roots(z),
        jacobian=lambda z: _diagonal(z, _elliptic_roots(z)),
    ),
    "styblinski-tang": Definition(styblinski_tang, -5, 5, STYBLINSKI_POINT),
}
"""By name: boxes of the first four from [dpso2014] section 3.1, of the others as usual in the literature."""

MIRRORED = ("modified-rosenbrock",)
"""Functions that are another one mirrored: "all" leaves them out, so that it counts none twice."""

PAPER = ("sphere", "rosenbrock", "rastrigin", "griewank")


def select(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of known test functions; none means those of the paper, "all" all that are not MIRRORED.

    Raises:
        ConfigError: an unknown name.
    """
    for name in names:
        if name != "all":
            _definition(name)
    if "all" not in names:
        return tuple(names) or PAPER
    return tuple(name for name in FUNCTIONS if name not in MIRRORED or name in names)


def _definition(name: str) -> Definition:
    if name not in FUNCTIONS:
        raise ConfigError(
            f'unknown function "{name}"{did_you_mean(name, FUNCTIONS)}; known: {", ".join(FUNCTIONS)}'
        )
    return FUNCTIONS[name]


def rotations(normal: Float) -> Float:
    """Return rotations of D coordinates, uniform over SO(D) (Haar), shape (K, D, D), from N(0, 1) numbers alike.

    Q of the QR decomposition is uniform over O(D) once R has a positive diagonal [mezzadri2007]; of a reflection one
    column is turned round, so that the determinant is 1.
    """
    Q, R = np.linalg.qr(normal)
    Q = Q * np.sign(np.einsum("kii->ki", R))[:, None, :]
    Q[:, :, 0] *= np.linalg.det(Q).round()[:, None]
    return np.asarray(Q)


class TestFunction(Problem):
    """A test function over its box, with its optimum moved or its coordinates rotated if wanted.

    Args:
        name: key of FUNCTIONS.
        dimensions: D >= 2.
        shift: move the optimum to a random place in the box, and the box of the starting points with it.
        rotate: rotate the coordinates about the optimum at random, by a matrix uniform over all rotations.
        seed: of position and rotation.
        instances: numbers of the places and rotations, one for all runs or one for each, shape (R,).

    Attributes:
        optimum: the minimiser, shape (D,), or with several instances (R, 1, D).

    Raises:
        ConfigError: no such function.
    """

    __test__ = False  # not a test case, whatever pytest makes of the name
    minimum = 0.0

    def __init__(
        self,
        name: str,
        dimensions: int,
        *,
        shift: bool = False,
        rotate: bool = False,
        seed: int = 0,
        instances: Sequence[int] = (0,),
    ) -> None:
        """Draw the position of the optimum and the rotation."""
        self.name, self.definition = name, (definition := _definition(name))
        self.lower, self.upper = np.full((2, dimensions), [[float(definition.low)], [float(definition.high)]])
        stream = Streams(seed, instances, Purpose.SHIFT)
        centre, half = 0.5 * (self.lower + self.upper), 0.5 * (self.upper - self.lower)
        position = centre + (1.0 - MARGIN) * half * (2.0 * stream.uniform(1, dimensions) - 1.0)
        rotation = rotations(stream.normal(dimensions, dimensions)) if rotate else None
        if len(instances) == 1:
            position, rotation = position[0, 0], None if rotation is None else rotation[0]
        self.optimum = position if shift else np.full(dimensions, definition.optimum)
        self._offset = self.optimum - definition.optimum if shift else None
        self._rotation: Float | None = rotation
        if definition.start:
            moved = 0.0 if self._offset is None else self._offset
            low, high = (np.full(dimensions, limit) + moved for limit in definition.start)
            self.start = np.clip(low, self.lower, self.upper), np.clip(high, self.lower, self.upper)
        self.has_residuals = definition.residuals is not None

    def take(self, index: Int) -> TestFunction:
        """Return the function of the runs at `index`: with several instances each run has its own."""
        part = copy.copy(self)
        if self.optimum.ndim > 1:
            part.optimum = self.optimum[index]
        if self._offset is not None and self._offset.ndim > 1:
            part._offset = self._offset[index]
            if self.start is not None:
                part.start = self.start[0][index], self.start[1][index]
        if self._rotation is not None and self._rotation.ndim > 2:
            part._rotation = self._rotation[index]
        return part

    def cost(self, x: Float) -> Float:
        """Return the function, shape (R, P), at x, shape (R, P, D)."""
        return self.definition.formula(self._inner(x))

    def residuals(self, x: Float) -> Float:
        """Return the residuals whose squares sum to the function; see `Problem.residuals`."""
        if self.definition.residuals is None:
            raise NotImplementedError(f"{self.name} is not a sum of squares")
        return self.definition.residuals(self._inner(x))

    def jacobian(self, x: Float) -> Float:
        """Return the derivatives of the residuals; see `Problem.jacobian`."""
        if self.definition.jacobian is None:
            raise NotImplementedError(f"{self.name} is not a sum of squares")
        inner = self.definition.jacobian(self._inner(x))
        if self._rotation is None:
            return inner
        return np.asarray(inner @ (self._rotation if self._rotation.ndim == 2 else self._rotation[:, None]))

    def _inner(self, x: Float) -> Float:
        """Return z: x in the coordinates of the formula."""
        z = x if self._offset is None else x - self._offset
        if self._rotation is None:
            return z
        away = z - self.definition.optimum
        return np.asarray((self._rotation @ away.swapaxes(1, 2)).swapaxes(1, 2) + self.definition.optimum)
