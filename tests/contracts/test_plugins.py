"""A package of somebody else adds an optimizer, an exporter and a log format, with no file of this project edited.

`plugin/` is built and installed beside the project, as pip would, and found by its entry points alone.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
SAMPLE = str(ROOT / "docs" / "sample.csv")


def call(site: Path, *arguments: str, folder: Path = ROOT) -> subprocess.CompletedProcess[str]:
    """Run Python with the packages in a folder beside the project."""
    path = os.pathsep.join([str(site), str(ROOT)])
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("PIP_", "PYTEST_"))}
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env=environment | {"PYTHONPATH": path},
        capture_output=True,
        encoding="utf-8",
        check=False,
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The folder that the package is installed into."""
    source, target = tmp_path_factory.mktemp("source") / "plugin", tmp_path_factory.mktemp("site")
    shutil.copytree(HERE / "plugin", source)
    pip = "-m pip install --quiet --no-deps --no-index --no-build-isolation --disable-pip-version-check"
    done = call(target, *pip.split(), "--target", str(target), str(source))
    assert done.returncode == 0, done.stderr
    return target


@pytest.fixture
def altered(site, tmp_path):
    """A function that installs the package with one line of it replaced."""

    def alter(old: str, new: str, module: str = "grey_wolf.py") -> Path:
        copy = tmp_path / "site"
        shutil.copytree(site, copy, ignore=shutil.ignore_patterns("__pycache__"))
        file = copy / "accelcal_grey_wolf" / module
        text = file.read_text("utf-8")
        assert text.count(old) == 1
        file.write_text(text.replace(old, new), "utf-8")
        return copy

    return alter


def accelcal(site: Path, line: str) -> str:
    done = call(site, "-m", "accelcal_cli", *line.split())
    assert done.returncode == 0, done.stderr
    return done.stdout


def contract(site: Path, names: str, kind: str = "optimizers") -> subprocess.CompletedProcess[str]:
    """Run the project's contract tests of these names."""
    file = str(HERE / f"test_{kind}.py")
    return call(site, "-m", "pytest", "-n", "0", "-p", "no:cacheprovider", file, "-k", names)


def test_it_is_listed_with_the_settings_of_its_file(site):
    rows = {row["name"]: row for row in json.loads(accelcal(site, "optimizers --format json"))}
    assert len(rows) > 13
    assert rows["grey-wolf"]["family"] == "swarm"
    assert rows["grey-wolf"]["parameters"] == {"population": 50, "iterations": 500, "reach": 2.0}
    assert "first reach of the pack" in accelcal(site, "optimizers grey-wolf")


@pytest.mark.parametrize(
    "line",
    [
        "benchmark --func sphere --optimizer grey-wolf,pso --runs 2 --evaluations 900 --quiet --format json",
        "compare --optimizer grey-wolf,pso --runs 2 --iterations 20 --quiet --format json",
    ],
)
def test_it_takes_part_in_studies(site, line):
    rows = json.loads(accelcal(site, line))
    assert [row["optimizer"] for row in rows] == ["grey-wolf", "pso"]


def test_all_means_it_too(site):
    line = "benchmark --func sphere --optimizer all --runs 1 --evaluations 600 --quiet --format json"
    assert "grey-wolf" in {row["optimizer"] for row in json.loads(accelcal(site, line))}


def test_it_calibrates_with_the_settings_of_its_file(site):
    line = f"calibrate {SAMPLE} --g 9.80665 --optimizer grey-wolf --iterations 40 --quiet --format json"
    record = json.loads(accelcal(site, line))
    assert record["settings"]["optimizer"] == "grey-wolf"
    assert record["settings"]["parameters"] == {"population": 50, "iterations": 40, "reach": 2.0}


def test_it_keeps_the_contract(site):
    done = contract(site, "grey-wolf")
    assert done.returncode == 0, done.stdout
    assert "skipped" not in done.stdout


