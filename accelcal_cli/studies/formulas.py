"""The formulas of the test functions of z, shape (..., D); each returns costs of shape (...)."""

from __future__ import annotations

import math

import numpy as np

from accelcal_cli.streams import Float

SCHWEFEL_POINT = 420.968746359982
SCHWEFEL_LEVEL = SCHWEFEL_POINT * math.sin(math.sqrt(SCHWEFEL_POINT))
STYBLINSKI_POINT = -2.903534027771177
STYBLINSKI_LEVEL = STYBLINSKI_POINT**4 - 16.0 * STYBLINSKI_POINT**2 + 5.0 * STYBLINSKI_POINT


def sphere(z: Float) -> Float:
    """Return sum z_i^2. [dpso2014] section 3.1."""
    total: Float = np.add.reduce(z * z, axis=-1)
    return total


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
    total: Float = np.add.reduce(valley, axis=-1)
    return total


def modified_rosenbrock(z: Float) -> Float:
    """Return sum 100 (z_{i+1} + z_i^2)^2 + (z_i + 1)^2, minimum at -1. [ifoa2021] section 3.1, reconstructed."""
    return rosenbrock(-z)


def rastrigin(z: Float) -> Float:
    """Return sum z_i^2 - 10 cos(2 pi z_i) + 10. [dpso2014] section 3.1."""
    waves = np.cos(2.0 * math.pi * z)
    waves *= -10.0
    waves += z * z
    waves += 10.0
    total: Float = np.add.reduce(waves, axis=-1)
    return total


def griewank(z: Float) -> Float:
    """Return sum z_i^2 / 4000 - prod cos(z_i / sqrt(i)) + 1. [dpso2014] section 3.1."""
    roots = np.sqrt(np.arange(1.0, z.shape[-1] + 1.0))
    waves = np.multiply.reduce(np.cos(z / roots), axis=-1)
    total: Float = np.add.reduce(z * z, axis=-1) / 4000.0 - waves + 1.0
    return total


def ackley(z: Float) -> Float:
    """Return Ackley's function: 20 + e - 20 exp(-0.2 rms(z)) - exp(mean cos(2 pi z)). [jamil2013] 1."""
    rms = np.sqrt(np.mean(z * z, axis=-1))
    total = 20.0 + math.e - 20.0 * np.exp(-0.2 * rms) - np.exp(np.mean(np.cos(2 * math.pi * z), axis=-1))
    least: Float = np.maximum(total, 0.0)  # rounding would leave -4e-16
    return least


def schwefel(z: Float) -> Float:
    """Return 418.98 D - sum z_i sin(sqrt |z_i|), continued quadratically beyond 500. [jamil2013] 2.26."""
    inside = np.clip(z, -500.0, 500.0)
    waves = inside * np.sin(np.sqrt(np.abs(inside)))
    beyond = z - inside
    total: Float = np.add.reduce(SCHWEFEL_LEVEL - waves + beyond * beyond, axis=-1)
    return total


def levy(z: Float) -> Float:
    """Return Levy's function with w = 1 + (z - 1) / 4. [laguna2005]."""
    w = 1.0 + (z - 1.0) / 4.0
    head = np.sin(math.pi * w[..., 0]) ** 2
    body = (w[..., :-1] - 1.0) ** 2 * (1.0 + 10.0 * np.sin(math.pi * w[..., :-1] + 1.0) ** 2)
    tail = (w[..., -1] - 1.0) ** 2 * (1.0 + np.sin(2.0 * math.pi * w[..., -1]) ** 2)
    total: Float = head + np.add.reduce(body, axis=-1) + tail
    return total


def zakharov(z: Float) -> Float:
    """Return s + t^2 + t^4 with s = sum z_i^2, t = sum i z_i / 2. [jamil2013] 173."""
    t = z @ (0.5 * np.arange(1.0, z.shape[-1] + 1.0))
    total: Float = np.add.reduce(z * z, axis=-1) + t**2 + t**4
    return total


def elliptic(z: Float) -> Float:
    """Return sum 10^(6 (i - 1) / (D - 1)) z_i^2: a bowl a thousand times as long as wide. [hansen2016]."""
    total: Float = np.add.reduce(elliptic_weights(z.shape[-1]) * (z * z), axis=-1)
    return total


def elliptic_weights(dimensions: int) -> Float:
    """Return the D coefficients of `elliptic`."""
    return np.logspace(0.0, 6.0, dimensions)


def styblinski_tang(z: Float) -> Float:
    """Return sum (z_i^4 - 16 z_i^2 + 5 z_i) / 2 above its least value, -39.166 D. [jamil2013] 144."""
    square = z * z
    total = np.add.reduce(square * square - 16.0 * square + 5.0 * z - STYBLINSKI_LEVEL, axis=-1)
    least: Float = np.maximum(0.5 * total, 0.0)  # rounding would leave -1e-14
    return least
