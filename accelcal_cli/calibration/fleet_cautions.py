"""The cautions of many sensors: arrays tell which have any, and those are put into the words of `calibrate`."""

from __future__ import annotations

import numpy as np

from accelcal_cli.calibration.cautions import LARGE, MORE_THAN_NOISE, NOISE_BIAS, cautions, odd_gravity
from accelcal_cli.calibration.fleet_fit import PoseFits
from accelcal_cli.calibration.quality import SCALE
from accelcal_cli.calibration.scatter import beyond_scatter
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.sensor.doubts import RAW_ROWS, may_be_doubtful
from accelcal_cli.sensor.fleet import Batch, FleetReadings
from accelcal_cli.streams import Float


def fleet_cautions(
    readings: FleetReadings,
    batch: Batch,
    settings: Settings,
    s: Float,
    covariance: Float,
    fits: PoseFits,
) -> np.ndarray:
    """Return the cautions of each sensor of a batch in one text, empty where there are none, shape (R,).

    Args:
        readings, batch, settings: as they are calibrated.
        s: standard deviation of a pose, m/s^2, shape (R,); covariance: of the nine, (m/s^2)^2, shape (R, 9, 9).
        fits: their residuals.
    """
    g = settings.g
    sigma = np.sqrt(np.einsum("rpp->rp", covariance)[:, SCALE]).max(axis=1) / g
    suspect = (
        (s > LARGE * g) | (NOISE_BIAS * (s / g) ** 2 > sigma) | (s**2 >= MORE_THAN_NOISE**2 * fits.explained)
    )
    suspect |= (batch.count >= RAW_ROWS) | np.array([bool(names) for names in fits.outlying])
    suspect |= may_be_doubtful(batch.output, batch.count) | bool(odd_gravity(g))
    words = np.full(len(s), "", dtype=object)
    for at in np.flatnonzero(suspect).tolist():
        noise = beyond_scatter(float(s[at]), float(fits.explained[at]), int(batch.count[at]) - 9)
        own = cautions(
            settings,
            1,
            0.0,
            float(s[at]),
            int(batch.count[at]) - 9,
            float(sigma[at]),
            noise,
            fits.outlying[at],
        )
        words[at] = " ".join((*readings.cautions(batch, at), *own))
    return words
