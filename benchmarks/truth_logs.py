"""Traps of raw logs: poses held by a hand, and moves between them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

import numpy as np
from numpy.random import Generator

from accelcal_cli.arrays import Bool, Float, Int
from accelcal_cli.sensor.model import ErrorModel
from benchmarks.truth_scenes import Recording, Scene, random_sensor, spread, text_of, tilted, unit

Pair = tuple[Recording, Recording]

RATE, HOLD, MOVE = 50, 150, 60
"""Rows per second of a log; rows of a hold and of a move."""

TREMOR_RATE, TREMOR_ROWS = 9.0, 100.0
"""Hz at which a hand trembles, and rows per second of the poses in it."""


def tremble(rng: Generator, f: Float, rows: int, radians: float) -> Float:
    """Return forces turned by a trembling hand, `radians` rms about two axes across each, shape (J * rows, 3).

    Two frequencies near TREMOR_RATE and phases anew in every pose.
    """
    t = np.arange(rows) / TREMOR_ROWS
    angles = []
    for _ in range(2):
        rate = TREMOR_RATE + rng.uniform(-1.5, 1.5, (len(f) // rows, 1, 2))
        phase = rng.uniform(0, 2 * np.pi, rate.shape)
        angles.append(np.sin(2 * np.pi * rate * t[:, None] + phase).sum(axis=2).ravel() * radians)
    size = np.linalg.norm(f, axis=1, keepdims=True)
    return np.asarray(size * tilted(f / size, angles[0], angles[1]))


def gyroscope(rng: Generator, rows: int) -> Float:
    """Return what a gyroscope at rest reads, rad/s, shape (rows, 3)."""
    return np.asarray(0.01 * rng.normal(size=3) + 0.002 * rng.normal(size=(rows, 3)))


def log_row(recording: Recording, table: Mapping[str, Iterable[object]]) -> Recording:
    """Return the recording with the text of a table without header."""
    return replace(recording, text=text_of(table, header=False))


def like(scene: Scene) -> ErrorModel:
    """Return another sensor of the same type as the scene's."""
    other, size = random_sensor(scene.rng)
    return ErrorModel(other.K * scene.size / size, other.D * scene.size / size)


def force_of_log(scene: Scene, tremor: float = 0.0) -> tuple[Float, Int, Bool]:
    """Return force, shape (n, 3), pose (0 in moves) and whether a row is a hold's of a log of the scene's poses."""
    rng, u = scene.rng, scene.rng.permutation(spread(scene.rng, scene.count))
    parts, pose = [], []
    for k, here in enumerate(u):
        n = int(HOLD * rng.uniform(0.8, 1.2))
        part = scene.g * np.repeat(here[None], n, axis=0)
        parts.append(tremble(rng, part, n, tremor) if tremor else part)
        pose.append(np.full(n, k + 1))
        if k + 1 < len(u):
            parts.append(_move(rng, here, u[k + 1], scene.g))
            pose.append(np.zeros(MOVE, dtype=int))
    whole = np.concatenate(pose)
    return np.concatenate(parts), whole, whole > 0


def _move(rng: Generator, a: Float, b: Float, g: float) -> Float:
    """Return the force of a turn from a to b by way of a random direction, with the shake of a hand."""
    s = np.linspace(0, 1, MOVE)[:, None]
    s = 10 * s**3 - 15 * s**4 + 6 * s**5
    way = a * (1 - s) ** 2 + 2 * s * (1 - s) * 1.5 * unit(rng.normal(size=3)) + b * s**2
    shake = 2.0 * np.sin(np.pi * s) * np.sin(2 * np.pi * (3 * s + rng.uniform(size=3)))
    return np.asarray(g * unit(way) + shake)


