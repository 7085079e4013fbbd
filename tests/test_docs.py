"""The documentation is true: its commands run and print what it says, and nothing is left out of it.

`python tests/test_docs.py` writes the generated tables and the outputs into the pages anew, with pages as arguments
only into those; `python tests/test_docs.py pictures` draws the pictures of the optimizers anew.
"""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import re
import shlex
import subprocess
import sys
import tempfile
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer.main
import yaml

from accelcal_cli.calibration.result import Calibration, Dop, PoseFit, Sigma, Temperature, Worn
from accelcal_cli.calibration.settings import BoxSettings, Nominal, Settings
from accelcal_cli.cli.main import app, help_text
from accelcal_cli.exporters.base import EXPORTERS
from accelcal_cli.notices import Notice
from accelcal_cli.optimization.optimizer import OPTIMIZERS, PRESETS, preset_parameters
from accelcal_cli.sensor.simulation import Sensor, Spread
from accelcal_cli.sensor.vehicle import VehicleCorrection

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
BLOCK = re.compile(r"^```(\w+)(?: +(\S+))?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
NUMBER = re.compile(r"[-+]?\d[\d,]*\.?\d*(?:e[-+]?\d+)?")
GENERATED = re.compile(
    r"(<!-- (options|keys|parameters|presets|optimizers|exporters): (\S+) -->\n).*?(<!-- end -->)", re.DOTALL
)
SYMBOL = re.compile(r" \((\w+(?:, or \w+)?)\)|(?<=S-curve): (\w)$")
"""The symbol of a setting in its description."""
PICTURE = re.compile(r"^Made by `accelcal (\w+ .*--plot (docs/optimizers/\S+))`\.$", re.MULTILINE)
EQUATION = re.compile(r"(?:\[(\w+)\] )?eq\. ([\d, and]*\d)")
HOW = "run `python tests/test_docs.py` and look at what it changed"


def names_of(pages: list[Path]) -> list[str]:
    return [str(page.relative_to(ROOT)) for page in pages]


# Commands and what they print


@dataclass
class Step:
    """A command of a page and the lines it is said to print."""

    command: str
    expected: list[str]


def steps(block: str) -> list[Step]:
    """Return the commands of a console block: `$ command`, then its output, `...` for lines left out."""
    found: list[Step] = []
    for line in block.splitlines():
        if line.startswith("$ "):
            found.append(Step(line[2:], []))
        else:
            found[-1].expected.append(line.rstrip())
    return found


class Reader:
    """Somebody who follows a page from top to bottom in a folder of their own."""

    def __init__(self, folder: Path) -> None:
        program = folder / ".bin" / "accelcal"
        program.parent.mkdir(parents=True)
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m accelcal_cli "$@"\n')
        program.chmod(0o755)
        (folder / "docs").mkdir()
        for name in ("docs/sample.csv", "data.csv"):
            (folder / name).write_bytes((DOCS / "sample.csv").read_bytes())
        self.folder, self.code = folder, 0
        path = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
        dropped = ("COLUMNS", "NO_COLOR", "FORCE_COLOR")
        self.environment = {k: v for k, v in os.environ.items() if k not in dropped} | {
            "PYTHONPATH": path,
            "PYTHONIOENCODING": "utf-8",
            "PATH": f"{program.parent}{os.pathsep}{os.environ['PATH']}",
        }

    def run(self, command: str) -> list[str]:
        """Return what a command prints on both streams."""
        if command == "echo $?":
            return [str(self.code)]
        self.code, text = self._call(["bash", "-c", command])
        assert "Traceback" not in text, text
        return [line.rstrip() for line in text.splitlines()]

    def python(self, code: str) -> None:
        """Run a Python example."""
        done, text = self._call([sys.executable, "-c", code])
        assert done == 0, text

    def _call(self, arguments: list[str]) -> tuple[int, str]:
        done = subprocess.run(
            arguments,
            cwd=self.folder,
            env=self.environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            encoding="utf-8",
            check=False,
        )
        return done.returncode, done.stdout


def same(shown: str, printed: str) -> bool:
    """Whether two lines agree, but for what the rounding of another processor may change.

    Numbers agree to 1e-4. A search that has not converged, the floor of rounding and the steps of a solver
    depend on the last digits: small costs agree within a factor, evaluations to a tenth.
    """
    if shown == printed:
        return True
    if NUMBER.sub("#", shown).split() != NUMBER.sub("#", printed).split():
        return False
    pairs = zip(NUMBER.findall(shown), NUMBER.findall(printed), strict=True)
    return all(_near(*(float(text.replace(",", "")) for text in pair), shown) for pair in pairs)


def _near(a: float, b: float, line: str) -> bool:
    if min(a, b) > 0 and max(a, b) < 1e-20:
        return abs(math.log10(a / b)) < 3
    if max(abs(a), abs(b)) < 1e-13:
        return True  # rounding, whatever its digits
    if "cost L" in line and min(a, b) > 0 and max(a, b) < 0.01:
        return abs(math.log10(a / b)) < 1.5
    return math.isclose(a, b, rel_tol=0.1 if "evaluations" in line else 1e-4)


def find(expected: list[str], printed: list[str]) -> str | None:
    """Return the first documented line that is not printed where it should be, or None."""
    at, gap = 0, False
    for line in expected:
        if line == "...":
            gap = True
            continue
        candidates = range(at, len(printed)) if gap else range(at, min(at + 1, len(printed)))
        hit = next((k for k in candidates if same(line, printed[k])), None)
        if hit is None:
            return line
        at, gap = hit + 1, False
    return None if gap or at == len(printed) or not expected else printed[at]


def blocks(page: Path) -> Iterator[tuple[str, str, str]]:
    for match in BLOCK.finditer(page.read_text(encoding="utf-8")):
        yield match[1], match[2] or "", match[3]


@pytest.mark.parametrize("name", [n for n in names_of(PAGES) if "accelcal" in (ROOT / n).read_text("utf-8")])
def test_the_commands_of_a_page_do_what_it_says(name, tmp_path):
    reader = Reader(tmp_path)
    for language, file, text in blocks(ROOT / name):
        if file:
            (tmp_path / file).write_text(text, encoding="utf-8")
        elif language == "python":
            reader.python(text)
        elif language == "console":
            _follow(reader, steps(text))


def _follow(reader: Reader, told: list[Step]) -> None:
    for step, then in zip(told, [*told[1:], None], strict=True):
        printed = reader.run(step.command)
        if step.command != "echo $?" and (then is None or then.command != "echo $?"):
            assert reader.code == 0, "\n".join([step.command, *printed])
        wrong = find(step.expected, printed) if step.expected else None
        assert wrong is None, "\n".join([f"$ {step.command}", f"not as told: {wrong}", *printed, HOW])


def test_every_accelcal_line_is_run():
    """A command in a block of another kind would not be tested."""
    for page in PAGES:
        for language, file, text in blocks(page):
            if language != "console" and not file:
                assert not re.search(r"^(\$ )?accelcal ", text, re.MULTILINE), (page, text)


# Generated tables


def option_table(command: str) -> str:
    """Return the arguments and options of a command, one a row."""
    group = typer.main.get_command(app)
    rows = ["| option | default | meaning |", "| --- | --- | --- |"]
    for parameter in group.commands[command].params:  # type: ignore[attr-defined]
        if parameter.name == "help":
            continue
        names = [*parameter.opts, *parameter.secondary_opts]
        argument = parameter.param_type_name == "argument"
        shown = (
            f"`{parameter.name.upper()}`"
            if argument
            else ", ".join(f"`{name}`" for name in sorted(names, key=len))
        )
        default = parameter.show_default if isinstance(parameter.show_default, str) else parameter.default
        if argument and parameter.required:
            default = "required"
        elif isinstance(default, bool):
            default = (
                parameter.opts[0].lstrip("-") if default else "".join(parameter.secondary_opts).lstrip("-")
            )
        elif default is None:
            default = ""
        meaning = help_text(parameter, None, parameter.help)
        rows.append(f"| {shown} | {default} | {_cell(meaning)} |")
    return "\n".join(rows) + "\n"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


CLASSES: dict[str, Any] = {
    "settings": Settings,
    "box": BoxSettings,
    "nominal": Nominal,
    "sensor": Sensor,
    "spread": Spread,
}


def key_table(name: str) -> str:
    """Return the keys of a configuration with default, range and meaning, one a row."""
    cls = CLASSES[name]
    hints = typing.get_type_hints(cls)
    rows = ["| key | default | range | meaning |", "| --- | --- | --- | --- |"]
    for field in dataclasses.fields(cls):
        limits = field.metadata
        meaning = _cell(limits.get("doc", "see below"))
        rows.append(
            f"| `{field.name}` | {_default(field)} | {_range(hints[field.name], limits)} | {meaning} |"
        )
    return "\n".join(rows) + "\n"


def parameter_table(name: str) -> str:
    """Return the settings of an optimizer with symbol, default, range and meaning, one a row."""
    cls = OPTIMIZERS.get(name)
    hints = typing.get_type_hints(cls)
    rows = ["| name | symbol | default | range | meaning |", "| --- | --- | --- | --- | --- |"]
    for field in dataclasses.fields(cls):
        meaning = field.metadata["doc"]
        symbol = SYMBOL.search(meaning)
        if symbol:
            meaning = meaning.replace(symbol[0], "", 1)
        cells = [
            f"`{field.name}`",
            (symbol[1] or symbol[2]) if symbol else "",
            _default(field),
            _range(hints[field.name], field.metadata),
            _cell(meaning),
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def preset_table(name: str) -> str:
    """Return what the presets of an optimizer set, one a row."""
    rows = ["| preset | sets |", "| --- | --- |"]
    for preset in PRESETS:
        stated = preset_parameters(name, preset)
        said = ", ".join(f"`{key}: {list(v) if isinstance(v, tuple) else v}`" for key, v in stated.items())
        rows.append(f"| `{preset}` | {said or 'nothing: the defaults'} |")
    return "\n".join(rows) + "\n"


def optimizer_table(_: str) -> str:
    """Return the optimizers with family, paper and what they are, one a row."""
    rows = ["| name | family | paper | what it is |", "| --- | --- | --- | --- |"]
    for name in OPTIMIZERS.names():
        cls = OPTIMIZERS.get(name)
        summary = (cls.__doc__ or "").splitlines()[0]
        rows.append(f"| [{name}]({name}.md) | {cls.family} | [{cls.paper}] | {_cell(summary)} |")
    return "\n".join(rows) + "\n"


def exporter_table(_: str) -> str:
    """Return the formats of `export` with what they are, their usual suffix and their options, one a row."""
    rows = ["| format | what it is | file | options |", "| --- | --- | --- | --- |"]
    for name in EXPORTERS.names():
        cls = EXPORTERS.get(name)
        taken = ", ".join(f"`--{field.name.replace('_', '-')}`" for field in dataclasses.fields(cls))
        kind = f"`{cls.suffix}`{', binary' if cls.binary else ''}"
        rows.append(f"| `{name}` | {_cell((cls.__doc__ or '').splitlines()[0])} | {kind} | {taken} |")
    return "\n".join(rows) + "\n"


def _default(field: Any) -> str:
    value = field.default
    if value is dataclasses.MISSING or dataclasses.is_dataclass(value):
        return "see below"
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if isinstance(value, tuple):
        return f"`{list(value)}`"
    return f"`{value}`" if value != "" else "not set"


def _range(hint: Any, limits: Any) -> str:
    if typing.get_origin(hint) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(hint))
    words = []
    if limits.get("above") is not None:
        words.append(f"more than {limits['above']:g}")
    if limits.get("low") is not None:
        words.append(f"from {limits['low']:g}")
    if limits.get("high") is not None:
        words.append(f"to {limits['high']:g}")
    return " ".join(words)


TABLES = {
    "options": option_table,
    "keys": key_table,
    "parameters": parameter_table,
    "presets": preset_table,
    "optimizers": optimizer_table,
    "exporters": exporter_table,
}


def generated(page: Path) -> str:
    """Return a page with its generated tables anew."""

    def table(match: re.Match[str]) -> str:
        return f"{match[1]}{TABLES[match[2]](match[3])}{match[4]}"

    return GENERATED.sub(table, page.read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", names_of(PAGES))
def test_the_tables_are_up_to_date(name):
    assert (ROOT / name).read_text(encoding="utf-8") == generated(ROOT / name), HOW


def markers(page: str, kind: str) -> set[str]:
    return {match[3] for match in GENERATED.finditer((DOCS / page).read_text("utf-8")) if match[2] == kind}


def test_every_command_is_documented():
    commands = set(typer.main.get_command(app).commands)  # type: ignore[attr-defined]
    assert markers("reference/commands.md", "options") == commands
    text = (DOCS / "reference" / "commands.md").read_text("utf-8")
    assert commands <= set(re.findall(r"^## accelcal (\S+)$", text, re.MULTILINE))


def test_every_format_is_documented():
    assert markers("reference/exports.md", "exporters") == {"all"}
    text = (DOCS / "reference" / "exports.md").read_text("utf-8")
    headings = re.findall(r"^## (.+)$", text, re.MULTILINE)
    assert set(EXPORTERS.names()) <= {name for heading in headings for name in heading.split(", ")}


def test_every_key_is_documented():
    assert markers("reference/configuration.md", "keys") == {*CLASSES}


def test_every_name_of_the_result_is_documented():
    text = (DOCS / "reference" / "result-file.md").read_text("utf-8")
    before, _, rest = text.partition("Keys of warnings")
    text = (
        before + rest.partition("Each entry of `poses_fit`")[2]
    )  # keys of warnings are tested with the notices
    told = set(re.findall(r"^\| `(\w+)`", text, re.MULTILINE))
    records = (Calibration, Sigma, Dop, PoseFit, Temperature, VehicleCorrection, Worn)
    names = {f.name for cls in records for f in dataclasses.fields(cls)}
    assert told - {f.name for f in dataclasses.fields(Notice)} == names | {"engineering"}


def test_the_schemes_have_the_dilution_that_is_told(tmp_path):
    text = (DOCS / "how-to" / "choose-poses.md").read_text("utf-8")
    rows = re.findall(r"^\| `([\w-]+)` \| (\d+) \| ([\d.]+) \| ([\d.]+) \| ([\d.]+) \|$", text, re.MULTILINE)
    reader = Reader(tmp_path)
    assert len(rows) == 5
    for scheme, count, *told in rows:
        line = (
            f"accelcal simulate --scheme {scheme} --positions {count} | accelcal calibrate - -q --format json"
        )
        dop = json.loads("\n".join(reader.run(line)))["dop"]
        assert [f"{dop[kind]:.2f}" for kind in ("misalignment", "scale", "bias")] == told, scheme


# The page of each optimizer


def optimizer_page(name: str) -> Path:
    return DOCS / "optimizers" / f"{name}.md"


def sources(module: str) -> set[Path]:
    """Return the file of an optimizer and of those it takes parts from."""
    folder = ROOT / "accelcal_cli" / "optimization" / "algorithms"
    text = (folder / f"{module}.py").read_text("utf-8")
    parts = re.findall(r"^from accelcal_cli\.optimization\.algorithms\.(\w+) import", text, re.MULTILINE)
    parts += re.findall(r"^from accelcal_cli\.optimization\.algorithms import (\w+)$", text, re.MULTILINE)
    return {folder / f"{module}.py"}.union(*(sources(part) for part in parts))


@pytest.mark.parametrize("name", OPTIMIZERS.names())
def test_every_optimizer_has_a_page_with_the_equations_of_its_source(name):
    text = optimizer_page(name).read_text("utf-8")
    cls = OPTIMIZERS.get(name)
    assert text.startswith(f"# {name}\n")
    assert f"<!-- parameters: {name} -->" in text
    assert f"<!-- presets: {name} -->" in text
    assert f"[{cls.paper}]" in text
    for file in sources(cls.__module__.rpartition(".")[2]):
        for key, numbers in EQUATION.findall(file.read_text("utf-8")):
            assert not key or f"[{key}]" in text, f"{file.name}: {key}"
            for number in re.findall(r"\d+", numbers):
                assert f"({number})" in text, f"{file.name}: eq. {number}"


@pytest.mark.parametrize("name", OPTIMIZERS.names())
def test_every_optimizer_has_a_picture_and_a_command_that_makes_it(name):
    text = optimizer_page(name).read_text("utf-8")
    ((command, picture),) = PICTURE.findall(text)
    assert re.search(rf"^!\[[^\]]+\]\({re.escape(Path(picture).name)}\)$", text, re.MULTILINE)
    assert 0 < (ROOT / picture).stat().st_size < 60_000
    words = shlex.split(command)
    group = typer.main.get_command(app)
    with group.commands[words[0]].make_context(words[0], words[1:]) as context:  # type: ignore[attr-defined]
        assert context.params["plot"] == picture
        chosen = ",".join(context.params.get("optimizer") or ())
    assert not chosen or name in chosen.split(",")


# Sources, links, the sample


def test_every_citation_is_in_the_bibliography():
    known = set(
        re.findall(r"^\*\*\[(\w+)\]\*\*", (DOCS / "bibliography.md").read_text("utf-8"), re.MULTILINE)
    )
    used = {cls.paper for cls in map(OPTIMIZERS.get, OPTIMIZERS.names())}
    files = [*ROOT.glob("accelcal_cli/**/*.py"), *ROOT.glob("configs/**/*.yaml"), *PAGES]
    for file in files:
        used.update(re.findall(r"\[([a-z]+(?:19|20)\d\d)\]", file.read_text(encoding="utf-8")))
    assert "dpso2014" in used
    assert used - known == set()


def test_every_link_leads_somewhere():
    for page in [*PAGES, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md"]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text(encoding="utf-8")):
            assert "://" in target or (page.parent / target).exists(), f"{page}: {target}"


def test_every_page_is_in_the_index():
    """In the index, or in the index of its folder, which is in the index."""
    listed = set()
    for index in DOCS.rglob("index.md"):
        for target in re.findall(r"\]\(([^):#]+)\)", index.read_text("utf-8")):
            listed.add(str((index.parent / target).resolve().relative_to(DOCS)))
    pages = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")} - {"index.md"}
    assert pages - listed == set()


def sample_command() -> str:
    text = (DOCS / "tutorials" / "first-calibration.md").read_text("utf-8")
    (command,) = re.findall(r"^\$ (accelcal simulate .* -o sample.csv)$", text, re.MULTILINE)
    return command


def test_the_sample_is_what_its_command_makes(tmp_path):
    """To 12 digits: the last ones of a product of matrices may differ from processor to processor."""
    reader = Reader(tmp_path)
    assert reader.run(sample_command()) == ["accelcal: wrote sample.csv"]
    header, made = _rows(tmp_path / "sample.csv")
    shipped_header, shipped = _rows(DOCS / "sample.csv")
    assert header == shipped_header
    np.testing.assert_allclose(made, shipped, rtol=1e-12)


def _rows(path: Path) -> tuple[str, list[list[float]]]:
    header, *rows = path.read_text("utf-8").splitlines()
    return header, [[float(cell) for cell in row.split(",")] for row in rows]


@pytest.mark.parametrize("path", sorted((ROOT / "configs").rglob("*.yaml")), ids=lambda p: p.stem)
def test_every_shipped_configuration_names_its_source(path):
    assert yaml.safe_load(path.read_text("utf-8"))["source"]


# Writing the pages anew


def refresh(page: Path) -> None:
    """Write the generated tables and replace each documented line by the printed one most like it."""
    page.write_text(generated(page), encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        reader = Reader(Path(folder))

        def renew(match: re.Match[str]) -> str:
            if match[2]:
                (Path(folder) / match[2]).write_text(match[3], encoding="utf-8")
            if match[1] != "console":
                return match[0]
            lines = []
            for step in steps(match[3]):
                printed = reader.run(step.command)
                lines += [f"$ {step.command}", *_renewed(step.expected, printed)]
            return "```console\n" + "".join(f"{line}\n" for line in lines) + "```"

        page.write_text(BLOCK.sub(renew, page.read_text(encoding="utf-8")), encoding="utf-8")


def _renewed(expected: list[str], printed: list[str]) -> list[str]:
    if "..." not in expected:
        return printed if expected else []
    lines, at = [], 0
    for line in expected:
        if line == "..." or at >= len(printed):
            lines.append(line)
            continue
        likeness = [difflib.SequenceMatcher(None, line, other).ratio() for other in printed[at:]]
        at += likeness.index(max(likeness))
        lines.append(printed[at])
        at += 1
    return lines


def draw(page: Path) -> None:
    """Run the command of a page's picture, with the files that the page shows."""
    for command, picture in PICTURE.findall(page.read_text(encoding="utf-8")):
        with tempfile.TemporaryDirectory() as folder:
            reader = Reader(Path(folder))
            for _, file, text in blocks(page):
                if file:
                    (Path(folder) / file).write_text(text, encoding="utf-8")
            (Path(folder) / picture).parent.mkdir(exist_ok=True)
            printed = reader.run(f"accelcal {command} --quiet")
            assert reader.code == 0, printed
            (ROOT / picture).write_bytes((Path(folder) / picture).read_bytes())


if __name__ == "__main__":
    wanted = [Path(name).resolve() for name in sys.argv[1:] if name != "pictures"]
    for changed in wanted or PAGES:
        if "pictures" in sys.argv[1:]:
            draw(changed)
        else:
            refresh(changed)
