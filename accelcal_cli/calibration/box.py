"""The nominal sensor and the search box around it, from the readings or as stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.calibration.observability import Observability, information
from accelcal_cli.calibration.problem import Box, Loetters, Triangle, fit_ellipsoid, pack
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.rng import Purpose, Streams
from accelcal_cli.sensor.model import to_gauge

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""

SPHERE_PRIOR = 1e-3
"""Information a pose lends to the middle of the readings as centre of the sphere, relative to its own: what axes
whose scale factors differ by 3 % pretend to say about an axis that the poses do not turn through."""


@dataclass(frozen=True)
class Start:
    """Where searches start.

    Attributes:
        box: the search box of each of R sensors, D = 6, 9 or 12.
        sources: of each: "stated", "closed form" or "sphere".
    """

    box: Box
    sources: tuple[str, ...]

    @property
    def source(self) -> str:
        """That of the first sensor."""
        return self.sources[0]

    def take(self, index: Int) -> Start:
        """Return the starts of the sensors at `index`."""
        return Start(self.box.take(index), tuple(self.sources[i] for i in index))


def search_box(triangle: Triangle, settings: Settings) -> Start:
    """Return the search box of each sensor; the same in any company.

    Args:
        triangle: the compressed readings of R sensors.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 6 if not settings.misalignment else 12 if settings.gauge == "full" else 9
    sensors = len(triangle.scale)
    if settings.nominal is not None:
        K = np.broadcast_to(np.diag(settings.nominal.scale), (sensors, 3, 3))
        D = np.broadcast_to(settings.nominal.bias, (sensors, 3))
        return Start(_box(K, D, settings, unknowns), ("stated",) * sensors)
    K, D = _closed_form(triangle, settings.g)
    index = np.flatnonzero(np.isfinite(K).all(axis=(1, 2)))
    index = index[_trustworthy(triangle.take(index), K[index], D[index], settings)]
    closed = np.zeros(sensors, dtype=bool)
    closed[index] = True
    sphere_K, sphere_D = _sphere(triangle, settings.g)
    if unknowns == 12:
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K[index] = to_gauge(K[index], "symmetric")
    K, D = np.where(closed[:, None, None], K, sphere_K), np.where(closed[:, None], D, sphere_D)
    box = _box(K, D, settings, unknowns)
    u = Streams(settings.seed, [0], Purpose.BOX).uniform(1, unknowns)[0, 0]
    moved = box.centre + SHIFT * (2.0 * u - 1.0) * box.half
    return Start(
        Box(np.where(closed[:, None], moved, box.centre), box.half),
        tuple("closed form" if c else "sphere" for c in closed),
    )


def _box(K: Float, D: Float, settings: Settings, unknowns: int) -> Box:
    half = half_widths(np.einsum("rii->ri", K), settings.box, settings.g, unknowns)
    return Box(pack(K, D, unknowns), half)


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    K, d = fit_ellipsoid(triangle)
    return K * triangle.scale[:, None, None] / g, d * triangle.scale[:, None] + triangle.centre


def _trustworthy(triangle: Triangle, K: Float, D: Float, settings: Settings) -> Bool:
    """Whether the poses determine what the closed form says, shape (R,); where they do not, noise has decided it."""
    problem = Loetters(triangle, settings.g, _box(K, D, settings, 9))
    seen = Observability.of(information(problem, np.zeros((len(K), 9))), triangle.poses)
    return np.array([verdict != "undetermined" for verdict in seen.verdicts], dtype=bool)


def _sphere(triangle: Triangle, g: float) -> tuple[Float, Float]:
    """Return K, shape (R, 3, 3), and D, shape (R, 3), of the spheres nearest to readings that fix no ellipsoid.

    |x|^2 = 2 c x + (r^2 - |c|^2) is linear in c and the constant. A direction that the poses do not turn through
    is held at the middle of the readings by the prior.
    """
    left, right = triangle.R[..., 6:10], triangle.R[..., :3].sum(axis=2)
    transposed = left.swapaxes(1, 2)
    prior = SPHERE_PRIOR * triangle.poses[:, None, None] * np.diag([1.0, 1.0, 1.0, 0.0])
    c = np.linalg.solve(transposed @ left + prior, transposed @ right[..., None])[..., 0]
    radius = np.sqrt(np.maximum(c[:, 3] + np.sum(c[:, :3] ** 2, axis=1), 0.0))
    # Far from the readings' own extent, which is 1, it is noise.
    radius = np.where((radius > 0.3) & (radius < 3.0), radius, 1.0)
    K = (radius * triangle.scale / g)[:, None, None] * np.eye(3)
    return K, c[:, :3] * triangle.scale[:, None] + triangle.centre


def half_widths(scale: Float, box: BoxSettings, g: float, unknowns: int) -> Float:
    """Return the half-widths in the units of the unknowns, shape (..., unknowns), for scale factors (..., 3)."""
    mean = scale.mean(axis=-1, keepdims=True)
    turned = np.repeat(box.misalignment * mean, unknowns - 6, axis=-1)
    return np.concatenate([box.scale * scale, turned, box.bias * g * scale], axis=-1)


def uncalibrated(scale: Float, D: Float, settings: Settings) -> tuple[Float, Float, list[str]]:
    """Return scale factors and biases, shape (R, 3), that readings have before calibration, and the same in words.

    A stated nominal sensor; else, for readings that are specific force already, themselves; else one scale factor for
    all axes and the bias in the middle, which is what a user without calibration could do.

    Args:
        scale: mean scale factor, output units per m/s^2, shape (R,); D: bias, output units, shape (R, 3).
        settings: may state a nominal sensor.
    """
    if settings.nominal is not None:
        k, bias = (np.broadcast_to(v, D.shape) for v in (settings.nominal.scale, settings.nominal.bias))
        return k, bias, ["the stated nominal sensor"] * len(D)
    # A nominal scale factor carries no more than three significant digits.
    rounded = np.array([float(f"{value:.3g}") for value in scale.tolist()])
    force = (rounded > 0.8) & (rounded < 1.25)  # specific force already, in m/s^2 or in g
    words = "one scale factor for all axes and the estimated bias, no misalignment"
    return (
        np.repeat(np.where(force, 1.0, rounded)[:, None], 3, axis=1),
        np.where(force[:, None], 0.0, D),
        ["the readings as they are" if f else words for f in force],
    )
