"""How a calculation flows through the files, and how big the house is: `python -m benchmarks.flow`.

Four commands run in processes of their own under `sys.setprofile`. A file is passed through when code of it runs,
bodies of classes included and bodies of modules not; two files form a pair when a function of one calls a function of
the other directly. `calibrate docs/sample.csv`, `detect` and `fleet` of simulated tables, `benchmark --func sphere`.
Then the way of one parameter through the code (see `walk`), and the size of the whole.

`--source DIR` measures another checkout, `--json` prints everything with the names of the files.

Figures of the first version, before its calculation was brought into one flow (15f80e4):

    calibrate      61 files   101 pairs   (62 and 102 in the issue, which counted one more at the start)
    detect         58 files    89 pairs
    fleet          56 files    69 pairs
    benchmark      59 files    64 pairs
    readings       25 files    97 stays   72 returns   (26, 93 and 67 in the issue, which followed it a little less far)
    the whole     214 files   14 529 statements   971 docstrings of public classes, functions and methods
"""

from __future__ import annotations

import argparse
import ast
import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from types import FrameType

PACKAGE = "accelcal_cli"
HERE = Path(__file__).resolve().parent.parent

LONG_BODY = 45
"""Lines of a function's body, its docstring not counted, above which it is listed."""

READERS = ("io/", "calibration/", "detection/")
"""What a benchmark of optimizers has no use for."""

ENTRIES = (
    ("calibration/calibrate.py", "_calibrated", "readings"),
    ("calibration/calibrate.py", "calibrate", "readings"),
    ("calibration/pipeline.py", "calibrate", "readings"),
)
"""Where the parameter that `walk` follows starts: the present place, then those of earlier versions."""


@dataclass(frozen=True)
class Flow:
    """What one command passes through: files, ordered pairs (caller, callee) of files, calls, imported modules."""

    files: list[str]
    pairs: list[tuple[str, str]]
    calls: int
    imported: list[str]

    @property
    def readers(self) -> list[str]:
        """The imported files of readers and calibrations."""
        return [
            name for name in self.imported if name.startswith(READERS) and not name.endswith("__init__.py")
        ]


def flows(source: Path = HERE) -> dict[str, Flow]:
    """Return the flow of each command, run on the checkout `source`."""
    with tempfile.TemporaryDirectory() as folder:
        log, table = str(Path(folder) / "log.csv"), str(Path(folder) / "fleet.csv")
        _accelcal(source, "simulate", "--raw", "--seed", "1", "-o", log)
        _accelcal(source, "simulate", "--sensors", "20", "--positions", "24", "--noise", "1e-3", "-o", table)
        commands = {
            "calibrate": ["calibrate", "docs/sample.csv"],
            "detect": ["detect", log],
            "fleet": ["fleet", table],
            "benchmark": ["benchmark", "--func", "sphere", "--runs", "2"],
        }
        return {name: flow(arguments, source) for name, arguments in commands.items()}


def flow(arguments: list[str], source: Path = HERE) -> Flow:
    """Return the flow of one command line, run in a process of its own in the folder `source`."""
    with tempfile.TemporaryDirectory() as folder:
        result = Path(folder) / "flow.json"
        command = [sys.executable, str(Path(__file__).resolve()), "--trace", str(result), *arguments]
        stderr = _run(command, source)
        if not result.exists():
            raise RuntimeError(f"{' '.join(arguments)}: {stderr}")
        values = json.loads(result.read_text())
    return Flow(values["files"], [(a, b) for a, b in values["pairs"]], values["calls"], values["imported"])


def _accelcal(source: Path, *arguments: str) -> None:
    _run([sys.executable, "-m", PACKAGE, *arguments, "--quiet"], source)


