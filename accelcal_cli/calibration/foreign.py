"""New readings that no ageing of a sensor explains: another unit than those of the result, or another sensor."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.residuals import modulus_errors
from accelcal_cli.calibration.result import Calibration
from accelcal_cli.errors import DataError
from accelcal_cli.sensor.readings import Readings
from accelcal_cli.sensor.units import STANDARD_GRAVITY

STRANGE = 0.5
"""Readings off by this part of g are rather in another unit than of a sensor that changed."""

LIKELY = {
    1.0 / STANDARD_GRAVITY: "in g where those of the result are in m/s^2",
    STANDARD_GRAVITY: "in m/s^2 where those of the result are in g",
    1e-3: "in a unit a thousand times as large (g for mg)",
    1e3: "in a unit a thousand times as small (mg for g)",
}
"""What readings of so many times the size are, as a rule."""

NEAR = 0.05
"""How near to one of them the size has to be, in part."""


def check_unit(old: Calibration, readings: Readings) -> None:
    """Refuse readings not one of which is near g under the result; a sensor that changed has some that are.

    Raises:
        DataError: each of them misses g by half of it or more; the message says what unit that looks like.
    """
    model = old.model.in_gauge("lower")
    sizes = np.concatenate(
        [np.linalg.norm(f, axis=1) / old.g for _, _, f in modulus_errors(readings, model, old.g)]
    )
    if (np.abs(sizes - 1.0) < STRANGE).any():
        return
    size = float(np.median(sizes))
    likely = next((text for factor, text in LIKELY.items() if abs(size / factor - 1.0) < NEAR), None)
    words = (
        f"they seem to be {likely}"
        if likely
        else "are they in another unit than its readings, or of another sensor?"
    )
    raise DataError(
        f"{readings.source}: under the result no pose is near g = {old.g:.6g} {old.unit}, most have "
        f"{size * old.g:.3g}; {words}"
    )


def strange(rms: float, old: Calibration) -> tuple[str, ...]:
    """Return a warning of readings some of which are far off, by the rms of |f| - g in the unit of the result."""
    if rms < STRANGE * old.g:
        return ()
    return (
        f"Under the result they miss g by {rms:.3g} {old.unit}: another unit than its readings, or another sensor?",
    )
