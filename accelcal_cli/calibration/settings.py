"""The settings of a calibration: model, box, optimizer, robustness; the YAML keys of `--config`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from accelcal_cli.config import load_mapping
from accelcal_cli.errors import ConfigError
from accelcal_cli.optimization.optimizer import (
    OPTIMIZERS,
    Optimizer,
    State,
    built,
    preset_parameters,
    shipped_parameters,
)
from accelcal_cli.schema import Checked, check, from_mapping, setting
from accelcal_cli.sensor.model import STANDARD_GRAVITY, Gauge

Robust = Literal["none", "huber", "soft-l1"]
Weights = Literal["none", "n", "sd", "auto"]

Attitudes = Literal["unknown", "known"]

LARGEST = 1e30
"""Largest scale factor or bias of a nominal sensor, output units: its fourth power is still a number."""


ALIGNED = {
    "gauge": ("lower", "upper", "symmetric"),
    "robust": ("none",),
    "weights": ("none", "n", "sd"),
    "attitudes": ("unknown",),
}
"""What goes with axes that are taken as perpendicular."""

KNOWN = {"robust": ("none",), "weights": ("none", "n", "sd")}
"""What goes with known attitudes."""


@dataclass(frozen=True)
class BoxSettings(Checked):
    """Half-widths of the search box around the nominal sensor."""

    scale: float = setting(0.05, "scale factors, part of nominal", above=0, high=0.9)
    misalignment: float = setting(0.06, "misalignments, rad", above=0, high=0.7)
    bias: float = setting(0.10, "bias, part of g times nominal scale factor", above=0, high=10)


@dataclass(frozen=True)
class Nominal:
    """A stated nominal sensor; what is left out is estimated from the readings."""

    scale: tuple[float, float, float] = setting(None, "scale factors, output units per m/s^2")
    bias: tuple[float, float, float] = setting((0.0, 0.0, 0.0), "bias, output units")

    def __post_init__(self) -> None:
        """Refuse a nominal sensor without positive scale factors."""
        if self.scale is None or min(self.scale) <= 0:
            raise ConfigError("scale: expected three positive scale factors in output units per m/s^2")
        check(self)
        if not (min(self.scale) >= 1 / LARGEST and max(map(abs, (*self.scale, *self.bias))) <= LARGEST):
            raise ConfigError(f"expected scale factors and biases of {1 / LARGEST:g} to {LARGEST:g}")


@dataclass(frozen=True)
class Settings:
    """Everything that decides a calibration besides its readings; the YAML keys of `--config`."""

    optimizer: str = setting("de-pso", "name of the optimizer")
    parameters: dict[str, Any] = field(default_factory=dict)
    g: float = setting(
        STANDARD_GRAVITY, "local gravity, m/s^2; 1 for readings in units of g", low=1e-3, high=1e6
    )
    gauge: Gauge = setting("lower", "which of the equivalent matrices is shown")
    runs: int = setting(1, "independent searches (multi-start)", low=1, high=100_000)
    seed: int = setting(0, "seed of all random numbers", low=0)
    polish: bool = setting(True, "finish by Levenberg-Marquardt")
    robust: Robust = setting("none", "loss: none is least squares")
    weights: Weights = setting(
        "none",
        "weight of a pose: none, n (readings averaged), sd (their scatter and n) or auto (sd beside a shared error)",
    )
    attitudes: Attitudes = setting("unknown", "known: all twelve parameters, from columns fx, fy, fz")
    misalignment: bool = setting(
        True, "estimate misalignments; false: take the axes as perpendicular, six unknowns"
    )
    temperature: bool = setting(True, "slopes with temperature, where a temperature column determines them")
    box: BoxSettings = field(default_factory=BoxSettings)
    nominal: Nominal | None = setting(None, "stated nominal sensor; estimated when left out")

    def __post_init__(self) -> None:
        """Refuse a setting outside its range, and what does not go with perpendicular axes."""
        check(self)
        for applies, words, limits in (
            (not self.misalignment, "misalignment: false", ALIGNED),
            (self.attitudes == "known", "--attitudes known", KNOWN),
        ):
            for key, allowed in limits.items() if applies else ():
                if getattr(self, key) not in allowed:
                    raise ConfigError(
                        f"{key}: {getattr(self, key)} does not go with {words}; expected {' or '.join(allowed)}"
                    )

    def build_optimizer(self) -> Optimizer[State]:
        """Return the optimizer with its parameters.

        Raises:
            ConfigError: unknown optimizer or parameter.
        """
        return built(self.optimizer, self.parameters)


def _of_preset(name: Any, preset: Any, where: str) -> dict[str, Any]:
    if preset is None or not isinstance(name, str):
        return {}
    try:
        return preset_parameters(name, preset)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def load_settings(path: Path | None, overrides: Mapping[str, Any]) -> Settings:
    """Return the settings of a calibration: shipped defaults, then a file, then the command line.

    Args:
        path: the file of `--config`, or None.
        overrides: what the command line states; `parameters` holds settings of the optimizer. Here and in the file
            `preset` names one of the optimizer's, beneath its parameters.

    Raises:
        ConfigError: the file cannot be read or says something that is not known.
    """
    where = str(path) if path else "command line"
    stated = load_mapping(path) if path else {}
    for note in ("source", "presets"):  # of a shipped file of an optimizer: they set nothing
        stated.pop(note, None)
    merged = {**stated, **overrides}
    name = merged.get("optimizer", Settings.optimizer)
    if ":" in str(overrides.get("optimizer", "")):
        OPTIMIZERS.imported(str(name))  # stated on the command line: the only place that may import code
    elif ":" in str(name):
        raise ConfigError(f"{where}: optimizer {name}: a file imports no code; state it by --optimizer")
    own = stated.get("parameters") or {}
    if not isinstance(own, Mapping):
        raise ConfigError(f"{where}: parameters: expected a mapping of keys, not {own!r}")
    if stated.get("optimizer", name) != name:
        own = {}  # the file's parameters and preset belong to the optimizer that the command line replaced
        stated.pop("preset", None)
    preset = overrides.get("preset", stated.get("preset"))
    merged.pop("preset", None)
    shipped = {**shipped_parameters(name), **_of_preset(name, preset, where)}
    parameters = {**shipped, **own, **overrides.get("parameters", {})}
    settings = from_mapping(Settings, {**merged, "parameters": parameters}, where)
    settings.build_optimizer()
    return settings


def weights_of_log(keys: Mapping[str, Any]) -> str:
    """Return how the static poses of a log are weighted unless something else is stated, by the other keys."""
    return "n" if keys.get("misalignment") is False else "auto"
