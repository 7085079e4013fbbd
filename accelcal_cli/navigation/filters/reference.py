"""The reference: a Gaussian sum of extended Kalman filters [alspach1972], which shows what is attainable."""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.navigation.filter import FILTERS, Filter, PositionEstimates
from accelcal_cli.navigation.gaussian_sum import run_bank
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.rng import Streams
from accelcal_cli.schema import setting


@FILTERS.register("reference")
@dataclass(frozen=True)
class Reference(Filter):
    """Gaussian sum of extended Kalman filters [alspach1972]; it draws no random number, and has one mode."""

    components: int = setting(7, "on either axis of the initial position error", low=1, high=50)
    recovery: float = setting(
        0.1, "part of the prior that is added where innovations do not fit; 0: none", low=0.0, high=10.0
    )

    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:  # noqa: ARG002
        """Return the filter's estimates; see `Filter`."""
        return run_bank(scenario, self.components, self.recovery, split=True)
