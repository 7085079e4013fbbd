"""A sensor that is carried from pose to pose by hand, and the serial line that it is on."""

from __future__ import annotations

import contextlib
import os
import pty
import threading
import time
import tty

import numpy as np
from simulated import MEMS

from accelcal_cli.planning import candidates, distinct_poses
from accelcal_cli.rng import Streams

TOGETHER = 4
"""Lines that a device sends at once."""

G = 9.8
PLANNED = candidates("corners")[distinct_poses(candidates("corners"), 12)]


def hand(directions, *, still=100, moving=30, model=MEMS, sigma=0.01, seed=1):
    """Readings of a sensor that is carried from pose to pose: held still, turned with a tremor."""
    path, tremor = [], []
    for before, after in zip(np.roll(directions, 1, axis=0), directions, strict=True):
        # By way of a third direction, as the shortest one does not exist between opposite poses.
        corner = np.cross(before, after) + 0.3 * (before + after) + 1e-3
        way = np.linspace(0, 1, moving)[:, None]
        turned = (1 - way) ** 2 * before + 2 * way * (1 - way) * corner + way**2 * after
        path += [
            turned / np.linalg.norm(turned, axis=1, keepdims=True),
            np.repeat(after[None], still, axis=0),
        ]
        tremor += [np.full(moving, 1.0), np.full(still, sigma)]
    force = G * np.concatenate(path)
    noise = Streams(seed, [0]).normal(len(force), 3)[0] * np.concatenate(tremor)[:, None]
    return model.output(force + noise)


def held(directions, offsets):
    """The directions as a hand holds them, degrees beside the plan."""
    turned = directions + np.radians(offsets) * Streams(3, [0]).normal(len(directions), 3)[0] / np.sqrt(2)
    return turned / np.linalg.norm(turned, axis=1, keepdims=True)


def text_of(stream):
    return "".join(f"{k};{x:.6f};{y:.6f};{z:.6f}\n" for k, (x, y, z) in enumerate(stream)).encode()


class Device:
    """A sensor at the other end of a serial line."""

    def __init__(self):
        self.master, slave = pty.openpty()
        tty.setraw(slave)
        self.name, self.slave = os.ttyname(slave), slave

    def send(self, data, rate=None):
        """Send in the background, so many lines a second; a port that nobody reads any more ends it."""

        def chunks():
            if rate is None:
                yield from (data[start : start + 1000] for start in range(0, len(data), 1000))
                return
            lines, begun = data.splitlines(keepends=True), time.monotonic()
            for start in range(0, len(lines), TOGETHER):
                time.sleep(max(0.0, begun + start / rate - time.monotonic()))
                yield b"".join(lines[start : start + TOGETHER])

        def work():
            with contextlib.suppress(OSError):
                os.write(self.master, b"12.5;3\n")  # the rest of a line that began before
                for chunk in chunks():
                    os.write(self.master, chunk)

        thread = threading.Thread(target=work, daemon=True)
        thread.start()
        return thread

    def unplug(self):
        for descriptor in (self.slave, self.master):
            with contextlib.suppress(OSError):
                os.close(descriptor)
