"""One schema for settings and for records: frozen dataclasses to plain mappings and back, each value checked.

A field says once what it may be: its type, and by `setting` or by `Annotated[type, Limits(...)]` its range, its shape
and what None stands for. `to_mapping` and `from_mapping` do the rest. Settings, which people write, and records, which
programs write, differ in two ways alone: every setting has a default, and unknown keys of a record are passed over,
since a later version may have written them.
"""

from __future__ import annotations

import dataclasses
import math
import operator
import re
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, TypeVar, dataclass_transform

from accelcal_cli.errors import ConfigError, did_you_mean

T = TypeVar("T")


@dataclass_transform(frozen_default=True, field_specifiers=(dataclasses.field,))
def frozen(*, eq: bool = True) -> Callable[[type[T]], type[T]]:
    """Make a frozen dataclass in a third of the time that `dataclass` takes; without `eq` compared by identity.

    `dataclass` writes and compiles six methods for each class, and a start of the command line makes eighty classes.
    Here all classes share five of them.

        >>> @frozen()
        ... class Point:
        ...     x: float
        >>> Point(1.0), Point(1.0) == Point(1.0)
        (Point(x=1.0), True)
    """
    shared = {"__setattr__": _set_once, "__delattr__": _delete, "__repr__": _shown}
    if eq:
        shared |= {"__eq__": _equal, "__hash__": _hash}

    def make(cls: type[T]) -> type[T]:
        made = dataclasses.dataclass(eq=False, repr=False)(cls)
        for name, method in shared.items():
            if name not in cls.__dict__:
                setattr(made, name, method)
        return made

    return make


def _set_once(self: object, name: str, value: object) -> None:
    """Set a field that has no value yet, as `__init__` does."""
    if name in self.__dict__:
        raise dataclasses.FrozenInstanceError(f"cannot assign to field {name!r}")
    object.__setattr__(self, name, value)


def _delete(_: object, name: str) -> None:
    raise dataclasses.FrozenInstanceError(f"cannot delete field {name!r}")


def _equal(self: object, other: object) -> bool:
    return _compared(self) == _compared(other) if type(other) is type(self) else NotImplemented


def _hash(self: object) -> int:
    return hash(_compared(self))


def _shown(self: object) -> str:
    fields = dataclasses.fields(self)  # type: ignore[arg-type]
    shown = ", ".join(f"{f.name}={getattr(self, f.name)!r}" for f in fields if f.repr)
    return f"{type(self).__qualname__}({shown})"


def _compared(self: object) -> tuple[object, ...]:
    fields = dataclasses.fields(self)  # type: ignore[arg-type]
    return tuple(getattr(self, f.name) for f in fields if f.compare)


KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "text"}

EXPONENT = r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+"
"""A number that YAML 1.1 takes for text: 1e-6 has no dot, 1.5e6 no sign."""


@dataclasses.dataclass(frozen=True)
class Limits:
    """What a field may hold, besides its type.

    Attributes:
        low, high: inclusive; above: exclusive; of the number, or of each number in a list, mapping or array.
        none: the number that None stands for in a file, NaN or infinity; without it None is refused.
        shape: of an array.
        older: the value for a file that was written before there was such a field; `...`: none.
    """

    low: float | None = None
    high: float | None = None
    above: float | None = None
    none: float | None = None
    shape: tuple[int, ...] = ()
    older: Any = ...

    def check(self, value: Any, label: str) -> None:
        """Raise ConfigError when a number, or one in a tuple, is not finite or outside the range; `label` is named."""
        if isinstance(value, tuple):
            for i, element in enumerate(value):
                self.check(element, f"{label}[{i}]")
        if isinstance(value, bool) or not isinstance(value, int | float):
            return
        if isinstance(value, float) and not math.isfinite(value):
            raise ConfigError(f"{label}: {value} is not a finite number")
        for limit, beyond, what in (
            (self.low, operator.lt, "too small; expected at least"),
            (self.above, operator.le, "too small; expected more than"),
            (self.high, operator.gt, "too large; expected at most"),
        ):
            if limit is not None and beyond(value, limit):
                raise ConfigError(f"{label}: {_short(value)} is {what} {limit:g}")


