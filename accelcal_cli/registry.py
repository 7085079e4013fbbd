"""Names to classes: one way to find optimizers, exporters, filters and log formats, ours and those of other packages.

A registry finds its own classes by module name: `de-pso` lives in `<package>/de_pso.py`. Asking for one name imports
that one file only, so that a hundred algorithms cost nothing at start-up. Another package adds a class of its own
through an entry point, which is looked up only when a name is not built in, or when all names are asked for:

    [project.entry-points."accelcal.optimizers"]
    grey-wolf = "my_package.grey_wolf:GreyWolf"
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import sys
from collections.abc import Callable
from functools import cache, cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from accelcal_cli.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

T = TypeVar("T")
C = TypeVar("C", bound=type)


class Registry(Generic[T]):
    """Classes by name.

    Args:
        base: the class that all of them derive from.
        package: dotted name of the package that holds the built-in ones, one a module, named after it.
        kind: what the classes are, for messages ("optimizer").
        group: entry points of other packages ("accelcal.optimizers"): the name on the left, the class on the right.

    Attributes:
        faults: installed classes that could not be loaded when `names` was last called: name to message.
    """

    def __init__(self, base: type, package: str, kind: str, group: str) -> None:
        """Start empty; modules are imported when a name is asked for."""
        self.base, self.package, self.kind, self.group = base, package, kind, group
        self.faults: dict[str, str] = {}
        self._classes: dict[str, type[T]] = {}

    def register(self, name: str) -> Callable[[C], C]:
        """Return the class decorator that enters a class under `name`, which becomes its attribute `name`."""

        def enter(cls: C) -> C:
            self._classes[name] = cls
            cls.name = name  # type: ignore[attr-defined]
            return cls

        return enter

    def names(self) -> list[str]:
        """Return the name of every class that can be used by name, sorted; those of `imported` cannot.

        Imports every module of the package and every installed class; one that fails is left out and its message
        put into `faults`, so that somebody else's broken package breaks nothing that does not use it.
        """
        for module in pkgutil.iter_modules(importlib.import_module(self.package).__path__):
            importlib.import_module(f"{self.package}.{module.name}")
        self.faults = {}
        for name in self._entry_points:
            try:
                self.find(name)
            except ConfigError as error:
                self.faults[name] = str(error)
        return sorted(name for name in self._classes if ":" not in name)

    def get(self, name: str) -> type[T]:
        """Return the class called `name`.

        Raises:
            ConfigError: no such name (the message gives the nearest one and lists all), or an installed class that
                cannot be loaded (the message names its package and its entry point).
        """
        cls = self.find(name)
        if cls is None:
            known = self.names()
            raise ConfigError(
                f'unknown {self.kind} "{name}"{did_you_mean(name, known)}; known: {", ".join(known)}'
            )
        return cls

    def find(self, name: str) -> type[T] | None:
        """Return the class called `name`: built in, or else installed; None when there is none.

        Raises:
            ConfigError: an installed class that cannot be loaded.
        """
        if name not in self._classes and name.replace("-", "").isalnum():
            module = f"{self.package}.{name.replace('-', '_')}"
            try:
                importlib.import_module(module)
            except ModuleNotFoundError as error:
                if error.name != module:
                    raise
        if name not in self._classes and name in self._entry_points:
            self.register(name)(self._load(self._entry_points[name]))
        return self._classes.get(name)

    def imported(self, place: str) -> type[T]:
        """Return the class at `package.module:Class`, entered under that name.

        This runs somebody's code: only what a user states on the command line may come here, nothing from a file. The
        current folder is looked in, too.

        Raises:
            ConfigError: it cannot be imported, or is no complete class of the kind.
        """
        if place in self._classes:
            return self._classes[place]
        found = import_place(place, self.kind)
        if not (inspect.isclass(found) and issubclass(found, self.base)) or inspect.isabstract(found):
            raise ConfigError(f"{self.kind} {place}: not a complete subclass of {self.base.__name__}")
        return self.register(place)(cast(type[T], found))

    def is_built_in(self, cls: type) -> bool:
        """Return whether a class is one of ours, and not of an installed package."""
        return cls.__module__.startswith(f"{self.package}.")

    def beside(self, name: str, suffix: str) -> Path | None:
        """Return the file `<name><suffix>` in the folder of the class's module; None when there is none."""
        cls = self.find(name)
        path = Path(inspect.getfile(cls)).with_name(f"{name}{suffix}") if cls else None
        return path if path and path.is_file() else None

    @cached_property
    def _entry_points(self) -> dict[str, EntryPoint]:
        """The entry points of the group; where two packages share a name, the first on the path has it."""
        if not is_mentioned(self.group):
            return {}
        from importlib.metadata import entry_points

        return {point.name: point for point in reversed(tuple(entry_points(group=self.group)))}

    def _load(self, point: EntryPoint) -> type[T]:
        """Return the class of an entry point, or raise ConfigError naming its package and the entry point."""
        package = f" {point.dist.name} {point.dist.version}" if point.dist else ""
        place = f'{self.kind} "{point.name}" of the installed package{package}, entry point {self.group}'
        try:
            cls = point.load()
        except (Exception, SystemExit) as error:  # whatever somebody else's module does when it is imported
            reason = " ".join(str(error).split())
            raise ConfigError(
                f"{place}: {point.value} cannot be loaded ({type(error).__name__}: {reason})"
            ) from None
        if not (inspect.isclass(cls) and issubclass(cls, self.base)) or inspect.isabstract(cls):
            raise ConfigError(f"{place}: {point.value} is not a complete subclass of {self.base.__name__}")
        return cast(type[T], cls)


def import_place(place: str, kind: str) -> object:
    """Return what stands at `package.module:name`, in the current folder or installed; see `Registry.imported`."""
    module, _, name = place.partition(":")
    if str(Path.cwd()) not in sys.path and "" not in sys.path:
        sys.path.insert(0, str(Path.cwd()))
    try:
        return getattr(importlib.import_module(module), name)
    except (Exception, SystemExit) as error:  # whatever somebody else's module does when it is imported
        reason = " ".join(str(error).split())
        raise ConfigError(f"{kind} {place}: cannot be imported ({type(error).__name__}: {reason})") from None


@cache
def is_mentioned(group: str) -> bool:
    """Return whether an installed package may have entry points of a group: `importlib.metadata` is slow to import."""
    for folder in map(Path, sys.path):
        if folder.is_file():  # an archive: what is in it, `importlib.metadata` finds out
            return True
        files = folder.glob("*-info/entry_points.txt")
        if any(f"[{group}]" in file.read_text("utf-8", errors="replace") for file in files):
            return True
    return False
