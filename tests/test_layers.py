"""Who may import whom; the library neither prints nor exits; heavy packages wait until they are used."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import layers
import pytest

import accelcal_cli

ROOT = Path(accelcal_cli.__file__).parent


def test_every_import_goes_downward():
    assert layers.violations(ROOT) == []


def test_every_unit_has_a_layer():
    units = {layers.unit_of(path, ROOT) for path in ROOT.rglob("*.py")}
    assert units - set(layers.FRONT) - set(layers.RANK) == set()
    assert {
        "errors",
        "optimization",
        "sensor",
        "io",
        "calibration",
        "config",
        "views",
        "output",
        "cli",
    } <= units


def test_the_library_neither_prints_nor_exits_nor_shares_random_numbers():
    assert layers.forbidden_calls(ROOT) == []


def test_loading_the_library_loads_nothing_heavy():
    """What the source shows, seen from outside: all modules but the command line, in a fresh interpreter."""
    modules = sorted(
        ".".join((layers.PACKAGE, *path.relative_to(ROOT).with_suffix("").parts))
        for path in ROOT.rglob("*.py")
        if layers.unit_of(path, ROOT) not in (*layers.FRONT, "cli", "output")
        and str(path.relative_to(ROOT)) not in layers.LATE
    )
    script = (
        f"import importlib, sys\nfor name in {modules!r}: importlib.import_module(name.removesuffix('.__init__'))\n"
        f"print([name for name in {[*layers.HEAVY, 'typer', 'rich']!r} if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT.parent)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"


def test_a_calibration_loads_nothing_heavy():
    """Nor does one whose repeated readings tell their scatter: loading scipy would take as long as all the rest."""
    sample = Path(__file__).parents[1] / "docs" / "sample.csv"
    script = (
        "import sys\nfrom accelcal_cli.cli.main import app\n"
        f"app(['calibrate', {str(sample)!r}, '--format', 'json', '-q'], standalone_mode=False)\n"
        f"print([name for name in {layers.HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, cwd=ROOT.parent)
    assert 0 < json.loads(done.stdout)["residual_noise_p"] < 1
    assert done.stderr.splitlines()[-1] == "[]"


def _tree(folder, files):
    for name, text in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return folder


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("optimization/algorithms/pso.py", "from accelcal_cli.sensor.model import ErrorModel"),
        ("optimization/algorithms/pso.py", "from ...sensor.model import ErrorModel"),
        ("optimization/algorithms/pso.py", "from ... import sensor"),
        ("optimization/algorithms/pso.py", "def step():\n    import accelcal_cli.sensor.model"),
        ("sensor/model.py", "from accelcal_cli.optimization.optimizer import OPTIMIZERS"),
        ("sensor/model.py", "from accelcal_cli.calibration import quality"),
        ("arrays.py", "from accelcal_cli.optimization.optimizer import State"),
        ("errors.py", "from accelcal_cli.optimization.problem import Problem"),
        ("config.py", "from accelcal_cli.calibration.result import Calibration"),
        ("config.py", "def load():\n    from accelcal_cli.sensor.simulation import Sensor"),
        ("navigation/ins.py", "from accelcal_cli.views.navigation import table"),
        ("studies/study.py", "from accelcal_cli.navigation import study"),
        ("studies/monte_carlo.py", "from accelcal_cli.output import console"),
        ("output/console.py", "from accelcal_cli.cli.main import app"),
        ("calibration/search.py", "import typer"),
        ("studies/monte_carlo.py", "from rich.progress import Progress"),
        ("calibration/result.py", "import yaml"),
        ("calibration/fit.py", "from accelcal_cli.calibration.assess import assess"),
        ("calibration/fit.py", "def late():\n    from accelcal_cli.calibration.calibrate import calibrate"),
        ("calibration/slices.py", "from accelcal_cli.calibration.fit import Fit"),
        ("calibration/quality.py", "import scipy.stats"),
        ("calibration/quality.py", "from scipy import stats"),
        ("calibration/quality.py", "try:\n    import matplotlib\nexcept ImportError:\n    pass"),
        ("cli/plot.py", "class A:\n    import polars"),
        ("sensor/model.py", "if True:\n    import boule"),
        ("io/reader.py", "from accelcal_cli.io.parquet import ParquetTable"),
        ("io/reader.py", "from accelcal_cli.io import parquet"),
        ("helpers.py", "from accelcal_cli.sensor import model"),
    ],
)
def test_the_rule_sees_a_breach(tmp_path, file, text):
    assert layers.violations(_tree(tmp_path, {file: text})) != []


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("calibration/search.py", "from accelcal_cli import __version__"),
        ("calibration/search.py", "from accelcal_cli.optimization.optimizer import OPTIMIZERS"),
        ("io/parquet.py", "import polars"),
        ("io/reader.py", "def open_table():\n    from accelcal_cli.io.parquet import ParquetTable"),
        ("sensor/model.py", "def normal():\n    import boule"),
        (
            "optimization/algorithms/pso.py",
            "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    import accelcal_cli.sensor",
        ),
        ("studies/monte_carlo.py", "from accelcal_cli.calibration.calibrate import calibrate"),
        ("navigation/ins.py", "from accelcal_cli.sensor.model import ErrorModel"),
        ("cli/calibrate.py", "import typer, rich"),
        ("config.py", "import yaml"),
        ("__init__.py", "from accelcal_cli.calibration.calibrate import calibrate"),
    ],
)
def test_the_rule_lets_the_permitted_pass(tmp_path, file, text):
    assert layers.violations(_tree(tmp_path, {file: text})) == []


def test_the_rule_sees_a_circle(tmp_path):
    files = {
        "config.py": "from accelcal_cli.studies import study",
        "studies/study.py": "def run():\n    from accelcal_cli.config import load",
    }
    assert layers.violations(_tree(tmp_path, files)) != []
    del files["config.py"]
    (tmp_path / "config.py").unlink()
    assert layers.violations(_tree(tmp_path, files)) == []


@pytest.mark.parametrize(
    "text",
    [
        "print(1)",
        "import sys\nsys.exit(1)",
        "raise SystemExit(2)",
        "import sys\nsys.stdout.write('a')",
        "import numpy as np\nnp.random.seed(1)",
        "import numpy as np\nx = np.random.default_rng().normal()",
    ],
)
def test_the_rule_sees_a_forbidden_call(tmp_path, text):
    assert layers.forbidden_calls(_tree(tmp_path / "a", {"calibration/search.py": text})) != []
    assert layers.forbidden_calls(_tree(tmp_path / "b", {"cli/search.py": text})) == []
