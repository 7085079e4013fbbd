"""The wheel is whole: installed without a checkout, in another folder, it simulates and calibrates."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import accelcal_cli

ROOT = Path(__file__).parents[1]


def run(*command: str | Path, folder: Path, path: Path | None = None) -> str:
    """Run a program in a folder with one more place to import from; pip's own variables do not reach it."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PIP_", "PYTHONPATH"))}
    environment = kept if path is None else {**kept, "PYTHONPATH": str(path)}
    done = subprocess.run(
        list(map(str, command)),
        cwd=folder,
        env=environment,
        capture_output=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", folder, folder=ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel, tmp_path_factory) -> Path:
    """The wheel alone in a folder of its own; the dependencies are those of this environment."""
    site = tmp_path_factory.mktemp("site")
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index")
    run(*pip, "--disable-pip-version-check", "--target", site, wheel, folder=site)
    return site


def test_the_wheel_holds_the_configurations(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    shipped = {f"accelcal_cli/{path.relative_to(ROOT)}" for path in (ROOT / "configs").rglob("*.yaml")}
    assert shipped
    assert shipped <= set(names)
    assert "accelcal_cli/py.typed" in names
    assert "accelcal_cli/output/templates/report.html.jinja" in names
    page = {
        f"accelcal_cli/output/page/{name}"
        for name in ("index.html", "page.css", "page.js", "picture.js", "icon.svg")
    }
    assert page <= set(names)
    assert not [name for name in names if name.startswith(("tests", "docs", "configs", "benchmarks"))]


def test_an_installed_accelcal_needs_no_checkout(installed, tmp_path):
    accelcal = installed / "bin" / "accelcal"
    where = "import accelcal_cli; print(accelcal_cli.__file__)"
    assert run(sys.executable, "-c", where, folder=tmp_path, path=installed).startswith(str(installed))
    version = run(accelcal, "--version", folder=tmp_path, path=installed)
    assert version == f"accelcal {accelcal_cli.__version__}\n"
    run(accelcal, "simulate", "--sensor", "mems", "-o", "data.csv", folder=tmp_path, path=installed)
    arguments = ("calibrate", "data.csv", "--optimizer", "de", "--format", "json", "-o", "result.yaml")
    record = json.loads(run(accelcal, *arguments, folder=tmp_path, path=installed))
    assert record["verdict"] == "good"
    assert record["settings"]["parameters"]["strategy"] == "rand/1"
    assert (tmp_path / "result.yaml").stat().st_size > 1000
