"""What an optimizer minimises: a box, a cost, and where they exist residuals and their Jacobian.

Shapes everywhere: R runs, P points of a population, D dimensions, M residuals.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from accelcal_cli.arrays import Float, Int

Bound = Float | float
"""A limit of every coordinate: one number for all, or an array that broadcasts against (R, P, D)."""


class Problem(ABC):
    """A cost over a box.

    Attributes:
        name: for tables.
        lower, upper: the box, shape (D,).
        start: lower and upper corner of the region that starting points are drawn from; None is the whole box.
        minimum: the known least cost, or None.
        has_residuals: whether `residuals` and `jacobian` exist, with cost = sum of squared residuals.
        has_closed_form: whether `closed_form` exists.
    """

    name: str
    lower: Float
    upper: Float
    start: tuple[Float, Float] | None = None
    minimum: float | None = None
    has_residuals: bool = False
    has_closed_form: bool = False

    @property
    def dimensions(self) -> int:
        """D, the number of unknowns."""
        return int(self.lower.size)

    @property
    def units(self) -> Float:
        """How much of its own unit one step of each coordinate is, shape (D,) or (R, D)."""
        return np.ones(self.dimensions)

    @property
    def groups(self) -> Int:
        """Number of the group of alike unknowns that each coordinate belongs to, shape (D,)."""
        return np.zeros(self.dimensions, dtype=np.intp)

    @cached_property
    def limits(self) -> tuple[Bound, Bound]:
        """Lower and upper, as two numbers where all coordinates have the same: numpy clips faster by numbers."""
        alike = np.ptp(self.lower) == 0 and np.ptp(self.upper) == 0
        return (float(self.lower[0]), float(self.upper[0])) if alike else (self.lower, self.upper)

    @property
    def half_width(self) -> Float:
        """Half the width of the box, shape (D,)."""
        return np.asarray(0.5 * (self.upper - self.lower))

    @abstractmethod
    def cost(self, x: Float) -> Float:
        """Return the cost, shape (R, P), at x, shape (R, P, D)."""

    def gradient_hessian(self, x: Float) -> tuple[Float, Float]:
        """Return the gradient, shape (R, P, D), and Hessian, (R, P, D, D), of the cost at x, shape (R, P, D).

        By central differences of the cost, 2 D^2 evaluations per point, unless the problem knows better.
        """
        return differences(self, x)

    def residuals(self, x: Float) -> Float:
        """Return residuals whose squares sum to the cost, shape (R, P, M), at x, shape (R, P, D)."""
        raise NotImplementedError(f"{self.name} has no residuals")

    def jacobian(self, x: Float) -> Float:
        """Return d residual / d x, shape (R, P, M, D), at x, shape (R, P, D)."""
        raise NotImplementedError(f"{self.name} has no Jacobian")

    def closed_form(self) -> Float:
        """Return the solution that needs no search, shape (R, D) or (1, D); NaN where there is none."""
        raise NotImplementedError(f"{self.name} has no closed form")

    def take(self, index: Int) -> Problem:  # noqa: ARG002
        """Return the problem of the runs at `index`; itself when all runs share one problem."""
        return self


class FunctionProblem(Problem):
    """Any function over a box.

    Args:
        function: of points, shape (..., D), that returns their costs, shape (...); see `numpy.vectorize` for one that
            takes one point at a time.
        lower, upper: the box, shape (D,).
        name: for tables.

        >>> import numpy as np
        >>> from accelcal_cli.optimization.algorithms.de import DifferentialEvolution
        >>> from accelcal_cli.optimization.minimize import minimize
        >>> bowl = FunctionProblem(lambda x: ((x - 1.0) ** 2).sum(axis=-1), [-5.0, -5.0], [5.0, 5.0])
        >>> minimize(bowl, DifferentialEvolution()).x.round(6)
        array([[1., 1.]])
    """

    def __init__(
        self, function: Callable[[Float], Float], lower: ArrayLike, upper: ArrayLike, name: str = "function"
    ) -> None:
        """Take the box as arrays."""
        self.function, self.name = function, name
        self.lower, self.upper = np.array(lower, dtype=float), np.array(upper, dtype=float)

    def cost(self, x: Float) -> Float:
        """Return the function at every point, shape (R, P)."""
        return np.asarray(self.function(x), dtype=float)


class Counted(Problem):
    """A problem that counts its evaluations and remembers the best point of every run.

    Every point whose cost or residuals are asked for is one evaluation, and so is every Jacobian: algorithms
    never report their own counts. A NaN cost becomes +inf, so that no comparison can choose it.
    """

    def __init__(self, problem: Problem, runs: int) -> None:
        """Wrap `problem` for `runs` runs (R)."""
        self.problem = problem
        self.name, self.lower, self.upper = problem.name, problem.lower, problem.upper
        self.minimum = problem.minimum
        self.has_residuals, self.has_closed_form = problem.has_residuals, problem.has_closed_form
        self.runs, self.spent = runs, 0
        self.best_x: Float = np.full((runs, problem.dimensions), np.nan)
        self.best_cost: Float = np.full(runs, np.inf)

    @property
    def evaluations(self) -> NDArray[np.int64]:
        """Evaluations of each run, shape (R,); all runs are always evaluated together."""
        return np.full(self.runs, self.spent)

    def cost(self, x: Float) -> Float:
        """Return the cost with NaN as +inf; see `Problem.cost`."""
        fx = self.problem.cost(x)
        if len(fx) == 1:
            return self._alone(x, fx)
        column = fx.argmin(axis=1)  # the first NaN of a run with one
        least = points(fx, column)
        if math.isnan(least.dot(least)):
            fx = np.where(np.isnan(fx), np.inf, fx)
            column = fx.argmin(axis=1)
            least = points(fx, column)
        self._note(x, column, least)
        return fx

    def _alone(self, x: Float, fx: Float) -> Float:
        """Do for one run, on Python's own numbers, what `cost` does for many: in half the time."""
        column = fx.argmin()
        least = fx.item(column)
        if math.isnan(least):
            fx = np.where(np.isnan(fx), np.inf, fx)
            column = fx.argmin()
            least = fx.item(column)
        self.spent += x.shape[1]
        if least < self.best_cost.item():
            self.best_x, self.best_cost = x[:, column].copy(), fx[:, column].copy()
        return fx

    def residuals(self, x: Float) -> Float:
        """Return the residuals; their squares are noted as costs."""
        r = self.problem.residuals(x)
        fx = np.einsum("rpm,rpm->rp", r, r)
        fx = np.where(np.isnan(fx), np.inf, fx)
        column = fx.argmin(axis=1)
        self._note(x, column, points(fx, column))
        return r

    def jacobian(self, x: Float) -> Float:
        """Return the Jacobian, counted as one evaluation per point."""
        self.spent += x.shape[1]
        return self.problem.jacobian(x)

    @property
    def units(self) -> Float:
        """The problem's own units; see `Problem.units`."""
        return self.problem.units

    @property
    def groups(self) -> Int:
        """The problem's own groups; see `Problem.groups`."""
        return self.problem.groups

    def gradient_hessian(self, x: Float) -> tuple[Float, Float]:
        """Return gradient and Hessian; analytic ones count as one evaluation per point, differences as they are."""
        if type(self.problem).gradient_hessian is Problem.gradient_hessian:
            return differences(self, x)
        self.spent += x.shape[1]
        return self.problem.gradient_hessian(x)

    def closed_form(self) -> Float:
        """Return the closed form, which evaluates nothing."""
        return self.problem.closed_form()

    def take(self, index: Int) -> Counted:
        """Return the counted problem of the runs at `index`, with their counts and best points."""
        part = Counted(self.problem.take(index), len(index))
        part.spent = self.spent
        part.best_x, part.best_cost = self.best_x[index], self.best_cost[index]
        return part

    def _note(self, x: Float, column: Int, least: Float) -> None:
        """Enter points, which of each run is the best and its cost; best_x and best_cost become new arrays."""
        self.spent += x.shape[1]
        better = least < self.best_cost
        count = np.count_nonzero(better)
        if count == len(least):
            self.best_x, self.best_cost = points(x, column), least
        elif count:
            self.best_x = np.where(better[:, None], points(x, column), self.best_x)
            self.best_cost = np.minimum(least, self.best_cost)


