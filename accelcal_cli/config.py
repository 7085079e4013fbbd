"""YAML files to frozen dataclasses: the only place that reads or writes YAML."""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import yaml

from accelcal_cli.calibration.result import Calibration
from accelcal_cli.calibration.settings import Settings
from accelcal_cli.errors import ConfigError, did_you_mean
from accelcal_cli.optimization.optimizer import OPTIMIZERS
from accelcal_cli.schema import build

if TYPE_CHECKING:
    from accelcal_cli.sensor.simulation import Sensor

CONFIGS = Path(__file__).parent / "configs"
"""The shipped configurations, inside the installed package."""

if not CONFIGS.is_dir():  # a checkout keeps them beside the package
    CONFIGS = Path(__file__).parent.parent / "configs"


class _UniqueKeys(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """A safe loader that refuses a key given twice: YAML itself would silently keep the last."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key!r} is not text", key_node.start_mark
                )
            if key in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f'key "{key}" is given twice', key_node.start_mark
                )
            seen.add(key)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def load_mapping(path: Path) -> dict[str, Any]:
    """Return the mapping in a YAML (or JSON) file.

    Raises:
        ConfigError: unreadable, not UTF-8, not YAML (line and column named), a key twice, or not a mapping.
    """
    return _mapping(_text(path), str(path))


def _mapping(text: str, path: str) -> dict[str, Any]:
    """Return the mapping in YAML text of a file."""
    try:
        content = yaml.load(text, Loader=_UniqueKeys)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        place = f", line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(f"{path}{place}: {error.problem or 'not YAML'}") from None
    except (yaml.YAMLError, RecursionError, ValueError) as error:
        raise ConfigError(f"{path}: not YAML: {str(error).splitlines()[0]}") from None
    if not isinstance(content, Mapping):
        raise ConfigError(f"{path}: expected keys and values (a YAML mapping)")
    return dict(content)


def _text(path: Path, stdin: BinaryIO | None = None) -> str:
    try:
        return (path.read_bytes() if stdin is None else stdin.read()).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 text (byte {error.start})") from None
    except (OSError, ValueError) as error:  # ValueError: a NUL in the name
        reason = getattr(error, "strerror", None) or str(error)
        raise ConfigError(f"{path}: {reason.lower()}") from None


def load_result(path: str | Path, stdin: BinaryIO | None = None) -> Calibration:
    """Return the calibration of a result file, JSON or YAML whatever its name says; of `stdin` where it is given.

    Raises:
        ConfigError: unreadable, or neither JSON nor YAML.
        DataError: not the record of a calibration; the message names the key.
    """
    text = _text(Path(path), stdin)
    record = None
    if text.lstrip().startswith("{"):  # YAML 1.1 would take JSON's 1e-05 for text
        with contextlib.suppress(ValueError):  # flow style YAML, or a fault that the YAML parser can place
            record = json.loads(text)
    if record is None:
        try:
            record = _mapping(text, str(path))
        except ConfigError as error:
            raise ConfigError(f"{error}; the result file of a calibration was expected") from None
    return Calibration.from_record(record, str(path))


RECORD_HEAD = re.compile(rb"(?:\xef\xbb\xbf)?(?:\s|#[^\n]*\n|---\s)*(?:\{|['\"]?(?:K_a|D_a|schema)['\"]?:)")
"""How the record of a calibration begins, as JSON or YAML in our order of keys or sorted; no table of readings does."""


def is_result(head: bytes) -> bool:
    """Return whether a file that begins so is a result file rather than readings."""
    return RECORD_HEAD.match(head) is not None


def dump(record: Mapping[str, Any]) -> str:
    """Return a record as YAML text that reads back to the same record."""
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


def load_settings(path: Path | None, overrides: Mapping[str, Any]) -> Settings:
    """Return the settings of a calibration: shipped defaults, then a file, then the command line.

    Args:
        path: the file of `--config`, or None.
        overrides: what the command line states; `parameters` holds settings of the optimizer.

    Raises:
        ConfigError: the file cannot be read or says something that is not known.
    """
    where = str(path) if path else "command line"
    stated = load_mapping(path) if path else {}
    stated.pop("source", None)  # documentation: the paper the numbers come from
    merged = {**stated, **overrides}
    name = merged.get("optimizer", Settings.optimizer)
    own = stated.get("parameters") or {}
    if not isinstance(own, Mapping):
        raise ConfigError(f"{where}: parameters: expected a mapping of keys, not {own!r}")
    if stated.get("optimizer", name) != name:
        own = {}  # the file's parameters belong to the optimizer that the command line replaced
    parameters = {**shipped_parameters(name), **own, **overrides.get("parameters", {})}
    settings = build(Settings, {**merged, "parameters": parameters}, where)
    settings.build_optimizer()
    return settings


def optimizer_file(name: str) -> Path | None:
    """Return the YAML file of an optimizer, None where there is none.

    That is `configs/optimizers/<name>.yaml`, or `<name>.yaml` beside the module of an installed optimizer.
    """
    return shipped("optimizers").get(name) or OPTIMIZERS.beside(name, ".yaml")


def shipped_parameters(optimizer: Any) -> dict[str, Any]:
    """Return the settings that the file of an optimizer states; none for an unknown one."""
    path = optimizer_file(optimizer) if isinstance(optimizer, str) else None
    parameters: dict[str, Any] = (load_mapping(path).get("parameters") or {}) if path else {}
    return parameters


def load_sensor(name: str) -> Sensor:
    """Return a sensor by the name of a shipped configuration or by the path of a file.

    Raises:
        ConfigError: neither such a configuration nor such a file, or one that says something unknown.
    """
    from accelcal_cli.sensor.simulation import Sensor

    files = shipped("sensors")
    path = files.get(name, Path(name))
    if name not in files and not path.suffix:
        raise ConfigError(
            f'unknown sensor "{name}"{did_you_mean(name, files)}; known: {", ".join(files)}, or the path of a '
            "YAML file"
        )
    return build(Sensor, load_mapping(path), str(path))