def array(*shape: int, none: float | None = None, largest: float | None = None) -> Limits:
    """Return the limits of an array of a shape; without `none` no number may be missing."""
    return Limits(shape=shape, none=none, high=largest, low=None if largest is None else -largest)


def setting(
    default: Any, doc: str, *, low: float | None = None, high: float | None = None, above: float | None = None
) -> Any:
    """Return a dataclass field that is one YAML key: its default, its meaning, and the range it keeps to.

    `low` and `high` are inclusive, `above` is exclusive.
    """
    return dataclasses.field(default=default, metadata={"doc": doc, "low": low, "high": high, "above": above})


def check(instance: Any) -> None:
    """Raise ConfigError when a number in a field of a dataclass is outside the field's range, or not finite."""
    for name, (_, limits) in _declared(type(instance)).items():
        limits.check(getattr(instance, name), name)


class Checked:
    """Base of dataclasses that refuse a number outside the range of its field, however they are made."""

    def __post_init__(self) -> None:
        """Raise ConfigError for it; see `check`."""
        check(self)


def _short(value: Any) -> str:
    """Return a value as a message shows it: a number of 400 digits is cut off."""
    text = repr(value)
    return text if len(text) <= 30 else f"{text[:30]}..."


def to_mapping(record: Any) -> dict[str, Any]:
    """Return a dataclass as plain mappings, lists, numbers, text and None, ready for JSON and YAML.

    Mappings, arrays, sequences and dataclasses in it are taken apart likewise, and so is a mapping instead of a
    dataclass; NaN and infinity become None, since JSON has neither.
    """
    return dict(_plain(record))


def _plain(value: Any) -> Any:
    if hasattr(value, "tolist"):  # an array, or a number of numpy, which YAML does not know either
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


def from_mapping(cls: type[T], mapping: Mapping[str, Any], where: str, *, extra: bool = False) -> T:
    """Return dataclass `cls` of a mapping whose keys are its fields; a key may be left out if the field has a default.

    Args:
        cls: a frozen dataclass.
        mapping: what a YAML or JSON file or a command line gave.
        where: what to name in a message, for instance ``de-pso.yaml: parameters``.
        extra: whether keys that are not known are passed over rather than refused, here and in the parts.

    Raises:
        ConfigError: an unknown key (with the nearest known one), a missing one, a wrong type or shape, or a value out
            of range; the message says where and what was expected.
    """
    fields = _declared(cls)
    values = {name: limits.older for name, (_, limits) in fields.items() if limits.older is not ...}
    for key, value in mapping.items():
        if key in fields:
            values[key] = _convert(value, *fields[key], f"{where}: {key}", extra)
        elif not extra:
            known = ", ".join(fields) or "none"
            raise ConfigError(f'{where}: unknown key "{key}"{did_you_mean(str(key), fields)}; known: {known}')
    none = (dataclasses.MISSING, dataclasses.MISSING)
    absent = (f for f in dataclasses.fields(typing.cast(Any, cls)) if f.name not in values)
    missing = [f.name for f in absent if (f.default, f.default_factory) == none]
    if missing:
        raise ConfigError(f"{where}: missing: {', '.join(missing)}")
    try:
        return cls(**values)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from None


_DECLARED: dict[type, dict[str, tuple[Any, Limits]]] = {}


def _declared(cls: type) -> dict[str, tuple[Any, Limits]]:
    """Return type and limits of the fields of a dataclass by name; looked up once for each class."""
    if cls not in _DECLARED:
        hints = typing.get_type_hints(cls, include_extras=True)
        ranges = (
            (f.name, Limits(f.metadata.get("low"), f.metadata.get("high"), f.metadata.get("above")))
            for f in dataclasses.fields(cls)
        )
        _DECLARED[cls] = {name: _apart(hints[name], limits) for name, limits in ranges}
    return _DECLARED[cls]


