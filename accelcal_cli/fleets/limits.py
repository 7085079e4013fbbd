"""Limits for the parameters of a sensor, from a YAML file: which sensors of a fleet keep them, and which do not.

    limits:
      bias: 50 mg
      scale: 1 %
      misalignment: 10 mrad
      noise: 300 ug
      rms: 1 mg

A limit is for the size of a parameter on every axis. The estimate decides; its 95 % interval is told with it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields
from math import pi
from pathlib import Path
from typing import Any

import numpy as np

from accelcal_cli.arrays import Bool, Float
from accelcal_cli.calibration.fleet import Fleet, parameter_gains
from accelcal_cli.calibration.observability import PARAMETERS
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.config import load_mapping
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.schema import from_mapping
from accelcal_cli.sensor.model import STANDARD_GRAVITY

NUMBER = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S.*?)?\s*")

FORCE = {"g": 1e6, "mg": 1e3, "ug": 1.0, "m/s^2": 1e6 / STANDARD_GRAVITY, "mm/s^2": 1e3 / STANDARD_GRAVITY}
ANGLE = {"mrad": 1.0, "rad": 1e3, "deg": 1e3 * pi / 180.0}
PART = {"%": 1e-2, "ppm": 1e-6}
"""Units of limits, and their sizes in micro-g, mrad and parts of one."""

OTHER_WORDS = {"µg": "ug", "μg": "ug", "micro-g": "ug", "m/s2": "m/s^2", "m/s²": "m/s^2", "°": "deg"}


@dataclass(frozen=True)
class ParameterLimits:
    """Limits as a file states them, with their units; None where there is none.

    Attributes:
        bias: of a bias; scale: of a scale factor's distance from the nominal one, as a part of it.
        misalignment: of a misalignment; noise: of s, the standard deviation of a pose; rms: of |f| - g.
    """

    bias: Any = None
    scale: Any = None
    misalignment: Any = None
    noise: Any = None
    rms: Any = None


UNITS: Mapping[str, Mapping[str, float]] = {
    "bias": FORCE,
    "scale": PART,
    "misalignment": ANGLE,
    "noise": FORCE,
    "rms": FORCE,
}
EXAMPLES = {"bias": "50 mg", "scale": "1 %", "misalignment": "10 mrad", "noise": "300 ug", "rms": "1 mg"}


@dataclass(frozen=True)
class Limit:
    """A limit: its number and unit as stated, and the size of the unit in micro-g, mrad or parts of one."""

    number: float
    unit: str
    size: float

    def __str__(self) -> str:
        """As it was stated: ``50 mg``."""
        return f"{self.number:g} {self.unit}"


def load_limits(path: Path, settings: Settings) -> dict[str, Limit]:
    """Return the limits of a file by the name of the parameter.

    Raises:
        ConfigError: it cannot be read, an unknown key, no limit at all, a value that is no positive number with a unit
            of its parameter, or a limit of scale without a nominal sensor.
    """
    content = load_mapping(path)
    if set(content) != {"limits"} or not isinstance(content["limits"], Mapping):
        near = "".join(did_you_mean(str(key), ["limits"]) for key in content if key != "limits")
        raise ConfigError(
            f'{path}: expected the key "limits" with a mapping, as limits: {{bias: 50 mg}}{near}'
        )
    stated = from_mapping(ParameterLimits, content["limits"], f"{path}: limits")
    found = {
        f.name: _limit(value, f"{path}: limits: {f.name}", f.name)
        for f in fields(ParameterLimits)
        if (value := getattr(stated, f.name)) is not None
    }
    if not found:
        raise ConfigError(f"{path}: limits: expected at least one of {', '.join(UNITS)}")
    if "scale" in found and settings.nominal is None:
        raise ConfigError(
            f"{path}: limits: scale: needs a nominal sensor to be a distance from; state nominal: "
            "{scale: [x, y, z]} in the --config file"
        )
    return found


def _limit(value: Any, label: str, name: str) -> Limit:
    units = UNITS[name]
    expected = f'expected a number with its unit ({", ".join(units)}), as "{EXAMPLES[name]}"'
    match = NUMBER.fullmatch(value) if isinstance(value, str) else None
    if match is None or not match[2]:
        raise ConfigError(f"{label}: {expected}, not {value!r}")
    unit = OTHER_WORDS.get(match[2], match[2])
    if unit not in units:
        raise ConfigError(f'{label}: unknown unit "{unit}"{did_you_mean(unit, units)}; {expected}')
    if not 0.0 < float(match[1]) < np.inf:
        raise ConfigError(f"{label}: {match[1]} is not above zero; {expected}")
    return Limit(float(match[1]), unit, units[unit])


@dataclass(frozen=True)
class LimitCheck:
    """Which of R sensors keep the limits.

    Attributes:
        quantities: the K quantities that have limits, as `bias x`; limits: of each.
        kinds: the parameter of the file that each is of.
        value, half: of each, in the unit of its limit, and half its 95 % interval, NaN where none is told, (R, K).
        determined: whether there is a value to go by, shape (R,).
    """

    quantities: Sequence[str]
    kinds: Sequence[str]
    limits: Sequence[Limit]
    value: Float
    half: Float
    determined: Bool

    @property
    def beyond(self) -> Bool:
        """Which quantities are beyond their limits, shape (R, K); a value that is not known is."""
        most = np.array([limit.number for limit in self.limits])
        return ~(np.abs(self.value) <= most)

    @property
    def passed(self) -> Bool:
        """Which sensors keep all limits, shape (R,); one that is not determined does not."""
        return np.asarray(self.determined & ~self.beyond.any(axis=1))

    def reason(self, at: int) -> str:
        """Return why a sensor fails, each quantity with its value, interval and limit; nothing for one that passes."""
        if not self.determined[at]:
            return "not determined"
        return "; ".join(self._words(at, int(k)) for k in np.flatnonzero(self.beyond[at]))

    def _words(self, at: int, k: int) -> str:
        value, half, limit = float(self.value[at, k]), float(self.half[at, k]), self.limits[k]
        interval = f" (95 % interval {value - half:.4g} to {value + half:.4g})" if np.isfinite(half) else ""
        return f"{self.quantities[k]} {value:.4g} {limit.unit}{interval} is beyond {limit}"

    def counts(self) -> dict[str, int]:
        """Return how many sensors fail by each parameter of the file."""
        beyond = self.beyond & self.determined[:, None]
        kinds = np.array(self.kinds)
        return {kind: int(beyond[:, kinds == kind].any(axis=1).sum()) for kind in dict.fromkeys(self.kinds)}


def check_limits(fleet: Fleet, limits: Mapping[str, Limit], settings: Settings) -> LimitCheck:
    """Hold the sensors of a fleet against limits; `settings.g` is that of their readings."""
    nominal = np.ones(3) if settings.nominal is None else np.array(settings.nominal.scale)
    to_micro_g = 1e6 / settings.g
    half = fleet.coverage[:, None] * fleet.s[:, None] * parameter_gains(fleet, settings.g)
    nothing = np.full((len(fleet.s), 1), np.nan)
    sources: dict[str, Callable[[], tuple[Sequence[str], Float, Float]]] = {
        "bias": lambda: (PARAMETERS[6:9], fleet.parameters[:, 6:9], half[:, 6:9]),
        "scale": lambda: (
            PARAMETERS[0:3],
            fleet.parameters[:, 0:3] / nominal - 1.0,
            half[:, 0:3] / nominal,
        ),
        "misalignment": lambda: (PARAMETERS[3:6], fleet.parameters[:, 3:6], half[:, 3:6]),
        "noise": lambda: (["noise"], fleet.s[:, None] * to_micro_g, nothing),
        "rms": lambda: (["rms"], fleet.rms[:, None] * to_micro_g, nothing),
    }
    names, kinds, each = list[str](), list[str](), list[Limit]()
    values, halves = list[Float](), list[Float]()
    for kind, limit in limits.items():
        own, value, interval = sources[kind]()
        names += own
        kinds += [kind] * len(own)
        each += [limit] * len(own)
        local = STANDARD_GRAVITY / settings.g if limit.unit.endswith("s^2") and settings.g != 1.0 else 1.0
        values.append(value / (limit.size * local))
        halves.append(interval / (limit.size * local))
    value, width = np.concatenate(values, axis=1), np.concatenate(halves, axis=1)
    return LimitCheck(names, kinds, each, value, width, fleet.determined)
