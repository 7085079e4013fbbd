"""What a navigation filter is: its estimates, and how those of several noise models are mixed by their evidence."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from accelcal_cli.arrays import Float
from accelcal_cli.navigation.noise import NoiseModel
from accelcal_cli.navigation.scenario import Scenario
from accelcal_cli.registry import Registry
from accelcal_cli.rng import Streams
from accelcal_cli.schema import Checked, setting


@dataclass(frozen=True)
class PositionEstimates:
    """What a filter estimates in R runs at K epochs.

    Attributes:
        mean: position error of the INS, m north and east, shape (R, K, 2).
        covariance: its covariance, m^2, shape (R, K, 2, 2).
        evidence: logarithm of the density of each measurement as predicted from those before it, shape (R, K).
        nis: normalised innovation squared of each measurement, 1 on average when the filter is right, shape (R, K); NaN
            without a measurement.
        rejected: which measurements were left out as outliers, shape (R, K), 1 or 0.
        disturbed: probability of the disturbed noise model, shape (R, K).
        blind: number of epochs at which no particle was on the map, shape (R,).
        lookups: look-ups of the map per run and epoch, on average.
    """

    mean: Float
    covariance: Float
    evidence: Float
    nis: Float
    rejected: Float
    disturbed: Float
    blind: Float
    lookups: float

    @classmethod
    def empty(cls, scenario: Scenario) -> PositionEstimates:
        """Return estimates that are still to be filled in."""
        shape = scenario.runs, scenario.epochs
        evidence, nis, rejected, disturbed = (np.zeros(shape) for _ in range(4))
        nis[:] = np.nan
        mean, covariance = np.zeros((*shape, 2)), np.zeros((*shape, 2, 2))
        return cls(mean, covariance, evidence, nis, rejected, disturbed, np.zeros(shape[0]), 0.0)

    def note(self, k: int, innovation: Float, variance: Float, gate: float) -> Float:
        """Fill in what the innovations of epoch k say; return which runs use the measurement, shape (R,), 1 or 0.

        Args:
            innovation: mGal, shape (R,), NaN without a measurement; variance: as predicted, mGal^2.
            gate: in sigma; 0: none.
        """
        nis = innovation**2 / variance
        known = np.isfinite(nis)
        self.nis[:, k] = nis
        self.rejected[:, k] = known & (nis > gate**2) & (gate > 0.0)
        used = known & (self.rejected[:, k] == 0.0)
        density = -0.5 * (nis + np.log(2.0 * np.pi * variance))
        self.evidence[:, k] = np.where(used, density, OUTLIER * self.rejected[:, k])
        return np.asarray(used, dtype=float)


OUTLIER = -14.0
"""Logarithm of the density of a measurement that is an outlier, 1/mGal [chosen]: below it the gate leaves out."""

SWITCH = 2e-3
"""Probability that the noise changes to another model between two measurements [chosen]: no model is ever far from
coming back, for an hour of a biased gravimeter may well look like another position."""


@dataclass(frozen=True)
class Filter(Checked, ABC):
    """A filter; its dataclass fields are its YAML keys.

    Raises:
        ConfigError: a setting out of range.
    """

    name: ClassVar[str]

    mode: Literal["default", "literal"] = setting(
        "default", "`literal`: as the paper prints it, with R as stated; `default`: R enlarged"
    )
    robust: bool = setting(
        True, "weigh the nominal against the disturbed noise model, and gate (mode default alone)"
    )

    def run(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the filter's estimates; run r of the streams belongs to run r of the scenario."""
        plain = NoiseModel(eotvos=scenario.models[0].eotvos and self.mode == "default")
        models = scenario.models if self.robust and self.mode == "default" else (plain,)
        return mix([self.track(scenario.under(model), streams) for model in models])

    @abstractmethod
    def track(self, scenario: Scenario, streams: Streams) -> PositionEstimates:
        """Return the estimates under the noise model of a scenario, whose measurements the filter may leave out."""


FILTERS: Registry[Filter] = Registry(Filter, "accelcal_cli.navigation.filters", "filter", "accelcal.filters")


def mix(parts: Sequence[PositionEstimates]) -> PositionEstimates:
    """Return the estimates of all noise models, weighed by the evidence so far [magill1965].

    The model may change: before each measurement a part SWITCH of every weight goes to the other models, so that a
    disturbance that comes late is noticed at once [blom1988].
    """
    if len(parts) == 1:
        return parts[0]
    first, count = parts[0], len(parts)
    weights = np.full((count, len(first.mean)), 1.0 / count)
    out = replace(
        first, **{n: np.zeros_like(getattr(first, n)) for n in ("mean", "covariance", "nis", "rejected")}
    )
    for k in range(first.mean.shape[1]):
        weights = (1.0 - SWITCH) * weights + SWITCH * (1.0 - weights) / (count - 1)
        for name in ("nis", "rejected"):
            getattr(out, name)[:, k] = sum(
                w * getattr(p, name)[:, k] for w, p in zip(weights, parts, strict=True)
            )
        logs = np.stack([p.evidence[:, k] for p in parts])
        logs = np.where(np.isfinite(logs), logs, -1e9)  # a model whose filter has diverged
        weights = weights * np.exp(logs - logs.max(axis=0))
        weights /= weights.sum(axis=0)
        shares = [(w[:, None], p) for w, p in zip(weights, parts, strict=True)]
        out.mean[:, k] = sum(np.where(w > 0.0, w * p.mean[:, k], 0.0) for w, p in shares)
        for w, p in shares:
            away = p.mean[:, k] - out.mean[:, k]
            spread = p.covariance[:, k] + away[:, :, None] * away[:, None, :]
            out.covariance[:, k] += np.where(w[:, :, None] > 0.0, w[:, :, None] * spread, 0.0)
        out.disturbed[:, k] = 1.0 - weights[0]
    blind = np.min([p.blind for p in parts], axis=0)
    return replace(out, blind=blind, lookups=sum(p.lookups for p in parts))
