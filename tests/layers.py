"""The layer rule, read off the source files of a package tree."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

PACKAGE = "accelcal_cli"

GROUPS = (
    ("errors", "notices", "arrays", "rng", "schema", "registry", "config", "pools"),
    ("optimization", "sensor"),
    ("io",),
    ("calibration",),
    ("detection", "planning", "verification", "exporters"),
    ("studies", "fleets"),
    ("navigation",),
    ("views",),
    ("output",),
    ("cli",),
)
"""From the lowest layer to the highest; a module may import from lower groups, and from its own unit.

`config` knows YAML text, mappings and shipped files alone. It is of the lowest group so that a sensor, settings and a
calibration load themselves."""

RANK = {unit: rank for rank, group in enumerate(GROUPS) for unit in group}

SIBLINGS = GROUPS[0]
"""Units that may import others of their own group, as long as no circle comes of it."""

INSIDE = {
    "calibration": (
        "settings",
        "provenance",
        "distributions",
        "sample",
        "observability",
        "consensus",
        "noise",
        "problem",
        "result",
        "search",
        "temperature",
        "residuals",
        "fit",
        "known_attitudes",
        "assess",
        "calibrate",
        "fleet",
        "apply",
    ),
    "verification": ("difference", "shift", "verify"),
}
"""The files of a package in which the flow has an order, the lowest first; each imports only those before it."""

ONLY_IN = {
    "typer": ("cli",),
    "click": ("cli",),
    "rich": ("output", "cli"),
    "yaml": ("config",),
}
"""Third-party packages and the units that may know them."""

HEAVY = ("scipy", "polars", "boule", "matplotlib", "dask", "jinja2", "serial")
"""Packages that are imported where they are used, never when a module is loaded."""

LATE = {"io/parquet.py": "accelcal_cli.io.parquet"}
"""Modules that are nothing without a heavy package: they may load it, and no one may load them early."""

DOORS = {
    "calibration/result.py": ("views", "output"),
    "calibration/fleet.py": ("views", "output"),
    "exporters/base.py": ("output",),
}
"""Records that print, draw and save themselves: the methods by which they do import what is above them when called."""

FRONT = ("__init__", "__main__")
"""The public API and the entry point: they may import any unit."""


@dataclass(frozen=True)
class Import:
    """One import of a module: where it stands, what it names, and when it runs."""

    unit: str
    file: str
    line: int
    target: str
    names: tuple[str, ...]
    at_load: bool

    def __str__(self) -> str:
        return f"{self.file}:{self.line}: {self.unit} imports {self.target}"


def unit_of(path: Path, root: Path) -> str:
    """The top-level unit of a file: a subpackage or a top-level module."""
    return path.relative_to(root).parts[0].removesuffix(".py")


def imports(root: Path) -> Iterator[Import]:
    """Every import below `root` that is not for type checkers alone."""
    for path in sorted(root.rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node, at_load in _walk(tree.body, True):
            for target, names in _targets(node, path, root):
                yield Import(
                    unit_of(path, root), str(path.relative_to(root)), node.lineno, target, names, at_load
                )


def _walk(body: list[ast.stmt], at_load: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    for node in body:
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node, at_load
        elif isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            yield from _walk(node.orelse, at_load)
        else:
            inside = at_load and not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            for name in ("body", "orelse", "finalbody"):
                yield from _walk(getattr(node, name, []), inside)
            for handler in (*getattr(node, "handlers", ()), *getattr(node, "cases", ())):
                yield from _walk(handler.body, inside)


def _targets(
    node: ast.Import | ast.ImportFrom, path: Path, root: Path
) -> Iterator[tuple[str, tuple[str, ...]]]:
    if isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name, ()
        return
    module = node.module or ""
    if node.level:
        here = (PACKAGE, *path.relative_to(root).parent.parts)
        module = ".".join((*here[: len(here) - node.level + 1], *filter(None, [module])))
    names = tuple(alias.name for alias in node.names)
    if module == PACKAGE:
        for name in names:
            yield f"{PACKAGE}.{name}", ()
    else:
        yield module, names


def violations(root: Path) -> list[str]:
    """Every import that breaks the layer rule, in words."""
    found = []
    edges: dict[str, set[str]] = {}
    for item in imports(root):
        top, _, rest = item.target.partition(".")
        if top == PACKAGE:
            target = rest.partition(".")[0]
            if target in ("__version__", ""):
                continue
            if not item.at_load and target in DOORS.get(item.file, ()):
                continue
            edges.setdefault(item.unit, set()).add(target)
            if not allowed(item.unit, target):
                found.append(f"{item}: not a lower layer")
        found += inside(item)
        named = {item.target, *(f"{item.target}.{name}" for name in item.names)}
        if item.at_load and item.file not in LATE and named & set(LATE.values()):
            found.append(f"{item}: loads a heavy package, to be imported where it is used")
        if top in ONLY_IN and item.unit not in ONLY_IN[top]:
            found.append(f"{item}: {top} belongs in {' and '.join(ONLY_IN[top])}")
        if top in HEAVY and item.at_load and item.file not in LATE:
            found.append(f"{item}: heavy, to be imported where it is used")
    return found + circles(edges)


def inside(item: Import) -> list[str]:
    """The breach of an order inside a package, if an import is one."""
    order = INSIDE.get(item.unit)
    _, _, rest = item.target.partition(f"{PACKAGE}.{item.unit}.")
    own = Path(item.file).stem
    if order is None or not rest or own == "__init__":
        return []
    if own not in order or rest not in order:
        return [f"{item}: {own if own not in order else rest} has no place in the order of {item.unit}"]
    return [] if order.index(rest) < order.index(own) else [f"{item}: not a file before it in {item.unit}"]


def allowed(unit: str, target: str) -> bool:
    """Whether a unit may import another."""
    if unit in FRONT or unit == target:
        return True
    if target not in RANK or unit not in RANK:
        return False
    if RANK[unit] == RANK[target]:
        return unit in SIBLINGS and target in SIBLINGS
    return RANK[target] < RANK[unit]


def circles(edges: dict[str, set[str]]) -> list[str]:
    """Units that import one another, directly or by way of others."""

    def below(unit: str, seen: set[str]) -> set[str]:
        for target in edges.get(unit, set()) - seen - {unit}:
            seen.add(target)
            below(target, seen)
        return seen

    return [f"{unit} imports itself in a circle" for unit in edges if unit in below(unit, set()) - {unit}] + [
        f"{unit} and {other} import one another"
        for unit in edges
        for other in edges[unit]
        if unit < other and unit in edges.get(other, set())
    ]


RANDOM = "uses numpy's global or unseeded random numbers"


def forbidden_calls(root: Path) -> list[str]:
    """Printing, exiting and global random numbers in the library (everything below output/ and cli/)."""
    found = []
    for path in sorted(root.rglob("*.py")):
        unit = unit_of(path, root)
        if unit == "cli" or unit in FRONT:
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            text = ast.unparse(node) if isinstance(node, ast.Call | ast.Raise | ast.Attribute) else ""
            fault = _fault(node, text)
            if fault == RANDOM and path.match("studies/peers.py"):
                continue  # it runs other libraries, some of which know no other stream
            if fault and not (unit == "output" and fault == "writes to a terminal"):
                found.append(f"{path.relative_to(root)}:{node.lineno}: {text} {fault}")
    return found


def _fault(node: ast.AST, text: str) -> str:
    if isinstance(node, ast.Call):
        name = ast.unparse(node.func)
        if name == "print":
            return "writes to a terminal"
        if name in ("exit", "quit", "sys.exit", "os._exit", "os.abort"):
            return "exits"
    if isinstance(node, ast.Raise) and text.startswith("raise SystemExit"):
        return "exits"
    if isinstance(node, ast.Attribute):
        if text in ("sys.stdout", "sys.stderr"):
            return "writes to a terminal"
        if text.startswith(("np.random.", "numpy.random.")) and node.attr.islower():
            return RANDOM
    return ""
