"""The optimizers as data: what each is, where it comes from, and its settings."""

from __future__ import annotations

import dataclasses
import typing
from typing import Any

from accelcal_cli.optimization.optimizer import OPTIMIZERS, shipped_parameters
from accelcal_cli.table import Column, Table


def parameters(name: str) -> dict[str, Any]:
    """Return the settings of an optimizer as `calibrate` and `benchmark` use them."""
    defaults = {field.name: field.default for field in dataclasses.fields(OPTIMIZERS.get(name))}
    return {**defaults, **shipped_parameters(name)}


def catalogue() -> Table:
    """Return all optimizers: name, family, what it needs, paper, one sentence, parameters with defaults."""
    rows = []
    for name in OPTIMIZERS.names():
        cls = OPTIMIZERS.get(name)
        needs = ", ".join(need.replace("_", " ") for need in cls.needs)
        rows.append((name, cls.family, needs, cls.paper, _sentence(cls), parameters(name)))
    names = ("name", "family", "needs", "paper", "summary", "parameters")
    return Table("Optimizers", tuple(Column(n) for n in names), tuple(rows))


def settings(name: str) -> Table:
    """Return the settings of one optimizer: name, default, range, meaning.

    Raises:
        ConfigError: no such optimizer.
    """
    cls = OPTIMIZERS.get(name)
    values, hints = parameters(name), typing.get_type_hints(cls)
    rows = [
        (
            field.name,
            values[field.name],
            _range(field.metadata, hints[field.name]),
            field.metadata.get("doc", ""),
        )
        for field in dataclasses.fields(cls)
    ]
    columns = (Column("parameter"), Column("default"), Column("range"), Column("meaning"))
    title = f"{name}: {cls.family}, [{cls.paper}]. {_sentence(cls)}"
    return Table(title, columns, tuple(rows))


def _sentence(cls: type) -> str:
    return (cls.__doc__ or "").strip().splitlines()[0]


def _range(limits: Any, hint: Any) -> str:
    """Return the values that a setting may have, in words."""
    if typing.get_origin(hint) is typing.Literal:
        return " or ".join(map(str, typing.get_args(hint)))
    low, above, high = (limits.get(key) for key in ("low", "above", "high"))
    parts = [f"> {above:,}"] if above is not None else [f">= {low:,}"] if low is not None else []
    if high is not None:
        parts.append(f"<= {high:,}")
    return ", ".join(parts)
