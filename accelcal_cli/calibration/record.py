"""Plain values to arrays and back, for records that go through JSON and YAML."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from accelcal_cli.streams import Float

MOST = 2**53
"""Largest count: up to here floats hold every whole number."""


def plain(value: Any) -> Any:
    """Return a value as plain mappings, lists, numbers and text; NaN and inf become None."""
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):  # numpy's too, which YAML does not know
        return float(value) if math.isfinite(value) else None
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if hasattr(value, "__dataclass_fields__"):
        return {f.name: plain(getattr(value, f.name)) for f in fields(value)}
    return value


def array(value: Any, shape: tuple[int, ...], *, whole: bool = False) -> Float:
    """Return nested lists as an array of a shape, None as NaN.

    Raises:
        ValueError, TypeError: another shape, no numbers, or None although it is to be `whole`.
    """
    found = np.array(
        [
            [math.nan if v is None else v for v in row]
            if isinstance(row, list)
            else (math.nan if row is None else row)
            for row in value
        ],
        dtype=float,
    )
    if found.shape != shape:
        raise ValueError(f"expected {' x '.join(map(str, shape))} numbers")
    if whole and not np.isfinite(found).all():
        raise ValueError("a number is missing")
    return found


def of_kind(value: Any, kinds: tuple[type, ...], words: str) -> Any:
    """Return a value of one of the kinds; a truth value is no number.

    Raises:
        ValueError: another kind.
    """
    if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
        raise ValueError(f"{value!r} where {words} was expected")
    if kinds == (int,) and isinstance(value, int) and abs(value) > MOST:
        raise ValueError(f"a number beyond {MOST} where {words} was expected")
    return value


def check_size(value: Any, depth: int = 4) -> None:
    """Refuse a whole number that no float can be, in a value or in lists and mappings `depth` deep.

    Raises:
        OverflowError: there is one.
    """
    if isinstance(value, int):
        float(value)
    elif depth and isinstance(value, list | Mapping):
        for part in value.values() if isinstance(value, Mapping) else value:
            check_size(part, depth - 1)


def or_nan(value: Any) -> float:
    """Return a number, NaN for None."""
    return math.nan if value is None else float(value)


def or_infinite(value: Any) -> float:
    """Return a number, infinity for None."""
    return math.inf if value is None else float(value)