def _run(command: list[str], source: Path) -> str:
    environment = os.environ | {"PYTHONPATH": str(source)}
    done = subprocess.run(command, cwd=source, env=environment, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(f"{' '.join(command)}: {done.stderr}")
    return done.stderr


def _trace(result: Path, arguments: list[str]) -> None:
    """Run a command line in this process under a profile function, and write its flow to `result`."""
    home = str(Path.cwd() / PACKAGE) + os.sep
    files: set[str] = set()
    pairs: set[tuple[str, str]] = set()
    calls = 0

    def profile(frame: FrameType, event: str, _: object) -> None:
        nonlocal calls
        code = frame.f_code
        if event != "call" or code.co_name == "<module>" or not code.co_filename.startswith(home):
            return
        calls += 1
        name = code.co_filename[len(home) :]
        files.add(name)
        caller = frame.f_back.f_code if frame.f_back else None
        if (
            caller is not None
            and caller.co_name != "<module>"
            and caller.co_filename.startswith(home)
            and caller.co_filename != code.co_filename
        ):
            pairs.add((caller.co_filename[len(home) :], name))

    sys.path.insert(0, str(Path.cwd()))
    sys.argv = [PACKAGE, *arguments]
    code: object = 0
    sys.setprofile(profile)
    threading.setprofile(profile)
    try:
        from accelcal_cli.__main__ import main as run

        run()
    except SystemExit as leave:
        code = leave.code
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    paths = [getattr(module, "__file__", None) or "" for module in list(sys.modules.values())]
    imported = sorted({path[len(home) :] for path in paths if path.startswith(home)})
    values = {"files": sorted(files), "pairs": sorted(pairs), "calls": calls, "imported": imported}
    result.write_text(json.dumps(values))
    sys.exit(code)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Way:
    """The files that a parameter is handed to: (caller, callee, function) of each stay, in the order of the calls."""

    calls: list[tuple[str, str, str]]

    @property
    def stays(self) -> list[str]:
        """The file of each stay."""
        return [file for _, file, _ in self.calls]

    @property
    def files(self) -> int:
        """How many different files it visits."""
        return len(set(self.stays))

    @property
    def returns(self) -> int:
        """How often it comes to a file where it was before."""
        return len(self.stays) - self.files


def walk(source: Path = HERE) -> Way:
    """Return the way of the readings from the function that calibrates one sensor on, read from the code alone.

    The parameter is followed in the order of the lines, all branches one after the other, into every function of the
    package that it is handed to, or called on; so is everything made of it: a name assigned from an expression in
    which it stands, the result of such a function, an object built from it. numpy and the standard library lose it,
    and so does a comparison. Each call from one file into another is a stay there; a function is looked into once.
    Methods of the parameter's own class are itself, not a stay, and constructors (`@classmethod`) none.
    """
    names = Names({name: ast.parse(text) for name, text in _texts(source).items()})
    for file, function, parameter in ENTRIES:
        if function in names.defined.get(file, {}):
            start = names.defined[file][function]
            owner = names.annotated(file, _annotations(start)[parameter])
            walker = Walker(names, owner)
            walker.enter(start, {parameter}, "")
            return Way(walker.calls)
    raise LookupError(f"none of {', '.join(file for file, _, _ in ENTRIES)} in {source}")


@dataclass(frozen=True)
class Definition:
    """A function or class of the package: its file, the class it is a method of (or nothing), its syntax tree."""

    file: str
    home: str
    node: ast.FunctionDef | ast.ClassDef

    @property
    def is_class(self) -> bool:
        """Whether calling it builds an object."""
        return isinstance(self.node, ast.ClassDef)

    def decorated(self, name: str) -> bool:
        """Whether a decorator of this plain name stands above it."""
        return any(isinstance(mark, ast.Name) and mark.id == name for mark in self.node.decorator_list)


class Names:
    """What the names of every file of the package stand for."""

    def __init__(self, trees: Mapping[str, ast.Module]) -> None:
        """Take in the trees of the files, by path in the package."""
        self.defined: dict[str, dict[str, Definition]] = {}
        self.imported: dict[str, dict[str, tuple[str, str]]] = {}
        for file, tree in trees.items():
            nodes = [node for node in tree.body if isinstance(node, ast.FunctionDef | ast.ClassDef)]
            self.defined[file] = {node.name: Definition(file, "", node) for node in nodes}
            self.imported[file] = {
                alias.asname or alias.name: ("/".join((node.module or "").split(".")[1:]), alias.name)
                for node in ast.walk(tree)
                if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == PACKAGE
                for alias in node.names
            }

    def find(self, file: str, name: str) -> Definition | None:
        """Return the function or class that a name of a file stands for."""
        if name in self.defined.get(file, {}):
            return self.defined[file][name]
        folder, original = self.imported.get(file, {}).get(name, ("", ""))
        return self.find(f"{folder}.py", original) if f"{folder}.py" in self.defined else None

    def attribute(self, file: str, module: str, name: str) -> Definition | None:
        """Return the function or class `name` of an imported module."""
        folder, original = self.imported.get(file, {}).get(module, ("", ""))
        return self.find(f"{folder}/{original}.py".lstrip("/"), name) if original else None

    def method(self, owner: Definition, name: str) -> Definition | None:
        """Return a method of a class, its own or inherited."""
        for node in owner.node.body:
            if isinstance(node, ast.FunctionDef) and node.name == name:
                return Definition(owner.file, owner.node.name, node)
        for base in owner.node.bases if isinstance(owner.node, ast.ClassDef) else []:
            parent = self.annotated(owner.file, base)
            if parent and (method := self.method(parent, name)):
                return method
        return None

    def member(self, owner: Definition, name: str) -> Definition | None:
        """Return the class of what stands in a field or property of an object of class `owner`."""
        for node in owner.node.body:
            if (
                isinstance(node, ast.AnnAssign)
                and isinstance(node.target, ast.Name)
                and node.target.id == name
            ):
                return self.annotated(owner.file, node.annotation)
        method = self.method(owner, name)
        return self.result(method) if method else None

    def result(self, function: Definition) -> Definition | None:
        """Return the class of what a call returns."""
        if isinstance(function.node, ast.ClassDef):
            return function
        return self.annotated(function.file, function.node.returns)

    def annotated(self, file: str, note: ast.expr | None) -> Definition | None:
        """Return the class that an annotation names, the first of a union."""
        if isinstance(note, ast.BinOp):
            return self.annotated(file, note.left) or self.annotated(file, note.right)
        found = self.find(file, note.id) if isinstance(note, ast.Name) else None
        return found if found and found.is_class else None


class Walker:
    """Goes the way of a parameter and notes every call that takes it to another file."""

    def __init__(self, names: Names, owner: Definition | None) -> None:
        """Start with no visits; `owner` is the class of the parameter."""
        self.names = names
        self.owner = owner
        self.calls: list[tuple[str, str, str]] = []
        self._known: set[tuple[str, str, str]] = set()

    def enter(self, function: Definition, carriers: set[str], caller: str) -> None:
        """Go into a function whose parameters `carriers` carry it, called from the file `caller`."""
        if function.file != caller:
            self.calls.append((caller, function.file, function.node.name))
        key = (function.file, function.home, function.node.name)
        if key not in self._known:
            self._known.add(key)
            Body(self, function, carriers).statements(function.node.body)


class Body:
    """The way through one function: the names that carry the parameter, and the classes of names."""

    def __init__(self, walker: Walker, function: Definition, carriers: set[str]) -> None:
        """Begin at the first statement."""
        self.walker, self.names, self.file = walker, walker.names, function.file
        self.carriers = set(carriers)
        notes = _annotations(function)
        found = {name: self.names.annotated(self.file, note) for name, note in notes.items()}
        self.classes = {name: owner for name, owner in found.items() if owner}
        if function.home:
            self.classes["self"] = self.names.defined[self.file][function.home]

    def statements(self, nodes: Iterable[ast.AST]) -> None:
        """Go through statements one after the other."""
        for node in nodes:
            if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
                targets = node.targets if isinstance(node, ast.Assign) else [node.target]
                carries = node.value is not None and self.carries(node.value)
                for target in targets:
                    self.bind(target, carries, node.value)
            elif isinstance(node, ast.For):
                self.bind(node.target, self.carries(node.iter), None)
                self.statements([*node.body, *node.orelse])
            elif isinstance(node, ast.withitem):
                carries = self.carries(node.context_expr)
                if node.optional_vars:
                    self.bind(node.optional_vars, carries, node.context_expr)
            elif isinstance(node, ast.expr):
                self.carries(node)
            else:
                self.statements(ast.iter_child_nodes(node))

    def bind(self, target: ast.expr, carries: bool, value: ast.expr | None) -> None:
        """Assign to a name, or to several, what carries the parameter or does not."""
        if isinstance(target, ast.Tuple | ast.List):
            values = value.elts if isinstance(value, ast.Tuple) else [None] * len(target.elts)
            for part, each in zip(target.elts, values, strict=False):
                self.bind(part, self.holds(each) if each is not None else carries, each)
            self._unpack(target, value)
        elif isinstance(target, ast.Starred):
            self.bind(target.value, carries, None)
        elif isinstance(target, ast.Name):
            (self.carriers.add if carries else self.carriers.discard)(target.id)
            owner = self.owner(value) if value is not None else None
            self.classes.pop(target.id, None)
            if owner:
                self.classes[target.id] = owner
        elif carries and isinstance(target, ast.Attribute):
            self.carriers.add(ast.unparse(target))

    def _unpack(self, target: ast.Tuple | ast.List, value: ast.expr | None) -> None:
        """Give the names of `a, b = f()` the classes of the tuple that `f` is annotated to return."""
        function = self.callee(value.func) if isinstance(value, ast.Call) else None
        note = function.node.returns if function and isinstance(function.node, ast.FunctionDef) else None
        if function and isinstance(note, ast.Subscript) and isinstance(note.slice, ast.Tuple):
            for part, each in zip(target.elts, note.slice.elts, strict=False):
                if isinstance(part, ast.Name) and (owner := self.names.annotated(function.file, each)):
                    self.classes[part.id] = owner

    def holds(self, node: ast.expr) -> bool:
        """Whether a name that carries the parameter stands in an expression; goes nowhere."""
        return any(isinstance(part, ast.Name) and part.id in self.carriers for part in ast.walk(node))

    def owner(self, node: ast.expr) -> Definition | None:
        """Return the class of the value of an expression."""
        if isinstance(node, ast.Name):
            return self.classes.get(node.id)
        if isinstance(node, ast.Attribute):
            owner = self.owner(node.value)
            return self.names.member(owner, node.attr) if owner else None
        if isinstance(node, ast.IfExp):
            return self.owner(node.body) or self.owner(node.orelse)
        if isinstance(node, ast.Call):
            if isinstance(node.func, ast.Name) and node.func.id == "replace":
                return self.owner(node.args[0])
            function = self.callee(node.func)
            return self.names.result(function) if function else None
        return None

    def callee(self, node: ast.expr) -> Definition | None:
        """Return the function, method or class of the package that an expression names."""
        if isinstance(node, ast.Name):
            return self.names.find(self.file, node.id)
        if not isinstance(node, ast.Attribute):
            return None
        owner = self.owner(node.value)
        if owner is None and isinstance(node.value, ast.Name):
            if function := self.names.attribute(self.file, node.value.id, node.attr):
                return function
            named = self.names.find(self.file, node.value.id)
            owner = named if named and named.is_class else None
        return self.names.method(owner, node.attr) if owner else None

    def carries(self, node: ast.expr) -> bool:
        """Go through an expression as it is evaluated; return whether its value is made of the parameter."""
        if isinstance(node, ast.Name):
            return node.id in self.carriers
        if isinstance(node, ast.Attribute):
            return self.carries(node.value) or ast.unparse(node) in self.carriers
        if isinstance(node, ast.Call):
            return self.call(node)
        if isinstance(node, ast.ListComp | ast.SetComp | ast.GeneratorExp | ast.DictComp):
            for loop in node.generators:
                self.bind(loop.target, self.carries(loop.iter), None)
                self.statements(loop.ifs)
            results = [node.key, node.value] if isinstance(node, ast.DictComp) else [node.elt]
            parts = [self.carries(result) for result in results]  # all of them: each is gone through
            return any(parts)
        parts = [self.carries(part) for part in ast.iter_child_nodes(node) if isinstance(part, ast.expr)]
        if isinstance(node, ast.NamedExpr):
            self.bind(node.target, parts[-1], node.value)
        if isinstance(node, ast.Subscript):
            return parts[0]
        return any(parts) and not isinstance(node, ast.Compare | ast.Lambda)

    def call(self, node: ast.Call) -> bool:
        """Go into a function that is called with the parameter; return whether the result is made of it."""
        receiver = self.carries(node.func.value) if isinstance(node.func, ast.Attribute) else False
        arguments = [self.carries(argument) for argument in node.args]
        keywords = {keyword.arg: self.carries(keyword.value) for keyword in node.keywords}
        given = any(arguments) or any(keywords.values())
        function = self.callee(node.func)
        if function is None:
            return given and isinstance(node.func, ast.Name) and node.func.id == "replace"
        if function.is_class:
            method = self.names.method(function, "__init__")
            receiver = False
        else:
            method = function
            own = self.walker.owner
            if own and (function.file, function.home) == (own.file, own.node.name):
                return receiver or given
            if function.decorated("classmethod"):
                return given
        if method and (given or receiver):
            self.walker.enter(method, _carriers(method, receiver, arguments, keywords), self.file)
        return given or receiver


def _carriers(
    function: Definition, receiver: bool, arguments: list[bool], keywords: Mapping[str | None, bool]
) -> set[str]:
    """Return the parameters of a function that arguments which carry something go to."""
    names = list(_annotations(function))
    if function.home and not function.decorated("staticmethod"):
        arguments = [receiver, *arguments]
    positional = {name for name, carries in zip(names, arguments, strict=False) if carries}
    return positional | {name for name, carries in keywords.items() if carries and name}


def _annotations(function: Definition) -> dict[str, ast.expr | None]:
    """Return the annotation of each parameter, in order."""
    if isinstance(function.node, ast.ClassDef):
        return {}
    arguments = function.node.args
    every = [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs]
    return {argument.arg: argument.annotation for argument in every}


@dataclass(frozen=True)
class Size:
    """How big the package is: files, statements, public docstrings; files by length; functions with a long body."""

    files: int
    statements: int
    docstrings: int
    lines: int
    longest: list[tuple[str, int]]
    bodies: list[tuple[str, int]]


def size(source: Path = HERE) -> Size:
    """Measure every file: statements are `ast.stmt` nodes; a body counts from below the docstring to its last line."""
    texts = _texts(source)
    trees = {name: ast.parse(text) for name, text in texts.items()}
    lengths = sorted(((name, text.count("\n")) for name, text in texts.items()), key=lambda pair: -pair[1])
    bodies = [
        (f"{name}:{node.lineno} {node.name}", length)
        for name, tree in trees.items()
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef) and not name.startswith("cli/")
        if (length := _body_lines(node)) > LONG_BODY
    ]
    return Size(
        files=len(texts),
        statements=sum(isinstance(node, ast.stmt) for tree in trees.values() for node in ast.walk(tree)),
        docstrings=sum(_docstrings(tree) for tree in trees.values()),
        lines=sum(length for _, length in lengths),
        longest=lengths[:10],
        bodies=sorted(bodies, key=lambda pair: -pair[1]),
    )