def differences(problem: Problem, x: Float) -> tuple[Float, Float]:
    """Return gradient and Hessian of a cost by central differences; see `Problem.gradient_hessian`.

    The points stay in the box: next to a wall they are those of the nearest point that has room for them. The step
    is the fourth root of the rounding unit times the box, which balances truncation and rounding of a
    second difference.
    """
    D = problem.dimensions
    h = np.finfo(float).eps ** 0.25 * problem.half_width
    x = np.clip(x, problem.lower + 2.0 * h, problem.upper - 2.0 * h)
    f0, steps = problem.cost(x), np.diag(h)
    plus = np.stack([problem.cost(x + steps[i]) for i in range(D)], axis=-1)
    minus = np.stack([problem.cost(x - steps[i]) for i in range(D)], axis=-1)
    gradient = (plus - minus) / (2.0 * h)
    hessian = np.empty((*x.shape, D))
    for i in range(D):
        hessian[..., i, i] = (plus[..., i] - 2.0 * f0 + minus[..., i]) / h[i] ** 2
        for j in range(i):
            both = problem.cost(x + steps[i] + steps[j]) + problem.cost(x - steps[i] - steps[j])
            mixed = (both - plus[..., i] - plus[..., j] - minus[..., i] - minus[..., j] + 2.0 * f0) / (
                2 * h[i] * h[j]
            )
            hessian[..., i, j] = hessian[..., j, i] = mixed
    return gradient, hessian


def points(x: Float, index: Int) -> Float:
    """Return the point (or cost) of each run's population, (R, P, ...), at its index, (R,): a copy, shape (R, ...)."""
    if len(index) == 1:  # Indexing by one number is several times as fast as by arrays.
        return x[:, index[0]].copy()
    return np.asarray(x[np.arange(len(index)), index])
