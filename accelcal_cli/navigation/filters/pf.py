"""The plain particle filter under its name."""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.navigation.particle_filter import FILTERS, Sir


@FILTERS.register("pf")
@dataclass(frozen=True)
class Pf(Sir):
    """Sampling-importance-resampling particle filter [gordon1993]."""
