"""A simulated raw log as CSV."""

from __future__ import annotations

from collections.abc import Iterable
from typing import IO

import numpy as np

from accelcal_cli.sensor.motion import Stretch

DIGITS = "%.9g"


def write_log(stretches: Iterable[Stretch], gyro: bool, file: IO[str]) -> list[tuple[int, int]]:
    """Write the rows as they come; return first and last row of each hold, counted from 1."""
    file.write("t,ax,ay,az" + ",wx,wy,wz" * gyro + "\n")
    holds, row = [], 0
    for stretch in stretches:
        columns = [stretch.time[:, None], stretch.output] + [stretch.gyro] * gyro
        line = ",".join([DIGITS] * (7 if gyro else 4)) + "\n"
        file.writelines(line % tuple(cells) for cells in np.hstack(columns).tolist())
        if stretch.pose:
            holds.append((row + 1, row + len(stretch.time)))
        row += len(stretch.time)
    return holds
