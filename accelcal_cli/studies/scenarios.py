"""What the runs of a calibration study calibrate: simulated sensors of known errors, or one recording.

A block of runs shares one problem, with the truth by which its results are judged. Run r draws its sensor, its noise
and its box from its own streams, so that it is the same in any block.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.calibrate import calibrate
from accelcal_cli.calibration.problem import (
    Box,
    Loetters,
    Triangle,
    compress_each,
    fit_ellipsoid,
    pack,
    packed,
)
from accelcal_cli.calibration.sample import Sample
from accelcal_cli.calibration.search import SHIFT, half_widths
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.errors import ConfigError, DataError
from accelcal_cli.io.readings import Readings
from accelcal_cli.optimization.minimize import polish
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.model import ARCSEC, MICRO_G, PPM, ErrorModel, to_gauge, triangular
from accelcal_cli.sensor.poses import directions
from accelcal_cli.sensor.simulation import Sensor, draw

FEWEST = 9
"""Poses that nine parameters need."""


@dataclass(frozen=True)
class SearchSpace:
    """The search space of a calibration study.

    Attributes:
        g: local gravity, m/s^2.
        unknowns: 9 (lower-triangular K_a) or 12 (full, as the DPSO and AKPSO papers search).
        box: half-widths; nominal: scale factor in the middle, bias 0 there; None takes the closed form of each
            run's readings, moved by a random part of the half-widths.
        start: half-widths of the starting points about the nominal sensor; None is the box.
    """

    g: float
    unknowns: int = 9
    box: BoxSettings = field(default_factory=BoxSettings)
    nominal: float | None = None
    start: BoxSettings | None = None

    def box_of(self, triangle: Triangle, runs: Sequence[int], seed: int) -> Box:
        """Return the box of each run: about the stated nominal, or about the closed form and moved."""
        shape = (len(runs), 3)
        if self.nominal is not None:
            scale = np.full(shape, self.nominal)
            half = half_widths(scale, self.box, self.g, self.unknowns)
            return Box(pack(scale[..., None] * np.eye(3), np.zeros(shape), self.unknowns), half)
        K, D = _closed_form(triangle, self.g)
        if self.unknowns == 12:  # of all K that differ by a rotation, the one closest to no rotation
            K = to_gauge(K, "symmetric")
        half = half_widths(np.einsum("rii->ri", K), self.box, self.g, self.unknowns)
        u = Streams(seed, runs, Purpose.BOX).uniform(1, self.unknowns)[:, 0]
        return Box(pack(K, D, self.unknowns) + SHIFT * (2.0 * u - 1.0) * half, half)

    def starting_points(self, box: Box, population: int, runs: Sequence[int], seed: int) -> Float | None:
        """Return starting points in box coordinates, shape (R, P, D), or None for the box itself."""
        if self.start is None:
            return None
        scale = np.broadcast_to(self.nominal or box.centre[:, :3].mean(axis=1, keepdims=True), (len(runs), 3))
        centre = pack(scale[..., None] * np.eye(3), np.zeros((len(runs), 3)), self.unknowns)
        half = half_widths(scale, self.start, self.g, self.unknowns)
        u = 2.0 * Streams(seed, runs, Purpose.START).uniform(population, self.unknowns) - 1.0
        return (centre[:, None] + half[:, None] * u - box.centre[:, None]) / box.half[:, None]


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    """Return K, shape (R, 3, 3), and D, (R, 3): the ellipsoid, or without one the sphere that the readings span."""
    K, d = fit_ellipsoid(triangle)
    K = np.where(np.isnan(K), np.eye(3), K) * triangle.scale[:, None, None] / g
    return K, np.nan_to_num(d) * triangle.scale[:, None] + triangle.centre


@dataclass(frozen=True)
class CalibrationBlock:
    """The calibrations of R runs.

    Attributes:
        problem: the cost of each.
        truth: errors of each sensor in gauge `lower`; of a recording, those at the least cost.
        least: least cost, by Levenberg-Marquardt from the truth or the closed form, (m/s^2)^4, shape (R,).
        information: J^T J of the nine parameters at the truth, shape (R, 9, 9).
    """

    problem: Loetters
    truth: ErrorModel
    least: Float
    information: Float

    @classmethod
    def of(cls, problem: Loetters, least: Float, K: Float, D: Float, clean: Triangle) -> CalibrationBlock:
        """Return the block with the truth K, shape (R, 3, 3), and D, (R, 3), and readings without noise."""
        truth = ErrorModel(to_gauge(K, "lower"), D)
        theta = pack(truth.K, truth.D, 9)
        at_truth = Loetters(clean, problem.g, Box(np.zeros_like(theta), np.ones_like(theta)))
        return cls(problem, truth, least, at_truth.information(theta))


@dataclass(frozen=True)
class Simulation:
    """Simulated readings.

    Attributes:
        sensor: its configured errors, or the type that sensors are drawn from.
        drawn: whether every run has a sensor of its own.
        positions, scheme: the poses; noise: one sigma of a reading per axis, m/s^2.
    """

    sensor: Sensor
    drawn: bool = True
    positions: int = 12
    scheme: str | None = None
    noise: float = 0.0

    def __post_init__(self) -> None:
        """Refuse poses that cannot determine nine parameters, and a noise that is not a number from 0."""
        if self.positions < FEWEST:
            raise ConfigError(
                f"positions: {self.positions} is too few; nine parameters need at least {FEWEST}"
            )
        if not (np.isfinite(self.noise) and self.noise >= 0):
            raise ConfigError(f"noise: {self.noise:g}: expected zero or more, in m/s^2")

    def calibrations(self, space: SearchSpace, runs: Sequence[int], seed: int) -> CalibrationBlock:
        """Return the calibrations of the runs of these numbers."""
        sensor = draw(self.sensor, runs, seed) if self.drawn else self.sensor.model
        K = np.broadcast_to(sensor.K, (len(runs), 3, 3))
        D = np.broadcast_to(sensor.D, (len(runs), 3))
        random = Streams(seed, [0], Purpose.ATTITUDE).normal(self.positions, 3)[0]
        force = space.g * directions(self.positions, self.scheme, random)
        clean = force @ K.swapaxes(1, 2) + D[:, None]
        noise = self.noise * Streams(seed, runs, Purpose.NOISE).normal(self.positions, 3)
        triangle = compress_each(clean + noise @ K.swapaxes(1, 2))
        problem = Loetters(triangle, space.g, space.box_of(triangle, runs, seed))
        least = polish(problem, np.clip(problem.coordinates(K, D), -1.0, 1.0)).cost
        return CalibrationBlock.of(problem, least, K, D, compress_each(clean))


@dataclass(frozen=True)
class Recording:
    """Real readings of one sensor, compressed: every run searches on the same ones."""

    source: str
    sha256: str
    triangle: tuple[tuple[float, ...], ...]
    centre: tuple[float, ...]
    scale: float
    poses: int

    @classmethod
    def of(cls, readings: Readings, g: float) -> Recording:
        """Return readings as part of a study at a local gravity g, m/s^2.

        Raises:
            DataError: fewer than nine poses, or readings that determine no sensor: their cost has no unique minimum.
        """
        if readings.poses < FEWEST:
            raise DataError(
                f"{readings.source}: {readings.poses} poses; nine parameters need at least {FEWEST}, better 12 or more"
            )
        calibration = calibrate(readings, Settings(optimizer="levenberg-marquardt", g=g))
        if calibration.verdict == "undetermined":
            raise DataError(
                f"{readings.source}: there is no unique least cost to compare with; accelcal calibrate calls these "
                f"readings undetermined ({calibration.reasons[0].rstrip('.')})"
            )
        triangle = packed(Sample.of([readings]), None)
        return cls(
            readings.source,
            readings.sha256,
            tuple(tuple(row) for row in triangle.R[0].tolist()),
            tuple(triangle.centre[0].tolist()),
            float(triangle.scale[0]),
            readings.poses,
        )

    def calibrations(self, space: SearchSpace, runs: Sequence[int], seed: int) -> CalibrationBlock:
        """Return the calibrations of the runs of these numbers."""
        parts = (self.triangle, self.centre, self.scale, self.poses)
        triangle = Triangle(*(np.array([part]) for part in parts)).take(np.zeros(len(runs), dtype=np.intp))
        problem = Loetters(triangle, space.g, space.box_of(triangle, runs, seed))
        solution = polish(problem, np.nan_to_num(np.clip(problem.closed_form(), -1.0, 1.0)))
        return CalibrationBlock.of(problem, solution.cost, *problem.parameters(solution.x), triangle)


WITHIN = 0.01
"""A run has reached the least cost when its cost exceeds it by at most this part."""

ERRORS = ("bias_error", "scale_error", "misalignment_error")

MATRIX = ("K_11", "K_22", "K_33", "K_21", "K_31", "K_32", "K_12", "K_13", "K_23")


def success_limit(least: Float, tolerance: float) -> Float:
    """Return the cost at or below which a run has succeeded, same shape as the least cost."""
    return np.asarray(np.maximum(least + tolerance, (1.0 + WITHIN) * least))


def parameter_errors(K: Float, D: Float, block: CalibrationBlock, noise: float) -> dict[str, Float]:
    """Return the errors of estimates in gauge `lower` against the truth, each of shape (R,), rms over the axes.

    Definition:
        bias_error: (D_i - truth) / K_ii over g. Units: micro-g. scale_error: K_ii / truth - 1. Units: ppm.
        misalignment_error: K_ij / K_ii less the true one, i > j. Units: arcsec.
        efficiency: sqrt(p^T J^T J p / 9) / noise with p the errors of the nine parameters in m/s^2: 1 for an
        estimator that is as good as the Cramer-Rao bound allows. Units: 1; left out without noise.

    Args:
        K: shape (R, 3, 3); D: shape (R, 3).
        block: truth and information.
        noise: one sigma of a reading per axis, m/s^2.
    """
    true_K, true_D, g = block.truth.K, block.truth.D, block.problem.g
    axis = np.arange(3)
    scale = K[:, axis, axis] / true_K[:, axis, axis] - 1.0
    angles = _angles(K) - _angles(true_K)
    bias = (D - true_D) / true_K[:, axis, axis]
    rms = _rms(bias) / g * MICRO_G, _rms(scale) * PPM, _rms(angles) * ARCSEC
    errors = dict(zip(ERRORS, rms, strict=True))
    if noise > 0:
        usable = np.isfinite(K).all(axis=(1, 2)) & (K[:, axis, axis] != 0).all(axis=1)
        E = np.linalg.solve(np.where(usable[:, None, None], K, np.nan_to_num(true_K)), true_K) - np.eye(3)
        p = np.concatenate([g * pack(E, bias, 9)[:, :6], bias], axis=1)
        square = np.einsum("rp,rpq,rq->r", p, block.information, p) / 9.0
        errors["efficiency"] = np.where(usable, np.sqrt(square) / noise, np.nan)
    return errors


def _angles(K: Float) -> Float:
    return K[:, [1, 2, 2], [0, 0, 1]] / K[:, [1, 2, 2], [1, 2, 2]]


def _rms(values: Float) -> Float:
    return np.asarray(np.sqrt(np.mean(values**2, axis=1)))


def in_lower(K: Float) -> Float:
    """Return K in gauge `lower`, shape (R, 3, 3), for any K: NaN where a search has failed."""
    finite = np.asarray(np.isfinite(K).all(axis=(1, 2)))[:, None, None]
    return np.where(finite, triangular(np.where(finite, K, np.eye(3))), np.nan)
