"""One schema for settings and records: mappings to frozen dataclasses, strictly."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from accelcal_cli.errors import ConfigError, did_you_mean

T = TypeVar("T")


def setting(
    default: Any, doc: str, *, low: float | None = None, high: float | None = None, above: float | None = None
) -> Any:
    """Return a dataclass field that is one YAML key: its default, its meaning, and the range it keeps to.

    `low` and `high` are inclusive, `above` is exclusive.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "low": low, "high": high, "above": above})


def check(instance: Any, where: str = "") -> None:
    """Raise ConfigError when a field of a dataclass made with `setting` is outside its range."""
    for field in dataclasses.fields(instance):
        value, limits = getattr(instance, field.name), field.metadata
        if isinstance(value, tuple) and not _all_finite(value):
            raise ConfigError(f"{where}{field.name}: {list(value)} holds a number that is not finite")
        if isinstance(value, bool) or not isinstance(value, int | float):
            continue
        label = f"{where}{field.name}"
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{label}: {value} is not a finite number")
        if limits.get("low") is not None and value < limits["low"]:
            raise ConfigError(f"{label}: {value} is too small; expected at least {limits['low']:g}")
        if limits.get("above") is not None and value <= limits["above"]:
            raise ConfigError(f"{label}: {value} is too small; expected more than {limits['above']:g}")
        if limits.get("high") is not None and value > limits["high"]:
            raise ConfigError(f"{label}: {_shown(value)} is too large; expected at most {limits['high']:g}")


def _shown(value: float) -> str:
    text = str(value)
    return text if len(text) <= 30 else f"{text[:30]}..."


def _all_finite(values: tuple[Any, ...]) -> bool:
    return all(_all_finite(v) if isinstance(v, tuple) else math.isfinite(v) for v in values)


def build(cls: type[T], mapping: Mapping[str, Any], where: str) -> T:
    """Build dataclass `cls` from `mapping`, refusing unknown keys and wrong types.

    Args:
        cls: a frozen dataclass whose fields are the permitted keys.
        mapping: what a YAML file or a command line gave.
        where: what to name in a message, for instance ``de-pso.yaml: parameters``.

    Raises:
        ConfigError: an unknown key (with the nearest known one), a wrong type, or a value out of range.
    """
    fields = {field.name: field for field in dataclasses.fields(cls)}  # type: ignore[arg-type]
    hints = typing.get_type_hints(cls)
    values = {}
    for key, value in mapping.items():
        if key not in fields:
            known = ", ".join(fields) or "none"
            raise ConfigError(f'{where}: unknown key "{key}"{did_you_mean(str(key), fields)}; known: {known}')
        values[key] = convert(value, hints[key], f"{where}: {key}")
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


def convert(value: Any, hint: Any, label: str) -> Any:
    """Return `value` as the annotated type, or raise ConfigError saying what was expected.

    Whole floats such as 1e3 pass for integers, and integers for floats; nothing else is bent.
    """
    if hint is Any:
        return value
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        (hint,) = [argument for argument in arguments if argument is not type(None)]
        return convert(value, hint, label)
    if origin is typing.Literal:
        if value not in arguments or isinstance(value, bool):
            raise ConfigError(
                f"{label}: {value!r} is not one of {', '.join(map(str, arguments))}"
                f"{did_you_mean(str(value), map(str, arguments))}"
            )
        return value
    if origin is dict and isinstance(value, Mapping):
        return dict(value)
    if origin is tuple:
        return _sequence(value, arguments, label)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{label}: expected a mapping of keys, not {value!r}")
        return build(hint, value, label)
    return _scalar(value, hint, label)


def _scalar(value: Any, hint: Any, label: str) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int and number and (isinstance(value, int) or value.is_integer()):
        return int(value)
    if hint is float and number:
        try:
            return float(value)
        except OverflowError:
            raise ConfigError(f"{label}: {_shown(value)} is too large; no number can be") from None
    if hint is float and isinstance(value, str):
        # YAML 1.1 reads 1e-6 (no dot) as text; the number is meant.
        try:
            return float(value)
        except ValueError:
            pass
    if hint in (bool, str) and isinstance(value, hint):
        return value
    names = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}
    raise ConfigError(f"{label}: expected {names.get(hint, str(hint))}, not {value!r}")


def _sequence(value: Any, arguments: tuple[Any, ...], label: str) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{label}: expected a list, not {value!r}")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ConfigError(f"{label}: expected {len(arguments)} values, not {len(value)}")
    return tuple(
        convert(v, a, f"{label}[{i}]") for i, (v, a) in enumerate(zip(value, arguments, strict=True))
    )
