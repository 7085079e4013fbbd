"""IFOA: the improved fruit fly optimization algorithm [ifoa2021].

Dai Hongde et al., "Calibration of MEMS accelerometer without turntable based on IFOA", J. BUAA 2021, 47(10). Two
changes to FOA: the candidate is the fly itself, S = X, so that parameters may be negative, and the search radius
shrinks with the best cost, by a factor alpha for every decade below the threshold sigma. The formula of the
exponent is lost in print; p = floor(log10(sigma / best)) is the one that reaches the paper's tolerance with the
paper's constants (docs/explanation/reproduction.md shows the alternatives failing).

One radius serves all parameters, in the units of the readings. The authors name several radii as future work:
`radius_scale` holds one factor for each group of parameters (scale factors, misalignments, biases).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.operators import moved_to_best
from accelcal_cli.optimization.optimizer import OPTIMIZERS, Optimizer, State, Status
from accelcal_cli.optimization.problem import Problem
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting

PART_OF_BOX = 0.4
"""Radius when none is stated, as a part of the first coordinate's half box: 2 % of a scale factor in the default
box of 5 %, which is what the paper's 1e4 pulses are."""


ROUNDINGS = {"floor": np.floor, "round": np.rint, "ceil": np.ceil}


@dataclass(frozen=True, eq=False)
class FlyState(State):
    """Swarms on a line: x and fx are the last candidates and their smells."""

    axis: Float  # X_axis, (R, 1, D)
    smell: Float  # Smell_best, (R,)
    threshold: Float  # sigma, (R,)


@OPTIMIZERS.register("ifoa")
@dataclass(frozen=True)
class ImprovedFruitFly(Optimizer[FlyState]):
    """IFOA: S = X and a radius that shrinks with the best cost."""

    family = "fruit fly"
    paper = "ifoa2021"

    population: int = setting(10, "candidates of a generation (n)", low=4, high=1_000_000)
    iterations: int = setting(20_000, "generations (Maxgen)", low=1, high=100_000_000)
    radius: float | None = setting(
        None, "first search radius in the units of the unknowns (Delta); automatic when left out", above=0
    )
    shrink: float = setting(0.25, "radius factor for a decade of cost (alpha)", above=0, high=1)
    threshold: float | None = setting(
        None, "cost below which the radius shrinks (sigma); the median start cost when left out", above=0
    )
    radius_scale: tuple[float, ...] = setting(
        (1.0, 1.0, 1.0), "radius factor of each group: scale factors, misalignments, biases"
    )
    rounding: Literal["floor", "round", "ceil", "1+floor"] = setting(
        "floor", "how the exponent p becomes a whole number, which the lost formula may do in another way"
    )

    def __post_init__(self) -> None:
        """Refuse a radius factor that is not positive."""
        super().__post_init__()
        if not self.radius_scale or min(self.radius_scale) <= 0:
            raise ConfigError("radius_scale: expected positive numbers, one for each group of parameters")

    def init(self, problem: Problem, x: Float, rng: Streams) -> FlyState:
        """Start at the first point; the costs of all of them give the threshold when none is stated."""
        fx = problem.cost(x)
        threshold = _middle(fx) if self.threshold is None else np.full(len(x), self.threshold)
        return FlyState(x, fx, x[:, :1], fx[:, 0], threshold)

    def step(self, problem: Problem, state: FlyState, rng: Streams) -> FlyState:
        """Fly at random within the radius; move the swarm to the best fly if it is better."""
        population, dimensions = state.x.shape[1:]
        radius = self.reach(problem) * self.shrink ** self.exponent(state)[:, None, None]
        flies = state.axis + radius * (2.0 * rng.uniform(population, dimensions) - 1.0)  # step 2'
        np.clip(flies, problem.lower, problem.upper, out=flies)  # S = X, step 3'
        fx = problem.cost(flies)
        axis, smell = moved_to_best(state.axis, state.smell, flies, fx)
        # Below the spacing of doubles around the swarm no fly differs from it any more.
        stuck = (radius < np.spacing(np.abs(axis))).all(axis=(1, 2))
        status = np.where(stuck, Status.CONVERGED, Status.RUNNING).astype(np.int8)
        return FlyState(flies, fx, axis, smell, state.threshold, status=status)

    def exponent(self, state: FlyState) -> Float:
        """Return p, shape (R,): 0 above the threshold, else floor(log10(sigma / Smell_best)). [ifoa2021] section 6."""
        decades = np.log10(state.threshold / np.maximum(state.smell, 1e-300))
        if self.rounding == "1+floor":
            return np.where(decades < 0.0, 0.0, 1.0 + np.floor(decades))
        return np.maximum(ROUNDINGS[self.rounding](decades), 0.0)

    def reach(self, problem: Problem) -> Float:
        """Return Delta of every coordinate in the problem's coordinates, shape (1 or R, 1, D)."""
        units = np.atleast_2d(problem.units)
        automatic = PART_OF_BOX * problem.half_width[:1] * units[:, :1]
        first = np.full((len(units), 1), self.radius) if self.radius else automatic
        scale = np.array(self.radius_scale)[np.minimum(problem.groups, len(self.radius_scale) - 1)]
        return np.asarray((first * scale / units)[:, None, :])


def _middle(fx: Float) -> Float:
    """Return the median cost of each run, shape (R,); a point without a cost counts as the worst that has one."""
    finite = np.isfinite(fx)
    worst = np.where(finite, fx, 0.0).max(axis=1, keepdims=True)
    return np.asarray(np.median(np.where(finite, fx, worst), axis=1))
