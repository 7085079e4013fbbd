"""YAML text to mappings and back, and the files that are shipped: the only place that reads or writes YAML.

The parser is imported when there is YAML to read: most runs are without, and it takes as long as half of numpy.

What a mapping means, a calibration or a sensor, is known where that is defined.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

from accelcal_cli.errors import ConfigError

if TYPE_CHECKING:
    import yaml

CONFIGS = Path(__file__).parent / "configs"
"""The shipped configurations, inside the installed package."""

DEEPEST, MOST_VALUES = 50, 1_000_000
"""Levels, and values with all aliases written out, of a YAML file at most: a result of 1000 poses has some 20,000."""

if not CONFIGS.is_dir():  # a checkout keeps them beside the package
    CONFIGS = Path(__file__).parent.parent / "configs"


@cache
def _loader() -> Any:
    """Return a safe loader that refuses a key given twice, which YAML would silently keep the last of, and bombs.

    An alias stands for what it names, which may be an alias again: a page of them becomes gigabytes when it is written
    or compared. Aliases and depth are bounded before anything is built.
    """
    import yaml

    class BoundedUniqueKeys(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
        def get_single_node(self) -> yaml.Node | None:
            node: yaml.Node | None = super().get_single_node()
            if node is not None:
                _weigh(node, {}, 0)
            return node

        def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
            seen = set()
            for key_node, _ in node.value:
                key = self.construct_object(key_node, deep=True)
                if not isinstance(key, str) or key in seen:
                    twice = f'key "{key}" is given twice'
                    fault = twice if isinstance(key, str) else f"key {key!r} is not text"
                    raise yaml.constructor.ConstructorError(None, None, fault, key_node.start_mark)
                seen.add(key)
            mapping: dict[Any, Any] = super().construct_mapping(node, deep)
            return mapping

    return BoundedUniqueKeys


def _weigh(node: yaml.Node, known: dict[int, int], depth: int) -> int:
    """Return how many values a node stands for with its aliases written out; too many, or too deep, is an error."""
    if id(node) in known:
        return known[id(node)]
    if depth > DEEPEST:
        raise _too_much(f"nested more than {DEEPEST} deep", node)
    known[id(node)] = MOST_VALUES  # an alias of itself
    entries = node.value if isinstance(node.value, list) else []  # of a mapping these are pairs
    children = [part for entry in entries for part in (entry if isinstance(entry, tuple) else (entry,))]
    weight = 1 + sum(_weigh(child, known, depth + 1) for child in children)
    if weight > MOST_VALUES:
        raise _too_much(f"its aliases stand for more than {MOST_VALUES:,} values", node)
    known[id(node)] = weight
    return weight


def _too_much(fault: str, node: yaml.Node) -> Exception:
    from yaml.constructor import ConstructorError

    return ConstructorError(None, None, fault, node.start_mark)


def load_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML or JSON file.

    Raises:
        ConfigError: unreadable, not UTF-8, not YAML (line and column named), a key twice, or not a mapping.
    """
    return parse_mapping(read_text(path), str(path))


def read_text(path: Path, stdin: BinaryIO | None = None) -> str:
    """Return the text of a file, or that of `stdin` where it is given.

    Raises:
        ConfigError: unreadable, or not UTF-8.
    """
    try:
        return (path.read_bytes() if stdin is None else stdin.read()).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{path}: {reason.lower()}") from None


def parse_mapping(text: str, where: str) -> dict[str, Any]:
    """Return the mapping in YAML or JSON text.

    Raises:
        ConfigError: not YAML (line and column named, behind `where`), a key twice, or not a mapping.
    """
    if text.lstrip().startswith("{"):  # YAML 1.1 would take JSON's 1e-05 for text
        with contextlib.suppress(ValueError):  # YAML in flow style, or a fault that the YAML parser can place
            mapping: dict[str, Any] = json.loads(text, object_pairs_hook=_unique)
            return mapping
    import yaml

    try:
        content = yaml.load(text, Loader=_loader())
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(f"{where}{place}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ConfigError(f"{where}: not YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(content, Mapping):
        raise ConfigError(f"{where}: expected keys and values (a YAML mapping)")
    return dict(content)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the mapping of pairs; ValueError when a key is given twice."""
    mapping = dict(pairs)
    if len(mapping) < len(pairs):
        raise ValueError("a key is given twice")
    return mapping


def dump(record: Mapping[str, Any]) -> str:
    """Return a record as YAML text that reads back to the same record."""
    import yaml

    text: str = yaml.dump(
        record,
        Dumper=getattr(yaml, "CSafeDumper", yaml.SafeDumper),
        sort_keys=False,
        default_flow_style=None,
        allow_unicode=True,
        width=110,
    )
    return text


def shipped(kind: str) -> dict[str, Path]:
    """Return the shipped files of a kind ("optimizers", "sensors", "studies") by name."""
    return {path.stem: path for path in sorted((CONFIGS / kind).glob("*.yaml"))}
