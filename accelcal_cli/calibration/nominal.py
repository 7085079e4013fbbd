"""The nominal sensor and the search box around it, from the readings or as stated."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from accelcal_cli.calibration.compress import Triangle
from accelcal_cli.calibration.ellipsoid import fit_ellipsoid
from accelcal_cli.calibration.lotters import Box, pack
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.sensor.model import to_gauge
from accelcal_cli.streams import Float, Streams

BOX_PURPOSE = 1
"""Stream of the random shift of the box, apart from the searches' own streams."""

SHIFT = 0.5
"""The box is moved off the closed form by up to this part of its half-width: the search finds the answer by
itself, and the answer stays well inside."""


@dataclass(frozen=True)
class Start:
    """Where a search starts.

    Attributes:
        box: the search box, one sensor, D = 9 or 12.
        source: "stated", "closed form" or "mid-range".
    """

    box: Box
    source: str


def search_box(triangle: Triangle, low: Float, high: Float, settings: Settings) -> Start:
    """Return the search box of one sensor.

    Args:
        triangle: its compressed readings.
        low, high: least and greatest reading of each axis, shape (3,), output units.
        settings: stated nominal, half-widths, gauge, seed.
    """
    unknowns = 12 if settings.gauge == "full" else 9
    g = settings.g
    K, D = _closed_form(triangle, g)
    if settings.nominal is not None:
        K, D, source = np.diag(settings.nominal.scale), np.array(settings.nominal.bias), "stated"
    elif np.isfinite(K).all():
        # Of the twelve-parameter valley the symmetric point is the one closest to no rotation.
        K, source = (to_gauge(K, "symmetric") if unknowns == 12 else K), "closed form"
    else:
        K, D, source = *_mid_range(low, high, g), "mid-range"
    half = _half_widths(np.diagonal(K), settings, unknowns)
    centre = pack(K, D, unknowns)
    if source == "closed form":
        u = Streams(settings.seed, [0], purpose=BOX_PURPOSE).uniform(1, unknowns)[0, 0]
        centre = centre + SHIFT * (2.0 * u - 1.0) * half
    return Start(Box(centre[None], half[None]), source)


def _closed_form(triangle: Triangle, g: float) -> tuple[Float, Float]:
    K, d = fit_ellipsoid(triangle)
    return K[0] * triangle.scale[0] / g, d[0] * triangle.scale[0] + triangle.centre[0]


def _mid_range(low: Float, high: Float, g: float) -> tuple[Float, Float]:
    """Return K and D from the extremes alone; an axis that the poses hardly turn takes the widest one's scale."""
    spread = 0.5 * (high - low) / g
    spread = np.where(spread < 0.5 * spread.max(), spread.max(), spread)
    return np.diag(spread), 0.5 * (low + high)


def _half_widths(scale: Float, settings: Settings, unknowns: int) -> Float:
    """Return the half-widths in the units of the unknowns, shape (unknowns,)."""
    box = settings.box
    mean = scale.mean()
    return np.concatenate(
        [box.scale * scale, np.full(unknowns - 6, box.misalignment * mean), box.bias * settings.g * scale]
    )
