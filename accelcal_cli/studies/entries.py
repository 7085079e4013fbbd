"""The optimizers of a study: by name with the shipped settings, or from a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from accelcal_cli.config import load_mapping, shipped_parameters
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.schema import build
from accelcal_cli.studies.study import Entry

ALL = "all"


@dataclass(frozen=True)
class Budget:
    """What a study states for all its optimizers; None leaves each its own.

    Attributes:
        population: points that are evaluated together.
        iterations: steps at most.
        evaluations: of a run. Without `iterations`, an optimizer gets as many as this budget has room for.
    """

    population: int | None = None
    iterations: int | None = None
    evaluations: int | None = None


def words(values: Iterable[str]) -> list[str]:
    """Return the names in repeated and comma-separated options, each once, in order."""
    parts = [part.strip() for value in values for part in value.split(",")]
    return list(dict.fromkeys(part for part in parts if part))


def choose(names: Sequence[str], config: Path | None, default: Sequence[str], budget: Budget) -> list[Entry]:
    """Return the optimizers that a command line names, with their settings.

    Args:
        names: labels of the file, names of optimizers, or "all"; none means the file's, or else `default`.
        config: YAML file with optimizers and parameters.
        default: names to take when nothing is said.
        budget: what replaces the settings of all.

    Raises:
        ConfigError: an unknown name or setting, or a value out of range.
    """
    stated = load_entries(config) if config else {}
    wanted = list(names) or list(stated) or list(default)
    if ALL in wanted:
        others = [name for name in wanted if name != ALL]
        wanted = list(dict.fromkeys([*stated, *OPTIMIZERS.names(), *others]))
    entries = [stated[name] if name in stated else _shipped(name, stated) for name in wanted]
    return [limited(entry, budget) for entry in entries]


def _shipped(name: str, stated: Iterable[str]) -> Entry:
    if OPTIMIZERS.find(name) is None:
        known = {*OPTIMIZERS.names(), *stated}
        raise ConfigError(
            f'unknown optimizer "{name}"{did_you_mean(name, known)}; known: {", ".join(sorted(known))}'
        )
    return Entry(name, name, shipped_parameters(name))


@dataclass(frozen=True)
class _Stated:
    """One optimizer as a file states it."""

    optimizer: str
    label: str = ""
    parameters: dict[str, Any] = field(default_factory=dict)
    source: str = ""


def load_entries(path: Path) -> dict[str, Entry]:
    """Return the optimizers of a file by label.

    The file holds `optimizers:`, a list of mappings with `optimizer` and, if wanted, `label`, `parameters` and
    `source`; or just one such mapping, as the shipped files do.

    Raises:
        ConfigError: the file cannot be read, or says something unknown, or a label twice.
    """
    content = load_mapping(path)
    listed = content["optimizers"] if set(content) == {"optimizers"} else [content]
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{path}: optimizers: expected a list of optimizers with their parameters")
    entries: dict[str, Entry] = {}
    for number, item in enumerate(listed, 1):
        where = f"{path}: optimizers[{number}]" if "optimizers" in content else str(path)
        entry = _entry(item, where)
        if entry.label in entries:
            raise ConfigError(f'{where}: label "{entry.label}" is given twice')
        entries[entry.label] = entry
    return entries


def _entry(item: Any, where: str) -> Entry:
    if not isinstance(item, Mapping) or "optimizer" not in item:
        raise ConfigError(f'{where}: expected a mapping with the key "optimizer"')
    stated = build(_Stated, item, where)
    label = stated.label or stated.optimizer
    if "," in label or label == ALL:
        raise ConfigError(f'{where}: label "{label}": expected no comma, and not "{ALL}"')
    entry = Entry(label, stated.optimizer, {**shipped_parameters(stated.optimizer), **stated.parameters})
    OPTIMIZERS.build(entry.optimizer, entry.parameters, where)
    return entry


def limited(entry: Entry, budget: Budget) -> Entry:
    """Return an optimizer with the population, iterations and evaluations of a study.

    A setting that can have one value only, such as the population of a closed form, stays.

    Raises:
        ConfigError: a value that the optimizer does not permit.
    """
    limits = {f.name: f.metadata for f in dataclasses.fields(OPTIMIZERS.get(entry.optimizer))}
    stated = {"population": budget.population, "iterations": budget.iterations}
    stated = {k: v for k, v in stated.items() if v is not None and limits[k]["low"] != limits[k]["high"]}
    changed = dataclasses.replace(entry, parameters={**entry.parameters, **stated})
    if budget.evaluations is None:
        changed.build()
        return changed
    more = {}
    if "evaluations" in limits:
        more["evaluations"] = max(budget.evaluations, int(limits["evaluations"]["low"]))
    elif budget.iterations is None and limits["iterations"]["high"] != 1:
        more["iterations"] = max(1, -(-budget.evaluations // changed.build().population) - 1)
    changed = dataclasses.replace(changed, parameters={**changed.parameters, **more})
    changed.build()
    return changed
