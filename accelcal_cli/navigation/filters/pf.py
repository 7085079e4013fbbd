"""PF: the plain particle filter."""

from __future__ import annotations

from dataclasses import dataclass

from accelcal_cli.navigation.filter import FILTERS
from accelcal_cli.navigation.particle_filter import ParticleFilter


@FILTERS.register("pf")
@dataclass(frozen=True)
class Pf(ParticleFilter):
    """Sampling-importance-resampling particle filter [gordon1993]."""
