"""Names to classes, and strict building of frozen dataclasses from mappings.

A registry finds its classes by module name: `de-pso` lives in `<package>/de_pso.py`. Asking for one name
imports that one file only, so that a hundred algorithms cost nothing at start-up.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Callable, Mapping
from typing import Any, Generic, TypeVar

from accelcal_cli import schema
from accelcal_cli.errors import ConfigError, did_you_mean

T = TypeVar("T")


class Registry(Generic[T]):
    """Classes by name, each in a module of `package` named after it.

    Args:
        package: dotted name of the package that holds one module a class.
        kind: what the classes are, for messages ("optimizer").
    """

    def __init__(self, package: str, kind: str) -> None:
        """Start empty; modules are imported when a name is asked for."""
        self.package, self.kind = package, kind
        self._classes: dict[str, type[T]] = {}

    def register(self, name: str) -> Callable[[type[T]], type[T]]:
        """Return the class decorator that enters a class under `name`."""

        def enter(cls: type[T]) -> type[T]:
            self._classes[name] = cls
            cls.name = name  # type: ignore[attr-defined]
            return cls

        return enter

    def names(self) -> list[str]:
        """Return every name, sorted. Imports every module of the package."""
        path = importlib.import_module(self.package).__path__
        for module in pkgutil.iter_modules(path):
            importlib.import_module(f"{self.package}.{module.name}")
        return sorted(self._classes)

    def get(self, name: str) -> type[T]:
        """Return the class called `name`.

        Raises:
            ConfigError: no such name; the message gives the nearest one and lists all.
        """
        if name not in self._classes and name.replace("-", "").isalnum():
            module = f"{self.package}.{name.replace('-', '_')}"
            try:
                importlib.import_module(module)
            except ModuleNotFoundError as error:
                if error.name != module:
                    raise
        if name not in self._classes:
            known = self.names()
            raise ConfigError(
                f'unknown {self.kind} "{name}"{did_you_mean(name, known)}; known: {", ".join(known)}'
            )
        return self._classes[name]

    def build(self, name: str, mapping: Mapping[str, Any], where: str) -> T:
        """Build the class called `name` from `mapping`; see `build`."""
        return schema.from_mapping(self.get(name), mapping, where)
