"""Simulated sensors and readings for the tests."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.problem import Box, Loetters, compress_each
from accelcal_cli.io.readings import Readings
from accelcal_cli.rng import Streams
from accelcal_cli.sensor.model import ErrorModel

DPSO = ErrorModel(
    np.array(
        [
            [5.6392e5, -2.3575e2, -6.9285e2],
            [-2.8895e2, 5.6698e5, -2.6772e2],
            [4.2258e2, -4.4782e2, 5.6779e5],
        ]
    ),
    np.array([-3.0832e3, 1.1723e4, 6.0155e3]),
)
"""The sensor of [dpso2014] Table 3, column truth; pulse/s per m/s^2 and pulse/s."""

MEMS = ErrorModel(
    np.array([[0.98, 0.02, -0.03], [-0.04, 1.03, 0.015], [0.05, -0.02, 1.01]]), np.array([0.2, -0.35, 0.15])
)
"""A poor sensor with misalignments up to 0.07 rad, output in m/s^2."""


def noise(poses, sigma, seed):
    """Noise of `poses` readings, shape (poses, 3), m/s^2."""
    return sigma * Streams(seed, [0], purpose=900).normal(poses, 3)[0]


def readings(u, *, model=DPSO, g=9.8, sigma=0.0, seed=1, **more):
    """Readings of a sensor held in the directions u, shape (J, 3), with noise in m/s^2."""
    return Readings.from_array(model.output(g * u + noise(len(u), sigma, seed)), **more)


def dpso_box(unknowns):
    """The box of the paper's runs: 1e4, 1e3, 2e4 pulses about a nominal sensor of 5.67e5."""
    centre = np.array([5.67e5] * 3 + [0.0] * (unknowns - 3))
    half = np.array([1e4] * 3 + [1e3] * (unknowns - 6) + [2e4] * 3)
    return Box(centre[None], half[None])


def lower_loetters(output, g, weights=None):
    """The nine-unknown problem of the DPSO sensor's readings, shape (J, 3)."""
    return loetters(output, g, dpso_box(9), weights)


def loetters(output, g, box, weights=None):
    """The problem of one sensor's readings, shape (J, 3)."""
    triangle = compress_each(output[None], None if weights is None else weights[None])
    return Loetters(triangle, g, box)


def direct_cost(K, D, output, g, weights=None):
    """L of [dpso2014] eq. 15 pose by pose."""
    f = np.linalg.solve(K, (output - D).T).T
    r = g**2 - (f**2).sum(axis=1)
    return float(np.sum((1.0 if weights is None else weights) * r**2))


def rotation(seed):
    """A random rotation matrix."""
    q, r = np.linalg.qr(Streams(seed, [0], purpose=901).normal(3, 3)[0])
    q = q * np.sign(np.diagonal(r))
    return q * np.sign(np.linalg.det(q))