def log(
    scene: Scene,
    output: Float,
    hold: Bool,
    pose: Int,
    *,
    raw: bool = True,
    columns: Mapping[str, Iterable[object]] | None = None,
    stamps: int = 1,
) -> Recording:
    """Return the recording of a log; `stamps` rows share a time. Its plain fit takes the mean of every hold."""
    time = {"time": [f"{k // stamps / RATE:.2f}" for k in range(len(output))]}
    poses = np.unique(pose[hold])
    held = np.stack([output[hold & (pose == k)].mean(axis=0) for k in poses])
    return scene.recording(
        output,
        columns={**time, **(columns or {})},
        raw=raw,
        plain=held if raw else output,
    )


def without_raw(scene: Scene) -> Pair:
    """A log taken for poses; honest: with --raw."""
    f, pose, hold = force_of_log(scene)
    output = scene.model.output(f + scene.noises(len(f)))
    return log(scene, output, hold, pose, raw=False), log(scene, output, hold, pose)


def with_tremor(scene: Scene) -> Pair:
    """A log in a hand that trembles by 20 mrad; honest: in one that does not."""
    return _of_forces(scene, lambda: force_of_log(scene, 0.02))


def _of_forces(scene: Scene, forces: Callable[[], tuple[Float, Int, Bool]]) -> Pair:
    made = []
    for f, pose, hold in (forces(), force_of_log(scene)):
        made.append(log(scene, scene.model.output(f + scene.noises(len(f))), hold, pose))
    return made[0], made[1]


def asleep(scene: Scene) -> Pair:
    """A log in which the sensor sleeps now and then: stretches of zeros."""
    f, pose, hold = force_of_log(scene)
    output = scene.model.output(f + scene.noises(len(f)))
    out = output.copy()
    for first in scene.rng.choice(len(out) - HOLD, 4, replace=False):
        out[first : first + HOLD] = 0.0
    return log(scene, out, hold & (out != 0).any(axis=1), pose), log(scene, output, hold, pose)


def of_two(scene: Scene) -> Pair:
    """A log of two sensors with equal stamps and a column I that tells them apart; honest: the first of them."""
    f, pose, hold = force_of_log(scene)
    first, second = (model.output(f + scene.noises(len(f))) for model in (scene.model, like(scene)))
    both = np.stack([first, second], axis=1).reshape(-1, 3)
    columns = {"I": [k % 2 for k in range(len(both))]}
    faulty = log(scene, both, np.repeat(hold, 2), np.repeat(pose, 2), columns=columns, stamps=2)
    return faulty, log(scene, first, hold, pose)


def gyroscope_first(scene: Scene) -> Pair:
    """A log without header that begins with the columns of a gyroscope; honest: acceleration first."""
    f, pose, hold = force_of_log(scene)
    output = scene.model.output(f + scene.noises(len(f)))
    turned = gyroscope(scene.rng, len(f)) + np.where(hold[:, None], 0.0, scene.rng.normal(size=(len(f), 3)))
    time = {"t": [f"{k / RATE:.2f}" for k in range(len(f))]}
    gyro = {f"w{k}": [f"{v:.5f}" for v in turned[:, k]] for k in range(3)}
    acceleration = {f"a{k}": [scene.digits(v) for v in output[:, k]] for k in range(3)}
    recording = log(scene, output, hold, pose)
    return log_row(recording, time | gyro | acceleration), log_row(recording, time | acceleration | gyro)


def unmoved(scene: Scene) -> Pair:
    """A log of a sensor that was never turned."""
    f, pose, hold = force_of_log(scene)
    still = np.repeat(f[:1], len(f), axis=0)
    z = scene.noises(len(f))
    return tuple(  # type: ignore[return-value]
        log(scene, scene.model.output(force + z), hold, pose) for force in (still, f)
    )


LOGS: tuple[tuple[str, Callable[[Scene], Pair], tuple[str, ...]], ...] = (
    ("log without --raw", without_raw, ("log",)),
    ("log with a tremor of 20 mrad", with_tremor, ("tremor",)),
    ("log with rows of zeros", asleep, ("zero-rows",)),
    ("log of two sensors", of_two, ("several-sensors",)),
    ("log, gyroscope taken", gyroscope_first, ("gravity-removed", "gyroscope", "never-moved")),
    ("log, never moved", unmoved, ("never-moved",)),
)