def _body_lines(node: ast.FunctionDef) -> int:
    body = node.body[1:] if ast.get_docstring(node) is not None else node.body
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def _docstrings(node: ast.Module | ast.ClassDef | ast.FunctionDef) -> int:
    """Count the docstrings of the public classes, functions and methods in a module; its own is not one of them."""
    count = int(ast.get_docstring(node) is not None and not isinstance(node, ast.Module))
    if isinstance(node, ast.FunctionDef):
        return count
    inner = [part for part in node.body if isinstance(part, ast.ClassDef | ast.FunctionDef)]
    return count + sum(
        _docstrings(part) for part in inner if not part.name.startswith("_") or part.name == "__init__"
    )


def _texts(source: Path) -> dict[str, str]:
    home = source / PACKAGE
    return {path.relative_to(home).as_posix(): path.read_text() for path in sorted(home.rglob("*.py"))}


def main() -> None:
    """Print what was measured."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.flow", description=__doc__.splitlines()[0])
    parser.add_argument(
        "--source", type=Path, default=HERE, help="the checkout to measure (default: this one)"
    )
    parser.add_argument("--json", action="store_true", help="print everything, with the names of the files")
    options = parser.parse_args()
    source = options.source.resolve()
    commands, way, whole = flows(source), walk(source), size(source)
    if options.json:
        record = {name: asdict(each) | {"readers": each.readers} for name, each in commands.items()}
        print(json.dumps({"commands": record, "readings": asdict(way), "size": asdict(whole)}, indent=1))
        return
    for name, each in commands.items():
        tail = f"{len(each.readers)} of {len(each.imported)} imported modules read or calibrate"
        print(f"{name:10} {len(each.files):4} files {len(each.pairs):4} pairs {each.calls:7} calls   {tail}")
    print(
        f"{'readings':10} {way.files:4} files {len(way.stays):4} stays {way.returns:4} returns to where it was"
    )
    print(
        f"{'the whole':10} {whole.files:4} files {whole.lines} lines {whole.statements} statements"
        f" {whole.docstrings} public docstrings"
    )
    print(f"{'longest':10}", ", ".join(f"{name} {lines}" for name, lines in whole.longest[:5]))
    print(f"{'bodies':10} {len(whole.bodies)} above {LONG_BODY} lines outside cli/", end="")
    print("".join(f"\n{'':10} {name} {lines}" for name, lines in whole.bodies))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--trace"]:
        _trace(Path(sys.argv[2]), sys.argv[3:])
    else:
        main()