def test_the_exporter_is_in_the_help_and_writes_its_file(site, tmp_path):
    shown = accelcal(site, "export --help")
    assert "text" in shown.split("--to", 1)[1].split("--output", 1)[0]
    assert "--digits" in shown
    result = str(tmp_path / "result.yaml")
    accelcal(site, f"calibrate {SAMPLE} --g 9.80665 --optimizer levenberg-marquardt --quiet -o {result}")
    lines = accelcal(site, f"export {result} --to text --digits 4").splitlines()
    assert lines[0].startswith("accelcal ")
    assert [len(line.split()) for line in lines[lines.index("K_a") + 1 :]] == [3, 3, 3, 1, 3]


def test_the_exporter_keeps_the_contract(site):
    done = contract(site, "test_the_contract and text", "exporters")
    assert (done.returncode, "1 passed" in done.stdout) == (0, True), done.stdout


def test_the_log_format_is_found_by_content_and_keeps_the_contract(site, tmp_path):
    force = np.vstack([np.eye(3), -np.eye(3), np.full((2, 3), [[0.6], [-0.6]])]) * 9.81
    rows = np.column_stack([np.arange(8.0), 1.01 * force + 0.1])
    (tmp_path / "log").write_bytes(b"WOLF\0\0\0\0" + rows.astype("<f8").tobytes())
    code = (
        "import sys\nfrom accelcal_cli.io.reader import open_table, Selection\n"
        "table = open_table(sys.argv[1])\n"
        "print(table.source_format, sum(len(b.numbers) for b in table.blocks(Selection((1, 2, 3)))))"
    )
    done = call(site, "-c", code, str(tmp_path / "log"))
    assert done.stdout.split() == ["wolf", "8"], done.stderr
    done = contract(site, "says_what_it_is and wolf", "log_formats")
    assert (done.returncode, "1 passed" in done.stdout) == (0, True), done.stdout


def test_an_exporter_without_its_origin_breaks_the_contract(altered):
    bare = altered("[*self.header(result), ", "[", module="text.py")
    done = contract(bare, "test_the_contract and text", "exporters")
    assert (done.returncode, "AssertionError: no " in done.stdout) == (1, True), done.stdout


def test_without_its_update_it_breaks_the_contract_for_the_right_reason(altered):
    dead = altered("x = sum(np.split(around, 3, axis=2)) / 3.0  # eq. 3.7", "x = state.x")
    done = contract(dead, "grey-wolf and test_contract and reaches and sphere")
    assert (done.returncode, "AssertionError: sphere: best costs" in done.stdout) == (1, True), done.stdout
    done = contract(dead, "grey-wolf and test_contract and worsens and sphere")
    assert (done.returncode, "not one improvement" in done.stdout) == (1, True), done.stdout


def test_a_broken_package_breaks_nothing_that_does_not_use_it(altered):
    broken = altered("import numpy as np", "import a_module_that_is_missing as np")
    line = f"calibrate {SAMPLE} --g 9.80665 --optimizer pso --iterations 5 --quiet --format json"
    assert json.loads(accelcal(broken, line))["settings"]["optimizer"] == "pso"
    line = "benchmark --func sphere --optimizer all --runs 1 --evaluations 600 --quiet --format json"
    assert "pso" in {row["optimizer"] for row in json.loads(accelcal(broken, line))}
    message = (
        'optimizer "grey-wolf" of the installed package accelcal-grey-wolf 0.1, entry point accelcal.optimizers: '
        "accelcal_grey_wolf.grey_wolf:GreyWolf cannot be loaded (ModuleNotFoundError: No module named "
        "'a_module_that_is_missing')\n"
    )
    listed = call(broken, "-m", "accelcal_cli", "optimizers", "--format", "json")
    assert (listed.returncode, listed.stderr) == (0, f"accelcal: {message}")
    assert "pso" in {row["name"] for row in json.loads(listed.stdout)}
    for line in (
        "optimizers grey-wolf",
        "benchmark --optimizer grey-wolf",
        f"calibrate {SAMPLE} --optimizer grey-wolf",
    ):
        done = call(broken, "-m", "accelcal_cli", *line.split())
        assert (done.returncode, done.stdout) == (2, "")
        assert done.stderr.splitlines()[-1].endswith(message.rstrip()), done.stderr
        assert len(done.stderr.splitlines()) == 1
