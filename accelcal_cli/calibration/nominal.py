"""The nominal sensor and the search box around it, from the readings or as stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.compress import Triangle
from accelcal_cli.calibration.ellipsoid import fit_ellipsoid
from accelcal_cli.calibration.lotters import Box, Loetters, pack
from accelcal_cli.calibration.quality import Observability, information
from accelcal_cli.calibration.settings import BoxSettings, Settings
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.streams import Float, Streams

BOX_PURPOSE = 1
"""Stream of the random shift of the box, apart from the searches' own streams."""

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""


SPHERE_PRIOR = 1e-3
"""Information a pose lends to the middle of the readings as centre of the sphere, relative to its own: what axes
whose scale factors differ by 3 % pretend to say about an axis that the poses do not turn through."""


@dataclass(frozen=True)
class Start:
    """Where a search starts.

    Attributes:
        box: the search box, one sensor, D = 9 or 12.
        source: "stated", "closed form" or "sphere".
    """

    box: Box
    source: str


def search_box(triangle: Triangle, settings: Settings) -> Start:
    """Return the search box of one sensor.

    Args:
        triangle: its compressed readings.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 12 if settings.gauge == "full" else 9
    K, D = _closed_form(triangle, settings.g)
    if settings.nominal is not None:
        K, D, source = np.diag(settings.nominal.scale), np.array(settings.nominal.bias), "stated"
    elif np.isfinite(K).all() and _trustworthy(triangle, K, D, settings):
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K, source = (to_gauge(K, "symmetric") if unknowns == 12 else K), "closed form"
    else:
        K, D, source = *_sphere(triangle, settings.g), "sphere"
    half = half_widths(np.diagonal(K), settings.box, settings.g, unknowns)
    centre = pack(K, D, unknowns)
    if source == "closed form":
        u = Streams(settings.seed, [0], purpose=BOX_PURPOSE).uniform(1, unknowns)[0, 0]
        centre = centre + SHIFT * (2.0 * u - 1.0) * half
    return Start(Box(centre[None], half[None]), source)


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    K, d = fit_ellipsoid(triangle)
    return K[0] * triangle.scale[0] / g, d[0] * triangle.scale[0] + triangle.centre[0]


def _trustworthy(triangle: Triangle, K: Float, D: Float, settings: Settings) -> bool:
    """Whether the poses determine what the closed form says; where they do not, noise has decided it."""
    box = Box(pack(K, D, 9)[None], half_widths(np.diagonal(K), settings.box, settings.g, 9)[None])
    seen = Observability.of(
        information(Loetters(triangle, settings.g, box), np.zeros((1, 9)))[0], triangle.poses
    )
    return seen.verdict != "undetermined"


def _sphere(triangle: Triangle, g: float) -> tuple[Float, Float]:
    """Return K and D of the sphere nearest to readings that fix no ellipsoid.

    |x|^2 = 2 c x + (r^2 - |c|^2) is linear in c and the constant. A direction that the poses do not turn through
    is held at the middle of the readings by the prior.
    """
    left, right = triangle.R[0][:, 6:10], triangle.R[0][:, :3].sum(axis=1)
    prior = SPHERE_PRIOR * triangle.poses * np.diag([1.0, 1.0, 1.0, 0.0])
    c = np.linalg.solve(left.T @ left + prior, left.T @ right)
    radius = np.sqrt(max(c[3] + c[:3] @ c[:3], 0.0))
    if not 0.3 < radius < 3.0:  # far from the readings' own extent, which is 1
        radius = 1.0
    return radius * triangle.scale[0] / g * np.eye(3), c[:3] * triangle.scale[0] + triangle.centre[0]


def half_widths(scale: Float, box: BoxSettings, g: float, unknowns: int) -> Float:
    """Return the half-widths in the units of the unknowns, shape (..., unknowns), for scale factors (..., 3)."""
    mean = scale.mean(axis=-1, keepdims=True)
    turned = np.repeat(box.misalignment * mean, unknowns - 6, axis=-1)
    return np.concatenate([box.scale * scale, turned, box.bias * g * scale], axis=-1)
