"""The house stays one in which you find your way: sizes, names, and how many files a command passes through."""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT))

from benchmarks import flow  # noqa: E402

FILES, LINES = 199, 600
"""135 files when the house was built; then came what makes a verdict true (attitudes, consensus, covariance, residuals,
screening, weights, ...), the texts that devices write (clock, lines, vocabulary, ...), their native logs, one format
a file (formats/), the running times of benchmarks (runtimes, profiles, bbob, peers),
navigation with records (files of maps, noise, the interface of filters, a bank, baselines), fleets in blocks that are
kept and sent (fleets/), and what shows a result or a capture (pictures in SVG, certificate, comparison, live page)."""

FLOW = {
    # files and pairs of files; 61 and 101 in the first version, 36 and 61 in the new house
    "calibrate": (42, 76),  # 36 and 61; results print themselves, and the library takes what commands take
    "detect": (42, 59),  # 58 and 89; 35 and 52
    "fleet": (45, 74),  # 56 and 69; 34 and 46; then blocks that are kept and sent, and a bar of progress
    "benchmark": (28, 68),  # 59 and 64; 26 and 59, before hits, running times and instances
}
RETURNS = 155
"""How often the readings may come back to a file that they had left, between `calibrate` and the record, all branches
followed as `benchmarks.flow.walk` does it; 72 in the first version, 63 in the new house, before noise, agreement and
weights were told from the readings. The walk follows whatever is computed from them, down to a single weight."""


@pytest.fixture(scope="module")
def whole():
    return flow.size(ROOT)


@pytest.fixture(scope="module")
def flows():
    return flow.flows(ROOT)


def test_there_are_few_files(whole):
    assert whole.files <= FILES


def test_no_file_is_long(whole):
    assert [(name, lines) for name, lines in whole.longest if lines > LINES] == []


def test_no_function_is_long(whole):
    assert whole.bodies == []


def test_no_two_classes_have_one_name():
    names = Counter(
        node.name
        for path in (ROOT / "accelcal_cli").rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.ClassDef)
    )
    assert [name for name, count in names.items() if count > 1] == []


@pytest.mark.parametrize("name", FLOW)
def test_a_command_passes_through_few_files(flows, name):
    files, pairs = FLOW[name]
    assert len(flows[name].files) <= files, flows[name].files
    assert len(flows[name].pairs) <= pairs, flows[name].pairs


def test_a_benchmark_needs_no_readings(flows):
    assert flows["benchmark"].readers == []


def test_the_readings_go_one_way():
    assert flow.walk(ROOT).returns <= RETURNS


def test_the_measure_sees_a_detour(tmp_path):
    """The way through three files and back is counted as it is."""
    for name, text in {
        "calibration/calibrate.py": """
            from accelcal_cli.calibration.fit import fit, judge
            def calibrate(readings, settings):
                solution = search(readings)
                return judge(fit(solution))
            def search(readings):
                return readings
        """,
        "calibration/fit.py": """
            from accelcal_cli.sensor.model import force
            def fit(solution):
                return force(solution)
            def judge(fitted):
                return fitted
        """,
        "sensor/model.py": """
            def force(x):
                return x
        """,
    }.items():
        path = tmp_path / "accelcal_cli" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = text.splitlines()
        path.write_text("\n".join(line[12:] for line in lines))
    way = flow.walk(tmp_path)
    assert way.stays == [
        "calibration/calibrate.py",
        "calibration/fit.py",
        "sensor/model.py",
        "calibration/fit.py",
    ]
    assert (way.files, way.returns) == (3, 1)
