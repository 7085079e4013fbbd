"""Do the tests notice a wrong optimizer? `python tests/mutants.py [COUNT] [--seed N]`: named and random mutants.

A mutant is a copy of the package with one expression of one algorithm changed: an operator, a comparison, a constant, a
function of numpy, a statement left out. The tests of equations run first, then the other tests of optimizers and
the contract of that optimizer. Mutants that survive are printed; CONTRIBUTING.md says which have to be looked at.
"""

from __future__ import annotations

import argparse
import ast
import copy
import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDER = "accelcal_cli/optimization/algorithms"
FILES = (
    "ade", "akpso", "de", "de_pso", "ellipsoid", "foa", "full_foa", "ifoa", "kpso", "levenberg_marquardt", "newton",
    "pso", "shade_cma",
)  # fmt: skip
TIMEOUT = 240

NAMED = {
    "DE-PSO's swarm led by its own best": (
        "de_pso",
        "state.memory[:, :half], state.leader)",
        "state.memory[:, :half], best_of(state.memory[:, :half], state.memory_cost[:, :half]))",
    ),
    "AKPSO's four-state covariance reduced to two": ("akpso", "[: self.kalman_dim]", "[:2]"),
    "AKPSO's eq. 18 dropped": ("akpso", 'P = P - np.einsum("riapd,rajpd->rijpd", gain, HP)', "P = P + 0.0"),
    "AKPSO's velocity innovation ignored": ("akpso", ", zv - expected[1]", ", 0.0 * zv"),
    "KPSO's velocity gain 0": (
        "kpso",
        "rate = state.rate + gain[:, 1, None, None] * innovation",
        "rate = state.rate",
    ),
    "KPSO's U(0, 1) for U(0, 2)": ("kpso", "pull = 2.0 * rng", "pull = 1.0 * rng"),
    "SHADE's archive unused": (
        "shade_cma",
        "population + state.archived[:, None]",
        "population + 0 * state.archived[:, None]",
    ),
    "CMA's rank-one update dropped": ("shade_cma", "k.c_1 * rank_one", "0.0 * rank_one"),
    "ADE's F not adapted": ("ade", "* _distance(fx, fx)", "* 0.5"),
    "IFOA's radius never shrinks": ("ifoa", "** self.exponent(state)", "** (0.0 * self.exponent(state))"),
    "FOA judged at the fly": (
        "foa",
        "np.clip(1.0 / np.maximum(_distance(flies), 1e-12)",
        "np.clip(_distance(flies)",
    ),
    "Newton's step halved": ("newton", "np.clip(state.x - step,", "np.clip(state.x - 0.5 * step,"),
}
"""Mutants by what they break: file, text, and what takes its place."""

SWAPS: dict[type, type] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult, ast.Lt: ast.GtE,
    ast.LtE: ast.Gt, ast.Gt: ast.LtE, ast.GtE: ast.Lt, ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.And: ast.Or,
    ast.Or: ast.And, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
NAMES = {
    "minimum": "maximum", "maximum": "minimum", "argmin": "argmax", "min": "max", "max": "min", "floor": "ceil",
    "sum": "mean", "mean": "sum", "cos": "sin", "any": "all", "all": "any", "zeros": "ones", "cumsum": "cumprod",
}  # fmt: skip


@dataclass
class Mutant:
    """A changed file: its name, where and what was changed, and its text."""

    file: str
    line: int
    change: str
    text: str


