"""Generated gravity fields: isotropic, Gaussian, with Jordan's third-order Markov covariance [jordan1972].

C(d) = sigma^2 (1 + s + s^2 / 3) exp(-s), s = d / D: differentiable, with an rms slope of sigma / (sqrt(3) D) an axis.
Drawn by circulant embedding [dietrich1997] on a grid of twice the size, negative eigenvalues set to zero.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.gravity_map import GravityMap
from accelcal_cli.streams import Float, Purpose, Streams


@dataclass(frozen=True)
class Field:
    """Statistics and extent of a generated field.

    Attributes:
        sigma: standard deviation, mGal.
        distance: correlation length D, km.
        south, north, west, east: edges, degrees.
        step: between nodes, arc seconds.
    """

    sigma: float
    distance: float
    south: float = 19.5
    north: float = 22.0
    west: float = 114.5
    east: float = 117.5
    step: float = 30.0


PRESETS = {
    "rough": Field(60.0, 8.0),
    "moderate": Field(30.0, 11.5),
    "constant": Field(0.0, 8.0),
}
"""`rough` is about as informative as the paper's results need; `moderate` is like the published statistics."""


def covariance(distance: Float, field: Field) -> Float:
    """Return the covariance in mGal^2 at a distance in km, any shape."""
    s = distance / field.distance
    total: Float = field.sigma**2 * (1.0 + s + s * s / 3.0) * np.exp(-s)
    return total


def generate(field: Field, seed: int, source: str = "generated") -> GravityMap:
    """Return a field drawn from `seed`; the same seed gives the same field."""
    step = math.radians(field.step / 3600.0)
    south, west = math.radians(field.south), math.radians(field.west)
    rows = round((math.radians(field.north) - south) / step) + 1
    columns = round((math.radians(field.east) - west) / step) + 1
    north_metres, east_metres = metres_per_radian(np.array(south + 0.5 * step * rows))
    dy = np.minimum(np.arange(2 * rows), 2 * rows - np.arange(2 * rows)) * step * north_metres / 1e3
    dx = np.minimum(np.arange(2 * columns), 2 * columns - np.arange(2 * columns)) * step * east_metres / 1e3
    spectrum = np.fft.fft2(covariance(np.hypot(dy[:, None], dx[None, :]), field)).real
    noise = Streams(seed, [0], Purpose.FIELD).normal(2 * rows, 4 * columns)[0]
    white = noise[:, : 2 * columns] + 1j * noise[:, 2 * columns :]
    drawn = np.fft.fft2(np.sqrt(np.maximum(spectrum, 0.0) / spectrum.size) * white).real
    return GravityMap(south, west, step, step, drawn[:rows, :columns], source)
