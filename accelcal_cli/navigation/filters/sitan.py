"""SITAN: one extended Kalman filter whose slope is fitted to the map over its own uncertainty [hostetler1983].

The map is replaced by a plane through nine places about the one-sigma ellipse of the position; what the plane leaves
is added to the variance of the measurement. With a narrow ellipse it is the ordinary extended Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.navigation.filter import FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.gaussian_sum import run_bank
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@FILTERS.register("sitan")
@dataclass(frozen=True)
class Sitan(Filter):
    """Extended Kalman filter with stochastic linearisation [hostetler1983]; it draws no random number."""

    recovery: float = setting(
        0.1, "part of the prior that is added when innovations do not fit; 0: none", low=0.0, high=10.0
    )

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:  # noqa: ARG002
        """Return the filter's estimates; see `Filter`."""
        return run_bank(scenario, 1, self.recovery, split=False, stochastic=True)
