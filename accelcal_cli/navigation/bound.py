"""The posterior Cramer-Rao bound of a scenario: what no filter's mean square error is below [tichavsky1998].

The system is linear but for the map, and the noise is Gaussian; the recursion is then that of a Kalman filter whose
measurement matrix is the slope of the map at the true position.
"""

from __future__ import annotations

import numpy as np

from accelcal_cli.navigation.earth import metres_per_radian
from accelcal_cli.navigation.error_model import process_noise
from accelcal_cli.navigation.scenario import Scenario, transitions
from accelcal_cli.streams import Float


def bound(scenario: Scenario) -> Float:
    """Return the least variances of the position error north and east at every epoch, m^2, shape (K, 2).

    A measurement that is missing, or taken where the map has no value, tells nothing.
    """
    route = scenario.route
    latitude = np.atleast_2d(route.latitude)[0]
    longitude = np.atleast_2d(route.longitude)[0]
    north, east = scenario.gravity_map.slope(latitude, longitude)
    slope = np.stack([north, east], axis=-1) / np.stack(metres_per_radian(latitude), axis=-1)
    slope[np.isnan(slope).any(axis=1) | np.isnan(scenario.measured[0])] = 0.0
    F = transitions(route, scenario.turns, (0, scenario.epochs), scenario.period, scenario.grade).reshape(
        -1, 12, 12
    )
    Q = np.diag(process_noise(scenario.grade, scenario.period))
    P = np.diag(scenario.prior())
    out = np.empty((scenario.epochs, 2))
    for k, h in enumerate(-slope):
        gain = P[:, :2] @ h
        P = P - np.outer(gain, gain) / (h @ gain[:2] + scenario.noise**2)
        out[k] = P[0, 0], P[1, 1]
        P = F[k] @ P @ F[k].T + Q
    return out