def _apart(hint: Any, limits: Limits) -> tuple[Any, Limits]:
    """Return type and limits of `Annotated[type, Limits(...)]`; any other type with the limits that are given."""
    return typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint, limits)


def _convert(value: Any, hint: Any, limits: Limits, label: str, extra: bool) -> Any:
    """Return `value` as the annotated type, or raise ConfigError saying what was expected.

    Whole floats such as 1e3 pass for integers, and integers for floats; nothing else is bent.
    """
    hint, limits = _apart(hint, limits)
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        (hint,) = [argument for argument in arguments if argument is not type(None)]
        return _convert(value, hint, limits, label, extra)
    if origin is dict or dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(f"{label}: expected a mapping of keys, not {_short(value)}")
        if origin is not dict:
            return from_mapping(hint, value, label, extra=extra)
        return {key: _convert(v, arguments[1], limits, f"{label}: {key}", extra) for key, v in value.items()}
    if origin is tuple:
        return _sequence(value, arguments, limits, label, extra)
    if origin is typing.Literal:
        return _choice(value, arguments, label)
    if origin is not None:  # the only other type with parameters
        return _array(value, limits, label)
    return _free(value, label) if hint is Any else _scalar(value, hint, limits, label)


def _array(value: Any, limits: Limits, label: str) -> Any:
    import numpy as np  # here: most of what is declared has no arrays, and the help of a command does without

    rows: Any = float
    for length in reversed(limits.shape):
        rows = types.GenericAlias(tuple, (rows,) * length)
    try:
        return np.array(_convert(value, rows, limits, label.rpartition(": ")[2], extra=False))
    except ConfigError as error:
        numbers = " x ".join(map(str, limits.shape))
        raise ConfigError(f"{label}: expected {numbers} numbers; {error}") from None


def _sequence(
    value: Any, arguments: tuple[Any, ...], limits: Limits, label: str, extra: bool
) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise ConfigError(f"{label}: expected a list, not {_short(value)}")
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        arguments = (arguments[0],) * len(value)
    if len(value) != len(arguments):
        raise ConfigError(f"{label}: expected {len(arguments)} values, not {len(value)}")
    pairs = enumerate(zip(value, arguments, strict=True))
    return tuple(_convert(v, hint, limits, f"{label}[{i}]", extra) for i, (v, hint) in pairs)


def _choice(value: Any, choices: tuple[Any, ...], label: str) -> Any:
    if value not in choices or isinstance(value, bool):
        names = [str(choice) for choice in choices]
        near = did_you_mean(str(value), names)
        raise ConfigError(f"{label}: {_short(value)} is not one of {', '.join(names)}{near}")
    return value


def _scalar(value: Any, hint: Any, limits: Limits, label: str) -> Any:
    if value is None and limits.none is not None:
        return limits.none
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if (hint is float and isinstance(value, str) and re.fullmatch(EXPONENT, value)) or (
        hint is float and number
    ):
        value = _float(value, label)
    elif hint is int and number and (isinstance(value, int) or value.is_integer()):
        value = int(value)
    elif hint not in (bool, str) or not isinstance(value, hint):
        raise ConfigError(f"{label}: expected {KINDS.get(hint, str(hint))}, not {_short(value)}")
    limits.check(value, label)
    return value


def _float(value: Any, label: str) -> float:
    try:
        return float(value)
    except OverflowError:
        raise ConfigError(f"{label}: {_short(value)} is too large for a floating-point number") from None


def _free(value: Any, label: str, depth: int = 4) -> Any:
    """Return a value of any kind, once no whole number in it, down to a depth, is too large for a float."""
    if isinstance(value, int):
        _float(value, label)
    elif depth and isinstance(value, Mapping | list):
        for key, part in value.items() if isinstance(value, Mapping) else enumerate(value):
            _free(part, f"{label}: {key}", depth - 1)
    return value
