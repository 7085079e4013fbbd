"""The optimizers as data: what each is, where it comes from, and its settings."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

from accelcal_cli.config import shipped_parameters
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.table import Column, Table
from accelcal_cli.views.blocks import BLANK, Block, Paragraph


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


def catalogue_blocks(table: Table) -> list[Block]:
    """Return what the catalogue shows: one paragraph per optimizer, with its settings."""
    blocks: list[Block] = []
    for record in table.records():
        needs = f" Needs {record['needs']}." if record["needs"] else ""
        blocks += [
            Paragraph(f" - {record['family']}, [{record['paper']}]", heading=record["name"]),
            Paragraph(record["summary"] + needs, indent=2),
            Paragraph(assignments(record["parameters"]), indent=2),
        ]
    closing = "The settings of one: accelcal optimizers NAME. The papers: docs/bibliography.md."
    return [*blocks, BLANK, Paragraph(closing)]


def settings_blocks(table: Table) -> list[Block]:
    """Return what the settings of one optimizer show, each with its default, its range and its meaning."""
    blocks: list[Block] = [Paragraph(heading=table.title)]
    for name, default, values, meaning in table.rows:
        limits = f"  ({values})" if values else ""
        blocks += [Paragraph(f" = {plain(default)}{limits}", heading=name), Paragraph(meaning, indent=2)]
    return blocks


def assignments(parameters: Mapping[str, Any]) -> str:
    """Return settings as `name=value` with spaces between."""
    return " ".join(f"{name}={plain(value)}" for name, value in parameters.items())


def plain(value: Any) -> str:
    """Return a setting as YAML has it."""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple | list):
        return f"[{', '.join(map(plain, value))}]"
    return f"{value:g}" if isinstance(value, float) else str(value)


def flat(table: Table) -> Table:
    """Return the table with every cell as text that fits into CSV."""
    rows = tuple(
        tuple(
            assignments(cell) if isinstance(cell, Mapping) else "" if cell == "" else plain(cell)
            for cell in row
        )
        for row in table.rows
    )
    return dataclasses.replace(table, rows=rows)
