"""What a navigation filter is, and what it leaves: estimates of the INS position error with their covariance."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from accelcal_cli.navigation.gravity_map import OUTSIDE
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.registry import Registry
from accelcal_cli.streams import Float, Streams


@dataclass(frozen=True)
class Track:
    """What a filter says of R runs at K epochs.

    Attributes:
        mean: position error of the INS, m north and east, shape (R, K, 2).
        covariance: of it, m^2, shape (R, K, 2, 2).
        blind: epochs at which no particle was on the map, shape (R,).
        lookups: of the map, for each run and epoch on average.
    """

    mean: Float
    covariance: Float
    blind: Float
    lookups: float

    @classmethod
    def empty(cls, scenario: Scenario) -> Track:
        """Return a track to be filled."""
        shape = scenario.runs, scenario.epochs
        return cls(np.zeros((*shape, 2)), np.zeros((*shape, 2, 2)), np.zeros(shape[0]), 0.0)


class Filter(ABC):
    """A filter; its dataclass fields are its YAML keys."""

    name: ClassVar[str]
    mode: str

    @abstractmethod
    def run(self, scenario: Scenario, streams: Streams) -> Track:
        """Return the filter's track; run r of the streams belongs to run r of the scenario."""


FILTERS: Registry[Filter] = Registry("accelcal_cli.navigation", "filter")

UNSEEN = -1e5
"""Greatest log-likelihood of a cloud of which no particle is on the map: above OUTSIDE, below any misfit on it."""


def log_likelihood(measured: Float, anomaly: Float, variance: float) -> Float:
    """Return -(y - map)^2 / 2R, OUTSIDE where the map has no value, and 0 without a measurement.

    Args:
        measured: mGal, broadcast against anomaly; anomaly: mGal; variance: R, mGal^2. [depf2015] eq. 2.
    """
    misfit = measured - anomaly
    misfit *= misfit
    misfit *= -0.5 / variance
    unknown = np.isnan(misfit)
    if unknown.any():
        misfit[unknown] = OUTSIDE
        misfit = np.where(np.isnan(measured), 0.0, misfit)
    return misfit