def functions(tree: ast.Module) -> Iterator[ast.AST]:
    """Yield every node in the functions of a module, docstrings and annotations left out."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            for statement in node.body:
                if not (isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)):
                    yield from ast.walk(statement)


def changed(node: ast.AST) -> bool:
    """Change a node in place; False when nothing of it can be changed."""
    if isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in SWAPS:
        node.op = SWAPS[type(node.op)]()
    elif isinstance(node, ast.Compare) and type(node.ops[0]) in SWAPS:
        node.ops[0] = SWAPS[type(node.ops[0])]()
    elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        node.op = ast.UAdd()
    elif isinstance(node, ast.Constant) and type(node.value) in (int, float):
        node.value = node.value + 1 if isinstance(node.value, int) else 1.5 * node.value + 0.1
    elif isinstance(node, ast.Attribute) and node.attr in NAMES:
        node.attr = NAMES[node.attr]
    elif isinstance(node, ast.Call) and ast.unparse(node.func) == "np.where" and len(node.args) == 3:
        node.args[1], node.args[2] = node.args[2], node.args[1]
    elif isinstance(node, ast.Expr) and isinstance(node.value, ast.Call):
        node.value = ast.Constant(None)
    else:
        return False
    return True


def random_mutants(count: int, seed: int) -> list[Mutant]:
    """Return so many different mutants, spread over all that can be changed."""
    places = []
    for file in FILES:
        tree = ast.parse((ROOT / FOLDER / f"{file}.py").read_text("utf-8"))
        nodes = list(functions(tree))
        places += [(file, number) for number, node in enumerate(nodes) if changed(copy.deepcopy(node))]
    chosen = random.Random(seed).sample(sorted(set(places)), min(count, len(set(places))))
    mutants = []
    for file, number in chosen:
        tree = ast.parse((ROOT / FOLDER / f"{file}.py").read_text("utf-8"))
        node = list(functions(tree))[number]
        before = ast.unparse(node)
        changed(node)
        mutants.append(Mutant(file, node.lineno, f"{before}  ->  {ast.unparse(node)}", ast.unparse(tree)))
    return mutants


def named_mutants() -> list[Mutant]:
    """Return the named ones; a text that no longer stands in its file exactly once is an error."""
    mutants = []
    for name, (file, old, new) in NAMED.items():
        text = (ROOT / FOLDER / f"{file}.py").read_text("utf-8")
        if text.count(old) != 1:
            raise SystemExit(f"{name}: {file}.py holds {text.count(old)} times: {old}")
        mutants.append(Mutant(file, text[: text.index(old)].count("\n") + 1, name, text.replace(old, new)))
    return mutants


def killed(mutant: Mutant, copy_of: Path) -> bool:
    """Whether a test fails in the copy of the package with the mutant in place."""
    target = copy_of / FOLDER / f"{mutant.file}.py"
    original = target.read_text("utf-8")
    target.write_text(mutant.text, "utf-8")
    name = mutant.file.replace("_", "-")
    contract = [
        "tests/contracts/test_optimizers.py",
        "-k",
        f"test_contract and {name} or test_every_reading and {name}",
    ]
    try:
        own = [f"tests/optimization/test_{part}.py" for part in ("equations", mutant.file)]
        first = [test for test in own if (copy_of / test).exists()]
        return any(_fails(copy_of, tests) for tests in (first, ["tests/optimization"], contract))
    finally:
        target.write_text(original, "utf-8")


def _fails(folder: Path, tests: list[str]) -> bool:
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-x",
        "-q",
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
        "-W",
        "ignore",
        *tests,
    ]
    environment = {
        **os.environ,
        "PYTHONPATH": str(folder),
        "PYTHONDONTWRITEBYTECODE": "1",
        "OPENBLAS_NUM_THREADS": "1",
    }
    try:
        done = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        return True
    return done.returncode not in (0, 5)


def main() -> int:
    """Run all mutants; the number of survivors is what counts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("count", nargs="?", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    survivors = []
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        for name in ("accelcal_cli", "configs", "tests"):
            shutil.copytree(ROOT / name, work / name, ignore=shutil.ignore_patterns("__pycache__"))
        shutil.copy(ROOT / "pyproject.toml", work)
        if _fails(work, ["tests/optimization"]):
            raise SystemExit("the tests fail without any mutant")
        mutants = [*named_mutants(), *random_mutants(options.count, options.seed)]
        for number, mutant in enumerate(mutants, 1):
            dead = killed(mutant, work)
            survivors += [] if dead else [mutant]
            fate = "killed  " if dead else "SURVIVED"
            print(
                f"{number}/{len(mutants)} {fate} {mutant.file}.py:{mutant.line} {mutant.change}", flush=True
            )
    print(f"{len(mutants) - len(survivors)} of {len(mutants)} killed, {len(survivors)} survived")
    return 1 if any(mutant.change in NAMED for mutant in survivors) else 0


if __name__ == "__main__":
    sys.exit(main())
