"""What all formats share: where the numbers come from, their units, and what a format drops."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import UsageError
from accelcal_cli.sensor.model import MRAD, STANDARD_GRAVITY, ErrorModel
from accelcal_cli.sensor.poses import AXES

NEAR_ONE = (0.5, 2.0)
"""Scale factors of readings that are specific force already, in m/s^2 or in g."""


@dataclass(frozen=True)
class Target:
    """What is to be written for.

    Attributes:
        instance: number of the sensor in the target, from 0.
        driver_scale: output units that the target's driver takes for 1 m/s^2; None when the readings of the result
            are what the target sees.
    """

    instance: int = 0
    driver_scale: float | None = None


@dataclass(frozen=True)
class Export:
    """A file in another tool's format, and what a user should know before using it."""

    content: bytes
    warnings: tuple[str, ...] = ()


Exporter = Callable[[Calibration, Target], Export]


def origin(result: Calibration) -> list[str]:
    """Return lines that say where the numbers come from."""
    lines = [
        f"accelcal {result.version}, verdict {result.verdict}, {result.poses} poses, g = {result.g:.9g} {result.unit}, "
        f"gauge {result.gauge}",
        f"readings {result.data.get('source', '?')}, sha256 {result.data.get('sha256', '?')}",
        *(f"caution: {caution}" for caution in result.cautions),
    ]
    return [" ".join(line.split()) for line in lines]


def comment(lines: Iterable[str], mark: str = "#") -> str:
    """Return lines as comments."""
    return "".join(f"{mark} {line}\n" for line in lines)


def rows(matrix: Float) -> list[list[float]]:
    """Return a matrix as lists of plain numbers."""
    return [[float(v) for v in row] for row in np.atleast_2d(matrix)]


def force_already(result: Calibration) -> bool:
    """Whether the readings are specific force already, in the unit of the result."""
    scale = np.diagonal(result.K_a)
    return bool(NEAR_ONE[0] < scale.min() and scale.max() < NEAR_ONE[1])


def in_metres(result: Calibration, target: Target, name: str) -> ErrorModel:
    """Return the sensor for a target whose readings are in m/s^2 before they are corrected.

    Readings in g are multiplied by 9.80665 on both sides; others by what the driver makes of them.

    Raises:
        UsageError: the readings are neither, and no driver scale says what the target makes of them; or a driver scale
            that is not that of these readings.
    """
    metres = STANDARD_GRAVITY if result.unit == "g" else 1.0  # how much one unit of f is in m/s^2
    scale = np.diagonal(result.K_a) / metres
    if target.driver_scale is not None:
        near = scale / target.driver_scale
        if not (NEAR_ONE[0] < near.min() and near.max() < NEAR_ONE[1]):
            raise UsageError(
                f"--driver-scale {target.driver_scale:g}: the calibrated readings are {scale.mean():.6g} to 1 m/s^2; "
                f"expected a number within a factor of {NEAR_ONE[1]:g} of it"
            )
        return ErrorModel(result.K_a / metres / target.driver_scale, result.D_a / target.driver_scale)
    if not force_already(result):
        raise UsageError(
            f"--to {name}: corrects readings in m/s^2, and these are in output units, {scale.mean():.6g} of them to "
            f"1 m/s^2; state with --driver-scale how many the driver takes for 1 m/s^2"
        )
    return ErrorModel(result.K_a, result.D_a * metres)


def dropped(model: ErrorModel, result: Calibration) -> tuple[str, ...]:
    """Return a sentence on the misalignments that a diagonal format leaves out, in mrad and as force at 1 g, if any."""
    if result.held.any():
        return ()
    rest = model.K / np.diagonal(model.K)[:, None] - np.eye(3)
    i, j = np.unravel_index(int(np.abs(rest).argmax()), (3, 3))
    angle = abs(float(rest[i, j]))
    metres = result.g * (STANDARD_GRAVITY if result.unit == "g" else 1.0)
    error = metres * float(np.linalg.norm(rest, 2))
    return (
        f"this format has no misalignments: up to {angle * MRAD:.3g} mrad ({angle:.3f} rad, axis {AXES[i]} towards "
        f"{AXES[j]}) are dropped, an error of up to {error:.2g} m/s^2 at 1 g",
    )


def without_temperature(result: Calibration) -> tuple[str, ...]:
    """Return a warning when the result has temperature slopes, which no format here holds."""
    temperature = getattr(result, "temperature", None)
    if temperature is None:
        return ()
    return (
        f"the slopes with temperature are dropped: the numbers hold at {temperature.reference:.4g} degrees",
    )
