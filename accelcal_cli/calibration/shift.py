"""What new readings say of the nine parameters of an old result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration import quality
from accelcal_cli.calibration.chances import Noise
from accelcal_cli.calibration.compress import compress
from accelcal_cli.calibration.lotters import ROWS_COLUMNS, Box, Loetters, pack
from accelcal_cli.calibration.quality import UNDETERMINED, Observability
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.search import model_at, polish
from accelcal_cli.sensor.model import ErrorModel
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.streams import Bool, Float

FARTHEST = (0.3, 0.3, 1.0)
"""Half-widths of the box for the new parameters: scale factors (part), misalignments (rad), biases (parts of g)."""

TOUCH = 0.1
"""A parameter is known alone when the undetermined directions have at most this part of it: the axes of a poor sensor
are not quite those of the cube that it was turned on."""


@dataclass(frozen=True)
class Shift:
    """What the new readings say of the nine parameters, relative to the old ones.

    Attributes:
        value: difference, m/s^2, shape (9,).
        cofactor: of the new estimate, shape (9, 9).
        basis: directions that the readings determine, shape (9, r).
        known: which parameters they determine one by one, shape (9,).
        noise: variance and degrees of freedom of the new readings.
        model: the sensor that their residuals are seen with, gauge `lower`; step: what the residuals are still to be
            moved by, to first order, m/s^2, shape (9,): none where the model is fitted to them.
    """

    value: Float
    cofactor: Float
    basis: Float
    known: Bool
    noise: Noise
    model: ErrorModel
    step: Float


def shift(old: Calibration, readings: Readings) -> Shift:
    """Return what new readings say of the nine parameters: a fit where they determine all, else one linear step."""
    problem = _problem(old, readings)
    start = np.zeros((1, 9))
    J, e = quality.jacobian(problem, start)[0], problem.residuals(start[:, None])[0, 0] / (2.0 * old.g)
    values, vectors = np.linalg.eigh(J.T @ J)
    # A direction with less information has an error above UNDETERMINED times the noise of a pose.
    seen = values > 1.0 / UNDETERMINED**2
    if not seen.all() or readings.poses < 9:
        basis, values = vectors[:, seen], values[seen]
        inverse = (basis / values) @ basis.T
        value = -inverse @ (J.T @ e)
        rest = float(e @ e - (basis.T @ J.T @ e) ** 2 @ (1.0 / values))
        freedom = readings.poses - int(seen.sum())
        known = np.einsum("pq,pq->p", basis, basis) > 1.0 - TOUCH**2
        noise = Noise(max(rest, 0.0) / max(freedom, 1), freedom)
        return Shift(value, inverse, basis, known, noise, old.model.in_gauge("lower"), value)
    x = polish(problem, start).x
    variance = float(problem.cost(x[:, None])[0, 0]) / (4.0 * old.g**2) / max(readings.poses - 9, 1)
    cofactor = Observability.of(quality.information(problem, x)[0], readings.poses).cofactor
    value = _between(problem, start, x)
    noise = Noise(variance, readings.poses - 9)
    return Shift(value, cofactor, np.eye(9), np.ones(9, bool), noise, model_at(problem, x), np.zeros(9))


def _problem(old: Calibration, readings: Readings) -> Loetters:
    """Return the least-squares problem of the new readings in a wide box about the old parameters."""
    model = old.model.in_gauge("lower")
    scale = np.diagonal(model.K)
    half = np.concatenate(
        [FARTHEST[0] * scale, np.full(3, FARTHEST[1] * scale.mean()), FARTHEST[2] * old.g * scale]
    )
    blocks = ((block, None) for _, block in readings.blocks())
    triangle = compress(blocks, model.D, old.g * float(scale.mean()))
    return Loetters(triangle, old.g, Box(pack(model.K, model.D, 9)[None], half[None]))


def _between(problem: Loetters, old: Float, new: Float) -> Float:
    """Return the nine parameters at `new` relative to `old`, both shape (1, 9), m/s^2: K_A = (I + E) K_A0."""
    (K_0,), (D_0,) = problem.parameters(old)
    (K,), (D,) = problem.parameters(new)
    E = np.linalg.solve(K, K_0) - np.eye(3)
    rows, columns = zip(*ROWS_COLUMNS[:6], strict=True)
    return np.concatenate([problem.g * E[rows, columns], (D - D_0) / np.diagonal(K_0)])
