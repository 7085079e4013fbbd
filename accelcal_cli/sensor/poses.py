"""Pose schemes: sets of unit directions of the specific force in the body frame, and words for a pose.

At rest the specific force points up, so a pose "+x up" has the direction (1, 0, 0).
"""

from __future__ import annotations

import itertools
import math

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.errors import UsageError, did_you_mean

AXES = "xyz"


def faces() -> Float:
    """Return the 6 faces of a cube, shape (6, 3)."""
    return np.concatenate([np.eye(3), -np.eye(3)])[[0, 3, 1, 4, 2, 5]]


def edges() -> Float:
    """Return the 12 edge directions (0, +-1, +-1)/sqrt 2 and permutations (a cuboctahedron), shape (12, 3)."""
    rows = [
        [a if k == i else b if k == j else 0.0 for k in range(3)]
        for i, j in itertools.combinations(range(3), 2)
        for a, b in itertools.product((1.0, -1.0), repeat=2)
    ]
    return np.array(rows) / math.sqrt(2.0)


def corners() -> Float:
    """Return the 8 corner directions (+-1, +-1, +-1)/sqrt 3, shape (8, 3)."""
    return np.array(list(itertools.product((1.0, -1.0), repeat=3))) / math.sqrt(3.0)


def grid(most: int) -> Float:
    """Return the directions of all integer vectors with components up to `most`, simplest first.

    26 for 1 (faces, edges, corners of a cube), 98 for 2, 290 for 3; shape (C, 3).
    """
    rows = [t for t in itertools.product(range(-most, most + 1), repeat=3) if math.gcd(*t) == 1]
    whole = np.array(sorted(rows, key=lambda t: (max(map(abs, t)), sum(map(abs, t)))), dtype=float)
    return np.asarray(whole / np.linalg.norm(whole, axis=1, keepdims=True))


def faces_edges() -> Float:
    """Return 6 faces and the 6 edges (e_i +- e_j)/sqrt 2, i < j, shape (12, 3)."""
    return np.concatenate([faces(), edges()[[0, 1, 4, 5, 8, 9]]])


def icosahedron() -> Float:
    """Return the 12 vertices of an icosahedron, shape (12, 3)."""
    golden = (1.0 + math.sqrt(5.0)) / 2.0
    signs = itertools.product((1.0, -1.0), repeat=2)
    base = np.array([[0.0, a, b * golden] for a, b in signs]) / math.hypot(1.0, golden)
    return np.concatenate([np.roll(base, shift, axis=1) for shift in range(3)])


def turns() -> Float:
    """Return the 24 positions of the AKPSO paper, shape (24, 3).

    Eight turns of 45 degrees about a horizontal body axis, for each of three axes. The six faces occur twice:
    18 directions are distinct, the duplicates average noise. [akpso2015] section 3.
    """
    angle = np.pi / 4 * np.arange(8)
    sine, cosine, zero = np.sin(angle), np.cos(angle), np.zeros(8)
    rows = np.concatenate(
        [
            np.stack([sine, zero, cosine], axis=1),
            np.stack([zero, cosine, sine], axis=1),
            np.stack([cosine, sine, zero], axis=1),
        ]
    )
    rows[np.abs(rows) < 1e-15] = 0.0
    return rows


def fibonacci(count: int) -> Float:
    """Return `count` directions spread evenly over the sphere (Fibonacci lattice), shape (count, 3)."""
    index = np.arange(count)
    z = 1.0 - (2.0 * index + 1.0) / count
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def fixture_directions() -> Float:
    """Return the 26 directions of the faces, edges and corners of a cube, shape (26, 3)."""
    return np.concatenate([faces(), edges(), corners()])


FIXED = {
    "faces": faces,
    "edges": edges,
    "faces-edges": faces_edges,
    "icosahedron": icosahedron,
    "turns": turns,
}
"""Schemes with a fixed number of poses."""

SCHEMES = (*FIXED, "fibonacci", "random")


def directions(count: int, scheme: str | None, random: Float) -> Float:
    """Return `count` unit directions, shape (count, 3).

    Args:
        count: number of poses J.
        scheme: one of SCHEMES; when None: faces for 6, edges for 12, the AKPSO turns for 24, an even spread for
            any other number.
        random: N(0, 1) numbers, shape (count, 3), used by the scheme "random" alone.

    Raises:
        UsageError: unknown scheme, or a scheme that does not have `count` poses.
    """
    if scheme is None:
        scheme = {6: "faces", 12: "edges", 24: "turns"}.get(count, "fibonacci")
    if scheme not in SCHEMES:
        raise UsageError(
            f'--scheme "{scheme}": unknown{did_you_mean(scheme, SCHEMES)}; expected one of {", ".join(SCHEMES)}'
        )
    if scheme == "fibonacci":
        return fibonacci(count)
    if scheme == "random":
        return np.asarray(random / np.linalg.norm(random, axis=1, keepdims=True))
    rows = FIXED[scheme]()
    if len(rows) != count:
        raise UsageError(
            f'--scheme "{scheme}" has {len(rows)} poses, not {count}; leave out --scheme or --positions'
        )
    return rows


def describe(direction: Float) -> str:
    """Say in words how to hold the sensor: "+x up", "+x up, tilted 45 degrees towards -y", ...

    Args:
        direction: direction of the specific force (upwards) in the body frame, shape (3,).
    """
    order = np.argsort(-np.abs(direction), kind="stable")
    name = [f"{'+' if direction[i] >= 0 else '-'}{AXES[i]}" for i in order]
    size = np.abs(direction)[order] / np.linalg.norm(direction)
    tilt = math.degrees(math.acos(min(1.0, size[0])))
    if tilt < 0.5:
        return f"{name[0]} up"
    if math.degrees(math.asin(min(1.0, size[2]))) < 0.5:
        return f"{name[0]} up, tilted {tilt:.0f} degrees towards {name[1]}"
    if size[0] - size[2] < 0.01:
        return f"corner between {name[0]}, {name[1]} and {name[2]} up"
    turn = math.degrees(math.atan2(size[2], size[1]))
    return f"{name[0]} up, tilted {tilt:.0f} degrees towards {name[1]} turned {turn:.0f} degrees to {name[2]}"
